"""Faults of the local machine: full disks, killed processes, concurrent processes, damaged files."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.download import fetch_planned, plan_download
from icrl4aht_data.errors import CacheError, Icrl4ahtError
from icrl4aht_data.format import columns
from icrl4aht_data.format.manifest import read_manifest, write_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from icrl4aht_data.reading.sources import CacheMode
from tests.helpers.damages import DAMAGES, contents
from tests.helpers.paths import ROOT
from tests.robustness.faults.workspace import Attempt, Workspace, check, hash_arrays, hash_batches
from tests.robustness.limits import PAGE, can_mount, file_size_limit, memory_limit, small_disk, time_limit
from tests.servers.common import Slow, http_server
from tests.servers.process import environment


def full_disk(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """A download fills the disk, or its files reach a limit of size; it is resumed by file when there is room."""

    def attempt(url: str, share: float, mounted: bool) -> None:
        sizes = [len(data) for data in workspace.content.values()]
        size = int(share * (sum(sizes) if mounted else max(sizes))) // PAGE * PAGE + PAGE
        with workspace.fresh_folders() as to, _limited(to.parent, size, mounted) as enlarge:
            try:
                workspace.download(url, to)
            except (Icrl4ahtError, OSError) as error:
                check(isinstance(error, Icrl4ahtError) or error.errno in (errno.ENOSPC, errno.EFBIG), repr(error))
                workspace.check_files(to)
                enlarge()
                workspace.download(url, to)

    with http_server(workspace.release) as server:
        for number in range(n):
            yield partial(attempt, server.url, workspace.rng.random(), number % 2 > 0 and can_mount())


def _limited(folder: Path, size: int, mounted: bool) -> AbstractContextManager[Callable[[], None]]:
    """Limit the bytes of a folder if disks can be mounted, else of each file."""
    return small_disk(folder, size) if mounted else file_size_limit(size)


_DOWNLOAD = """
import sys
from pathlib import Path
from icrl4aht_data.download import fetch_planned, plan_download

fetch_planned(plan_download(sys.argv[1], to=Path(sys.argv[2])))
"""

_OPEN = """
import sys
from icrl4aht_data.fetch import open_root

print(flush=True)
sys.stdin.readline()
for _ in range(20):
    open_root(sys.argv[1])
"""

_BUILD = """
import itertools, os, sys
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.format import columns

columns._UNCACHED = 0
for number in itertools.count():
    os.environ["ICRL4AHT_CACHE_DIR"] = f"{sys.argv[2]}/{number}"
    print(number, flush=True)
    load_icrl4aht(sys.argv[1], cache="mmap").storage
"""


_BUILD_ONCE = """
import os, sys
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.format import columns

columns._UNCACHED = 0
os.environ["ICRL4AHT_CACHE_DIR"] = sys.argv[2]
print(flush=True)
sys.stdin.readline()
load_icrl4aht(sys.argv[1], cache="mmap").storage
"""


def _start(code: str, *arguments: object, wait: bool = False) -> subprocess.Popen[str]:
    """Start a Python process that runs `code`, and with `wait` read its first line."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=ROOT)
    if wait and process.stdout is not None:
        process.stdout.readline()
    return process


def _check_success(processes: list[subprocess.Popen[str]], text: str | None = None) -> None:
    errors = [process.communicate(text)[1] for process in processes]
    check([process.returncode for process in processes] == [0] * len(processes), "\n".join(errors))


