"""Diagnosis of an installation: versions, devices, folders and settings, with advice for each problem."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, metadata, version
from pathlib import Path
from typing import Any

import h5py
from huggingface_hub import constants
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from icrl4aht_data.benchmark.facts import TEAMMATE_PLUGINS
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.clients import check_credentials, offline_switches, without_credentials
from icrl4aht_data.dataset import MINI
from icrl4aht_data.download import default_remote
from icrl4aht_data.errors import Icrl4ahtError, OptionError, PluginError
from icrl4aht_data.fetch import is_address
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.safe_hdf5 import OLDEST_HDF5
from icrl4aht_data.overcooked.layouts import LAYOUT_PLUGINS, get_layout
from icrl4aht_data.utils.install_hints import EXTRAS, PACKAGE, RESTORE, install_command
from icrl4aht_data.utils.plugins import METHOD_GROUP, Plugins
from icrl4aht_data.utils.system import (
    CACHE_VARIABLES,
    DATA_VARIABLES,
    cache_folder,
    cache_limit,
    data_folder,
    free_memory,
    usable_cores,
)

_LEAST_FREE = 2**30
"""Free bytes below which a disk is reported as nearly full."""

_HUB_VARIABLES = ("HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_HOME", "XDG_CACHE_HOME")
"""Environment variables that set the cache of the Hub's client."""

_JAX_CODE = "import json, jax; print(json.dumps([jax.default_backend(), [d.device_kind for d in jax.local_devices()]]))"
_JAX_TIMEOUT = 120  # seconds


Problems = dict[str, str]
"""Problem of an installation -> advice on how to correct it."""


def diagnose() -> dict[str, Any]:
    """Examine this installation without network access and without leaving files.

    Returns:
        A JSON object: "ok", then a mapping of findings per section (sizes in bytes), then "problems".
    """
    problems: Problems = {}
    checks = (_packages, _plugins, _devices, _folders, _network, _bundled)
    sections = {check.__name__.removeprefix("_"): check(problems) for check in checks}
    return {
        "ok": not problems,
        **sections,
        "problems": [{"problem": each, "next_step": step} for each, step in problems.items()],
    }


