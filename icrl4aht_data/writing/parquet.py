"""The index as a Parquet file."""

from __future__ import annotations

from pathlib import Path

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import ENTRY_HINTS
from icrl4aht_data.utils.files import atomic_write


def to_parquet(dataset: Dataset, path: Path) -> Path:
    """Write the selection's index as a Parquet file, one row per history. Needs pyarrow, of the extra `hf`.

    Raises:
        OptionError: if pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise OptionError("Parquet needs pyarrow: pip install 'icrl4aht-data[hf]'") from error
    types = {float: pa.float64(), int: pa.int64(), int | None: pa.int64(), str: pa.string(), bool: pa.bool_()}
    types |= {float | None: pa.float64(), tuple[int, int, int]: pa.list_(pa.int64())}
    schema = pa.schema([(name, types[hint]) for name, hint in ENTRY_HINTS.items()])
    rows = pa.Table.from_pylist([entry.to_json() for entry in dataset.entries], schema)
    with atomic_write(path) as partial:
        pq.write_table(rows, partial)
    return path
