"""Releases to inject faults into, and the checks that every family of faults shares."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

import numpy as np

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.download import fetch_planned, plan_download
from icrl4aht_data.format.schema import held_fields
from tests.helpers.damages import contents
from tests.helpers.random_releases import random_release
from tests.servers.process import environment

Attempt = Callable[[], str | None]
"""Injects one fault. Raises LostError if data or progress is lost; may return a remark, which is counted."""


class LostError(Exception):
    """A fault led to wrong data, to an error without a file's name, or to repeated work."""


def check(condition: object, message: str) -> None:
    """Raise LostError unless a condition holds."""
    if not condition:
        raise LostError(message)


class Workspace:
    """Releases of random play, empty folders, and random numbers.

    Args:
        folder: an empty folder.
        seed: seed of the random numbers.
    """

    def __init__(self, folder: Path, seed: int = 0) -> None:
        self.folder, self.rng = folder, np.random.default_rng(seed)
        self._numbers = itertools.count()

    @cached_property
    def release(self) -> Path:
        """A release of some hundred kilobytes, its shards of many pieces."""
        random_release(self.folder / "release", "full", teammates=1, streams=3, episodes=80, length=25)
        return self.folder / "release"

    @cached_property
    def small(self) -> Path:
        """A release that is verified within milliseconds."""
        random_release(self.folder / "small", teammates=2, streams=1, episodes=6, length=15)
        return self.folder / "small"

    @cached_property
    def content(self) -> dict[str, bytes]:
        """Content of each file of `release`."""
        return contents(self.release)

    @cached_property
    def batches(self) -> bytes:
        """Hash of batches of `release`."""
        return hash_batches(load_icrl4aht(self.release, obs="uint8", cache="ram"))

    def new_path(self) -> Path:
        """Return a path where nothing exists."""
        return self.folder / f"try-{next(self._numbers)}"

    def download(self, url: str, to: Path) -> None:
        """Download a complete release and check it."""
        fetch_planned(plan_download(url, to=to))
        self.check_files(to, complete=True)

    def check_batches(self, dataset: Dataset) -> None:
        """Check that batches are those of `release`."""
        check(hash_batches(dataset) == self.batches, "other batches than those of the release")

    def check_files(self, folder: Path, complete: bool = False) -> None:
        """Check that a folder has no files but those of the release, each with the right content."""
        found = contents(folder) if folder.exists() else {}
        wrong = {name for name in found if found[name] != self.content.get(name)}
        check(not wrong, f"files that are not the release's: {wrong}")
        check(not complete or found.keys() == self.content.keys(), "files are missing")

    @contextmanager
    def fresh_folders(self) -> Iterator[Path]:
        """Redirect cache and data folders to empty ones; yields a path for a download."""
        to = self.new_path()
        folders = {"ICRL4AHT_DATA_DIR": str(to / "data"), "ICRL4AHT_CACHE_DIR": str(to / "cache")}
        with environment(folders):
            yield to / "release"


def hash_batches(dataset: Dataset) -> bytes:
    """Return a hash of batches of both kinds, from all episodes and from some."""
    samplers = []
    for part in (dataset.filter(layout=layout.name) for layout in dataset.layouts):
        samplers.append(part.ad(batch_size=8, length=20, teammate_actions=True))
        samplers.append(part.ad(batch_size=4, length=7, seed=1, episodes=(1, 4)))
        samplers.append(part.dpt(batch_size=4, context=20))
    return _hash(array for sampler in samplers for array in sampler.batch(3)._asdict().values() if array is not None)


def hash_arrays(dataset: Dataset) -> bytes:
    """Return a hash of every stored array and of the observations."""
    names = {h: [one.name for one in held_fields(dataset.info.kind) if h.entry.has(one)] for h in dataset}
    return _hash(itertools.chain.from_iterable([h.obs[:], *map(h.read, names[h])] for h in names))


def _hash(arrays: Iterable[np.ndarray]) -> bytes:
    digest = hashlib.blake2b()
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.digest()
