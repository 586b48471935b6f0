"""Read hostile inputs in a separate process with bounded memory."""

from __future__ import annotations

import os
import shutil
import subprocess
import traceback
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icrl4aht_data import clients, load_icrl4aht, verify_release
from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.fetch import fetch_planned, plan_download
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import FIELDS, TEAMMATES
from icrl4aht_data.utils import files
from icrl4aht_data.utils.files import file_hash, files_below
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import from_published, to_published
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from tests.helpers.random_releases import make_tasks, random_history
from tests.robustness.hostile.cases import CASES, Case
from tests.robustness.limits import memory_limit, time_limit
from tests.servers.faults import Faults
from tests.servers.http import http_server

SECRET = "text outside of the release"
MEMORY = 3 * 2**30
SECONDS = 60

_BOUND = ExitStack()
LARGE = 2**26  # bytes; size limit of files except shards, and files of this size are not searched for `SECRET`
Steps = dict[str, Callable[[], Any]]


def make_release(root: Path) -> None:
    """Write a release of two histories with a heuristic teammate and two with a learned teammate."""
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
        histories = [NewHistory(k, random_history(task.layout, 6, 20, rng)) for k in range(2)]
        kept = {f"{TEAMMATES}/{digest}/{name}": root.parent / name for name in files} if task is learned else {}
        tasks.append(NewTask(task, Provenance(streams_recorded=2), 2, lambda histories=histories: histories, kept))
    write_release(root, "lite", tasks, data_version="0.0.1", card="# hostile\n", kept_steps=20)


def make_outside_files(folder: Path) -> None:
    """Create files outside the release, which readers of the release must neither touch nor reveal."""
    folder.mkdir()
    (folder / "secret.txt").write_text(SECRET)
    (folder / "policy.json").write_text(SECRET)
    os.mkfifo(folder / "pipe")
    with h5py.File(folder / "secret.h5", "w") as file:
        file["secret"] = np.frombuffer(SECRET.encode().ljust(120), "i1")


def file_states(folder: Path) -> dict[str, tuple]:
    """Return mode, size, time and inode of all files below a folder, without opening the files."""
    states = {}
    for name in files_below(folder):
        try:
            status = os.lstat(folder / name)
        except OSError:
            continue
        states[name] = status.st_mode, status.st_size, status.st_mtime_ns, status.st_ino
    return states


def run_operation(step: Callable[[], Any]) -> dict[str, Any]:
    """Run an operation; return its output or error message, and whether any error is an `Icrl4ahtError`."""
    try:
        with time_limit(SECONDS):
            ours, text = True, str(step() or "")
    except Icrl4ahtError as error:
        ours, text = True, str(error)
    except BaseException as error:
        ours, text = False, f"{error!r}\n{traceback.format_exc()[-3000:]}"
    return {"ours": ours, "said": text}


def read_all_fields(root: Path) -> None:
    """Read every field of every history."""
    dataset = load_icrl4aht(root, threads=1)
    for history in dataset:
        for name in FIELDS:
            history.read(name)
        history.returns()
        dataset.environment_parameters(history.entry.history_id)
        dataset.recover_teammate(history.entry.history_id)


def sample_batches(root: Path) -> None:
    """Sample an AD batch and a DPT batch, with cache `ram` and with cache `stream`."""
    for cache in ("ram", "stream"):
        dataset = load_icrl4aht(root, cache=cache, threads=1)
        dataset.ad(batch_size=4, length=8)[0]
        dataset.dpt(batch_size=4, context=8)[0]


def problems_found_by_verify(root: Path) -> str:
    """Return the problems that `verify` finds; at least one problem is expected."""
    report = verify_release(root, level="deep")
    assert not report.ok, "verify finds nothing"
    return "\n".join(f"{finding.file}: {finding.problem}" for finding in report.findings[:1000])


def download_release(root: Path, out: Path, case: Case) -> None:
    """Download a release from a server with the faults of a case."""
    faults = Faults()
    for path, fault in case.rules.items():
        faults.next(fault, times=10**9, path=path, method=None)
    with http_server(root, faults) as server:
        fetch_planned(plan_download(server.url, to=out / "mirror"))


def case_operations(case: Case, root: Path, out: Path) -> Steps:
    """Return the operations to run on a hostile input, as functions by name."""
    if case.kind == "served":
        return {"download": lambda: download_release(root, out, case)}
    if case.kind == "published":
        return {
            "lite": lambda: from_published(root, out / "lite", kept_steps=20),
            "observations": lambda: from_published(root, out / "observations", "observations", kept_steps=20),
        }
    return {
        "read": lambda: read_all_fields(root),
        "sample": lambda: sample_batches(root),
        "verify": lambda: problems_found_by_verify(root),
        "quick": lambda: verify_release(root, level="quick"),
        "convert": lambda: to_release(load_icrl4aht(root), out / "full", "full"),
        "published": lambda: to_published(load_icrl4aht(root), out / "published"),
        "combine": lambda: combine_releases(out / "combined", [root]),
    }


def run_in_folder(folder: Path, base: Path, case: Case) -> dict[str, Any]:
    """Run all operations of a case; return outcomes, whether inputs changed, leaks of `SECRET`, and bytes written."""
    folder.mkdir()
    root, out = folder / "root", folder / "out"
    shutil.copytree(base, root)
    make_outside_files(folder / "outside")
    out.mkdir()
    case.tamper(root)
    before = file_states(root), file_states(folder / "outside"), sorted(folder.iterdir())
    os.chdir(out)
    outcomes = {name: run_operation(step) for name, step in case_operations(case, root, out).items()}
    touched = before != (file_states(root), file_states(folder / "outside"), sorted(folder.iterdir()))
    written = [out / name for name in files_below(out)]
    leaked = [str(path) for path in written if path.is_symlink() or not path.is_file() or _contains_secret(path)]
    taken = sum(path.lstat().st_blocks * 512 for path in written)
    leaked += [step for step, outcome in outcomes.items() if SECRET in outcome["said"]]
    os.chdir(folder.parent)
    subprocess.run(["rm", "-rf", str(folder)], check=True)  # shutil.rmtree fails on folders that are nested too deep
    return {"steps": outcomes, "touched": touched, "leaked": leaked, "taken": taken}


def _contains_secret(path: Path) -> bool:
    return path.stat().st_size < LARGE and SECRET.encode() in path.read_bytes()


def make_valid_inputs(folder: Path) -> None:
    """Write the valid release and the valid published files that hostile cases copy and damage."""
    make_release(folder / "release")
    to_published(load_icrl4aht(folder / "release"), folder / "published")


def limit_process() -> None:
    """Limit this process's memory, file sizes and waits before retries, and turn warnings into errors."""
    warnings.simplefilter("error")
    clients._WAITS = (0.01, 0.01, 0.01)
    files.LARGEST = LARGE
    _BOUND.enter_context(memory_limit(MEMORY))


def run_case(folder: Path, name: str) -> dict[str, Any]:
    """Run the hostile case of a given name in a folder that `make_valid_inputs` has filled."""
    base = folder / ("published" if CASES[name].kind == "published" else "release")
    return run_in_folder(folder / "case", base, CASES[name])
