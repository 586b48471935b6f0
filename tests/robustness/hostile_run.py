"""Reads hostile folders in a process of its own, whose memory is bounded; prints a line of JSON for each.

python hostile_run.py releases|published|served FOLDER
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import FIELDS, TEAMMATES
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.paths import files_below
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import from_published, to_published
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from tests.helpers.random_play import make_tasks, play
from tests.robustness.hostile_folders import CASES, Spoil
from tests.robustness.hostile_published import PUBLISHED_CASES
from tests.robustness.hostile_served import SERVED

SECRET = "what lies outside of the release"
MEMORY = 3 * 2**30
SECONDS = 60

LARGE = 2**26  # bytes that are not looked through
Steps = Callable[[Path, Path], dict[str, Callable[[], Any]]]


class HungError(Exception):
    """A step took too long."""


def make_release(root: Path) -> None:
    """Four histories of a heuristic and of a learned teammate."""
    files = {"policy.safetensors": b"weights", "policy.json": b"{}"}
    for name, data in files.items():
        (root.parent / name).write_bytes(data)
    digest = file_hash(root.parent / "policy.safetensors")
    theta = {"checkpoint": "m0/c4", "sha256": digest}
    mate = {"kind": "rl", "family": "fcp", "theta_id": 0, "base_seed": 0, "theta": theta}
    heuristic = make_tasks(["coord_simple"])[0]
    learned = make_task("teammate", "train", "coord_simple", mate, 1)
    rng = np.random.default_rng(0)
    tasks = []
    for task in (heuristic, learned):
        histories = [NewHistory(k, play(task.layout, 6, 20, rng)) for k in range(2)]
        kept = {f"{TEAMMATES}/{digest}/{name}": root.parent / name for name in files} if task is learned else {}
        tasks.append(NewTask(task, Provenance(streams_recorded=2), 2, lambda histories=histories: histories, kept))
    write_release(root, "lite", tasks, data_version="0.0.1", card="# hostile\n", kept_steps=20)


def make_outside(folder: Path) -> None:
    """What no release may touch."""
    folder.mkdir()
    (folder / "secret.txt").write_text(SECRET)
    (folder / "policy.json").write_text(SECRET)
    os.mkfifo(folder / "pipe")
    with h5py.File(folder / "secret.h5", "w") as file:
        file["secret"] = np.frombuffer(SECRET.encode().ljust(120), "i1")


def state(folder: Path) -> dict[str, tuple]:
    """Of all that is in a folder, without opening anything."""
    kept = {}
    for name in files_below(folder):
        try:
            status = os.lstat(folder / name)
        except OSError:
            continue
        kept[name] = status.st_mode, status.st_size, status.st_mtime_ns, status.st_ino
    return kept


@contextmanager
def limit(seconds: float) -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise HungError(f"more than {seconds} seconds")

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def tried(steps: dict[str, Callable[[], Any]]) -> dict[str, dict[str, Any]]:
    """step -> whether it ended well, or in an error of ours, and what it said."""
    outcomes = {}
    for name, step in steps.items():
        began = time.monotonic()
        try:
            with limit(SECONDS):
                outcome = {"ours": True, "said": str(step() or ""), "failed": False}
        except Icrl4ahtError as error:
            outcome = {"ours": True, "said": str(error), "failed": True}
        except BaseException as error:
            outcome = {"ours": False, "said": f"{error!r}\n{traceback.format_exc()[-3000:]}", "failed": True}
        outcomes[name] = outcome | {"seconds": round(time.monotonic() - began, 2)}
    return outcomes


def read(root: Path | str) -> None:
    dataset = load_icrl4aht(root, threads=1)
    for history in dataset:
        for name in FIELDS:
            history.read(name)
        history.returns()
        dataset.recover_environment(history.entry.history_id)
        dataset.recover_teammate(history.entry.history_id)


def sample(root: Path | str) -> None:
    for cache in ("ram", "stream"):
        dataset = load_icrl4aht(root, cache=cache, threads=1)
        dataset.ad(batch_size=4, length=8)[0]
        dataset.dpt(batch_size=4, context=8)[0]


def verified(root: Path) -> str:
    report = verify_release(root, level="deep")
    assert not report.ok, "verify calls it whole"
    return "\n".join(f"{finding.file}: {finding.problem}" for finding in report.findings[:1000])


def release_steps(root: Path, out: Path) -> dict[str, Callable[[], Any]]:
    return {
        "read": lambda: read(root),
        "sample": lambda: sample(root),
        "verify": lambda: verified(root),
        "quick": lambda: verify_release(root, level="quick"),
        "convert": lambda: to_release(load_icrl4aht(root), out / "full", "full"),
        "published": lambda: to_published(load_icrl4aht(root), out / "published"),
        "combine": lambda: combine_releases(out / "combined", [root]),
    }


def published_steps(root: Path, out: Path) -> dict[str, Callable[[], Any]]:
    return {
        "lite": lambda: from_published(root, out / "lite", kept_steps=20),
        "observations": lambda: from_published(root, out / "observations", "observations", kept_steps=20),
    }


def served_steps(step: Callable[[Path, Path], Any]) -> Steps:
    def steps(root: Path, out: Path) -> dict[str, Callable[[], Any]]:
        copy = out / "served"
        shutil.copytree(root, copy, symlinks=True)
        return {"download": lambda: step(copy, out)}

    return steps


def run(folder: Path, base: Path, spoil: Spoil, steps: Steps) -> dict[str, Any]:
    """One case: what each step came to, and what it left behind."""
    folder.mkdir()
    root, out = folder / "root", folder / "out"
    shutil.copytree(base, root)
    make_outside(folder / "outside")
    out.mkdir()
    spoil(root)
    before = state(root), state(folder / "outside"), sorted(folder.iterdir())
    os.chdir(out)
    outcomes = tried(steps(root, out))
    touched = before != (state(root), state(folder / "outside"), sorted(folder.iterdir()))
    made = [out / name for name in files_below(out)]
    leaked = [str(path) for path in made if path.is_symlink() or not path.is_file() or _tells(path)]
    taken = sum(path.lstat().st_blocks * 512 for path in made)
    leaked += [step for step, outcome in outcomes.items() if SECRET in outcome["said"]]
    os.chdir(folder.parent)
    try:
        shutil.rmtree(folder)
    except RecursionError:
        subprocess.run(["rm", "-rf", str(folder)], check=True)
    return {"steps": outcomes, "touched": touched, "leaked": leaked, "taken": taken}


def _tells(path: Path) -> bool:
    return path.stat().st_size < LARGE and SECRET.encode() in path.read_bytes()


def main(kind: str, folder: Path) -> None:
    warnings.simplefilter("error")
    base = folder / "base"
    make_release(base)
    cases: dict[str, tuple[Spoil, Steps]] = {name: (spoil, release_steps) for name, (spoil, _) in CASES.items()}
    if kind == "published":
        to_published(load_icrl4aht(base), folder / "files")
        base = folder / "files"
        cases = {name: (spoil, published_steps) for name, (spoil, _) in PUBLISHED_CASES.items()}
    elif kind == "served":
        cases = {name: (lambda root: None, served_steps(step)) for name, (step, _) in SERVED.items()}
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    for number, (name, (spoil, steps)) in enumerate(cases.items()):
        print(json.dumps({"case": name} | run(folder / f"case{number}", base, spoil, steps)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
