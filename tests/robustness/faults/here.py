"""Faults of this machine: full disks, killed processes, two processes at once, files that are not as written."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.format import columns
from icrl4aht_data.format.chunks import chunk_table_name, read_table
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from icrl4aht_data.reading.selection import ReadOptions
from icrl4aht_data.reading.shard import Shards
from icrl4aht_data.remote.download import fetch_planned, plan_download
from icrl4aht_data.remote.partial_file import PartialFile
from icrl4aht_data.remote.remote_release import open_root
from icrl4aht_data.remote.store import Store
from tests.helpers.paths import ROOT
from tests.robustness.faults.remote import ANY, on_http
from tests.robustness.faults.scene import PATIENCE, PIECE, Ordered, Scene, Target, Try, arrays, batches, check, received
from tests.servers.common import Request, Slow
from tests.servers.process import environment

_PAGE = 4096
_GIB = 2**30


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Callable[[], None]]:
    """A disk of so many bytes at a folder; call what it gives to make it large."""
    folder.mkdir(parents=True, exist_ok=True)
    _mount(folder, f"size={size}")
    try:
        yield lambda: _mount(folder, "remount,size=64m")
    finally:
        subprocess.run(["umount", folder], check=True)


def _mount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True, capture_output=True)


@cache
def _may_mount() -> bool:
    from tempfile import TemporaryDirectory

    try:
        with TemporaryDirectory() as folder, small_disk(Path(folder), _PAGE):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


@contextmanager
def small_files(size: int) -> Iterator[Callable[[], None]]:
    """No file may become longer; call what it gives to end that. What a quota does, where no disk can be mounted."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def end() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield end
    finally:
        end()


def full_disk(scene: Scene, n: int) -> Iterator[Try]:
    """A download onto a disk that it fills, or whose files may not become as long as they should."""

    def attempt(target: Target, share: float, mounted: bool) -> None:
        began = len(target.log)
        largest = max(map(len, scene.content.values()))
        size = int(share * (sum(map(len, scene.content.values())) if mounted else largest)) // _PAGE * _PAGE + _PAGE
        with scene.met() as to:
            disk = small_disk(to.parent, size) if mounted else small_files(size)
            with disk as enlarge:
                try:
                    scene.download(target.url, to)
                except (Icrl4ahtError, OSError) as error:
                    scene.check_error(error)
                    check(isinstance(error, Icrl4ahtError) or error.errno in (errno.ENOSPC, errno.EFBIG), repr(error))
                    scene.check_arrived(to)
                    enlarge()
                    kept, again = _kept(scene, to), len(target.log)
                    scene.download(target.url, to)
                    _check_kept(kept, target.log[again:])
                check(len(target.log) > began, "nothing was asked")

    with on_http(scene) as target:
        for number in range(n):
            yield partial(attempt, target, scene.rng.random(), number % 2 > 0 and _may_mount())


def full_cache(scene: Scene, n: int) -> Iterator[Try]:
    """A stream whose cache has no room: it goes on in memory, and asks for nothing twice."""

    def attempt(target: Target, size: int, mounted: bool) -> None:
        with scene.met() as to:
            disk = small_disk(to.parent, 64 * 2**20) if mounted else small_files(size)
            origin = open_root(target.url, None, PATIENCE)
            index = read_index(origin.folder)
            dataset = Dataset(
                index, np.arange(len(index.entries)), ReadOptions("uint8", "stream", 1), Shards(origin, index)
            )
            for history in dataset:
                history.read("dones", 0, 1)  # brings the chunk table
            began = len(target.log)
            with disk:
                if mounted:
                    _fill(to.parent / "filler")
                check(batches(dataset) == scene.batches, "other batches than those of the release")
            asked = Counter((r.path, r.start) for r in target.log[began:] if r.method == "GET")
            check(max(asked.values()) == 1, f"fetched again: {asked.most_common(1)}")

    with on_http(scene) as target:
        for number in range(n):
            yield partial(attempt, target, int(scene.rng.integers(PIECE)), number % 2 > 0 and _may_mount())


