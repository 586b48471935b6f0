"""`icrl4aht-data plan`."""

from __future__ import annotations

import json
from typing import Any, cast

import jax
import pytest
from click.testing import CliRunner
from icrl4aht_generation.collection.noise import noise_bytes
from icrl4aht_generation.planning import plan
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.profiles.work import Work
from icrl4aht_generation.teammates.registry import heuristic_teammate

from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.overcooked.layouts import get_layout
from tests.helpers.tiny import LEARNED, NOISE, artefact

SIZES = {"lite": 1.85, "full": 9.25}
"""Bytes of a transition."""


@pytest.fixture
def measured(monkeypatch) -> None:
    """A machine that trains egos at 100,000 steps/s, populations at 50,000, and compiles in 36 s."""
    speeds = {1024: 100_000.0, 64: 100_000.0, 256: 50_000.0}
    monkeypatch.setattr(plan, "calibrate", lambda config, make: plan.LearnerSpeed(speeds[config.environments], 36.0))
    monkeypatch.setattr(plan, "bytes_per_transition", lambda kind, source: SIZES[kind])


def test_the_papers_numbers(measured):
    """8 layouts x 80 teammates; populations of 10 members, each with 256 environments."""
    profile = load_profile("paper")
    found = plan.estimate_cost(profile, devices=16)
    steps = 228 * 262_144
    assert (found.tasks, found.environment_steps) == (640, 640 * steps)
    assert found.kept_transitions == 640 * 128 * 146 * 100
    population = 457 * 256 * 256 * 10
    more = 457 * 256 * 256  # CoMeDi's first policy, which is no member
    assert (found.populations, found.teammate_steps) == (32, 32 * population + 8 * more)
    hours, teammate_hours = (steps / 100_000 + 36) / 3600, (found.teammate_steps / 50_000 + 32 * 36) / 3600
    assert found.teammate_hours_on_one == pytest.approx(teammate_hours, abs=0.01)
    assert found.hours_on_one == pytest.approx(640 * hours + teammate_hours, abs=0.01)
    assert found.hours_on_devices == pytest.approx(40 * hours + teammate_hours, abs=0.01)
    assert found.lite_bytes == pytest.approx(1.85 * found.kept_transitions)
    assert found.full_bytes == pytest.approx(9.25 * found.kept_transitions)


@pytest.mark.slow
@pytest.mark.parametrize(("source", "lite", "full"), [("ppo", 1.85, 9.23), ("noise", 2.55, 12.01)])
def test_sizes_are_measured_on_the_bundled_release(source, lite, full):
    assert plan.bytes_per_transition("lite", source) == pytest.approx(lite, rel=0.05)
    assert plan.bytes_per_transition("full", source) == pytest.approx(full, rel=0.05)


def test_disk_of_artefacts(built):
    profile = load_profile(str(built / "tiny.toml"))
    arrays = sum(path.stat().st_size for path in artefact(built / "a").glob("*.npy"))
    assert plan.artefact_bytes(profile.layouts, profile.ego) == arrays - 5 * 128  # NumPy's headers


def test_the_command(measured):
    result = CliRunner().invoke(cli, ["plan", "--profile", "smoke", "--devices", "2"])
    assert result.exit_code == 0, result.output
    for expected in ("environment steps", "100,000 steps/s", "hours on one such device", "hours on 2 of them"):
        assert expected in result.output
    found = json.loads(CliRunner().invoke(cli, ["plan", "--profile", "smoke", "--json"]).output)
    assert (found["profile"], found["tasks"], found["devices"]) == ("smoke", 2, 8)


def test_the_command_counts_learned_teammates(measured):
    result = CliRunner().invoke(cli, ["plan", "--profile", "paper"])
    assert result.exit_code == 0, result.output
    for expected in ("populations of teammates     32", "50,000 steps/s", "hours, teammates"):
        assert expected in result.output


def test_calibration_measures_one_minibatch_then_the_complete_update(built, monkeypatch):
    ego = load_profile(str(built / "tiny.toml")).ego
    widths = []

    def measure(config):
        widths.append(config.environments)
        return plan.LearnerSpeed(50.0 if len(widths) == 1 else 70.0, 1.0), config.steps_per_update

    def make(config) -> Any:
        return config

    monkeypatch.setattr(plan, "_measure", measure)
    assert plan.calibrate(ego, make).steps_per_second == 70.0
    assert widths == [4, 8]
    monkeypatch.setattr(plan, "_WORTH_MEASURING", 1.0)
    widths.clear()
    assert plan.calibrate(ego, make).steps_per_second == 50.0
    assert widths == [4]


class Doubling:
    """A learner whose update takes no time to compile."""

    steps_per_update = 640

    def init(self, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (4,))

    def update(self, state: jax.Array) -> tuple[jax.Array, dict[str, float]]:
        return 2 * state, {}


def test_measuring():
    speed, steps = plan._measure(cast("Any", Doubling()))
    assert steps == 640
    assert speed.steps_per_second > 0
    assert speed.compile_seconds > 0


@pytest.mark.slow
@pytest.mark.parametrize("make", [plan.task_learner, plan.calibration_population])
def test_measuring_the_learners_of_a_profile(tmp_path, make):
    path = tmp_path / "learned.toml"
    path.write_text(LEARNED)
    profile = load_profile(str(path))
    speed, steps = plan._measure(make(profile, profile.ego))
    assert steps == (2 if make is plan.calibration_population else 1) * 8 * 80
    assert speed.steps_per_second > 0
    assert speed.compile_seconds > 0


def test_noise_histories(monkeypatch, tmp_path):
    """Tasks of one family on one layout share a program on one device; on several each task compiles it."""
    (tmp_path / "noise.toml").write_text(NOISE)
    profile = load_profile(str(tmp_path / "noise.toml"))
    mate = heuristic_teammate("utility_greedy", "default", 0)
    works = [Work(make_task("teammate", "train", "demo_wide", mate, seed), "noise") for seed in range(3)]
    monkeypatch.setattr(type(profile), "works", lambda profile: works)
    monkeypatch.setattr(type(profile), "tasks_on", lambda profile, layout, source: 3)
    monkeypatch.setattr(plan, "noise_speed", lambda profile: plan.LearnerSpeed(100.0, 360.0))
    monkeypatch.setattr(plan, "bytes_per_transition", lambda kind, source: 2.0 if source == "noise" else 1.0)
    found = plan.estimate_cost(profile, devices=2)
    assert (found.tasks, found.learners, found.environment_steps) == (3, 0, 0)
    assert (found.noise_histories, found.noise_programs) == (12, 1)
    assert found.noise_transitions == found.kept_transitions == found.recorded_transitions == 12_000
    assert found.noise_hours_on_one == found.hours_on_one == pytest.approx((120 + 360) / 3600, abs=0.01)
    assert found.hours_on_devices == pytest.approx(2 * (40 + 360) / 3600, abs=0.01)
    assert found.artefact_bytes == 3 * noise_bytes(get_layout("demo_wide"), profile.noise)
    assert found.lite_bytes == 24_000
    text = dict(found.rows())
    assert text["measured, noise"].startswith("100 steps/s on ")
    assert text["compiling noise"] == "1 x 360 s"
    assert "learners" not in text
