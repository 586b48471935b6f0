"""Test that faults of disks, processes and files cause errors but never wrong data, and that retries succeed."""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import CacheError, Icrl4ahtError, IndexFormatError
from icrl4aht_data.fetch import fetch_planned, plan_download
from icrl4aht_data.format.manifest import parse_manifest, write_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS, memory_fields
from icrl4aht_data.reading.sources import CacheMode
from icrl4aht_data.utils.files import atomic_write
from tests.helpers.damages import file_contents
from tests.helpers.paths import ROOT
from tests.helpers.random_releases import random_release
from tests.robustness.limits import PAGE, can_mount, file_size_limit, memory_limit, small_disk, time_limit
from tests.servers.faults import SlowAnswer
from tests.servers.http import http_server

SLOW = pytest.mark.slow


def arrays_digest(arrays: Iterable[np.ndarray]) -> bytes:
    found = hashlib.blake2b()
    for array in arrays:
        found.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return found.digest()


def hash_batches(dataset: Dataset) -> bytes:
    """Return a hash of AD and DPT batches, drawn from all episodes and from a range of episodes."""
    samplers = []
    for part in (dataset.filter(layout=layout.name) for layout in dataset.layouts):
        samplers.append(part.ad(batch_size=8, length=20, teammate_actions=True))
        samplers.append(part.ad(batch_size=4, length=7, seed=1, episodes=(1, 4)))
        samplers.append(part.dpt(batch_size=4, context=20))
    return arrays_digest(
        array for sampler in samplers for array in sampler.batch(3)._asdict().values() if array is not None
    )


@pytest.fixture(scope="module")
def release(tmp_path_factory) -> Path:
    """Return a release of several hundred kilobytes with many chunks in each shard."""
    root = tmp_path_factory.mktemp("faults") / "release"
    random_release(root, "full", teammates=1, streams=3, episodes=80, length=25)
    return root


@pytest.fixture(scope="module")
def batches_hash(release) -> bytes:
    return hash_batches(load_icrl4aht(release, obs="uint8", cache="ram"))


@pytest.fixture
def cache_folder(tmp_path, monkeypatch) -> Path:
    """Set the cache and data folders to new paths, and return the cache folder."""
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "cache"


class SmallRelease:
    """A small release in which tests damage files; `before` is the result of `read` without damage."""

    def __init__(self, root: Path) -> None:
        random_release(root, teammates=2, streams=1, episodes=6, length=15)
        self.root = root
        self.before = self.read(root)

    def read(self, root: Path, cache: CacheMode = "ram") -> tuple[bytes, str]:
        """Return a hash of all arrays and of batches, and the metadata as text."""
        dataset = load_icrl4aht(root, obs="uint8", cache=cache, threads=1)
        names = {h: [one.name for one in memory_fields(dataset.info.kind) if h.entry.has(one)] for h in dataset}
        arrays = arrays_digest(itertools.chain.from_iterable([h.obs[:], *map(h.read, names[h])] for h in names))
        histories = [(repr(h.entry), dataset.recover_teammate(h.entry.history_id)) for h in dataset]
        return arrays + hash_batches(dataset), f"{histories} {dataset.info}"

    @contextmanager
    def damaged(self, path: Path, data: bytes) -> Iterator[None]:
        """Replace a file's content within the context, but keep the file's timestamps."""
        right, status = path.read_bytes(), path.stat()
        path.write_bytes(data)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        try:
            yield
        finally:
            path.write_bytes(right)

    def assert_damage_is_found(self, cache: CacheMode = "ram") -> None:
        """Assert that `verify` finds the damage, and that reading returns correct data or raises a package error."""
        assert not verify_release(self.root).ok, "verify finds nothing"
        with suppress(Icrl4ahtError):
            assert self.read(self.root, cache) == self.before, "other data without an error"


@pytest.fixture(scope="module")
def small_release(tmp_path_factory) -> SmallRelease:
    return SmallRelease(tmp_path_factory.mktemp("small") / "release")