def _fill(path: Path) -> None:
    try:
        with path.open("wb", buffering=0) as stream:
            while True:
                stream.write(bytes(_PAGE))
    except OSError:
        return


def _kept(scene: Scene, to: Path) -> dict[str, list[tuple[int, int]]]:
    """The byte ranges of files that are here: file -> first byte and the one behind the last."""
    found = {f"/{name}": [(0, len(data))] for name, data in scene.content.items() if (to / name).exists()}
    for name in (name for name in scene.content if name.startswith("data/") and f"/{name}" not in found):
        table = np.array(read_table(scene.release / chunk_table_name(name)))
        part = PartialFile(Store("file://"), name, to.with_name(f"{to.name}.partial") / name)
        missing = set(part.missing(table)["offset"].tolist())
        chunks = table[["offset", "size"]].tolist()
        found[f"/{name}"] = [(start, start + size) for start, size in chunks if start not in missing]
    return found


def _check_kept(kept: dict[str, list[tuple[int, int]]], log: list[Request]) -> None:
    for path, start, stop in received(log):
        again = [part for part in kept.get(path, []) if start <= part[0] and part[1] <= stop]
        check(not again, f"fetched again: {path}, {again[:3]}")


_DOWNLOAD = """
import sys
from pathlib import Path
from icrl4aht_data.remote import partial_file as blocks
from icrl4aht_data.remote.download import fetch_planned, plan_download

blocks._PIECE = int(sys.argv[3])
fetch_planned(plan_download(sys.argv[1], to=Path(sys.argv[2])))
"""

_OPEN = """
import sys
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.remote.remote_release import open_root

print(flush=True)
sys.stdin.readline()
for _ in range(20):
    open_root(sys.argv[1])
"""

_BUILD = """
import itertools, os, sys
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.format import columns
from icrl4aht_data.utils import cache

columns._UNCACHED = cache._SMALL = 0
for number in itertools.count():
    os.environ["ICRL4AHT_CACHE_DIR"] = f"{sys.argv[2]}/{number}"
    print(number, flush=True)
    load_icrl4aht(sys.argv[1], cache="mmap").holding
"""


