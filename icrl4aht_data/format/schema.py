"""What a release contains, said once for reader, writer, verifier and card.

    meta/info.json          versions, kind, environment, totals
    meta/histories.jsonl    one line per learning history: `Entry`
    meta/tasks.jsonl        one line per task, see `benchmark.tasks`; may be empty in releases of observations
    meta/provenance.json    task_id -> how its histories were made
    meta/chunks/**.npy      for each shard: offset, size, rows, crc32 of every chunk
    data/<track>/<layout>/<split>-00000-of-00001.h5
    teammates/<sha256>/     checkpoints of learned teammates, named as the tasks name their weights
    MANIFEST.sha256         every file above, in sha256sum's format

A `full` shard has one group per history with the paper's fields (App. D.1) and the state records. A `lite` shard leaves
`obs` out (it is a function of the state) and stacks the histories of equal length in one group, [history, T] arrays. A
shard of `observations` is a `full` one without state records, which the published code's files do not have.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np

from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import record_size

FORMAT_VERSION = 2
"""Of the files' layout. A reader takes exactly this one; see `FormatTooOldError` and `FormatTooNewError`."""

MANIFEST = "MANIFEST.sha256"
INFO, HISTORIES, TASKS, PROVENANCE = (
    f"meta/{name}" for name in ("info.json", "histories.jsonl", "tasks.jsonl", "provenance.json")
)

TEAMMATES = "teammates"
"""The folder of learned teammates."""

Kind = Literal["full", "lite", "observations"]
KINDS: tuple[Kind, ...] = ("full", "lite")
"""The kinds that have state records: those that are generated."""

OBSERVATIONS: Kind = "observations"
"""The kind that has none: observations do not determine the state, so nothing can be replayed or drawn."""

ALL_KINDS: tuple[Kind, ...] = (*KINDS, OBSERVATIONS)

CHUNK_DTYPE = np.dtype([("offset", "<u8"), ("size", "<u4"), ("rows", "<u4"), ("crc32", "<u4")])
"""One line of a chunk table: where the stored bytes are, how many of the chunk's rows are the history's (the last chunk
is padded), and the checksum of the stored bytes. What lies between the chunks follows in lines of 0 rows, so that every
byte of a shard stands in its table once. Chunks stand in the order of histories, then of `FIELDS`, then of
chunks. In the file a history's chunks stand by time, so that a window is one range of bytes, see `shard_writer`."""


@dataclass(frozen=True)
class Field:
    """One array of a history.

    Args:
        name: the HDF5 dataset's name.
        dtype: what the reader presents, and what a `full` shard stores (paper, App. D.1).
        compact: what a `lite` shard stores; the writer checks that it is lossless.
        axis: "T" for one row a step, "E" for one row an episode.
        row: what a row is: "scalar", "state" (S bytes) or "obs" (5 x 5 x C bytes). The latter two are one HDF5 element
            each, of array type, so that the shuffle filter groups what lies at one place in time; h5py gives them as
            (T, S) and (T, 5, 5, C).
        chunk: rows per chunk.
        optional: the kinds of release in which a history may lack it; its index entry says so.
        absent: the kinds of release that do not have it.
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
        """The stored element: a scalar, the S bytes of a state record, or the 5 x 5 x C of an observation."""
        if self.row == "scalar":
            return np.dtype(self.compact if kind == "lite" else self.dtype)
        return np.dtype(("u1", (record_size(layout),) if self.row == "state" else layout.obs_shape))

    def held(self, layout: Layout) -> np.dtype:
        """The element as samplers hold it: compact, whatever the release."""
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
        Field("episode_end_state", "uint8", "uint8", "E", "state", 1000, absent=(OBSERVATIONS,)),
        Field("obs", "uint8", "uint8", "T", "obs", 200, absent=("lite",)),
    )
}
"""Every field, in file order. `episode_end_state` is the state after each episode's last kept step."""

ACTION_FIELDS = ("actions", "teammate_actions", "expert_actions")


def held_fields(kind: Kind) -> tuple[Field, ...]:
    """What batches and other releases are made of: every stored field, but `obs` only where no state shows it."""
    stored = kind if kind == OBSERVATIONS else "lite"
    return tuple(field for field in FIELDS.values() if stored not in field.absent)


LONGEST = 2**40
"""No history has as many steps, so that sums of steps fit into 64 bits."""


def record_field(kind: Kind) -> Field:
    """The field that is held of each step to show what the ego saw: the state record, or the observation itself."""
    return FIELDS["state" if kind in KINDS else "obs"]