@pytest.mark.parametrize("count", [9, pytest.param(90, marks=SLOW)])
def test_flipped_bit_never_changes_the_data_that_is_read(small_release, cache_folder, count):
    """Flip a bit of one file after another and read in different cache modes; test_verify.py flips more bits."""
    rng, paths = np.random.default_rng(1), sorted(path for path in small_release.root.rglob("*") if path.is_file())
    modes: list[CacheMode] = ["ram", "stream", "mmap"]
    for number in range(count):
        path = paths[number % len(paths)]
        data = bytearray(path.read_bytes())
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        with small_release.damaged(path, bytes(data)):
            small_release.assert_damage_is_found(modes[number % 3])


VALUES = [0, -1, 2**31, 2**63, 10**400, 1e300, -0.5, None, True, "", "x", "\0", "../x", "/etc", "ü" * 9, [], [[]], {}]
RAW = [b"NaN", b"1e999", b"[" * 100_000, b'{"a":' * 50_000, b'"' + b"x" * 10_000_000 + b'"', b"\xff\xfe", b"\\ud800"]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the content of a file with a part removed, with other bytes, or with another JSON value."""
    low, high = sorted(rng.integers(len(data) + 1, size=2).tolist())
    found = list(re.finditer(rb'(?<=[:\[,] )(?:"[^"]*"|-?[\d.]+|true|false|null)', data)) or [re.match(b"", data)]
    value = found[rng.integers(len(found))]
    assert value is not None
    changes = [
        data[:low],
        data[:low] + data[high:],
        data[:low] + RAW[rng.integers(len(RAW))] + data[low + 1 :],
        data.replace(b"meta/", rng.choice([b"/meta/", b"../meta/", b"C:/meta/"]).item(), 1),
        *[data[: value.start()] + json.dumps(VALUES[rng.integers(len(VALUES))]).encode() + data[value.end() :]] * 6,
    ]
    return changes[rng.integers(len(changes))]


@pytest.mark.parametrize("name", [HISTORIES, INFO, MANIFEST, TASKS, PROVENANCE])
@pytest.mark.parametrize("count", [1, pytest.param(10, marks=SLOW)])
def test_mutated_text_files_raise_only_package_errors(small_release, cache_folder, tmp_path, name, count):
    """Read a mutated file with the old manifest, then with a matching manifest; download a mutated manifest."""
    path, rng = small_release.root / name, np.random.default_rng(count)
    for number in range(count):
        data = mutant = path.read_bytes()
        while mutant == data:
            mutant = mutate(data, rng)
        with small_release.damaged(path, mutant), time_limit(20), memory_limit(2 * 2**30):
            if name == MANIFEST:
                with http_server(small_release.root) as server, suppress(Icrl4ahtError):
                    fetch_planned(plan_download(server.url, to=tmp_path / f"{number}"))
                    assert small_release.read(tmp_path / f"{number}") == small_release.before, "other data, downloaded"
                continue
            small_release.assert_damage_is_found()
            with small_release.damaged(small_release.root / MANIFEST, (small_release.root / MANIFEST).read_bytes()):
                write_manifest(small_release.root)
                verify_release(small_release.root)
                with suppress(Icrl4ahtError):
                    small_release.read(small_release.root)


def limit_space(folder: Path, size: int, mounted: bool):
    """Limit the total bytes of a folder if `mounted`, else the bytes of each file."""
    return small_disk(folder, size) if mounted else file_size_limit(size)


DISKS = pytest.mark.parametrize(
    "mounted", [False, pytest.param(True, marks=pytest.mark.skipif(not can_mount(), reason="cannot mount disks"))]
)


@DISKS
@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_download_that_fills_the_disk_is_resumed(release, tmp_path, share, mounted):
    right, to = file_contents(release), tmp_path / "disk" / "release"
    sizes = [len(data) for data in right.values()]
    size = int(share * (sum(sizes) if mounted else max(sizes))) // PAGE * PAGE
    with http_server(release) as server, limit_space(to.parent, size, mounted) as enlarge:
        with pytest.raises((Icrl4ahtError, OSError)) as caught:
            fetch_planned(plan_download(server.url, to=to))
        error = caught.value
        assert isinstance(error, Icrl4ahtError) or error.errno in (errno.ENOSPC, errno.EFBIG), repr(error)
        assert (file_contents(to) if to.exists() else {}).items() <= right.items()
        enlarge()
        fetch_planned(plan_download(server.url, to=to))
        assert file_contents(to) == right


@DISKS
@pytest.mark.parametrize("size", [PAGE, 8 * PAGE])
def test_cache_on_a_full_disk_raises_error_and_can_be_rebuilt(release, batches_hash, cache_folder, size, mounted):
    with limit_space(cache_folder, size, mounted) as enlarge:
        dataset = load_icrl4aht(release, obs="uint8", cache="mmap")
        with pytest.raises(CacheError, match=f"{cache_folder}: the cache folder has no room for arrays of "):
            hash_batches(dataset)
        left = [path.name for path in cache_folder.iterdir()]
        assert all(name.startswith("histories-") for name in left), left
        enlarge()
        assert hash_batches(dataset) == batches_hash


CODE = {
    "download": "fetch_planned(plan_download(sys.argv[1], to=Path(sys.argv[2])))",
    "open": "for _ in range(20): open_root(sys.argv[1])",
    "build": "load_icrl4aht(sys.argv[1], cache='mmap').storage",
}
"""What processes do with a release or its address."""


def start_process(code: str, *arguments: object) -> subprocess.Popen[str]:
    """Start a Python process that waits for a line on stdin and then runs `code`; return when the process waits."""
    imports = """
