"""The files, arrays and index entries of a release: the definitions that reader, writer, verifier and card share.

    meta/info.json          versions, kind, environment, totals
    meta/histories.jsonl    one line per learning history: `Entry`
    meta/tasks.jsonl        one line per task, see `benchmark.tasks`; may be empty in releases of observations
    meta/provenance.json    task_id -> how its histories were made
    meta/chunks/**.npy      for each shard: offset, size, rows, crc32, hash of every chunk
    data/<track>/<layout>/<split>-00000-of-00001.h5
    teammates/<sha256>/     checkpoints of learned teammates, in folders named by the SHA-256 of their weights
    experts/<sha256>/       checkpoints of the egos that the expert actions come from; optional
    MANIFEST.sha256         every file above, in sha256sum's format

A `full` shard has one group per history with the paper's fields (App. D.1) and the state records. A `lite` shard leaves
`obs` out (it is a function of the state) and stacks the histories of equal length in one group, [history, T] arrays. A
shard of `observations` is a `full` one without state records, which files of the published code do not have.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size

FORMAT_VERSION = 4
"""Version of the file format that is written."""

READABLE_VERSIONS = (FORMAT_VERSION,)
"""Versions that are read; others raise `FormatTooOldError` or `FormatTooNewError`."""

MANIFEST = "MANIFEST.sha256"
INFO, HISTORIES, TASKS, PROVENANCE = (
    f"meta/{name}" for name in ("info.json", "histories.jsonl", "tasks.jsonl", "provenance.json")
)

TEAMMATES = "teammates"
"""The folder of learned teammates."""

EXPERTS = "experts"
"""The folder of the egos' checkpoints whose greedy actions are the labels; a release may be without it."""

RELEASE_CARD, CARD_TABLES = "README.md", "card.json"
"""The card, and its tables that are too long for people."""

SOURCE_CARD = "meta/source_card.md"
"""Cards of the releases that a release was combined from, or its own earlier card if this package did not make it."""

PARQUET_INDEX = "index"
"""The folder of the index as Parquet files, `index/<layout>/<split>.parquet`, in a release built for publication."""

PARQUET_EPISODES = "episodes"
"""The folder of the episodes as Parquet files, `episodes/<layout>/<split>-00000-of-00001.parquet`: a copy of the
histories for other tools, in a release built for publication that has state records."""

Kind = Literal["full", "lite", "observations"]
KINDS: tuple[Kind, ...] = ("full", "lite")
"""The kinds of release with state records: those that are generated."""

OBSERVATIONS: Kind = "observations"
"""The kind without state records: observations do not determine the state, so nothing can be replayed or drawn."""

ALL_KINDS: tuple[Kind, ...] = (*KINDS, OBSERVATIONS)

CHUNK_DTYPE = np.dtype([("offset", "<u8"), ("size", "<u4"), ("rows", "<u4"), ("crc32", "<u4"), ("hash", "u1", (16,))])
"""One row of a chunk table: position and size of the stored bytes, how many of the chunk's rows belong to the history
(the last chunk is padded), and checksum and hash of the stored bytes, see `chunks.check_chunk`. The bytes between the
chunks follow in rows with `rows` = 0, so that the table covers every byte of a shard exactly once. Rows are ordered by
history, then by `FIELDS`, then by chunk. In the file a history's chunks are ordered by time, so that a window of steps
is one range of bytes, see `shard_writer.file_order`."""


@dataclass(frozen=True)
class Field:
    """One array of a history.

    Args:
        name: the HDF5 dataset's name.
        dtype: what the reader returns, and what a `full` shard stores (paper, App. D.1).
        compact: what a `lite` shard stores; the writer checks that it is lossless.
        axis: "T" for one row per step, "E" for one row per episode.
        row: content of a row: "scalar", "state" (S bytes) or "obs" (5 x 5 x C bytes). A state or an observation is one
            HDF5 element of array type, so that the shuffle filter groups equal positions over time; h5py shows them as
            (T, S) and (T, 5, 5, C).
        chunk: rows per chunk.
        optional: the kinds of release in which a history may be without it; its index entry says so.
        absent: the kinds of release that never have it.
    """

    name: str
    dtype: str
    compact: str
    axis: Literal["T", "E"]
    row: Literal["scalar", "state", "obs"]
    chunk: int
    optional: tuple[Kind, ...] = ()
    absent: tuple[Kind, ...] = ()

    def element(self, layout: Layout, kind: Kind) -> np.dtype:
        """Return the stored element's dtype: a scalar, the S bytes of a state record, or 5 x 5 x C bytes."""
        if self.row == "scalar":
            return np.dtype(self.compact if kind == "lite" else self.dtype)
        return np.dtype(("u1", (record_size(layout),) if self.row == "state" else layout.obs_shape))

    def held(self, layout: Layout) -> np.dtype:
        """Return the dtype of an element in the memory of samplers: the compact one for every kind of release."""
        return self.element(layout, "lite")