def _start(code: str, *arguments: object) -> subprocess.Popen[str]:
    """A process of its own that runs code."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )


def killed_downloads(scene: Scene, n: int) -> Iterator[Try]:
    """kill -9 of a download between two random requests, or in one; then the download again."""

    def attempt(target: Target, requests: int, moment: float) -> None:
        target.faults.clear()
        target.faults.add(Ordered(Slow(0.02), times=10**9))
        began = len(target.log)
        with scene.met() as to:
            process = _start(_DOWNLOAD, target.url, to, PIECE)
            while len(target.log) - began < requests and process.poll() is None:
                time.sleep(0.001)
            time.sleep(moment)
            process.kill()
            _, said = process.communicate()
            check(process.returncode in (0, -signal.SIGKILL), said)
            target.faults.clear()
            scene.check_arrived(to)
            kept, again = _kept(scene, to), len(target.log)
            scene.download(target.url, to)
            _check_kept(kept, target.log[again:])

    with on_http(scene) as target:
        most = scene.requests(target, ANY)
        for _ in range(n):
            yield partial(attempt, target, int(scene.rng.integers(1, most)), 0.03 * scene.rng.random())


def killed_builds(scene: Scene, n: int) -> Iterator[Try]:
    """kill -9 of a process that builds the caches of index and arrays; then another one uses what is there."""

    def attempt(moment: float) -> None:
        caches = scene.new()
        process = _start(_BUILD, scene.release, caches)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(moment)
        process.kill()
        numbers, said = process.communicate()
        check(process.returncode == -signal.SIGKILL, said)
        last = caches / (numbers.split() or ["0"])[-1]
        with environment({"ICRL4AHT_CACHE_DIR": str(last)}), patch.object(columns, "_UNCACHED", 0):
            for _ in range(2):  # makes what is not there, then finds it
                dataset = load_icrl4aht(scene.release, obs="uint8", cache="mmap")
                check(batches(dataset) == scene.batches, "other batches than those of the release")
        left = [path.name for path in last.iterdir() if path.name.startswith(".") and path.suffix == ".partial"]
        check(not left, f"left behind: {left}")

    for _ in range(n):
        yield partial(attempt, 0.5 * scene.rng.random())


def two_readers(scene: Scene, n: int) -> Iterator[Try]:
    """Two processes that open the same release at the same time, again and again."""

    def attempt(target: Target) -> None:
        with scene.met():
            processes = [_start(_OPEN, target.url) for _ in range(2)]
            for process in processes:
                assert process.stdout is not None
                process.stdout.readline()
            for process in processes:
                assert process.stdin is not None
                process.stdin.write("\n")
                process.stdin.flush()
            said = [process.communicate()[1] for process in processes]
            check([process.returncode for process in processes] == [0, 0], "\n".join(said))

    with on_http(scene) as target:
        for _ in range(n):
            yield partial(attempt, target)


def two_processes(scene: Scene, n: int) -> Iterator[Try]:
    """Two processes that download the same release into the same folder at the same time."""

    def attempt(target: Target) -> None:
        began = len(target.log)
        with scene.met() as to:
            processes = [_start(_DOWNLOAD, target.url, to, PIECE) for _ in range(2)]
            said = [process.communicate()[1] for process in processes]
            check([process.returncode for process in processes] == [0, 0], "\n".join(said))
            scene.check_arrived(to, everything=True)
            asked = Counter((r.path, r.start) for r in target.log[began:] if r.method == "GET")
            twice = [key for key, count in asked.items() if count > 1 and not key[0].endswith(MANIFEST)]
            check(not twice, f"fetched twice: {twice[:3]}")

    with on_http(scene) as target:
        target.faults.add(Ordered(Slow(0.01), times=10**9))
        for _ in range(n):
            yield partial(attempt, target)


def _read(root: Path) -> tuple[bytes, str]:
    """A hash of all that a release's arrays and samplers give, and what is said of its histories."""
    dataset = load_icrl4aht(root, obs="uint8", cache="ram", threads=1)
    said = [(repr(h.entry), dataset.recover_teammate(h.entry.history_id)) for h in dataset]
    return arrays(dataset) + batches(dataset), f"{said} {dataset.info}"


def _check_damaged(root: Path, before: tuple[bytes, str]) -> str | None:
    """Whether `verify` sees that something is wrong, and reading raises an error of ours or gives the same."""
    check(not verify_release(root).ok, "verify finds nothing")
    try:
        after = _read(root)
    except Icrl4ahtError:
        return None
    check(after[0] == before[0], "other data, silently")
    return None if after[1] == before[1] else "metadata unnoticed"


def bit_flips(scene: Scene, n: int) -> Iterator[Try]:
    """One bit of one file of a release is another."""
    root = scene.new()
    shutil.copytree(scene.small, root)
    before = _read(root)
    paths = sorted(path for path in root.rglob("*") if path.is_file())

    def attempt(path: Path, position: int, bit: int) -> str | None:
        whole = path.read_bytes()
        spoiled = bytearray(whole)
        spoiled[position] ^= 1 << bit
        path.write_bytes(spoiled)
        try:
            return _check_damaged(root, before)
        finally:
            path.write_bytes(whole)

    for number in range(n):
        path = paths[number % len(paths)]
        yield partial(attempt, path, int(scene.rng.integers(path.stat().st_size)), int(scene.rng.integers(8)))