import sys
from pathlib import Path
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.fetch import fetch_planned, plan_download
from icrl4aht_data.fetch import open_root
print(flush=True)
sys.stdin.readline()
"""
    command, pipe = [sys.executable, "-c", imports + code, *map(str, arguments)], subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=ROOT)
    assert process.stdout is not None
    process.stdout.readline()
    return process


@pytest.mark.parametrize("what", ["download", pytest.param("open", marks=SLOW), pytest.param("build", marks=SLOW)])
def test_two_processes_can_share_a_download_or_cache(release, batches_hash, cache_folder, tmp_path, what):
    to = tmp_path / "copy"
    with http_server(release) as server:
        server.faults.next(SlowAnswer(0.01), times=10**9)
        root = release if what == "build" else server.url
        processes = [start_process(CODE[what], root, to) for _ in range(2)]
        for process in processes:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        errors = [process.communicate()[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], errors
    if what == "download":
        assert file_contents(to) == file_contents(release)
    if what == "build":
        assert {path.name.split("-")[0] for path in cache_folder.iterdir()} <= {"histories"}
        made = file_contents(cache_folder)
        assert hash_batches(load_icrl4aht(release, obs="uint8", cache="mmap")) == batches_hash
        assert file_contents(cache_folder) == made, "built again"


@SLOW
@pytest.mark.parametrize("moment", [0.02, 0.1, 0.3])
def test_cache_of_a_killed_process_is_completed_or_replaced(release, batches_hash, cache_folder, moment):
    process = start_process(CODE["build"] + "\nsys.stdin.readline()", release)
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
    time.sleep(moment)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    process.communicate()
    for _ in range(2):  # the first call builds missing arrays, the second call reuses them
        assert hash_batches(load_icrl4aht(release, obs="uint8", cache="mmap")) == batches_hash


def test_changed_episode_length_in_info_raises_errors(small_release, tmp_path):
    """One flipped bit changes the steps of an episode in info.json from 15 to 14."""
    root = tmp_path / "release"
    shutil.copytree(small_release.root, root)
    info = root / "meta" / "info.json"
    info.write_text(info.read_text().replace('"kept_steps": 15', '"kept_steps": 14'))
    with pytest.raises(IndexFormatError, match=r"info\.json: expected sha256"):
        load_icrl4aht(root)
    write_manifest(root)
    with pytest.raises(IndexFormatError, match=r"line 1: expected episodes of 14 steps as in meta/info\.json, found"):
        load_icrl4aht(root)


def test_manifest_without_its_last_byte_is_refused(small_release):
    text = (small_release.root / "MANIFEST.sha256").read_text()
    with pytest.raises(IndexFormatError, match=r"MANIFEST is cut off: the last line does not end"):
        parse_manifest(text[:-1], "MANIFEST")


def test_disk_error_names_the_file(tmp_path):
    path = tmp_path / "notes.json"
    with pytest.raises(OSError, match=r"notes\.json") as caught, file_size_limit(100), atomic_write(path) as partial:
        partial.write_bytes(bytes(200))
    assert caught.value.errno == errno.EFBIG
    assert not list(tmp_path.iterdir())