def killed_builds(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """kill -9 of a process that builds the caches of index and arrays; another process uses what it left."""

    def attempt(moment: float) -> None:
        caches = workspace.new_path()
        process = _start(_BUILD, workspace.release, caches, wait=True)
        time.sleep(moment)
        process.kill()
        numbers, errors = process.communicate()
        check(process.returncode == -signal.SIGKILL, errors)
        last = caches / (numbers.split() or ["0"])[-1]
        with environment({"ICRL4AHT_CACHE_DIR": str(last)}), patch.object(columns, "_UNCACHED", 0):
            for _ in range(2):  # the first builds what is missing, the second finds it
                workspace.check_batches(load_icrl4aht(workspace.release, obs="uint8", cache="mmap"))

    for _ in range(n):
        yield partial(attempt, 0.5 * workspace.rng.random())


def two_readers(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """Two processes open the same release at the same time, 20 times."""

    def attempt(url: str) -> None:
        with workspace.fresh_folders():
            _check_success([_start(_OPEN, url, wait=True) for _ in range(2)], "\n")

    with http_server(workspace.release) as server:
        for _ in range(n):
            yield partial(attempt, server.url)


def two_downloads(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """Two processes download the same release into the same folder at the same time."""

    def attempt(url: str) -> None:
        with workspace.fresh_folders() as to:
            _check_success([_start(_DOWNLOAD, url, to) for _ in range(2)])
            workspace.check_files(to, complete=True)

    with http_server(workspace.release) as server:
        server.faults.next(Slow(0.01), times=10**9)
        for _ in range(n):
            yield partial(attempt, server.url)


def full_mmap(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """Mapped arrays and the cached index do not fit on the disk, or their files reach a limit of size.

    The sizes go from nothing to more than is needed.
    """

    def attempt(size: int, mounted: bool) -> str:
        with workspace.fresh_folders() as to, patch.object(columns, "_UNCACHED", 0):
            caches = to.parent / "cache"
            with _limited(caches, size, mounted) as enlarge:
                dataset = load_icrl4aht(workspace.release, obs="uint8", cache="mmap")
                try:
                    workspace.check_batches(dataset)
                    return "fits"
                except CacheError as error:
                    check(f"{caches}: the cache folder has no room for arrays of " in str(error), repr(error))
                    left = [path for path in caches.iterdir() if not path.name.startswith("index-")]
                    check(all(path.name.startswith("histories-") for path in left), f"left behind: {left}")
                enlarge()
                workspace.check_batches(dataset)
                return "error"

    with workspace.fresh_folders() as to, patch.object(columns, "_UNCACHED", 0):
        workspace.check_batches(load_icrl4aht(workspace.release, obs="uint8", cache="mmap"))
        sizes = [path.stat().st_size for path in to.parent.rglob("*.npy")]
    most = 1.2 * (sum(sizes) + PAGE * len(sizes) if can_mount() else max(sizes))
    for number in range(n):
        yield partial(attempt, PAGE + int(most * number / max(n - 1, 1)) // PAGE * PAGE, can_mount())


def damaged_caches(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """A file of the caches of index and arrays is damaged in a way that its size or its header shows."""
    caches = workspace.new_path()

    def read() -> None:
        with (
            environment({"ICRL4AHT_CACHE_DIR": str(caches)}),
            patch.object(columns, "_UNCACHED", 0),
        ):
            workspace.check_batches(load_icrl4aht(workspace.release, obs="uint8", cache="mmap"))

    def attempt(name: str, damage: str) -> None:
        DAMAGES[damage](caches / name)
        read()
        check((caches / name).read_bytes() == right[name], f"{name}: not rebuilt")

    read()
    right, shown = contents(caches), [name for name in DAMAGES if "bit" not in name]
    for _ in range(n):
        yield partial(attempt, str(workspace.rng.choice(list(right))), str(workspace.rng.choice(shown)))


def two_builds(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """Two processes build the caches of index and arrays at the same time."""

    def attempt() -> None:
        caches = workspace.new_path()
        _check_success([_start(_BUILD_ONCE, workspace.release, caches, wait=True) for _ in range(2)], "\n")
        names = {path.name.split("-")[0] for path in caches.iterdir()}
        check(names <= {"index", "histories"}, f"left behind: {names}")
        with environment({"ICRL4AHT_CACHE_DIR": str(caches)}), patch.object(columns, "_UNCACHED", 0):
            made = contents(caches)
            workspace.check_batches(load_icrl4aht(workspace.release, obs="uint8", cache="mmap"))
            check(contents(caches) == made, "built again")

    for _ in range(n):
        yield partial(attempt)


class DamagedCopy:
    """A copy of the small release, and what reading it gave before it was damaged."""

    def __init__(self, workspace: Workspace) -> None:
        self.root = workspace.new_path()
        shutil.copytree(workspace.small, self.root)
        self.before = self.read()

    def read(self, root: Path | None = None, cache: CacheMode = "ram") -> tuple[bytes, str]:
        """Return a hash of all arrays and of batches, and the metadata as text."""
        dataset = load_icrl4aht(root or self.root, obs="uint8", cache=cache, threads=1)
        histories = [(repr(h.entry), dataset.recover_teammate(h.entry.history_id)) for h in dataset]
        return hash_arrays(dataset) + hash_batches(dataset), f"{histories} {dataset.info}"

    @contextmanager
    def damaged(self, path: Path, data: bytes) -> Iterator[None]:
        """Replace the content of a file for a while."""
        right = path.read_bytes()
        path.write_bytes(data)
        try:
            yield
        finally:
            path.write_bytes(right)

    def check(self, cache: CacheMode = "ram") -> str:
        """Check that `verify` finds the damage, and that reading raises one of our errors or gives the right data."""
        check(not verify_release(self.root).ok, "verify finds nothing")
        try:
            after = self.read(cache=cache)
        except Icrl4ahtError:
            return "error"
        check(after == self.before, "other data without an error")
        return "same data"


def bit_flips(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """One bit of one file of a release is inverted; `verify` has to find it, and no reading may believe it.

    Every file of the release has its turn, and every cache mode; the file's times are set back.
    """
    release = DamagedCopy(workspace)
    paths = sorted(path for path in release.root.rglob("*") if path.is_file())

    def attempt(path: Path, position: int, bit: int, cache: CacheMode) -> str:
        before, data = path.stat(), bytearray(path.read_bytes())
        data[position] ^= 1 << bit
        with release.damaged(path, bytes(data)), workspace.fresh_folders():
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
            return release.check(cache)

    modes: list[CacheMode] = ["ram", "stream", "ram", "stream", "mmap"]
    for number in range(n):
        path, rng = paths[number % len(paths)], workspace.rng
        mode = modes[number // len(paths) % len(modes)]
        yield partial(attempt, path, int(rng.integers(path.stat().st_size)), int(rng.integers(8)), mode)


def mutations(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """Text files of a release, also the manifest, have other lines, values or bytes; time and memory are bounded."""
    release = DamagedCopy(workspace)
    lines = _manifest(release.root)

    def attempt(name: str, seed: int) -> str | None:
        data, rng = (release.root / name).read_bytes(), np.random.default_rng(seed)
        mutated = data
        while mutated == data:
            mutated = _mutated(data, rng, name)
        with release.damaged(release.root / name, mutated), time_limit(20), memory_limit(2 * 2**30):
            return check_manifest() if name == MANIFEST else check_forged()

    def check_forged() -> str | None:
        """Check a file that the manifest does not fit, then with a manifest that fits it: no error but ours."""
        release.check()
        with release.damaged(release.root / MANIFEST, (release.root / MANIFEST).read_bytes()):
            write_manifest(release.root)
            verify_release(release.root)
            with suppress(Icrl4ahtError):
                release.read()
        return None

    def check_manifest() -> str | None:
        with http_server(release.root) as server, workspace.fresh_folders() as to:
            try:
                fetch_planned(plan_download(server.url, to=to))
                check(release.read(to) == release.before, "other data, downloaded")
            except Icrl4ahtError:
                pass
        return "same meaning" if _manifest(release.root) == lines else release.check()

    names = (HISTORIES, INFO, MANIFEST, TASKS, PROVENANCE)
    for number in range(n):
        yield partial(attempt, names[number % len(names)], int(workspace.rng.integers(2**32)))


def _manifest(root: Path) -> dict[str, str] | None:
    try:
        return read_manifest(root)
    except Icrl4ahtError:
        return None


_VALUES = [0, -1, 2**31, 2**63, 10**400, 1e300, -0.5, None, True, "", "x", "\0", "../x", "/etc", "ü" * 9, [], [[]], {}]
_RAW = [b"NaN", b"1e999", b"[" * 100_000, b'{"a":' * 50_000, b'"' + b"x" * 10_000_000 + b'"', b"\xff\xfe", b"\\ud800"]


def _mutated(data: bytes, rng: np.random.Generator, name: str) -> bytes:
    """Return `data` with one random change."""
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
    values = 0 if name == MANIFEST else 3 * len(changes)  # of JSON, most changes are of values
    choice = int(rng.integers(len(changes) + values))
    return changes[choice]() if choice < len(changes) else _other_value(data, rng, by_line=name.endswith(".jsonl"))


def _other_value(data: bytes, rng: np.random.Generator, by_line: bool) -> bytes:
    """Return JSON with one value or key changed or removed."""
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
