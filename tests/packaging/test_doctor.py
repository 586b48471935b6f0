"""`icrl4aht-data doctor`: what it says of a whole installation, and of each thing that can be wrong with one."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from collections import namedtuple
from email.message import Message
from pathlib import Path

import h5py
import pytest
from click.testing import CliRunner

from icrl4aht_data.commands import doctor, requirements
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.commands.requirements import extra_with, needs
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.schema import FORMAT_VERSION
from tests.helpers.paths import ROOT
from tests.helpers.random_play import SHARD


@pytest.fixture
def elsewhere(tmp_path, monkeypatch) -> Path:
    """Folders of the test's own, none of them made yet; JAX is not asked each time."""
    for name in ("CACHE", "DATA"):
        monkeypatch.setenv(f"ICRL4AHT_{name}_DIR", str(tmp_path / name.lower()))
    for name in ("ICRL4AHT_OFFLINE", "HF_HUB_OFFLINE", "ICRL4AHT_REMOTE", "ICRL4AHT_CACHE_BYTES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(doctor, "_ask_jax", lambda: '["cpu", ["cpu"]]')
    return tmp_path


def ask(*options: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli, ["doctor", *options])
    return result.exit_code, result.output


def problems() -> dict[str, str]:
    """What is wrong, and the next step."""
    code, output = ask("--json")
    found = json.loads(output)["problems"]
    assert code == bool(found)
    text = ask()[1]
    assert all(f"problem: {each['problem']}\n   next: {each['next_step']}" in text for each in found)
    return {each["problem"]: each["next_step"] for each in found}


def test_nothing_wrong(elsewhere):
    code, text = ask()
    assert code == 0, text
    info = read_info(MINI)
    for expected in (
        f"icrl4aht-data    {importlib.metadata.version('icrl4aht-data')} in {MINI.parent}",
        f"hdf5             {h5py.version.hdf5_version}",
        f"data version {info.data_version}, lite, format {FORMAT_VERSION}, {info.histories} histories; names and",
        "(>=0.8, extra generation)",
        "JAX     cpu: cpu",
        f"{elsewhere / 'cache'} (set by ICRL4AHT_CACHE_DIR)",
        "not made yet",
        "no problems found",
    ):
        assert expected in text
    assert not list(elsewhere.iterdir()), "it looks, and makes nothing"
    facts = json.loads(ask("--json")[1])
    assert facts["ok"] and facts["problems"] == []
    assert facts["folders"]["data"]["set_by"] == "ICRL4AHT_DATA_DIR"
    assert facts["packages"]["numpy"]["extra"] is None
    assert facts["devices"]["jax"] == {"backend": "cpu", "devices": ["cpu"]}


def test_it_imports_no_jax_itself(elsewhere):
    code = (
        "import sys; from icrl4aht_data.commands.doctor import diagnose;print(diagnose().devices, 'jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "'jax': {'backend': " in done.stdout
    assert done.stdout.endswith("False\n")


def test_where_folders_come_from(elsewhere, monkeypatch):
    monkeypatch.delenv("ICRL4AHT_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(elsewhere / "xdg"))
    monkeypatch.delenv("ICRL4AHT_DATA_DIR")
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setenv("HOME", str(elsewhere))
    folders = json.loads(ask("--json")[1])["folders"]
    assert (folders["cache"]["path"], folders["cache"]["set_by"]) == (str(elsewhere / "xdg/icrl4aht"), "XDG_CACHE_HOME")
    assert folders["data"]["path"] == str(elsewhere / ".local/share/icrl4aht")
    assert folders["data"]["set_by"] is None
    assert "(by default; ICRL4AHT_DATA_DIR moves it)" in ask()[1]


def test_what_folders_hold(elsewhere):
    (elsewhere / "cache" / "set").mkdir(parents=True)
    (elsewhere / "cache" / "set" / "state.npy").write_bytes(bytes(10_000))
    (elsewhere / "cache" / ".other.partial").mkdir()
    part = elsewhere / "data" / "host-1" / "0.partial" / "data"
    part.mkdir(parents=True)
    (part / "shard.h5").write_bytes(bytes(5_000))
    folders = json.loads(ask("--json")[1])["folders"]
    assert folders["cache"]["bytes"] >= 10_000
    assert folders["cache"]["left_over"] == [str(elsewhere / "cache" / ".other.partial")]
    assert folders["data"]["bytes"] >= folders["data"]["in_part"] >= 5_000
    text = ask()[1]
    assert "of at most 100,000,000,000" in text
    assert "1 unfinished sets" in text


def test_folders_that_cannot_be_written(elsewhere, monkeypatch):
    (elsewhere / "cache").write_text("a file")
    found = problems()
    assert found[f"{elsewhere / 'cache'}: the cache folder cannot be written: Not a directory"] == (
        "set ICRL4AHT_CACHE_DIR to another folder, or make it writable"
    )

    def refuse(dir: Path) -> None:
        raise PermissionError(13, "Permission denied", str(dir))

    monkeypatch.setattr(doctor.tempfile, "TemporaryFile", refuse)
    assert f"{elsewhere / 'data'}: the data folder cannot be written: Permission denied" in problems()


def test_a_disk_nearly_full(elsewhere, monkeypatch):
    usage = namedtuple("usage", ["total", "used", "free"])
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9, 5_000))
    found = problems()
    assert f"{elsewhere / 'data'}: the disk of the data folder is nearly full: 5,000 bytes are free" in found
    assert len(found) == 3, "cache, data and the Hub's"


@pytest.mark.parametrize("given", ["many", "-5"])
def test_settings_that_are_none(elsewhere, monkeypatch, given):
    monkeypatch.setenv("ICRL4AHT_CACHE_BYTES", given)
    monkeypatch.setenv("ICRL4AHT_REMOTE", "example.org/icrl4aht")
    cache, remote = problems()
    assert cache == f"ICRL4AHT_CACHE_BYTES={given!r}: expected a number of bytes, such as 2e11"
    assert remote == "ICRL4AHT_REMOTE='example.org/icrl4aht': expected an address"


def test_offline(elsewhere, monkeypatch):
    assert "may be asked" in ask()[1]
    monkeypatch.setenv("ICRL4AHT_OFFLINE", "1")
    code, text = ask()
    assert code == 0, "a setting, no fault"
    assert "nothing is asked of it: $ICRL4AHT_OFFLINE" in text


def test_a_damaged_bundled_release(elsewhere, monkeypatch, damaged):
    shard = damaged / SHARD
    shard.write_bytes(shard.read_bytes()[:-1])
    monkeypatch.setattr(doctor, "MINI", damaged)
    ((problem, step),) = problems().items()
    assert problem.startswith(f"the bundled release, {SHARD}: ")
    assert "pip install --force-reinstall --no-deps icrl4aht-data" in step
    (damaged / "meta/info.json").unlink()
    assert any("meta/info.json" in problem for problem in problems())


def test_an_old_hdf5(elsewhere, monkeypatch):
    monkeypatch.setattr(h5py.version, "hdf5_version_tuple", (1, 8, 3))
    monkeypatch.setattr(h5py.version, "hdf5_version", "1.8.3")
    assert problems() == {"HDF5 1.8.3: expected 1.10.5 or newer": "pip install -U --force-reinstall h5py"}


def test_packages_too_old_or_missing(elsewhere, monkeypatch):
    installed = {"numpy": "1.26.4", "matplotlib": "3.0", "rich": None, "pillow": None}

    def version(name: str) -> str:
        found = installed.get(name, importlib.metadata.version(name))
        if found is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return found

    monkeypatch.setattr(requirements, "version", version)
    found = problems()
    assert found["numpy 1.26.4: expected >=2.1"] == "pip install -U 'numpy>=2.1'"
    assert "matplotlib 3.0: expected >=3.9" in found
    assert "rich is not installed: expected >=13" in found
    assert len(found) == 3, "nobody has to have an extra"
    assert "pillow            not installed: pip install 'icrl4aht-data[plot]'" in ask()[1]


def test_another_python(elsewhere, monkeypatch):
    monkeypatch.setattr(doctor.platform, "python_version", lambda: "3.10.4")
    assert problems() == {"Python 3.10.4: expected >=3.11": "make an environment with such a Python"}


def test_a_jax_that_is_broken(elsewhere, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(doctor, "_ASK_JAX", "raise ImportError('libcuda.so is another version')")
    assert any("JAX cannot be used: ImportError: libcuda.so" in problem for problem in problems())


def test_without_jax(elsewhere, monkeypatch):
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    code, text = ask()
    assert code == 0
    assert "JAX" not in text
    assert "generation, baselines  not here: they run from a checkout" in text


def test_a_gpu_that_jax_does_not_see(elsewhere, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: name)
    code, text = ask()
    assert code == 0
    assert "JAX sees no GPU" in text


def test_requirements_come_from_the_metadata(monkeypatch):
    about = Message()
    for line in (
        "numpy>=2",
        "tomli>=2; python_version < '3.0'",
        "jax>=0.8; extra == 'big'",
        "flax; extra == 'big'",
        "jax>=0.8; extra == 'small'",
        "icrl4aht-data[small]; extra == 'big'",
        "pytest; extra == 'dev'",
    ):
        about["Requires-Dist"] = line
    for extra in ("big", "dev", "small"):
        about["Provides-Extra"] = extra
    monkeypatch.setattr(requirements, "metadata", lambda name: about)
    assert [(need.name, str(need.versions), need.extra) for need in needs()] == [
        ("numpy", ">=2", None),
        ("jax", ">=0.8", "small"),
        ("flax", "", "big"),
    ]
    assert extra_with("flax.linen") == "big"
    assert extra_with("pytest") is None


def test_every_extra_for_users_brings_something():
    assert {need.extra for need in needs()} == {
        None,
        *("plot", "generation", "baselines", "tensorboard", "hf", "s3", "grain", "torch", "cluster"),
    }
    assert extra_with("PIL.Image") == "plot"
    assert extra_with("orbax.checkpoint") == "baselines"


def test_a_package_that_is_not_installed(elsewhere, monkeypatch):
    def missing(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(requirements, "metadata", missing)
    assert problems() == {"icrl4aht-data: not installed": "`pip install -e .` in its checkout installs it"}


def test_a_module_that_is_missing_names_its_extra(tmp_path):
    """A process without flax, as with the reader alone."""
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['flax'] = None\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    command = [sys.executable, "-m", "generation", "speed", "--profile", "smoke"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.endswith(
        "error: this needs flax.linen, which is not installed: pip install 'icrl4aht-data[generation]'\n"
    ), done.stderr
