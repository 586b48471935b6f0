"""Releases that many tests read, made once."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from click.testing import CliRunner

from generation.cli import cli
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.writing.published import from_published, to_published
from tests.helpers.paths import ROOT
from tests.helpers.published_files import KEPT, publish
from tests.helpers.random_play import random_release
from tests.helpers.tiny import PAIR, TINY


@pytest.fixture(scope="session", autouse=True)
def compilation_cache() -> None:
    """Keep compiled programs on disk for other workers and later runs; a size limit makes JAX lock the folder."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(ROOT / ".cache" / "jax")
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_compilation_cache_max_size", 2 * 2**30)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture(scope="module")
def compiled_quickly():
    """For small models: compile in half the time what then runs slower."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="session", autouse=True)
def cache_of_this_run(tmp_path_factory) -> None:
    """What tests keep on disk does not outlive them, nor meets what earlier runs kept."""
    os.environ["ICRL4AHT_CACHE_DIR"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def lite(tmp_path_factory) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """A lite release of random play, and what went in. Read only."""
    root = tmp_path_factory.mktemp("releases") / "lite"
    return root, random_release(root, "lite")


@pytest.fixture(scope="session")
def full(tmp_path_factory) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """The full twin of `lite`. Read only."""
    root = tmp_path_factory.mktemp("releases") / "full"
    return root, random_release(root, "full")


@pytest.fixture(params=["lite", "full"])
def either(request) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """Both kinds in turn."""
    return request.getfixturevalue(request.param)


@pytest.fixture
def damaged(lite, tmp_path) -> Path:
    """A copy of `lite` to damage."""
    root = tmp_path / "release"
    shutil.copytree(lite[0], root)
    return root


@pytest.fixture(scope="session")
def built(tmp_path_factory) -> Path:
    """tiny.toml and pair.toml; `a`, the first collected and packed both ways by the command. Read only."""
    out = tmp_path_factory.mktemp("built")
    (out / "tiny.toml").write_text(TINY)
    (out / "pair.toml").write_text(PAIR)
    arguments = ["generate", "--profile", str(out / "tiny.toml"), "--out", str(out / "a")]
    result = CliRunner().invoke(cli, [*arguments, "--kind", "lite", "--kind", "full"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return out


@pytest.fixture(scope="session")
def pair(built) -> Path:
    """pair.toml, collected and packed by the command. Read only."""
    arguments = ["generate", "--profile", str(built / "pair.toml"), "--out", str(built / "pair")]
    result = CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return built / "pair"


@pytest.fixture(scope="session")
def theirs(tmp_path_factory) -> tuple[Path, list[dict[str, np.ndarray]]]:
    """Hand-written published files. Read only."""
    folder = tmp_path_factory.mktemp("theirs") / "files"
    return folder, publish(folder)


@pytest.fixture(scope="session")
def ours(theirs, tmp_path_factory) -> Path:
    """The release of observations made of `theirs`. Read only."""
    root = tmp_path_factory.mktemp("ours") / "release"
    assert from_published(theirs[0], root, kept_steps=KEPT) == "observations"
    return root


@pytest.fixture(scope="session")
def twin(lite, tmp_path_factory) -> Path:
    """`lite` by way of published files without states. Read only."""
    folder = tmp_path_factory.mktemp("twin")
    to_published(load_icrl4aht(lite[0]), folder / "files", states=False)
    with h5py.File(folder / "files" / "histories.h5") as file:
        assert not any("state" in name for group in file.values() for name in group)
    assert from_published(folder / "files", folder / "release", kept_steps=KEPT) == "observations"
    return folder / "release"