@dataclass(frozen=True)
class Entry:
    """One line of meta/histories.jsonl: the paper's 14 fields (App. D.3), then ours."""

    history_id: int
    task_id: str
    env_idx: int  # environment stream within the learner's parallel roll-out
    T: int
    obs_shape: tuple[int, int, int]
    action_dim: int
    track: str
    split: str
    layout: str
    teammate_family: str  # rl, H1..H4
    teammate_kind: str  # the algorithm or the heuristic's name
    h5_group: str
    has_teammate_actions: bool
    has_expert_actions: bool
    h5_row: int | None  # row in the group's stacked arrays; null where the group holds this history alone
    shard: str  # path below the release's root
    seed: int  # of the learner; -1 where the task was not given
    episodes: int  # that ended: as many as there are dones
    score: float  # end + (end - start), see `curve_ends` (paper, App. F.1)
    return_start: float  # mean return of the first episodes
    return_end: float  # mean return of the last episodes
    return_mean: float

    def stored_fields(self, kind: Kind) -> tuple[Field, ...]:
        """The fields that this history's shard stores."""
        return tuple(field for field in FIELDS.values() if kind not in field.absent and self.has(field))

    def has(self, field: Field) -> bool:
        """Whether the history has a field that its kind of release has; see `Field.optional`."""
        return getattr(self, f"has_{field.name}", True)

    def rows(self, field: Field) -> int:
        return self.T if field.axis == "T" else self.episodes

    def chunks(self, field: Field) -> int:
        return -(-self.rows(field) // field.chunk)

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"obs_shape": list(self.obs_shape)}

    @classmethod
    def from_json(cls, line: Any) -> Entry:
        """Checks names and types; unknown fields are errors.

        Raises:
            IndexFormatError: without file and line, which the caller adds.
        """
        if not isinstance(line, dict):
            raise IndexFormatError(f"expected an object, found {type(line).__name__}")
        missing, extra = JSON_TYPES.keys() - line.keys(), line.keys() - JSON_TYPES.keys()
        if missing or extra:
            raise IndexFormatError(f"missing fields {sorted(missing)}, unknown fields {sorted(extra)}")
        for name in JSON_TYPES:
            check_value(name, line[name])
        shape = line["obs_shape"]
        if len(shape) != 3 or not all(isinstance(n, int) for n in shape):
            raise IndexFormatError(f"field 'obs_shape': expected three integers, found {shape!r}")
        if line["T"] <= 0 or line["episodes"] <= 0:
            raise IndexFormatError(f"T = {line['T']} and episodes = {line['episodes']}: expected positive numbers")
        if line["T"] >= LONGEST:
            raise IndexFormatError(f"T = {line['T']}: expected less than {LONGEST}")
        values: dict[str, Any] = {**line, "obs_shape": tuple(shape)}
        return cls(**values)


JSON_TYPES: dict[str, set[type]] = {
    field.name: {
        "int": {int},
        "str": {str},
        "bool": {bool},
        "float": {float, int},
        "int | None": {int, type(None)},
        "tuple[int, int, int]": {list},
    }[str(field.type)]
    for field in fields(Entry)
}
"""The types that a JSON parser may give for each field of an index line."""

_NAME = 512  # characters: names are stored side by side, each as wide as the longest
FINITE = 1e15
"""What numbers of the index stay below: neither infinite nor anything that a sum would make so."""


def is_name(text: str) -> bool:
    """Whether a text may name something: short, and without what a terminal or UTF-8 takes otherwise."""
    return len(text) <= _NAME and text.isprintable()


def check_value(name: str, value: Any) -> None:
    """Whether a field of an index line has its type, and a value that can be stored.

    Raises:
        IndexFormatError: names the field.
    """
    types = JSON_TYPES[name]
    if type(value) not in types:
        expected = " or ".join(sorted(t.__name__ for t in types))
        raise IndexFormatError(f"field {name!r}: expected {expected}, found {value!r:.200}")
    if type(value) is int and not -(2**63) <= value < 2**63:
        raise IndexFormatError(f"field {name!r}: expected at most 64 bits, found {value}")
    if types == {float, int} and not abs(value) < FINITE:
        raise IndexFormatError(f"field {name!r}: expected a number below {FINITE:g}, found {value}")
    if type(value) is str and not is_name(value):
        raise IndexFormatError(f"field {name!r}: expected at most {_NAME} printable characters, found {value[:100]!r}")


def episode_ends(steps: int, kept_steps: int) -> np.ndarray:
    """bool (steps,): the last step of every episode of `kept_steps` steps."""
    return np.arange(steps) % kept_steps == kept_steps - 1


def episode_returns(rewards: np.ndarray, dones: np.ndarray) -> np.ndarray:
    """float64 (E,): the sum of rewards (T,) of each episode; `dones` (T,) marks last steps."""
    ends = np.flatnonzero(dones) + 1
    return np.diff(np.concatenate([[0.0], np.cumsum(rewards, dtype=np.float64)[ends - 1]]))


def curve_ends(returns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean return over the first and over the last w = max(5, floor(0.1 N)) of N episodes (paper, App. F.1).

    Args:
        returns: (B, N), episode returns.

    Returns:
        float64 (B,) twice: start and end.
    """
    window = max(5, returns.shape[-1] // 10)
    return returns[..., :window].mean(axis=-1), returns[..., -window:].mean(axis=-1)


def stream_score(returns: np.ndarray) -> np.ndarray:
    """float64 (B,): end + (end - start) of learning curves (B, N) (paper, App. F.1)."""
    start, end = curve_ends(returns)
    return end + (end - start)
