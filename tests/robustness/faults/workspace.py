"""Releases to inject faults into, and the checks that every family of faults shares."""

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
from icrl4aht_data.dataset import Dataset, open_dataset
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.format.schema import MANIFEST, held_fields
from icrl4aht_data.reading.selection import ReadOptions
from icrl4aht_data.remote import partial_file
from icrl4aht_data.remote.download import fetch_planned, plan_download
from icrl4aht_data.remote.remote_release import open_root
from icrl4aht_data.remote.store import RetryPolicy
from tests.helpers.damages import contents
from tests.helpers.random_releases import random_release
from tests.servers.common import Fault, Faults, Flip, Long, Request, Short
from tests.servers.process import environment

PIECE = 2**14
"""Bytes of one range request, small enough that the files of a small release take many."""

RETRIES = RetryPolicy(attempts=4, first_wait=0.01, longest_wait=5)

Attempt = Callable[[], str | None]
"""Injects one fault. Raises LostError if data or progress is lost; may return a remark, which is counted."""


class LostError(Exception):
    """A fault led to wrong data, to an error without a file's name, or to repeated work."""


def check(condition: object, message: str) -> None:
    """Raise LostError unless a condition holds."""
    if not condition:
        raise LostError(message)


@dataclass
class FaultRule:
    """Rule of a server: a fault for the matching requests number `first` to `first + times`.

    Attributes:
        fault: the fault, or a function of the request.
        path: pattern of the request's path.
        methods: HTTP methods that match.
        seen: matching requests so far.
        hit: the requests that met the fault.
    """

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
    def changed_unhashed(self) -> bool:
        """Whether the fault changed what no hash protects: the manifest, or the announced length of a file."""
        manifest = isinstance(self.fault, Flip) and self.hit[0].path.endswith(MANIFEST)
        return manifest or (isinstance(self.fault, Short | Long) and self.hit[0].method == "HEAD")


@dataclass(frozen=True)
class Target:
    """A release on a server: URL, rules of the server, log of the requests."""

    url: str
    faults: Faults
    log: list[Request]

    @property
    def is_hub(self) -> bool:
        return self.url.startswith("hf://")


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
    def other(self) -> Path:
        """A release with the files of `release` and other content."""
        random_release(self.folder / "other", "full", teammates=1, streams=3, episodes=80, length=25, seed=1)
        return self.folder / "other"

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

    def download(self, url: str, to: Path | None) -> None:
        """Download a complete release and check it."""
        plan = plan_download(url, to=to, retry=RETRIES)
        fetch_planned(plan)
        self.check_files(plan.root.folder, complete=True)

    def open_stream(self, url: str) -> Dataset:
        """Open a remote release for streaming through the default cache folder."""
        return open_dataset(open_root(url, None, RETRIES), ReadOptions("uint8", "stream", 1))

    def stream(self, url: str, to: Path | None) -> None:
        """Stream a few batches and check them."""
        self.check_batches(self.open_stream(url))

    def check_batches(self, dataset: Dataset) -> None:
        """Check that batches are those of `release`."""
        check(hash_batches(dataset) == self.batches, "other batches than those of the release")

    def check_files(self, folder: Path, complete: bool = False) -> None:
        """Check that a folder has no files but those of the release, each with the right content."""
        found = contents(folder) if folder.exists() else {}
        found = {name: data for name, data in found.items() if not name.endswith(".partial")}
        wrong = {name for name in found if found[name] != self.content.get(name)}
        # no hash protects the manifest; only with a wrong one may a partial download have a wrong file, the manifest
        check(not wrong or (wrong == {MANIFEST} and not complete), f"files that are not the release's: {wrong}")
        check(not complete or found.keys() == self.content.keys(), "files are missing")

    @contextmanager
    def fresh_folders(self) -> Iterator[Path]:
        """Redirect cache and data folders to empty ones; yields a path for a download."""
        to = self.new_path()
        folders = {"ICRL4AHT_DATA_DIR": str(to / "data"), "ICRL4AHT_CACHE_DIR": str(to / "cache")}
        with environment(folders), patch.object(partial_file, "_REQUEST_BYTES", PIECE):
            yield to / "release"

    def use_with_fault(
        self, target: Target, rule: FaultRule, *, succeeds: bool, stream: bool = False, default_folder: bool = False
    ) -> None:
        """Download or stream under a fault; after an error again without it, which may fetch nothing twice.

        Args:
            target: the release.
            rule: when the fault happens.
            succeeds: whether the first attempt has to succeed.
            stream: stream batches instead of downloading.
            default_folder: download into the default folder, on the Hub its own cache.
        """
        use = self.stream if stream else self.download
        with self.fresh_folders() as folder:
            to = None if default_folder else folder
            target.faults.clear()
            target.faults.add(rule)
            began = len(target.log)
            try:
                use(target.url, to)
            except Icrl4ahtError as error:
                check(not succeeds or rule.changed_unhashed, f"given up: {error}")
                self.check_error(error, target.url if rule.changed_unhashed else "")
                if to is not None:
                    self.check_files(to)
                target.faults.clear()
                arrived, again = received(target.log[began:], rule.hit), len(target.log)
                use(target.url, to)
                twice = arrived & received(target.log[again:])
                check(not twice or rule.changed_unhashed, f"fetched again: {sorted(twice)[:3]}")
            finally:
                target.faults.clear()

    def check_error(self, error: Exception, url: str = "") -> None:
        """Check that an error names a file of the release, or `url`."""
        named = any(name in str(error) for name in self.content) or (url and url in str(error))
        check(named, f"no file is named: {error}")

    def count_requests(
        self, target: Target, methods: tuple[str, ...] = ("GET",), stream: bool = False, default_folder: bool = False
    ) -> int:
        """Return the number of requests without a fault."""
        rule = FaultRule(lambda request: None, times=np.inf, methods=methods)
        self.use_with_fault(target, rule, succeeds=True, stream=stream, default_folder=default_folder)
        return rule.seen


def received(log: Iterable[Request], spoiled: Iterable[Request] = ()) -> set[tuple[str, int, int]]:
    """Return the byte ranges (path, start, stop) that a client received completely, without the spoiled ones."""
    bad = set(map(id, spoiled))
    return {
        (request.path, request.start, request.stop)
        for request in log
        if request.start is not None and request.stop is not None and not request.path.endswith(MANIFEST)
        if id(request) not in bad and request.method == "GET" and request.sent == request.stop - request.start
    }


def body_length(request: Request) -> int:
    """Return the number of bytes that a request's range has; 1000 without a range."""
    found = re.fullmatch(r"bytes=(\d+)-(\d+)", request.headers.get("Range", ""))
    return int(found[2]) - int(found[1]) + 1 if found else 1000


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
