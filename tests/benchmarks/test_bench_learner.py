"""Benchmarks of learning run on tiny profiles; curves and their intervals."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks import bench_curves, bench_learner
from benchmarks.bench_curves import Curves, draw_curves

TINY = """
[ego]
total_steps = 4000
environments = 2
rollout = 20
minibatches = 1
widths = {{ encoder = "{encoder}", pointwise = [4], spatial = [4], dense = 4, gru = 4, head = 4 }}

[release]
data_version = "0.0.1"
keep = 1

[tasks]
layouts = ["cramped_up"]
presets = ["default"]
"""


@pytest.fixture
def profiles(tmp_path):
    paths = []
    for encoder in ("paper", "mlp"):
        paths.append(tmp_path / f"{encoder}.toml")
        paths[-1].write_text(TINY.format(encoder=encoder))
    return [word for path in paths for word in ("--profile", str(path))]


def run(command, *arguments: str) -> list[dict]:
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in result.stdout.splitlines() if line.startswith("{")]


@pytest.mark.slow
def test_speed_and_parts_of_each_profile(profiles):
    lines = run(bench_learner.main, *profiles, "--layout", "cramped_up", "--rounds", "1")
    speed = [line for line in lines if line["part"] == "speed"]
    assert [(line["profile"], line["encoder"]) for line in speed] == [("paper", "paper"), ("mlp", "mlp")]
    assert speed[0]["ratio_to_paper"] == 1
    assert all(line["steps_per_second"] > 0 for line in speed)
    parts = [line for line in lines if line["part"] == "parts" and line["profile"] == "mlp"]
    assert [line["what"] for line in parts] == [
        "roll-out", "rendering", "encoder", "recurrent layer", "heads", "optimiser", "rest", "update"
    ]  # fmt: skip
    assert sum(line["share"] for line in parts[:-1]) == pytest.approx(1, abs=0.01)
    assert {line["what"] for line in parts if "gflops" in line} >= {"encoder", "recurrent layer"}


@pytest.mark.slow
def test_curves_are_kept_and_not_trained_again(profiles, tmp_path):
    arguments = (*profiles, "--layout", "cramped_up", "--seeds", "2", "--out", str(tmp_path / "curves"))
    lines = run(bench_curves.main, *arguments)
    assert [(line["profile"], line["seeds"]) for line in lines] == [("paper", 2), ("mlp", 2)]
    assert lines[0]["share_of_points_overlapping"] == 1
    assert (tmp_path / "curves" / "curves.png").stat().st_size > 10_000
    runs = {path: path.stat().st_mtime_ns for path in (tmp_path / "curves").rglob("*.json")}
    assert len(runs) == 4
    assert run(bench_curves.main, *arguments) == lines
    assert {path: path.stat().st_mtime_ns for path in runs} == runs


def test_the_peer_needs_its_file():
    result = CliRunner().invoke(bench_learner.main, ["--part", "peer"])
    assert result.exit_code == 2
    assert "--peer FILE" in result.output


def test_bands_are_intervals_of_the_mean_over_seeds(tmp_path):
    returns = np.arange(3)[:, None] + np.linspace(0, 9, 40)  # three seeds, 1 apart, that rise alike
    curves = Curves(returns, np.array([10.0, 20.0, 60.0]))
    mean, half = curves.band()
    np.testing.assert_allclose(mean, returns[1])
    np.testing.assert_allclose(half, 4.302653 / 3**0.5, rtol=1e-6)  # Student's t of 2 degrees of freedom, 97.5 %
    assert curves.end() == pytest.approx((returns[1, -4:].mean(), 4.302653 / 3**0.5))
    assert Curves(returns[:1], np.array([1.0])).band()[1].tolist() == [0.0] * 40
    draw_curves({("demo_wide", "one"): curves}, ("demo_wide",), 1000, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 5_000
