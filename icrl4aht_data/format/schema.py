"""Definitions of the files, arrays and index entries of a release, shared by reader, writer, verifier and card.

    meta/info.json          versions, kind, environment, totals
    meta/histories.jsonl    one line per learning history: `Entry`
    meta/tasks.jsonl        one line per task, see `benchmark.tasks`; may be empty in releases of observations
    meta/layouts.jsonl      layouts that the benchmark does not have, see `format.layouts_file`
    meta/provenance.json    for each task id: how the task's histories were made
    meta/chunks/**.npy      for each shard: offset, size, rows, crc32, hash of every chunk
    data/<track>/<layout>/<split>-00000-of-00001.h5
    teammates/<sha256>/     checkpoints of learned teammates, in folders named by the SHA-256 of their weights
    experts/<sha256>/       checkpoints of the egos that chose the expert actions; optional
    MANIFEST.sha256         hashes of all files above, in sha256sum's format

A `full` shard has one group per history with the paper's fields (App. D.1) and the state records. A `lite` shard does
not store `obs`, a function of the state, and has one group of [history, T] arrays for all histories of equal length. A
shard of `observations` is a `full` shard without state records, since files of the published code do not have them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size

FORMAT_VERSION = 5
"""Format version that this package writes."""

READABLE_VERSIONS = (4, FORMAT_VERSION)
"""Format versions that this package reads; other versions raise `FormatTooOldError` or `FormatTooNewError`."""

MANIFEST = "MANIFEST.sha256"
INFO, HISTORIES = "meta/info.json", "meta/histories.jsonl"
TASKS, PROVENANCE = "meta/tasks.jsonl", "meta/provenance.json"

LAYOUTS_FILE = "meta/layouts.jsonl"
"""Path of the layouts stored in a release, see `layouts_file`; absent if the benchmark has all of its layouts."""

INDEX_FILES = (INFO, HISTORIES, TASKS, PROVENANCE, LAYOUTS_FILE)
"""Files that are read when a release is opened."""

TEAMMATES = "teammates"
"""Folder of the checkpoints of learned teammates."""

EXPERTS = "experts"
"""Folder of the checkpoints of experts; their greedy actions are the expert actions. The folder is optional."""

RELEASE_CARD, CARD_TABLES = "README.md", "card.json"
"""Paths of the dataset card and of the card's long tables in a release."""

PARQUET_INDEX = "index"
"""Folder of the index as Parquet files, `index/<layout>/<split>.parquet`, in a release built for publication."""

PARQUET_EPISODES = "episodes"
"""Folder of the episodes as Parquet files, `episodes/<layout>/<split>-00000-of-00001.parquet`, a copy of the histories
for other tools; only in a release with state records that is built for publication."""

Kind = Literal["full", "lite", "observations"]
KINDS: tuple[Kind, ...] = ("full", "lite")
"""Kinds of release with state records."""

OBSERVATIONS: Kind = "observations"
"""Kind of release without state records; its steps can be neither replayed nor drawn as pictures."""

ALL_KINDS: tuple[Kind, ...] = (*KINDS, OBSERVATIONS)

CHUNK_DTYPE = np.dtype([("offset", "<u8"), ("size", "<u4"), ("rows", "<u4"), ("crc32", "<u4"), ("hash", "u1", (16,))])
"""Row of a chunk table: offset and size of the stored bytes, number of rows that belong to the history (the last chunk
is padded), CRC-32 and hash of the stored bytes, see `chunks.check_chunk`. Table rows are ordered by history, field and
chunk. Table rows for the HDF5 metadata between the chunks follow, with `rows` = 0, so the table covers every byte of
the shard once. In the shard, the chunks of a history are ordered by time, so a window of steps is one byte range, see
`shard_writer.chunk_sort_key`."""


@dataclass(frozen=True)
class Field:
    """One array of a history.

    Args:
        name: the HDF5 dataset's name.
        dtype: dtype that the reader returns and a `full` shard stores (paper, App. D.1).
        compact: dtype that a `lite` shard stores; the writer checks that the conversion is lossless.
        axis: "T" for one row per step, "E" for one row per episode.
        row: content of a row: "scalar", "state" (S bytes) or "obs" (5 x 5 x C bytes). A state or an observation is one
            HDF5 element of array type, so the shuffle filter groups equal positions over time; in h5py the arrays have
            shapes (T, S) and (T, 5, 5, C).
        chunk: number of rows per chunk.
        optional: kinds of release in which histories may be without the field; the index entry says whether they are.
        absent: kinds of release that never contain the field.
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
        """Return the dtype of a stored element: a scalar, a state of shape (S,) or an `obs` of shape (5, 5, C)."""
        if self.row == "scalar":
            return np.dtype(self.compact if kind == "lite" else self.dtype)
        return np.dtype(("u1", (record_size(layout),) if self.row == "state" else layout.obs_shape))

    def memory_dtype(self, layout: Layout) -> np.dtype:
        """Return the dtype of an element in samplers' memory, which equals the dtype in a `lite` shard."""
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
"""All fields by name, in file order. `episode_end_state` is the state after the last stored step of an episode."""

