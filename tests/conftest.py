"""Settings for all tests, and fixtures with releases that many tests read."""

from __future__ import annotations

import ctypes
import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np
import psutil
import pytest
from filelock import FileLock

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.writing.published import from_published, to_published
from tests.helpers.commands import run_cli
from tests.helpers.paths import ROOT
from tests.helpers.published_files import KEPT, write_published_files
from tests.helpers.random_releases import random_release
from tests.helpers.tiny import TINY
from tests.helpers.two_sources import two_source_release
from tests.helpers.xla_flags import add_xla_flag, is_xla_flag

MEMORY_TO_FREE = 1200 * 2**20
"""Memory in bytes above which a test worker clears JAX's compiled programs."""

SharedFolder = Callable[[str, Callable[[Path], object]], Path]
JAX_SETTINGS: dict[str, Any] = {
    "jax_compilation_cache_dir": os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(ROOT / ".cache" / "jax"),
    "jax_compilation_cache_max_size": 2 * 2**30,  # with a limit, JAX locks the folder, which processes share
    "jax_persistent_cache_min_compile_time_secs": 0.1,  # with 0.5, tests take 50% more CPU time (cache filled)
    "jax_cpu_enable_async_dispatch": False,  # as in the package's jobs with one thread
}
COSTLIEST = """
collect notebooks wheel reference heuristics scripted rl2 suite generate run fetch gymnasium_env docs models trainer
rollout ppo population_updates oracle hostile faults responses commands controls
"""
"""Test files that take longest, in the order to run them.

`test_collect.py` generates releases that others wait for, such as `test_generate.py`, which therefore comes later.
"""
QUICK_COMPILATION = (
    "--xla_cpu_use_fusion_emitters=false"  # XLA's older code generator compiles faster if optimizations are off
)


def pytest_configure() -> None:
    """Make JAX compile with few optimizations, and cache compiled programs on disk for subprocesses and later runs.

    Compilation takes longer than running in most tests. `JAX_DISABLE_MOST_OPTIMIZATIONS=0 make test` tests optimized
    programs.
    """
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    if os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] != "0":
        jax.config.update("jax_disable_most_optimizations", True)
        if QUICK_COMPILATION in os.environ.get("XLA_FLAGS", "").split() or is_xla_flag(QUICK_COMPILATION):
            os.environ["XLA_FLAGS"] = add_xla_flag(QUICK_COMPILATION)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")  # expected values and tolerances hold on CPUs only
    jax.config.update("jax_platforms", os.environ["JAX_PLATFORMS"])
    os.environ.setdefault(
        "PJRT_NPROC", "1"
    )  # one thread, as in the package's profiles for CPUs; read when JAX is first used
    for name, value in JAX_SETTINGS.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)
    if "PYTEST_XDIST_WORKER" not in os.environ:
        _remove_unfinished_entries(Path(JAX_SETTINGS["jax_compilation_cache_dir"]))


def _remove_unfinished_entries(folder: Path) -> None:
    """Remove cache entries that killed processes left without an access-time file; such entries block new ones."""
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".lockfile"):
        for entry in folder.glob("*-cache"):
            if not entry.with_name(entry.name.removesuffix("-cache") + "-atime").exists():
                entry.unlink()


def pytest_collection_finish() -> None:
    """Exempt all modules and tests from garbage collection, which tracing would otherwise start again and again."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slowest test files first, so that all workers finish at about the same time."""
    order = {f"test_{name}.py": place for place, name in enumerate(COSTLIEST.split())}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.fixture(scope="module", autouse=True)
def free_compiled_programs() -> Iterator[None]:
    """Clear the compiled programs after a test module if this process uses much memory."""
    yield
    if psutil.Process().memory_info().rss > MEMORY_TO_FREE:
        jax.clear_caches()
        gc.collect()
        getattr(ctypes.CDLL(None), "malloc_trim", lambda _: None)(0)  # glibc otherwise keeps freed memory


@pytest.fixture(scope="session", autouse=True)
def temporary_cache(tmp_path_factory) -> None:
    """Redirect the package's cache and downloads to temporary folders of this test session."""
    os.environ["ICRL4AHT_CACHE_DIR"] = str(tmp_path_factory.mktemp("cache"))
    os.environ["ICRL4AHT_DATA_DIR"] = str(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory) -> SharedFolder:
    """Return a function (name, make) that returns a folder shared by all test workers (read-only).

    The first worker that asks for the folder `name` fills it by calling `make`.
    """
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def make_once(name: str, make: Callable[[Path], object]) -> Path:
        folder, finished = base / "shared" / name, base / "shared" / f"{name}.finished"
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(base / "shared" / f"{name}.lock"):
            if not finished.exists():
                make(folder)
                finished.touch()
        return folder

    return make_once


@pytest.fixture(scope="session")
def lite(tmp_path_factory) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """Return a lite release of random play, and a dict from history id to the written arrays (read-only)."""
    root = tmp_path_factory.mktemp("releases") / "lite"
    return root, random_release(root, "lite")


@pytest.fixture(scope="session")
def full(tmp_path_factory) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """Return a full release with the histories of the fixture `lite`, and its arrays (read-only)."""
    root = tmp_path_factory.mktemp("releases") / "full"
    return root, random_release(root, "full")


@pytest.fixture(params=["lite", "full"])
def lite_or_full(request) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """Run a test twice: with the fixture `lite` and with the fixture `full`."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def two_sources(tmp_path_factory) -> tuple[Path, dict[int, dict[str, np.ndarray]]]:
    """Return a lite release with PPO and noise histories, two splits and all labels, and its arrays (read-only)."""
    root = tmp_path_factory.mktemp("releases") / "two_sources"
    return root, two_source_release(root)


@pytest.fixture
def release_copy(lite, tmp_path) -> Path:
    """Return a copy of the fixture `lite` that a test may change or damage."""
    root = tmp_path / "release"
    shutil.copytree(lite[0], root)
    return root


@pytest.fixture(scope="session")
def built(shared_folder) -> Path:
    """Return a folder with the profile tiny.toml and, in `a`, the releases generated from the profile (read-only)."""

    def generate_releases(folder: Path) -> None:
        (folder / "tiny.toml").write_text(TINY)
        run_cli(
            "generate", "--profile", folder / "tiny.toml", "--out", folder / "a", "--kind", "lite", "--kind", "full"
        )

    return shared_folder("built", generate_releases)


@pytest.fixture(scope="session")
def published_folder(tmp_path_factory) -> tuple[Path, list[dict[str, np.ndarray]]]:
    """Return a folder of small files in the published format, and their arrays; tests must not change either."""
    folder = tmp_path_factory.mktemp("theirs") / "files"
    return folder, write_published_files(folder)


@pytest.fixture(scope="session")
def converted_release(published_folder, tmp_path_factory) -> Path:
    """Return a release of kind `observations`, converted from `published_folder` (read-only)."""
    root = tmp_path_factory.mktemp("ours") / "release"
    assert from_published(published_folder[0], root, kept_steps=KEPT) == "observations"
    return root


@pytest.fixture(scope="session")
def reconverted_release(lite, tmp_path_factory) -> Path:
    """Return the fixture `lite`, converted to published files without states and back to a release (read-only)."""
    folder = tmp_path_factory.mktemp("twin")
    to_published(load_icrl4aht(lite[0]), folder / "files", states=False)
    with h5py.File(folder / "files" / "histories.h5") as file:
        assert not any("state" in name for group in file.values() for name in group)
    assert from_published(folder / "files", folder / "release", kept_steps=KEPT) == "observations"
    return folder / "release"