FIELDS: dict[str, Field] = {
    field.name: field
    for field in (
        Field("state", "uint8", "uint8", "T", "state", 1000, absent=(OBSERVATIONS,)),
        Field("actions", "int32", "int8", "T", "scalar", 2000),
        Field("rewards", "float32", "int8", "T", "scalar", 2000),
        Field("dones", "bool", "bool", "T", "scalar", 2000),
        Field("teammate_actions", "int32", "int8", "T", "scalar", 2000, optional=(OBSERVATIONS,)),
        Field("expert_actions", "int32", "int8", "T", "scalar", 2000, optional=ALL_KINDS),
        Field("oracle_actions", "int32", "int8", "T", "scalar", 2000, optional=ALL_KINDS),
        Field("episode_end_state", "uint8", "uint8", "E", "state", 1000, absent=(OBSERVATIONS,)),
        Field("obs", "uint8", "uint8", "T", "obs", 200, absent=("lite",)),
    )
}
"""Every field, in file order. `episode_end_state` is the state after each episode's last kept step."""

ACTION_FIELDS = ("actions", "teammate_actions", "expert_actions", "oracle_actions")


def held_fields(kind: Kind) -> tuple[Field, ...]:
    """Return the fields that batches and converted releases are made of.

    All stored ones, except `obs` where it can be rendered from the state records.
    """
    stored = kind if kind == OBSERVATIONS else "lite"
    return tuple(field for field in FIELDS.values() if stored not in field.absent)


def record_field(kind: Kind) -> Field:
    """Return the field that determines what the ego saw: the state record, or the observation itself."""
    return FIELDS["state" if kind in KINDS else "obs"]


LONGEST = 2**40
"""Every history has fewer steps than this, so that sums of steps fit into 64 bits."""

_NAME_LENGTH = 512  # characters: a name column is as wide as its longest name
_FINITE = 1e15  # sums of numbers below this stay finite