ACTION_FIELDS = ("actions", "teammate_actions", "expert_actions", "oracle_actions")


def memory_fields(kind: Kind) -> tuple[Field, ...]:
    """Return the fields that samplers hold in memory; `obs` only for a kind of release without state records."""
    stored = kind if kind == OBSERVATIONS else "lite"
    return tuple(field for field in FIELDS.values() if stored not in field.absent)


def record_field(kind: Kind) -> Field:
    """Return the field `state`, or the field `obs` for a kind of release without state records."""
    return FIELDS["state" if kind in KINDS else "obs"]


MAX_STEPS = 2**40
"""Upper limit of the number of steps of a history, so that sums of steps fit into 64 bits."""

_NAME_LENGTH = 512  # maximum number of characters
_FINITE = 1e15  # limit of absolute values, which keeps sums of values finite

_Int = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
StoredCount = Annotated[int, Meta(ge=0, le=2**63 - 1)]
StreamCount = Annotated[int, Meta(ge=0, lt=2**31)]
_Name = Annotated[str, Meta(max_length=_NAME_LENGTH)]
_Spans = Annotated[tuple[tuple[StoredCount, _Name], ...], Meta(min_length=1)]
FiniteNumber = Annotated[float, Meta(gt=-_FINITE, lt=_FINITE)]


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, gc=False):
    """One line of meta/histories.jsonl: the paper's 14 fields (App. D.3), then fields that only this project has.

    Args:
        history_id: position of the line in the index, counted from 0.
        task_id: id of the history's task, see `benchmark.tasks`.
        env_idx: index of the stream in the learner's parallel rollout; without a learner, number of the history.
        T: number of steps.
        obs_shape: shape (5, 5, C) of one observation.
        action_dim: number of actions.
        track: "teammate", "layout" or "preference".
        split: a name in `facts.SPLITS`.
        layout: the layout's short name.
        teammate_family: "rl" or "H1".."H4".
        teammate_kind: the algorithm's or the heuristic's name.
        h5_group: HDF5 group of the arrays.
        has_teammate_actions: whether the history has `teammate_actions`.
        has_expert_actions: whether the history has `expert_actions`.
        h5_row: row of the history in the group's stacked arrays; None if the group contains only this history.
        shard: path of the shard in the release.
        seed: the learner's seed; -1 if the task is unknown.
        episodes: number of finished episodes.
        score: end + (end - start), see `curve_ends` (paper, App. F.1).
        return_start: mean return of the first episodes, see `curve_ends`.
        return_end: mean return of the last episodes, see `curve_ends`.
        return_mean: mean return of all episodes.
        source: how the history was made: "ppo" (an ego learned), "noise" (a script played, and its random actions
            became rarer), "agent" (a trained agent played), "search" (a script found out which dish earns a reward),
            "human" (a person played), or another name.
        expert_return: mean return of the expert's greedy actions with the task's teammate, over 200 episodes of 100
            steps (for a script, over `ExpertLabels.episodes`); None if not measured. Equal for all histories of a task.
        expert_return_sampled: mean return of the expert's sampled actions.
        expert_step: number of environment steps that the expert was trained for; None for a script or if unknown.
        learner: number of the independent learner that made the history; `learner` and `env_idx` identify a stream.
        has_oracle_actions: whether the release stores `oracle_actions` of the history; see `stored_field`.
        label_view: input of the policy that chose `expert_actions`: "ego" (the ego's observation) or "state" (the full
            state, but without the wanted dish for source "search"); None if unknown.
        teammate_of_episode: pairs (episode, id), ascending: the teammate with this `tasks.teammate_id` played from this
            episode until the episode of the next pair. None if the task's teammate played all episodes.
    """

    history_id: _Int
    task_id: _Name
    env_idx: StoredCount
    T: Annotated[int, Meta(gt=0, lt=MAX_STEPS)]
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
    h5_row: StoredCount | None
    shard: _Name
    seed: _Int
    episodes: Annotated[int, Meta(gt=0, lt=MAX_STEPS)]
    score: FiniteNumber
    return_start: FiniteNumber
    return_end: FiniteNumber
    return_mean: FiniteNumber
    source: _Name = "ppo"
    expert_return: FiniteNumber | None = None
    expert_return_sampled: FiniteNumber | None = None
    expert_step: StoredCount | None = None
    learner: StoredCount = 0
    has_oracle_actions: bool = False
    label_view: _Name | None = None
    teammate_of_episode: _Spans | None = None

    def stored_fields(self, kind: Kind) -> tuple[Field, ...]:
        """Return the fields that a release of the given kind stores for this history."""
        return tuple(field for field in FIELDS.values() if kind not in field.absent and self._has_stored(field))

    def has(self, field: Field) -> bool:
        """Return whether the history has this field; always True for fields that are not `optional`."""
        return self._has_stored(self.stored_field(field))

    def stored_field(self, field: Field) -> Field:
        """Return the field whose stored array has the values of the given field; usually this is the given field.

        In histories of source "noise" the expert is the oracle, so `oracle_actions` may be stored only as
        `expert_actions`.
        """
        same = field.name == "oracle_actions" and self.source == "noise" and not self.has_oracle_actions
        return FIELDS["expert_actions"] if same else field

    def _has_stored(self, field: Field) -> bool:
        return getattr(self, f"has_{field.name}", True)

    def rows(self, field: Field) -> int:
        """Return the number of rows of a field, which is the number of steps or of episodes."""
        return self.T if field.axis == "T" else self.episodes

    def chunks(self, field: Field) -> int:
        """Return the number of chunks in which a field of this history is stored."""
        return -(-self.rows(field) // field.chunk)

    def to_json(self) -> dict[str, Any]:
        """Return this entry as a JSON object without fields that are None, except `h5_row`, which has no default."""
        content = json.loads(msgspec.json.encode(self))
        return {name: value for name, value in content.items() if value is not None or name == "h5_row"}

    def to_row(self) -> dict[str, Any]:
        """Return the fields of this entry as a row of a table, with `teammate_of_episode` as JSON text."""
        texts = {name: as_json(getattr(self, name)) for name in ENCODED}
        return msgspec.structs.asdict(self) | {"obs_shape": list(self.obs_shape)} | texts


ENTRY_HINTS: dict[str, Any] = get_type_hints(Entry)
"""Types of the fields of an index line by name, without bounds."""

TEXTS = (str, str | None)
"""Types of text fields in `ENTRY_HINTS`."""

ENCODED = tuple(name for name, hint in ENTRY_HINTS.items() if hint == tuple[tuple[int, str], ...] | None)
"""Fields that columns and tables store as JSON text."""


def as_json(value: Any) -> str | None:
    """Return the value of a field in `ENCODED` as JSON text; None stays None."""
    return None if value is None else json.dumps(value)


def check_name(text: str) -> None:
    """Check that a name is short and printable.

    Raises:
        IndexFormatError: if the name is too long, or has control characters or characters that UTF-8 cannot encode.
    """
    if len(text) > _NAME_LENGTH or not text.isprintable():
        raise IndexFormatError(f"expected at most {_NAME_LENGTH} printable characters, found {text[:100]!r}")


def episode_ends(steps: int, kept_steps: int) -> np.ndarray:
    """Return a mask of shape (steps,), True for the last step of each episode of `kept_steps` steps."""
    return np.arange(steps) % kept_steps == kept_steps - 1


def episode_returns(rewards: np.ndarray, dones: np.ndarray) -> np.ndarray:
    """Return each episode's sum of rewards, float64 of shape (E,), from `rewards` and `dones` of shape (T,)."""
    ends = np.flatnonzero(dones) + 1
    return np.diff(np.concatenate([[0.0], np.cumsum(rewards, dtype=np.float64)[ends - 1]]))


def curve_ends(returns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean returns of the first and the last w = max(5, floor(0.1 N)) of N episodes (paper, App. F.1).

    With fewer than 10 episodes, which does not occur in the paper, w is half of N, but at least 1.

    Args:
        returns: returns of the episodes in order, of shape (B, N) or (N,).

    Returns:
        The mean return at the start and the mean return at the end, each float64 of shape (B,) or ().
    """
    episodes = returns.shape[-1]
    window = max(1, min(max(5, episodes // 10), episodes // 2))
    return returns[..., :window].mean(axis=-1), returns[..., -window:].mean(axis=-1)


def curve_fields(returns: np.ndarray) -> dict[str, float]:
    """Return the fields of an index line that summarize a learning curve: `return_start`, `return_end`, .., `score`.

    Args:
        returns: returns of the history's episodes in order, of shape (N,).
    """
    start, end = curve_ends(returns)
    fields = {"return_start": start, "return_end": end, "return_mean": returns.mean(), "score": stream_score(returns)}
    return {name: float(value) for name, value in fields.items()}


def are_labels_weak(expert_return: Any, return_end: Any) -> Any:
    """Return whether an expert earns less than half of the ego's return at the end of the history.

    If the ego's return is negative, the limit is 1.5 times the ego's return.

    Args:
        expert_return: the expert's greedy return, a number or float64 (N,); None or NaN (not measured) gives False.
        return_end: mean return of the history's last episodes, a number or float64 (N,).

    Returns:
        True or False for each expert: bool, or bool (N,).
    """
    return False if expert_return is None else expert_return < return_end - abs(return_end) / 2


def stream_score(returns: np.ndarray) -> np.ndarray:
    """Return the score end + (end - start) of each learning curve (paper, App. F.1).

    Args:
        returns: returns of the episodes in order, of shape (B, N) or (N,).

    Returns:
        float64 of shape (B,) or ().
    """
    start, end = curve_ends(returns)
    return end + (end - start)
