"""`doctor`: what is installed, where things are kept, what is in the way; and the next step for each problem."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.commands.requirements import PACKAGE, needs, python_versions
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.safe_hdf5 import OLDEST_HDF5
from icrl4aht_data.remote.download import default_remote
from icrl4aht_data.remote.remote_release import is_address
from icrl4aht_data.remote.store import offline_switches
from icrl4aht_data.utils.cache import CACHE_VARIABLES, DATA_VARIABLES, cache_folder, cache_limit, data_folder
from icrl4aht_data.utils.memory import free_memory
from icrl4aht_data.utils.threads import usable_cores

_LEAST_FREE = 2**30
"""Bytes; a disk with less is nearly full."""

_HUB_VARIABLES = ("HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_HOME", "XDG_CACHE_HOME")
"""Environment variables by which the Hub's client chooses its cache."""

_OF_CHECKOUT = ("generation", "baselines")
"""Packages of the project that no wheel has."""

_ASK_JAX = "import json, jax; print(json.dumps([jax.default_backend(), [d.device_kind for d in jax.local_devices()]]))"
_JAX_TIMEOUT = 120  # seconds


class Problem(NamedTuple):
    """Something wrong, and what to do about it."""

    problem: str
    next_step: str


@dataclass
class Diagnosis:
    """What `diagnose` found."""

    versions: dict[str, Any] = field(default_factory=dict)
    packages: dict[str, dict[str, str | None]] = field(default_factory=dict)
    devices: dict[str, Any] = field(default_factory=dict)
    folders: dict[str, dict[str, Any]] = field(default_factory=dict)
    network: dict[str, Any] = field(default_factory=dict)
    bundled: dict[str, Any] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not self.problems

    def to_json(self) -> dict[str, Any]:
        return {"ok": self.ok, **asdict(self), "problems": [problem._asdict() for problem in self.problems]}

    def wrong(self, problem: str, next_step: str) -> None:
        self.problems.append(Problem(problem, next_step))


def diagnose() -> Diagnosis:
    """Look at this installation; nothing is asked of the network, and nothing is left on disk."""
    found = Diagnosis()
    _look_at_versions(found)
    _look_at_packages(found)
    _look_at_devices(found)
    _look_at_folders(found)
    _look_at_network(found)
    _look_at_bundled(found)
    return found


def _look_at_versions(found: Diagnosis) -> None:
    python, hdf5 = platform.python_version(), h5py.version.hdf5_version
    found.versions = {"python": python, "numpy": np.__version__, "h5py": h5py.version.version, "hdf5": hdf5}
    found.versions["checkout"] = all(importlib.util.find_spec(name) for name in _OF_CHECKOUT)
    if h5py.version.hdf5_version_tuple < OLDEST_HDF5:
        oldest = ".".join(map(str, OLDEST_HDF5))
        found.wrong(f"HDF5 {hdf5}: expected {oldest} or newer", "pip install -U --force-reinstall h5py")
    try:
        asked = python_versions()
        found.versions = {"package": version(PACKAGE), "folder": str(MINI.parent), **found.versions}
    except OptionError as error:
        problem, _, next_step = str(error).partition("; ")
        found.wrong(problem, next_step)
        return
    if not asked.contains(python, prereleases=True):
        found.wrong(f"Python {python}: expected {asked}", "make an environment with such a Python")


def _look_at_packages(found: Diagnosis) -> None:
    try:
        asked = needs()
    except OptionError:  # told already
        return
    for need in asked:
        found.packages[need.name] = {"found": need.found, "expected": str(need.versions), "extra": need.extra}
        if not need.fits and (need.found or need.extra is None):
            problem = f"{need.name} {need.found or 'is not installed'}: expected {need.versions}"
            found.wrong(problem, f"pip install -U '{need.name}{need.versions}'")


def _look_at_devices(found: Diagnosis) -> None:
    found.devices = {"cores": usable_cores(), "free_memory": free_memory()}
    if importlib.util.find_spec("jax") is None:
        return
    try:
        backend, kinds = json.loads(_ask_jax())
        found.devices["jax"] = {"backend": backend, "devices": kinds}
        if backend == "cpu" and shutil.which("nvidia-smi"):
            found.devices["note"] = "JAX sees no GPU: on a machine with one, install jax[cuda13] or jax[cuda12]"
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        found.wrong(f"JAX cannot be used: {error}", "pip install -U --force-reinstall jax jaxlib")


def _ask_jax() -> str:
    """Of a process of its own: a broken JAX takes nothing down, and no GPU memory is held."""
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    command = [sys.executable, "-P", "-c", _ASK_JAX]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=_JAX_TIMEOUT)
    if done.returncode:
        raise OSError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
    return done.stdout.strip().splitlines()[-1]


def _look_at_folders(found: Diagnosis) -> None:
    from huggingface_hub import constants

    limit = None
    try:
        limit = cache_limit()
    except OptionError as error:
        found.wrong(str(error), "set it so, or unset it")
    cache, data = cache_folder(), data_folder()
    found.folders["cache"] = _folder(found, "cache", cache, CACHE_VARIABLES) | {
        "bytes": _bytes(cache.rglob("*")),
        "limit": limit,
        "left_over": [str(path) for pattern in (".*.partial", ".*.removed-*") for path in cache.glob(pattern)],
    }
    found.folders["data"] = _folder(found, "data", data, DATA_VARIABLES) | {
        "bytes": _bytes(data.rglob("*")),
        "in_part": _bytes(path for folder in data.glob("*/*.partial") for path in folder.rglob("*")),
    }
    found.folders["hub"] = _folder(found, "hub", Path(constants.HF_HUB_CACHE), _HUB_VARIABLES)