_Int = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
_Row = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Name = Annotated[str, Meta(max_length=_NAME_LENGTH)]
_Number = Annotated[float, Meta(gt=-_FINITE, lt=_FINITE)]


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, gc=False):
    """One line of meta/histories.jsonl: the paper's 14 fields (App. D.3), then ours.

    Args:
        history_id: position of the line in the index.
        task_id: task whose learner made the history, see `benchmark.tasks`.
        env_idx: environment stream within the learner's parallel rollout, or number of a noise history.
        T: number of steps.
        obs_shape: (5, 5, C) of one observation.
        action_dim: number of actions.
        track: "teammate" or "layout".
        split: a name in `facts.SPLITS`.
        layout: the layout's short name.
        teammate_family: "rl" or "H1".."H4".
        teammate_kind: the algorithm's or the heuristic's name.
        h5_group: HDF5 group of the arrays.
        has_teammate_actions: whether the history has `teammate_actions`.
        has_expert_actions: whether the history has `expert_actions`.
        h5_row: row in the group's stacked arrays; None where the group contains this history alone.
        shard: path of the shard in the release.
        seed: the learner's seed; -1 where the task is unknown.
        episodes: number of finished episodes, as many as there are dones.
        score: end + (end - start), see `curve_ends` (paper, App. F.1).
        return_start: mean return of the first episodes.
        return_end: mean return of the last episodes.
        return_mean: mean return of all episodes.
        source: how the history was made: a name in `facts.SOURCES`, or another one.
        expert_return: mean return of 200 episodes of 100 steps of the policy that the expert actions come from, acting
            greedily with the task's teammate, or of a script in `ExpertLabels.episodes`; None where it was not
            measured. All histories of a task agree in this and the next two fields.
        expert_return_sampled: the mean return with sampled actions.
        expert_step: environment steps that the policy was trained for; None where it is unknown, or for a script.
        learner: which of the task's independent learners made the history, from 0.
        has_oracle_actions: whether the release stores `oracle_actions` of the history; see `stored_field`.
    """

    history_id: _Int
    task_id: _Name
    env_idx: _Row
    T: Annotated[int, Meta(gt=0, lt=LONGEST)]
    obs_shape: tuple[int, int, int]
    action_dim: _Int
    track: _Name
    split: _Name
    layout: _Name
    teammate_family: _Name
    teammate_kind: _Name
    h5_group: _Name
    has_teammate_actions: bool
    has_expert_actions: bool
    h5_row: _Row | None
    shard: _Name
    seed: _Int
    episodes: Annotated[int, Meta(gt=0, lt=LONGEST)]
    score: _Number
    return_start: _Number
    return_end: _Number
    return_mean: _Number
    source: _Name = "ppo"
    expert_return: _Number | None = None
    expert_return_sampled: _Number | None = None
    expert_step: _Row | None = None
    learner: _Row = 0
    has_oracle_actions: bool = False

    def stored_fields(self, kind: Kind) -> tuple[Field, ...]:
        """Return the fields that this history's shard stores."""
        return tuple(field for field in FIELDS.values() if kind not in field.absent and self._stores(field))

    def has(self, field: Field) -> bool:
        """Return whether the history has a field that its kind of release may have, see `Field.optional`."""
        return self._stores(self.stored_field(field))

    def stored_field(self, field: Field) -> Field:
        """Return the field that stores a field's values: itself, or `expert_actions` for `oracle_actions`.

        The expert of a noise history is the oracle, so its release may leave out the second copy of its actions.
        """
        same = field.name == "oracle_actions" and self.source == "noise" and not self.has_oracle_actions
        return FIELDS["expert_actions"] if same else field

    def _stores(self, field: Field) -> bool:
        return getattr(self, f"has_{field.name}", True)

    def rows(self, field: Field) -> int:
        """Return the number of rows of a field: T or E."""
        return self.T if field.axis == "T" else self.episodes

    def chunks(self, field: Field) -> int:
        """Return the number of chunks of a field."""
        return -(-self.rows(field) // field.chunk)

    def to_json(self) -> dict[str, Any]:
        """Return the object of the index line."""
        return msgspec.structs.asdict(self) | {"obs_shape": list(self.obs_shape)}


ENTRY_HINTS: dict[str, Any] = get_type_hints(Entry)
"""Type of every field of an index line, without bounds."""

JSON_TYPES: dict[str, set[type]] = {
    name: {
        int: {int},
        str: {str},
        bool: {bool},
        float: {float, int},
        int | None: {int, type(None)},
        float | None: {float, int, type(None)},
        tuple[int, int, int]: {list},
    }[hint]
    for name, hint in ENTRY_HINTS.items()
}
"""The types that a JSON parser may return for each field of an index line."""

_BOUNDED = get_type_hints(Entry, include_extras=True)


def check_value(name: str, value: Any) -> None:
    """Check one field of an index line: its type and bounds, and that names are printable.

    Raises:
        IndexFormatError: names the field.
    """
    try:
        msgspec.convert(value, _BOUNDED[name])
        if isinstance(value, str):
            check_name(value)
    except (msgspec.ValidationError, IndexFormatError) as error:
        raise IndexFormatError(f"field {name!r}: {error}, found {value!r:.200}") from error


def check_name(text: str) -> None:
    """Check that a text can name something.

    Raises:
        IndexFormatError: if it is too long, or has characters that terminals interpret or UTF-8 does not encode.
    """
    if len(text) > _NAME_LENGTH or not text.isprintable():
        raise IndexFormatError(f"expected at most {_NAME_LENGTH} printable characters: {text[:100]!r}")


def episode_ends(steps: int, kept_steps: int) -> np.ndarray:
    """Return bool (steps,): True on the last step of every episode of `kept_steps` steps."""
    return np.arange(steps) % kept_steps == kept_steps - 1


def episode_returns(rewards: np.ndarray, dones: np.ndarray) -> np.ndarray:
    """Return float64 (E,), the sum of rewards (T,) of each episode; `dones` (T,) marks last steps."""
    ends = np.flatnonzero(dones) + 1
    return np.diff(np.concatenate([[0.0], np.cumsum(rewards, dtype=np.float64)[ends - 1]]))


def curve_ends(returns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the first and of the last w = max(5, floor(0.1 N)) of N episodes (paper, App. F.1).

    Args:
        returns: (B, N), episode returns.

    Returns:
        float64 (B,) twice: start and end.
    """
    window = max(5, returns.shape[-1] // 10)
    return returns[..., :window].mean(axis=-1), returns[..., -window:].mean(axis=-1)


def are_labels_weak(expert_return: Any, return_end: Any) -> Any:
    """Return whether the policy behind expert actions earns less than half of what the ego earned at the end.

    Where the end is negative, labels are weak if they earn less than one and a half times it.

    Args:
        expert_return: the policy's greedy return, a number or float64 (N,); None or NaN, which are not weak, where it
            was not measured.
        return_end: mean return of the history's last episodes, of the same shape.

    Returns:
        bool, or bool (N,).
    """
    return False if expert_return is None else expert_return < return_end - abs(return_end) / 2


def stream_score(returns: np.ndarray) -> np.ndarray:
    """Return end + (end - start) of learning curves (B, N), float64 (B,) (paper, App. F.1)."""
    start, end = curve_ends(returns)
    return end + (end - start)