def mutations(scene: Scene, n: int) -> Iterator[Try]:
    """The text files of a release, manifest included, changed by lines, values and bytes; time and memory bounded."""
    root = scene.new()
    shutil.copytree(scene.small, root)
    before, listed = _read(root), _listed(root)

    def attempt(name: str, seed: int) -> str | None:
        path = root / name
        whole = path.read_bytes()
        spoiled, rng = whole, np.random.default_rng(seed)
        while spoiled == whole:
            spoiled = _mutated(whole, rng, name)
        path.write_bytes(spoiled)
        try:
            with _bounded():
                return _check_damaged(root, before) if name != MANIFEST else _check_manifest(root, before)
        finally:
            path.write_bytes(whole)

    def _check_manifest(root: Path, before: tuple[bytes, str]) -> str | None:
        with on_http(scene, root) as target, scene.met() as to:
            try:
                fetch_planned(plan_download(target.url, to=to, patience=PATIENCE))
                check(_read(to) == before, "other data, downloaded")
            except Icrl4ahtError:
                pass
        same = _listed(root) == listed
        return "same meaning" if same else _check_damaged(root, before)

    names = (HISTORIES, INFO, MANIFEST, TASKS, PROVENANCE)
    for number in range(n):
        yield partial(attempt, names[number % len(names)], int(scene.rng.integers(2**32)))


def _listed(root: Path) -> dict[str, str] | None:
    try:
        return read_manifest(root)
    except Icrl4ahtError:
        return None


@contextmanager
def _bounded(seconds: int = 20, memory: int = 2 * _GIB) -> Iterator[None]:
    """An error where that is not enough."""

    def late(number: int, frame: object) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    before, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, late)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + memory, before[1]))
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


_VALUES = [0, -1, 2**31, 2**63, 10**400, 1e300, -0.5, None, True, "", "x", "\0", "../x", "/etc", "ü" * 9, [], [[]], {}]
_RAW = [b"NaN", b"1e999", b"[" * 100_000, b'{"a":' * 50_000, b'"' + b"x" * 10_000_000 + b'"', b"\xff\xfe", b"\\ud800"]


def _mutated(data: bytes, rng: np.random.Generator, name: str) -> bytes:
    """One random change."""
    lines = data.splitlines(keepends=True)
    one, other = rng.integers(len(lines), size=2)
    low, high = sorted(rng.integers(len(data) + 1, size=2).tolist())
    changes: list[Callable[[], bytes]] = [
        lambda: data[:low],
        lambda: data[:low] + data[high:],
        lambda: data[:low] + rng.bytes(5) + data[low:],
        lambda: data[:low] + _RAW[rng.integers(len(_RAW))] + data[low + 1 :],
        lambda: b"".join([*lines[:one], *lines[one + 1 :]]),
        lambda: b"".join([*lines[: one + 1], *lines[one:]]),
        lambda: b"".join([lines[other if k == one else one if k == other else k] for k in range(len(lines))]),
        lambda: data.replace(b"\n", rng.choice([b"\r\n", b"\r", b"\n\n", b"\x0b", b""]).item()),
        lambda: b"\xef\xbb\xbf" + data,
        lambda: data.replace(b"meta/", rng.choice([b"/meta/", b"../meta/", b"meta//", b"C:/meta/"]).item(), 1),
        lambda: data.upper(),
    ]
    values = 0 if name == MANIFEST else 3 * len(changes)  # most changes are of values, where there are any
    choice = int(rng.integers(len(changes) + values))
    return changes[choice]() if choice < len(changes) else _other_value(data, rng, by_line=name.endswith(".jsonl"))


def _other_value(data: bytes, rng: np.random.Generator, by_line: bool) -> bytes:
    """JSON in which one value, key or place is another."""
    lines = data.splitlines() if by_line else [data]
    row = int(rng.integers(len(lines)))
    content: Any = json.loads(lines[row])
    inner = content
    while True:
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        key = keys[rng.integers(len(keys))]
        if not isinstance(inner[key], dict | list) or not inner[key] or rng.random() < 0.3:
            break
        inner = inner[key]
    kind = rng.random()
    if kind < 0.7:
        inner[key] = _VALUES[rng.integers(len(_VALUES))]
    elif kind < 0.85 or isinstance(inner, list):
        del inner[key]
    else:
        inner[f"{key}s"] = inner.pop(key)
    lines[row] = json.dumps(content).encode()
    return b"".join(line + b"\n" for line in lines)
