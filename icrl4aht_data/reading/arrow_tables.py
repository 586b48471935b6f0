"""Arrow tables of the index and the episodes, used for Parquet files and Hugging Face datasets.

In the table of episodes, a row contains one episode with all stored fields. Lists have fixed lengths: `steps` elements,
one per step, and `width` bytes for a state record. Shorter records are padded with zeros, so one table can hold
episodes of all layouts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from icrl4aht_data.format.schema import ACTION_FIELDS, ENCODED, ENTRY_HINTS, FIELDS, TEXTS
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.reading.history import History
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.utils.install_hints import import_optional

if TYPE_CHECKING:
    import pyarrow as pa


EpisodeColumn = tuple[str, *tuple[Literal["steps", "width"], ...]]
"""NumPy dtype of a column's elements, or "str", then the lengths of nested lists in a row, outermost first."""

_NAMES = ("task_id", "track", "split", "layout", "teammate_family", "teammate_kind", "source")

EPISODE_COLUMNS: dict[str, EpisodeColumn] = {
    "history_id": ("int64",),
    "episode": ("int32",),
    **dict.fromkeys(_NAMES, ("str",)),
    "learner": ("int32",),
    "return": ("float32",),
    "rewards": ("float32", "steps"),
    **dict.fromkeys(ACTION_FIELDS, ("int8", "steps")),
    "state": ("uint8", "steps", "width"),
    "episode_end_state": ("uint8", "width"),
}
"""Columns of the table of episodes, in order. Columns named like fields of `Entry` hold the history's values."""


def index_schema() -> pa.Schema:
    """Return the Arrow schema of the index, with one column per field of `Entry`.

    Raises:
        OptionError: if pyarrow is not installed.
    """
    arrow = import_pyarrow()
    types = {float: arrow.float64(), int: arrow.int64(), int | None: arrow.int64()}
    types |= {bool: arrow.bool_(), float | None: arrow.float64(), tuple[int, int, int]: arrow.list_(arrow.int64(), 3)}
    types |= dict.fromkeys((*TEXTS, *(ENTRY_HINTS[name] for name in ENCODED)), arrow.string())
    return arrow.schema([(name, types[hint]) for name, hint in ENTRY_HINTS.items()])


def record_width(layouts: Sequence[Layout]) -> int:
    """Return the number of bytes of the layouts' longest state record."""
    return max(map(record_size, layouts))


def episode_schema(dataset: Selection) -> pa.Schema:
    """Return the Arrow schema of the episodes of a selection with state records.

    Raises:
        OptionError: if pyarrow is not installed.
    """
    arrow = import_pyarrow()
    lengths = {"steps": dataset.info.environment.kept_steps, "width": record_width(dataset.layouts)}
    fields = []
    for name, (dtype, *axes) in EPISODE_COLUMNS.items():
        kind = arrow.string() if dtype == "str" else arrow.from_numpy_dtype(np.dtype(dtype))
        for axis in reversed(axes):
            kind = arrow.list_(kind, lengths[axis])
        fields.append(arrow.field(name, kind))
    return arrow.schema(fields)


def episode_table(history: History, schema: pa.Schema) -> pa.Table:
    """Return an Arrow table with one row for each episode of a history, in order.

    Args:
        history: a history of a release with state records; all of its arrays are read.
        schema: the `episode_schema` of a selection that contains the history.
    """
    arrow, entry = import_pyarrow(), history.entry
    count, steps = entry.episodes, schema.field("state").type.list_size
    width = schema.field("episode_end_state").type.list_size
    values: dict[str, Any] = {"episode": np.arange(count), "rewards": history.read("rewards")}
    values["return"] = values["rewards"].reshape(count, steps).sum(axis=1)
    for name in ACTION_FIELDS:
        values[name] = history.read(name) if entry.has(FIELDS[name]) else None
    for name in ("state", "episode_end_state"):
        records = history.read(name)
        values[name] = np.pad(records, ((0, 0), (0, width - records.shape[-1])))
    columns = []
    for field in schema:
        if field.name in ENTRY_HINTS:
            columns.append(arrow.repeat(arrow.scalar(getattr(entry, field.name), field.type), count))
        elif values[field.name] is None:
            columns.append(arrow.nulls(count, field.type))
        else:
            columns.append(_nested_lists(values[field.name], field.type))
    return arrow.Table.from_arrays(columns, schema=schema)


def _nested_lists(array: np.ndarray, kind: pa.DataType) -> pa.Array:
    """Convert an array to an Arrow array of fixed-size lists or of single values, in order."""
    arrow = import_pyarrow()
    if not arrow.types.is_fixed_size_list(kind):
        return arrow.array(array.reshape(-1).astype(kind.to_pandas_dtype(), copy=False))
    return arrow.FixedSizeListArray.from_arrays(_nested_lists(array, kind.value_type), kind.list_size)


def import_pyarrow() -> Any:
    """Return the module pyarrow.

    Raises:
        OptionError: if pyarrow is not installed; the message names the command that installs it.
    """
    return import_optional("pyarrow", "Parquet")
