"""Compare two generated releases bit for bit."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import PROVENANCE
from icrl4aht_data.utils.files import file_hash
from icrl4aht_generation.collection.task_folder import LABELLER_RETURNS, METADATA
from icrl4aht_generation.jobs.job import FAILED
from icrl4aht_generation.learners.resume import TIMING
from icrl4aht_generation.populations.train import POPULATION

_IGNORED = {TIMING, FAILED, LABELLER_RETURNS}
"""Names of files that are not compared, because they have times, tracebacks, or measurements of packed artefacts."""

_TEXT = {".json", ".jsonl", ".md", ".sha256"}


@dataclass
class Comparison:
    """Result of a comparison of two folders.

    Attributes:
        files: number of distinct file paths in the two folders together.
        differences: description of the difference by file.
        xla_threads: recorded numbers of XLA threads that generated each folder; the last bits of results depend on the
            number.
    """

    files: int = 0
    differences: dict[str, str] = field(default_factory=dict)
    xla_threads: tuple[list[int], list[int]] = ([], [])


def compare_rebuilds(a: Path, b: Path) -> Comparison:
    """Compare two folders by the hashes of their files.

    Hidden files, timing.jsonl, failed.jsonl and labeller_returns.json are not compared.

    Raises:
        OptionError: if a path is not a folder, or neither folder has files to compare.
    """
    for folder in (a, b):
        if not folder.is_dir():
            raise OptionError(f"{folder}: no such folder")
    ours, theirs = _files(a), _files(b)
    result = Comparison(len(ours | theirs), xla_threads=(_xla_threads(a, ours), _xla_threads(b, theirs)))
    if not result.files:
        raise OptionError(f"{a} and {b}: no files to compare")
    for name in sorted(ours | theirs):
        if name not in theirs:
            result.differences[name] = f"only in {a}"
        elif name not in ours:
            result.differences[name] = f"only in {b}"
        elif file_hash(a / name) != file_hash(b / name):
            result.differences[name] = _describe_difference(a / name, b / name)
    return result


def _files(root: Path) -> set[str]:
    paths = [path.relative_to(root) for path in root.rglob("*") if path.is_file() and path.name not in _IGNORED]
    return {path.as_posix() for path in paths if not any(part.startswith(".") for part in path.parts)}


def _xla_threads(root: Path, names: set[str]) -> list[int]:
    """Return the numbers of XLA threads in the records of tasks, populations and releases in a folder."""
    records = [root / name for name in names if name.endswith((METADATA, POPULATION, PROVENANCE))]
    found = {number for path in records for number in re.findall(rb'"xla_threads":\s*(\d+)', path.read_bytes())}
    return sorted(map(int, found))


def _describe_difference(a: Path, b: Path) -> str:
    if a.suffix == ".npy":
        with suppress(ValueError):  # one of the files may not be an array
            return _describe_arrays(np.load(a, mmap_mode="r"), np.load(b, mmap_mode="r"))
    ours, theirs = np.fromfile(a, np.uint8), np.fromfile(b, np.uint8)
    common = min(len(ours), len(theirs))
    wrong = np.flatnonzero(ours[:common] != theirs[:common])
    first = int(wrong[0]) if len(wrong) else common
    size = f"{len(ours)} bytes" if len(ours) == len(theirs) else f"{len(ours)} and {len(theirs)} bytes"
    line = f", line {1 + np.count_nonzero(ours[:first] == 10)}" if a.suffix in _TEXT else ""
    return f"{size}, the first difference at byte {first}{line}"


def _describe_arrays(a: np.ndarray, b: np.ndarray) -> str:
    if (a.shape, a.dtype) != (b.shape, b.dtype):
        return f"{a.dtype} {a.shape} and {b.dtype} {b.shape}"
    wrong = np.argwhere(np.asarray(a != b))
    if not len(wrong):
        return "equal arrays, stored differently"
    at = tuple(wrong[0].tolist())
    return f"{len(wrong)} of {a.size} values, the first at {at}: {a[at]} and {b[at]}"
