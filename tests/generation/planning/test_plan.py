"""Test the command `icrl4aht-data plan`, which estimates the cost of generating a release."""

from __future__ import annotations

import json

import pytest
from icrl4aht_generation.collection.scripted import scripted_bytes
from icrl4aht_generation.planning import plan
from icrl4aht_generation.profiles import load_profile

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.overcooked.layouts import get_layout
from tests.helpers.commands import run_cli
from tests.helpers.tiny import NOISE, artefact


@pytest.fixture
def fixed_speeds(monkeypatch) -> None:
    """Replace measured speeds: egos train at 100,000 steps/s, and populations at 50,000 steps/s."""
    monkeypatch.setattr(plan, "step_seconds", lambda config: 1e-5 if config.environments == 1024 else 2e-5)


def test_cost_of_profile_paper_matches_numbers_of_the_paper(fixed_speeds):
    """The paper uses 8 layouts with 80 teammates each, and populations of 10 members with 256 environments each.

    A history has the first 100 steps of 146 episodes of 400 steps, T = 14,600 (paper, App. D.1). Training takes 228
    updates, or 58,368 steps, and the 146th episode starts at step 58,000.
    """
    found = plan.estimate_cost(load_profile("paper"), devices=16)
    steps = 228 * 262_144
    assert (found["tasks"], found["environment_steps"]) == (640, 640 * steps)
    assert found["kept_transitions"] == 640 * 128 * 146 * 100
    population = 457 * 256 * 256 * 10
    more = 457 * 256 * 256  # CoMeDi also trains a first policy, which is not a member
    assert (found["populations"], found["teammate_steps"]) == (32, 32 * population + 8 * more)
    hours, teammate_hours = (steps / 100_000 + 30) / 3600, (found["teammate_steps"] / 50_000 + 32 * 30) / 3600
    assert found["teammate_hours"] == pytest.approx(teammate_hours, abs=0.01)
    assert found["hours_on_one"] == pytest.approx(640 * hours + teammate_hours, abs=0.01)
    assert found["hours_on_devices"] == pytest.approx(40 * hours + teammate_hours, abs=0.01)
    meta = 640 * (128 * 900 + 1400) + 0.12 * found["kept_transitions"]
    assert found["lite_bytes"] == pytest.approx(1.92 * found["kept_transitions"] + meta)
    assert found["full_bytes"] == pytest.approx(9.23 * found["kept_transitions"] + meta)


def test_cost_of_noise_histories_includes_no_learners(tmp_path):
    (tmp_path / "noise.toml").write_text(NOISE)
    profile = load_profile(str(tmp_path / "noise.toml"))
    found = plan.estimate_cost(profile, devices=2)
    transitions = profile.noise.histories * profile.noise.episodes * 100
    assert (found["learners"], found["environment_steps"], found["steps_per_second"]) == (0, 0, None)
    assert found["scripted_transitions"] == found["kept_transitions"] == found["tasks"] * transitions
    assert (
        found["scripted_hours"]
        == found["hours_on_one"]
        == pytest.approx(found["tasks"] * (transitions / 470_000 + 0.75) / 3600, abs=0.01)
    )
    assert found["artefact_bytes"] == found["tasks"] * scripted_bytes(get_layout(profile.layouts[0]), profile.noise)
    assert "learners" not in dict(plan.cost_rows(found))


@pytest.mark.parametrize(
    ("profile", "histories", "hours", "size"),
    [("teach", 56, 1057 / 3600, 447_144_160), ("billion", 318, 2753 / 3600, 2_168_576_928)],
)
def test_plan_states_time_and_size_of_scripted_profiles_as_measured(tmp_path, profile, histories, hours, size):
    """The measured values are those of complete runs on two cores, before the profiles had `all_dishes`."""
    counts = f"histories = {histories}\nepisodes = 100\n"
    path = tmp_path / "measured.toml"
    path.write_text(
        f'base = "{profile}"\n[search]\n{counts}[search.layouts.rooms-0-46]\n{counts}[tasks]\nall_dishes = false\n'
    )
    found = plan.estimate_cost(load_profile(str(path)), devices=1)
    assert found["hours_on_one"] == pytest.approx(hours, rel=0.05)
    assert found["lite_bytes"] == pytest.approx(size, rel=0.05)


def test_estimated_sizes_match_the_bundled_release():
    dataset = load_icrl4aht()
    shards = sum(path.stat().st_size for path in (dataset.root / "data").rglob("*.h5"))
    meta = sum(path.stat().st_size for path in (dataset.root / "meta").rglob("*") if path.is_file())
    # No profile makes histories of source `agent`; their steps take as many bytes as those of `noise`.
    sources = [(entry.T, "noise" if entry.source == "agent" else str(entry.source)) for entry in dataset.entries]
    expected = sum(
        length * plan.BYTES_PER_STEP["lite", source] + plan.BYTES_PER_HISTORY.get(source, 0)
        for length, source in sources
    )
    assert shards == pytest.approx(expected, rel=0.1)
    counts = {
        "transitions": sum(entry.T for entry in dataset.entries),
        "histories": len(dataset),
        "tasks": len({entry.task_id for entry in dataset.entries}),
    }
    assert meta == pytest.approx(sum(counts[name] * size for name, size in plan.META_BYTES.items()), rel=0.1)


def test_plan_command_measures_speed_and_prints_costs(built):
    found = json.loads(run_cli("plan", "--profile", built / "tiny.toml", "--json"))
    assert (found["tasks"], found["devices"]) == (1, 8)
    assert 0 < found["steps_per_second"] < plan.ENVIRONMENT_STEPS_PER_SECOND
    arrays = sum(path.stat().st_size for path in artefact(built / "a").glob("*.npy"))
    assert found["artefact_bytes"] == arrays - 5 * 128  # NumPy's headers take 128 bytes each
    printed = run_cli("plan", "--profile", built / "tiny.toml", "--devices", "2")
    for expected in ("environment steps", "disk, lite", "CPU cores", "hours on 2 devices"):
        assert expected in printed
