"""`python -m generation plan`."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner
from tiny import artefact

from generation import plan
from generation.cli import cli
from generation.profiles import load_profile


@pytest.fixture
def measured(monkeypatch) -> None:
    """A machine that makes 100,000 steps/s and compiles in 36 s."""
    monkeypatch.setattr(plan, "calibrate", lambda task, profile: (100_000.0, 36.0))


def test_the_papers_numbers(measured):
    profile = load_profile("paper")
    found = plan.cost(profile, devices=16)
    tasks = len(profile.tasks())
    steps = 228 * 262_144
    assert (found.tasks, found.environment_steps) == (tasks, tasks * steps)
    assert found.kept_transitions == tasks * 128 * profile.ego.episodes * 100
    hours = (steps / 100_000 + 36) / 3600
    assert found.hours_on_one == pytest.approx(tasks * hours, abs=0.01)
    assert found.hours_on_devices == pytest.approx(-(-tasks // 16) * hours, abs=0.01)
    assert 1 < found.lite_bytes / found.kept_transitions < 3 < found.full_bytes / found.kept_transitions < 12


def test_disk_of_artefacts(built):
    profile = load_profile(str(built / "tiny.toml"))
    arrays = sum(path.stat().st_size for path in artefact(built / "a").glob("*.npy"))
    assert plan.artefact_bytes(profile.tasks(), profile.ego) == arrays - 5 * 128  # NumPy's headers


def test_the_command(measured):
    result = CliRunner().invoke(cli, ["plan", "--profile", "smoke", "--devices", "2"])
    assert result.exit_code == 0, result.output
    for expected in ("environment steps", "100,000 steps/s", "hours on one such device", "hours on 2 of them"):
        assert expected in result.output
    found = json.loads(CliRunner().invoke(cli, ["plan", "--profile", "smoke", "--json"]).output)
    assert (found["profile"], found["tasks"], found["devices"]) == ("smoke", 2, 8)


def test_calibration_measures_a_share_then_the_whole(built, monkeypatch):
    profile = load_profile(str(built / "tiny.toml"))
    (task,) = profile.tasks()
    widths = []

    def measure(task, profile, ego):
        widths.append(ego.environments)
        return 50.0 if len(widths) == 1 else 70.0, 1.0

    monkeypatch.setattr(plan, "_measure", measure)
    assert plan.calibrate(task, profile) == (70.0, 1.0)
    assert widths == [4, 8]
    monkeypatch.setattr(plan, "_WORTH_MEASURING", 1.0)
    widths.clear()
    assert plan.calibrate(task, profile) == (50.0, 1.0)


def test_measuring(built):
    profile = load_profile(str(built / "tiny.toml"))
    speed, compiling = plan._measure(profile.tasks()[0], profile, profile.ego)
    assert speed > 0
    assert compiling > 0
