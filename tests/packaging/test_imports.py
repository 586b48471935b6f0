"""Which way imports may point, and what importing the reader loads."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

NOBODY_MAY_USE = {"benchmarks", "tests", *(path.stem for path in (ROOT / "tests").glob("*.py"))}
FORBIDDEN = {
    "icrl4aht_data": {"generation", "baselines", "jax", "flax", "optax"},
    "generation": {"baselines"},
    "baselines": set(),
}
BASELINES_MAY_USE = ("generation.env", "generation.teammates", "generation.learners", "generation.policy")
HEAVY = ("jax", "flax", "optax", "matplotlib", "PIL", "torch", "datasets", "huggingface_hub", "grain", "pyarrow")


def imported(path: Path) -> set[str]:
    """The modules a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def wrong_arrows(package: str, modules: set[str]) -> list[str]:
    """The imports that point the wrong way."""
    wrong = {m for m in modules if m.split(".")[0] in FORBIDDEN[package] | NOBODY_MAY_USE}
    if package == "baselines":
        inner = {m for m in modules if m.startswith("generation") and m != "generation"}
        wrong |= {m for m in inner if not m.startswith(BASELINES_MAY_USE)}
    return sorted(wrong)


@pytest.mark.parametrize("package", FORBIDDEN)
def test_imports_point_down(package):
    for path in sorted((ROOT / package).rglob("*.py")):
        on_demand = {"jax", "jax.numpy"} if path.name == "prefetch.py" else set()  # when a device is asked for
        assert not wrong_arrows(package, imported(path) - on_demand), path


def test_a_wrong_arrow_is_seen():
    assert wrong_arrows("icrl4aht_data", {"numpy", "jax.numpy"}) == ["jax.numpy"]
    assert wrong_arrows("generation", {"baselines.methods.ad", "icrl4aht_data"}) == ["baselines.methods.ad"]
    assert wrong_arrows("baselines", {"generation.collection.task", "generation.env"}) == ["generation.collection.task"]
    for package in FORBIDDEN:
        assert wrong_arrows(package, {"benchmarks.bench_env", "tests", "plays", "numpy"}) == [
            "benchmarks.bench_env",
            "plays",
            "tests",
        ]


def test_importing_the_reader_loads_nothing_heavy():
    code = "import sys, icrl4aht_data; print(sorted({name.split('.')[0] for name in sys.modules}))"
    loaded = ast.literal_eval(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    )
    assert "numpy" in loaded
    assert not set(HEAVY) & set(loaded)


def test_public_names_exist():
    import icrl4aht_data

    for name in icrl4aht_data.__all__:
        assert getattr(icrl4aht_data, name).__doc__ or name.isupper(), name