def in_words(found: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a readable report from the result of `diagnose`."""
    for section in (name for name, facts in found.items() if isinstance(facts, dict)):
        yield section.capitalize()
        longest = max(map(len, found[section]), default=0)
        yield from (f"  {name:<{longest}}  {_text(value)}" for name, value in found[section].items())
    for each in found["problems"]:
        yield f"problem: {each['problem']}"
        yield f"   next: {each['next_step']}"
    yield "no problems found" if found["ok"] else f"problems found: {len(found['problems'])}"


def _text(value: Any) -> str:
    if isinstance(value, dict):
        absent = ["not installed"] if value.get("found", "") is None else []
        known = (f"{name.replace('_', ' ')} {_text(v)}" for name, v in value.items() if v is not None)
        return ", ".join([*absent, *known])
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return f"{value:,}" if isinstance(value, int) else value


def _packages(problems: Problems) -> dict[str, Any]:
    facts: dict[str, Any] = {PACKAGE: {"found": _installed(PACKAGE), "folder": str(MINI.parent)}}
    oldest = SpecifierSet(f">={'.'.join(map(str, OLDEST_HDF5))}")
    wanted = [("HDF5", oldest, h5py.version.hdf5_version)]
    steps = {"HDF5": "pip install -U --force-reinstall h5py", "Python": "create an environment with such a Python"}
    try:
        about = metadata(PACKAGE)
    except PackageNotFoundError:
        problems[f"{PACKAGE}: not installed"] = f"pip install {PACKAGE}, or -e . in a checkout"
    else:
        wanted.append(("Python", SpecifierSet(about["Requires-Python"]), platform.python_version()))
        needed = {one.name: one for one in map(Requirement, reversed(about.get_all("Requires-Dist") or []))}
        wanted += [
            (name, one.specifier, _installed(name))
            for name, one in reversed(needed.items())
            if name in EXTRAS or one.marker is None
        ]
    for name, versions, found in wanted:
        extra = EXTRAS.get(name)
        facts[name] = {"found": found, "expected": str(versions), "extra": extra}
        if found is None and extra is not None:
            facts[name]["install"] = install_command(extra)
        elif found is None or not versions.contains(found, prereleases=True):
            step = steps.get(name, f"pip install -U '{name}{versions}'")
            problems[f"{name} {found or 'is not installed'}: expected {versions}"] = step
    return facts


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _plugins(problems: Problems) -> dict[str, Any]:
    """Return the objects that other packages register, by entry-point group; teammates and methods are not imported."""
    facts: dict[str, Any] = {}
    for plugins in (LAYOUT_PLUGINS, TEAMMATE_PLUGINS, Plugins(METHOD_GROUP, ())):
        try:
            facts[plugins.group] = [f"{name} ({package})" for name, package in plugins.packages.items()]
            if plugins is LAYOUT_PLUGINS:
                _ = [get_layout(name) for name in plugins.names]
        except PluginError as error:
            problems[str(error)] = "correct or uninstall the package"
    return facts


def _devices(problems: Problems) -> dict[str, Any]:
    facts: dict[str, Any] = {"cores": usable_cores(), "free_memory": free_memory()}
    if importlib.util.find_spec("jax"):
        try:
            backend, devices = json.loads(_query_jax())
            facts["jax"] = {"backend": backend, "devices": devices}
            if backend == "cpu" and shutil.which("nvidia-smi"):
                facts["note"] = f"JAX sees no GPU: on a machine with one, `{install_command('cuda13')}`, or cuda12"
        except (OSError, ValueError, subprocess.SubprocessError) as error:
            reason = (getattr(error, "stderr", None) or str(error)).strip().splitlines()[-1]
            problems[f"JAX cannot be used: {reason}"] = "pip install -U --force-reinstall jax jaxlib"
    return facts


def _query_jax() -> str:
    """Return JAX's backend and devices as JSON.

    Runs in a separate process, so that a broken JAX cannot crash this one and no GPU memory stays allocated."""
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    command = [sys.executable, "-P", "-c", _JAX_CODE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=_JAX_TIMEOUT, check=True)
    return done.stdout.strip().splitlines()[-1]


def _folders(problems: Problems) -> dict[str, Any]:
    cache, data = cache_folder(), data_folder()
    facts = {
        "cache": _folder("cache", cache, CACHE_VARIABLES, problems),
        "data": _folder("data", data, DATA_VARIABLES, problems),
        "hub": _folder("hub", Path(constants.HF_HUB_CACHE), _HUB_VARIABLES, problems),
    }
    facts["cache"]["bytes"], facts["data"]["bytes"] = (_disk_usage(folder.rglob("*")) for folder in (cache, data))
    try:
        facts["cache"]["limit"] = cache_limit()
    except OptionError as error:
        problems[str(error)] = "correct it, or unset it"
    facts["cache"]["left_over"] = [str(p) for p in cache.glob(".*.partial-*")]
    facts["data"]["in_part"] = _disk_usage(path for part in data.glob("*/*/.partial-*") for path in part.rglob("*"))
    return facts


def _folder(name: str, path: Path, variables: tuple[str, ...], problems: Problems) -> dict[str, Any]:
    """Return a folder's path, setting, free space and whether it is writable; the folder may not exist yet."""
    free, writable = None, False
    try:
        existing = next(folder for folder in (path, *path.parents) if folder.exists())
        free = shutil.disk_usage(existing).free
        with tempfile.TemporaryFile(dir=existing):
            writable = True
    except OSError as error:
        problem = f"{path}: the {name} folder cannot be written: {error.strerror or error}"
        problems[problem] = f"set {variables[0]} to another folder, or make it writable"
    if free is not None and free < _LEAST_FREE:
        problem = f"{path}: the disk of the {name} folder is nearly full: {free:,} bytes are free"
        problems[problem] = f"set {variables[0]} to a folder on another disk, or free some space"
    set_by = next((variable for variable in variables if os.environ.get(variable)), None)
    facts = {"path": str(path), "set_by": set_by, "variable": variables[0], "exists": os.access(path, os.F_OK)}
    return facts | {"writable": writable, "free": free}


def _disk_usage(paths: Iterable[Path]) -> int:
    """Return the disk usage of files in bytes."""
    total = 0
    for path in paths:
        with suppress(OSError):  # just removed by another process
            status = path.lstat()
            total += getattr(status, "st_blocks", 0) * 512 or status.st_size
    return total


def _network(problems: Problems) -> dict[str, Any]:
    remote = default_remote()
    if remote is not None and not is_address(remote):
        step = "set it to one such as hf://datasets/<org>/<repo>, https://... or s3://..., or unset it"
        problems[f"ICRL4AHT_REMOTE={remote!r}: expected an address"] = step
    try:
        check_credentials(remote or "")
    except OptionError as error:
        problems[f"ICRL4AHT_REMOTE: {error}"] = "set it to such an address, or unset it"
        remote = "not shown"
    return {"offline": offline_switches(), "remote": remote and without_credentials(remote)}


def _bundled(problems: Problems) -> dict[str, Any]:
    report = verify_release(MINI, level="quick")
    problems |= {f"the bundled release, {each.file}: {each.problem}": RESTORE for each in report.findings}
    facts: dict[str, Any] = {"ok": report.ok}
    with suppress(Icrl4ahtError):  # unreadable files are already reported
        info = read_info(MINI)
        names = ("data_version", "format_version", "kind", "histories")
        facts |= {name: getattr(info, name) for name in names}
    return facts
