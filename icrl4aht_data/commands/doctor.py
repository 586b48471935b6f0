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
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Any

import h5py
from packaging.requirements import Requirement

from icrl4aht_data.benchmark.facts import TEAMMATE_PLUGINS
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.clients import check_credentials, offline_switches, without_credentials
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import OptionError, PluginError
from icrl4aht_data.fetch import is_address
from icrl4aht_data.overcooked.layouts import LAYOUT_PLUGINS, get_layout
from icrl4aht_data.utils.install_hints import EXTRAS, PACKAGE, RESTORE, install_command
from icrl4aht_data.utils.plugins import METHOD_GROUP, Plugins
from icrl4aht_data.utils.system import (
    CACHE_VARIABLE,
    DATA_VARIABLE,
    cache_folder,
    cache_limit,
    data_folder,
    free_memory,
    usable_cores,
)

_JAX_CODE = "import json, jax; print(json.dumps([jax.default_backend(), [d.device_kind for d in jax.local_devices()]]))"
_JAX_TIMEOUT = 120  # maximum seconds to wait until JAX has started


Problems = dict[str, str]
"""Problem of an installation -> advice on how to correct it."""


def diagnose() -> dict[str, Any]:
    """Examine this installation without network access, and leave no files behind.

    Returns:
        A JSON object: "ok", then a mapping of findings per section (sizes in bytes), then "problems".
    """
    problems: Problems = {}
    checks = (_packages, _plugins, _devices, _folders, _network, _bundled)
    sections = {check.__name__.removeprefix("_"): check(problems) for check in checks}
    listed = [{"problem": each, "next_step": step} for each, step in problems.items()]
    return {"ok": not problems, **sections, "problems": listed}


def report_lines(found: dict[str, Any]) -> Iterator[str]:
    """Yield the result of `diagnose` as lines of readable text."""
    for section in (name for name, facts in found.items() if isinstance(facts, dict)):
        yield section.capitalize()
        yield from (
            f"  {name}: {one if isinstance(one, str) else json.dumps(one)}" for name, one in found[section].items()
        )
    for each in found["problems"]:
        yield f"problem: {each['problem']}"
        yield f"   next: {each['next_step']}"
    yield "no problems found" if found["ok"] else f"problems found: {len(found['problems'])}"


def _packages(problems: Problems) -> dict[str, Any]:
    """Return the version of each required or optional package, or how to install a missing optional package."""
    facts: dict[str, Any] = {PACKAGE: _installed_version(PACKAGE), "folder": str(MINI.parent)}
    if facts[PACKAGE] is None:
        problems[f"{PACKAGE}: not installed"] = f"pip install {PACKAGE}, or -e . in a checkout"
        return facts
    facts["Python"], facts["HDF5"] = platform.python_version(), h5py.version.hdf5_version
    for needed in map(Requirement, requires(PACKAGE) or []):
        name, found = needed.name, _installed_version(needed.name)
        if name in facts or (needed.marker is not None and name not in EXTRAS):
            continue
        facts[name] = found
        if found is None and name in EXTRAS:
            facts[name] = f"not installed: {install_command(EXTRAS[name])}"
        elif found is None or not needed.specifier.contains(found, prereleases=True):
            problem = f"{name} {found or 'is not installed'}: expected {needed.specifier}"
            problems[problem] = f"pip install -U '{name}{needed.specifier}'"
    return facts


def _installed_version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _plugins(problems: Problems) -> dict[str, Any]:
    """Return the names that other packages register, by entry-point group; import only the registered layouts."""
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
            # `stderr` of a timeout has no message about the timeout.
            said = error.stderr.strip() if isinstance(error, subprocess.CalledProcessError) else ""
            reason = (said or str(error)).splitlines()[-1]
            problems[f"JAX cannot be used: {reason}"] = "pip install -U --force-reinstall jax jaxlib"
    return facts


def _query_jax() -> str:
    """Return JAX's backend and devices as JSON, found by a separate process.

    Thus a broken JAX cannot crash this process, and no GPU memory stays allocated.
    """
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    command = [sys.executable, "-P", "-c", _JAX_CODE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=_JAX_TIMEOUT, check=True)
    return done.stdout.strip().splitlines()[-1]


def _folders(problems: Problems) -> dict[str, Any]:
    """Return the path and free space of the cache and data folders, which need not exist yet."""
    facts: dict[str, Any] = {}
    for name, path, variable in (("cache", cache_folder(), CACHE_VARIABLE), ("data", data_folder(), DATA_VARIABLE)):
        facts[name] = {"path": str(path)}
        try:
            existing = next(folder for folder in (path, *path.parents) if folder.exists())
            facts[name]["free"] = shutil.disk_usage(existing).free
            with tempfile.TemporaryFile(dir=existing):
                pass
        except OSError as error:
            problem = f"{path}: the {name} folder cannot be written: {error.strerror or error}"
            problems[problem] = f"set {variable} to another folder, or make it writable"
    try:
        facts["cache"]["limit"] = cache_limit()
    except OptionError as error:
        problems[str(error)] = "correct it, or unset it"
    return facts


def _network(problems: Problems) -> dict[str, Any]:
    remote = os.environ.get("ICRL4AHT_REMOTE") or None
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
    return {"ok": report.ok}