def _folder(found: Diagnosis, name: str, path: Path, variables: tuple[str, ...]) -> dict[str, Any]:
    """What is true of a folder, whether it exists already or will be made."""
    source = next((variable for variable in variables if os.environ.get(variable)), None)
    free, fault = None, None
    try:
        above = next(folder for folder in (path, *path.parents) if folder.exists())
        free = shutil.disk_usage(above).free
        with tempfile.TemporaryFile(dir=above):
            pass
    except OSError as error:
        fault = error.strerror or str(error)
        found.wrong(
            f"{path}: the {name} folder cannot be written: {fault}",
            f"set {variables[0]} to another folder, or make it writable",
        )
    if free is not None and free < _LEAST_FREE:
        problem = f"{path}: the disk of the {name} folder is nearly full: {free:,} bytes are free"
        found.wrong(problem, f"set {variables[0]} to a folder on another disk, or free some space")
    return {
        "path": str(path),
        "set_by": source,
        "variable": variables[0],
        "exists": os.access(path, os.F_OK),
        "writable": fault is None,
        "free": free,
    }


def _bytes(paths: Iterable[Path]) -> int:
    """What files take on disk."""
    total = 0
    for path in paths:
        try:
            status = path.lstat()
            total += getattr(status, "st_blocks", 0) * 512 or status.st_size
        except OSError:  # removed since
            continue
    return total


def _look_at_network(found: Diagnosis) -> None:
    remote = default_remote()
    found.network = {"offline": offline_switches(), "remote": remote}
    if remote is not None and not is_address(remote):
        expected = "hf://datasets/<org>/<repo>, https://... or s3://..."
        found.wrong(
            f"ICRL4AHT_REMOTE={remote!r}: expected an address", f"set it to one such as {expected}, or unset it"
        )


def _look_at_bundled(found: Diagnosis) -> None:
    try:
        info = read_info(MINI)
        found.bundled = {name: getattr(info, name) for name in ("data_version", "format_version", "kind", "histories")}
    except Icrl4ahtError:  # told below
        pass
    report = verify_release(MINI, quick=True)
    found.bundled["ok"] = report.ok
    for finding in report.findings:
        again = f"pip install --force-reinstall --no-deps {PACKAGE}, or `git checkout` in a checkout"
        found.wrong(f"the bundled release, {finding.file}: {finding.problem}", again)


def in_words(found: Diagnosis) -> Iterator[str]:
    """The lines of a report for people."""
    for heading, tell in _PARTS.items():
        yield heading
        rows = list(tell(found))
        longest = max((len(name) for name, _ in rows), default=0)
        yield from (f"  {name:<{longest}}  {text}" for name, text in rows)
    for problem in found.problems:
        yield f"problem: {problem.problem}"
        yield f"   next: {problem.next_step}"
    yield "no problems found" if found.ok else f"problems found: {len(found.problems)}"


Rows = Iterator[tuple[str, str]]


def _tell_versions(found: Diagnosis) -> Rows:
    if "package" in found.versions:
        yield PACKAGE, f"{found.versions['package']} in {found.versions['folder']}"
    if not found.versions["checkout"]:
        yield ", ".join(_OF_CHECKOUT), "not here: they run from a checkout of the project"
    for name in ("python", "numpy", "h5py", "hdf5"):
        yield name, found.versions[name]
    release = found.bundled
    if "data_version" in release:
        what = f"data version {release['data_version']}, {release['kind']}, format {release['format_version']}"
        state = "names and sizes are right" if release["ok"] else "damaged"
        yield "bundled release", f"{what}, {release['histories']} histories; {state}"


def _tell_packages(found: Diagnosis) -> Rows:
    for name, said in found.packages.items():
        extra = f", extra {said['extra']}" if said["extra"] else ""
        if said["found"] or not said["extra"]:
            yield name, f"{said['found'] or 'not installed'} ({said['expected']}{extra})"
        else:
            yield name, f"not installed: pip install '{PACKAGE}[{said['extra']}]'"


def _tell_devices(found: Diagnosis) -> Rows:
    yield "CPU", f"{found.devices['cores']} cores"
    yield "memory", f"{found.devices['free_memory']:,} bytes free"
    if "jax" in found.devices:
        yield "JAX", f"{found.devices['jax']['backend']}: {', '.join(found.devices['jax']['devices'])}"
    if "note" in found.devices:
        yield "", found.devices["note"]


def _tell_folders(found: Diagnosis) -> Rows:
    for name, said in found.folders.items():
        source = f"set by {said['set_by']}" if said["set_by"] else f"by default; {said['variable']} moves it"
        yield name, f"{said['path']} ({source})"
        facts = ["writable" if said["writable"] else "NOT writable"]
        facts += [] if said["free"] is None else [f"{said['free']:,} bytes free on its disk"]
        if "bytes" in said:
            most = f" of at most {said['limit']:,}" if said.get("limit") is not None else ""
            facts.append(f"{said['bytes']:,} bytes used{most}" if said["exists"] else "not made yet")
        if said.get("in_part"):
            facts.append(f"{said['in_part']:,} of them of files that are here in part")
        if said.get("left_over"):
            facts.append(f"{len(said['left_over'])} unfinished sets, which the next one to be made removes")
        yield "", ", ".join(facts)


def _tell_network(found: Diagnosis) -> Rows:
    switches = ", ".join(f"${name}" for name in found.network["offline"])
    yield "network", f"nothing is asked of it: {switches}" if switches else "may be asked"
    yield "ICRL4AHT_REMOTE", found.network["remote"] or "not set"


_PARTS: dict[str, Callable[[Diagnosis], Rows]] = {
    "Versions": _tell_versions,
    "Packages": _tell_packages,
    "Devices": _tell_devices,
    "Folders": _tell_folders,
    "Network": _tell_network,
}
