"""Test that `icrl4aht-data doctor` accepts a valid installation and reports each possible problem."""

from __future__ import annotations

import functools
import importlib.metadata
import json
import shutil
from pathlib import Path
from typing import Any

import h5py
import pytest
from packaging.requirements import Requirement

from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.commands import doctor
from icrl4aht_data.utils.install_hints import EXTRAS, RESTORE, install_command
from tests.helpers.commands import run_cli, run_python
from tests.helpers.random_releases import SHARD

QUERY_JAX = doctor._query_jax
verified_once = functools.cache(verify_release)


@pytest.fixture
def doctor_folder(tmp_path, monkeypatch) -> Path:
    """Set new cache and data folders and a fixed list of JAX devices; return the parent of both folders."""
    for name in ("CACHE", "DATA"):
        monkeypatch.setenv(f"ICRL4AHT_{name}_DIR", str(tmp_path / name.lower()))
    for name in ("ICRL4AHT_OFFLINE", "HF_HUB_OFFLINE", "ICRL4AHT_REMOTE", "ICRL4AHT_CACHE_BYTES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(doctor, "_query_jax", lambda: '["cpu", ["cpu"]]')
    monkeypatch.setattr(doctor, "verify_release", verified_once)
    return tmp_path


def run_doctor(code: int = 0) -> tuple[dict[str, Any], str]:
    """Run `doctor`, which must exit with `code`; return its output as parsed JSON and as text."""
    text, facts = run_cli("doctor", code=code), json.loads(run_cli("doctor", "--json", code=code))
    assert code == bool(facts["problems"]) == (not facts["ok"])
    for each in facts["problems"]:
        assert f"problem: {each['problem']}\n   next: {each['next_step']}" in text
    return facts, text


def reported_problems() -> dict[str, str]:
    """Run `doctor`, which must find problems; return a dict from each problem to the advised next step."""
    return {each["problem"]: each["next_step"] for each in run_doctor(1)[0]["problems"]}


def test_doctor_finds_no_problems_in_a_valid_installation(doctor_folder):
    facts, text = run_doctor()
    assert facts["ok"], facts["problems"]
    for expected in (
        f"icrl4aht-data: {importlib.metadata.version('icrl4aht-data')}",
        f"HDF5: {h5py.version.hdf5_version}",
        '"backend": "cpu"',
        f'cache: {{"path": "{doctor_folder / "cache"}"',
        "no problems found",
    ):
        assert expected in text
    assert not list(doctor_folder.iterdir()), "the doctor creates nothing"
    assert facts["bundled"] == {"ok": True}
    assert facts["packages"]["numpy"] == importlib.metadata.version("numpy")
    assert facts["devices"]["jax"] == {"backend": "cpu", "devices": ["cpu"]}
    assert facts["network"] == {"offline": [], "remote": None}


def test_doctor_imports_jax_in_another_process(doctor_folder):
    code = "import sys; from icrl4aht_data.commands import doctor; print(doctor._devices({}), 'jax' in sys.modules)"
    done = run_python("-c", code)
    assert "'jax': {'backend': " in done and done.endswith("False\n")


def test_doctor_reports_folders_that_cannot_be_written(doctor_folder, monkeypatch):
    (doctor_folder / "cache").write_text("a file")
    found = reported_problems()
    assert found[f"{doctor_folder / 'cache'}: the cache folder cannot be written: Not a directory"] == (
        "set ICRL4AHT_CACHE_DIR to another folder, or make it writable"
    )

    def raise_permission_error(dir: Path) -> None:
        raise PermissionError(13, "Permission denied", str(dir))

    monkeypatch.setattr(doctor.tempfile, "TemporaryFile", raise_permission_error)
    assert f"{doctor_folder / 'data'}: the data folder cannot be written: Permission denied" in reported_problems()


@pytest.mark.parametrize("value", ["many", "-5"])
def test_doctor_reports_invalid_environment_variables(doctor_folder, monkeypatch, value):
    monkeypatch.setenv("ICRL4AHT_CACHE_BYTES", value)
    monkeypatch.setenv("ICRL4AHT_REMOTE", "example.org/icrl4aht")
    cache, remote = reported_problems()
    assert cache == f"ICRL4AHT_CACHE_BYTES={value!r}: expected a number of bytes, such as 2e11"
    assert remote == "ICRL4AHT_REMOTE='example.org/icrl4aht': expected an address"


def test_doctor_reports_a_damaged_bundled_release(doctor_folder, monkeypatch, release_copy):
    shard = release_copy / SHARD
    shard.write_bytes(shard.read_bytes()[:-1])
    monkeypatch.setattr(doctor, "MINI", release_copy)
    monkeypatch.setattr(doctor, "verify_release", verify_release)
    ((problem, step),) = reported_problems().items()
    assert problem.startswith(f"the bundled release, {SHARD}: ")
    assert step == RESTORE
    (release_copy / "meta/info.json").unlink()
    assert any("meta/info.json" in problem for problem in reported_problems())


def test_doctor_reports_unsupported_package_versions(doctor_folder, monkeypatch):
    installed = {"numpy": "1.26.4", "matplotlib": "3.0", "rich": None, "pillow": None}

    def fake_version(name: str) -> str:
        found = installed.get(name, importlib.metadata.version(name))
        if found is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return found

    monkeypatch.setattr(doctor, "version", fake_version)
    found = reported_problems()
    assert found.pop("numpy 1.26.4: expected >=2.1") == "pip install -U 'numpy>=2.1'"
    assert set(found) == {"matplotlib 3.0: expected >=3.9", "rich is not installed: expected >=13"}
    assert f"pillow: not installed: {install_command('plot')}" in run_doctor(1)[1], "extras are optional"


def test_doctor_reports_a_broken_jax(doctor_folder, monkeypatch):
    monkeypatch.setattr(doctor, "_query_jax", QUERY_JAX)
    monkeypatch.setattr(doctor, "_JAX_CODE", "raise ImportError('libcuda.so is another version')")
    assert any("JAX cannot be used: ImportError: libcuda.so" in problem for problem in reported_problems())


def test_extras_in_install_hints_contain_their_library(doctor_folder):
    """`EXTRAS` maps libraries to extras; the metadata of icrl4aht-data must list each library in its extra."""
    listed = [Requirement(line) for line in importlib.metadata.requires("icrl4aht-data") or []]
    for name, extra in EXTRAS.items():
        found = [one for one in listed if one.name == name and one.marker and one.marker.evaluate({"extra": extra})]
        assert found, f"{name} is not in extra {extra}"
    assert EXTRAS.keys() <= run_doctor()[0]["packages"].keys()


def test_doctor_shows_offline_mode_and_an_unused_gpu(doctor_folder, monkeypatch):
    """`doctor` shows offline mode and a GPU that JAX does not use, but reports no problem."""
    monkeypatch.setenv("ICRL4AHT_OFFLINE", "1")
    monkeypatch.setattr(shutil, "which", lambda name: name)
    facts, text = run_doctor()
    assert facts["ok"] and 'offline: ["ICRL4AHT_OFFLINE"]' in text and "JAX sees no GPU" in text
