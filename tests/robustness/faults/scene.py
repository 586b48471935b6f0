"""What the families of faults share: releases, what is right of them, and how a faulty remote is met."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from unittest.mock import patch

import numpy as np

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.schema import MANIFEST, held_fields
from icrl4aht_data.reading.selection import ReadOptions
from icrl4aht_data.reading.shard import Shards
from icrl4aht_data.remote import partial_file as blocks
from icrl4aht_data.remote.download import ORIGIN, fetch_planned, plan_download
from icrl4aht_data.remote.remote_release import open_root
from icrl4aht_data.remote.store import RetryPolicy
from tests.helpers.random_play import random_release
from tests.servers.common import Fault, Faults, Flip, Long, Request, Short
from tests.servers.process import environment

PIECE = 2**14
"""Bytes asked for at once, so that the files of a small release come in many parts."""

PATIENCE = RetryPolicy(attempts=4, first=0.01, longest=5)

Try = Callable[[], str | None]
"""Meets one fault. Raises if something is lost; may say what was odd, which is counted."""


class LostError(Exception):
    """What was lost."""


def check(right: object, otherwise: str) -> None:
    if not right:
        raise LostError(otherwise)


@dataclass
class Ordered:
    """A rule of a server: a fault for the matching requests number `first` to `first + times`, and which they were."""

    fault: Fault | Callable[[Request], Fault | None]
    first: int = 0
    times: float = 1
    path: str = "*"
    methods: tuple[str, ...] = ("GET",)
    seen: int = 0
    hit: list[Request] = field(default_factory=list)

    def __call__(self, request: Request) -> Fault | None:
        if request.method not in self.methods or not fnmatchcase(request.path, self.path):
            return None
        self.seen += 1
        if not self.first < self.seen <= self.first + self.times:
            return None
        self.hit.append(request)
        return self.fault(request) if callable(self.fault) else self.fault

    @property
    def misled(self) -> bool:
        """Whether it changed what no hash vouches for: the manifest, or how long a file is said to be."""
        manifest = isinstance(self.fault, Flip) and self.hit[0].path.endswith(MANIFEST)
        return manifest or (isinstance(self.fault, Short | Long) and self.hit[0].method == "HEAD")


@dataclass(frozen=True)
class Target:
    """A release on a server."""

    url: str
    faults: Faults
    log: list[Request]


class Scene:
    """Releases of random play, folders for what happens to them, and random numbers.

    Args:
        folder: an empty one.
        seed: of the random numbers.
    """

    def __init__(self, folder: Path, seed: int = 0) -> None:
        self.folder, self.rng = folder, np.random.default_rng(seed)
        self._numbers = itertools.count()

    @cached_property
    def release(self) -> Path:
        """Of some hundred kilobytes: shards of many pieces."""
        random_release(self.folder / "release", "full", teammates=1, streams=3, episodes=80, length=25)
        return self.folder / "release"

    @cached_property
    def other(self) -> Path:
        """Another version of it."""
        random_release(self.folder / "other", "full", teammates=1, streams=3, episodes=80, length=25, seed=1)
        return self.folder / "other"

    @cached_property
    def small(self) -> Path:
        """That is verified in a moment."""
        random_release(self.folder / "small", teammates=2, streams=1, episodes=6, length=15)
        return self.folder / "small"

    @cached_property
    def content(self) -> dict[str, bytes]:
        """Of `release`."""
        return contents(self.release)

    @cached_property
    def batches(self) -> bytes:
        """Of `release`."""
        return batches(load_icrl4aht(self.release, obs="uint8", cache="ram"))

    def new(self) -> Path:
        """A path where nothing is."""
        return self.folder / f"try-{next(self._numbers)}"

    def download(self, url: str, to: Path | None) -> None:
        """All of it, whole."""
        plan = plan_download(url, to=to, patience=PATIENCE)
        fetch_planned(plan)
        self.check_arrived(plan.root.folder, everything=True)

    def stream(self, url: str, to: Path | None) -> None:
        """A few batches, the right ones; what comes goes to the default folder."""
        origin = open_root(url, None, PATIENCE)
        index = read_index(origin.folder)
        dataset = Dataset(
            index, np.arange(len(index.entries)), ReadOptions("uint8", "stream", 1), Shards(origin, index)
        )
        check(batches(dataset) == self.batches, "other batches than those of the release")

    def check_arrived(self, folder: Path, everything: bool = False) -> None:
        """Whether a folder has files of the release alone, each as it should be."""
        found = contents(folder) if folder.exists() else {}
        found = {name: data for name, data in found.items() if name != ORIGIN and not name.endswith(".partial")}
        wrong = [name for name in found if found[name] != self.content.get(name)]
        # which manifest is right cannot be known, see `remote`
        check(everything or MANIFEST not in wrong or wrong == [MANIFEST], f"files that are not the release's: {wrong}")
        wrong = [name for name in wrong if everything or name != MANIFEST]
        check(not wrong, f"files that are not the release's: {wrong}")
        check(not everything or found.keys() == self.content.keys(), "files are missing")

    @contextmanager
    def met(self) -> Iterator[Path]:
        """A folder for what comes, with our own folders beside it."""
        to = self.new()
        folders = {"ICRL4AHT_DATA_DIR": str(to / "data"), "ICRL4AHT_CACHE_DIR": str(to / "cache")}
        with environment(folders), patch.object(blocks, "_PIECE", PIECE):
            yield to / "release"

    def meet(self, target: Target, rule: Ordered, *, passing: bool, stream: bool = False, hub: bool = False) -> None:
        """Download or stream while a rule does something wrong; if that fails, again without it.

        Args:
            passing: whether the first attempt has to succeed.
            hub: download into the Hub's own cache.
        """
        use = self.stream if stream else self.download
        with self.met() as to:
            to = None if hub else to
            target.faults.clear()
            target.faults.add(rule)
            began = len(target.log)
            try:
                use(target.url, to)
            except Icrl4ahtError as error:
                check(not passing or rule.misled, f"given up: {error}")
                self.check_error(error, target.url if rule.misled else "")
                if to is not None:
                    self.check_arrived(to)
                target.faults.clear()
                arrived, again = received(target.log[began:], rule.hit), len(target.log)
                use(target.url, to)
                twice = arrived & received(target.log[again:])
                check(not twice or rule.misled, f"fetched again: {sorted(twice)[:3]}")
            finally:
                target.faults.clear()

    def check_error(self, error: Exception, url: str = "") -> None:
        """Whether it names a file, be it one of a wrong manifest at `url`."""
        named = any(name in str(error) for name in [*self.content, ORIGIN]) or (url and url in str(error))
        check(named, f"no file is named: {error}")

    def requests(self, target: Target, methods: tuple[str, ...], stream: bool = False, hub: bool = False) -> int:
        """How many there are where nothing goes wrong."""
        rule = Ordered(lambda request: None, times=np.inf, methods=methods)
        self.meet(target, rule, passing=True, stream=stream, hub=hub)
        return rule.seen


def contents(folder: Path) -> dict[str, bytes]:
    """Every file."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def received(log: Iterable[Request], spoiled: Iterable[Request] = ()) -> set[tuple[str, int, int]]:
    """The byte ranges of files that a client got whole."""
    bad = set(map(id, spoiled))
    return {
        (request.path, request.start, request.stop)
        for request in log
        if request.start is not None and request.stop is not None and not request.path.endswith(MANIFEST)
        if id(request) not in bad and request.method == "GET" and request.sent == request.stop - request.start
    }


def length(request: Request) -> int:
    """Of the body that is asked for, about."""
    found = re.fullmatch(r"bytes=(\d+)-(\d+)", request.headers.get("Range", ""))
    return int(found[2]) - int(found[1]) + 1 if found else 1000


def batches(dataset: Dataset) -> bytes:
    """A hash of batches of both kinds, of part of the episodes and of all."""
    samplers = []
    for part in (dataset.filter(layout=layout.name) for layout in dataset.layouts):
        samplers.append(part.ad(batch_size=8, length=20, teammate_actions=True))
        samplers.append(part.ad(batch_size=4, length=7, seed=1, episodes=(1, 4)))
        samplers.append(part.dpt(batch_size=4, context=20))
    arrays = (array for sampler in samplers for array in sampler.batch(3)._asdict().values() if array is not None)
    return _hash(arrays)


def arrays(dataset: Dataset) -> bytes:
    """A hash of every stored array and of observations."""
    names = [stored.name for stored in held_fields(dataset.info.kind)]
    return _hash(itertools.chain.from_iterable([h.obs[:], *map(h.read, names)] for h in dataset))


def _hash(some: Iterable[np.ndarray]) -> bytes:
    digest = hashlib.blake2b()
    for array in some:
        digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.digest()
