"""Comparison of an agent with the reference egos by family: who is better, by how much, and how sure that is."""

from __future__ import annotations

import numpy as np
import pytest
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.plotting import plot_family_curves
from icrl4aht_baselines.report.lead import (
    FamilyReturns,
    describe_rise,
    family_returns,
    find_lead,
    lead_table,
    lead_verdict,
)

from tests.helpers.evaluated import TEST_TASKS


def returns_of(family: str, **means: float) -> FamilyReturns:
    """Four pairs of a task and a seed, six episodes each, that differ by up to 1 from the agents' means."""
    spread = np.linspace(-1, 1, 4)[:, None] * np.ones((4, 6))
    return FamilyReturns(family, {agent: mean + spread * (agent == "AD") for agent, mean in means.items()})


BETTER = returns_of("H1", stay=0.0, random=2.0, AD=12.0)
BETWEEN = returns_of("H2", stay=0.0, random=12.0, AD=8.0)
UNSURE = returns_of("H3", stay=0.0, random=2.0, AD=2.5)


def test_results_are_grouped_by_family_with_seeds_and_tasks_as_rows():
    tasks = [task for task in TEST_TASKS if task.layout.name == "demo_wide"][::-1]
    results = [Result(task.task_id, {}, [[number, seed] for seed in range(2)]) for number, task in enumerate(tasks)]
    found = family_returns(tasks, {"AD": results})
    assert [of_family.family for of_family in found] == ["H1", "H2", "H3", "H4"]
    expected = [[number, seed] for number in range(5) for seed in range(2)]
    np.testing.assert_array_equal(found[3].returns["AD"], expected)


def test_an_agent_leads_if_it_earns_surely_more_than_both():
    lead = find_lead(BETTER, "AD")
    assert lead.better
    assert lead.mean == pytest.approx(10.0)
    assert 9.0 <= lead.low < 10.0 < lead.high <= 11.0
    assert find_lead(BETWEEN, "AD").mean == pytest.approx(-4.0), "the better of both counts"
    assert not find_lead(BETWEEN, "AD").better
    assert find_lead(UNSURE, "AD").mean > 0
    assert not find_lead(UNSURE, "AD").better, "its interval reaches below 0"


def test_the_verdict_names_the_families():
    assert lead_verdict([BETTER, BETWEEN, UNSURE], "AD") == (
        "AD earns more than stay and random with 1 of 3 families: H1; no more with H2, H3"
    )
    assert lead_verdict([BETTER], "AD") == "AD earns more than stay and random with 1 of 1 families: H1"
    assert lead_verdict([BETWEEN, UNSURE], "AD") == (
        "AD earns no more than stay and random with any of these families: H2, H3"
    )


def test_the_table_has_all_means_and_the_lead():
    lines = lead_table([BETTER, BETWEEN], "AD").splitlines()
    assert lines[0].split()[:4] == ["family", "stay", "random", "AD"]
    assert lines[2].split()[:5] == ["H2", "0.0", "12.0", "8.0", "-4.0"]


def test_the_rise_compares_the_first_episode_with_the_second_half():
    curve = np.tile([1.0, 5.0, 8.0, 9.0, 10.0], (3, 1))
    assert describe_rise([FamilyReturns("H1", {"AD": curve})], "AD") == (
        "its first episode earns 1.0, episodes 3 to 5 9.0"
    )


def test_curves_are_drawn_with_a_panel_per_family(tmp_path):
    panels = {of_family.family: of_family.returns for of_family in (BETTER, BETWEEN)}
    plot_family_curves(panels, "AD", tmp_path / "curves.png", "title", {"H1": "better", "H2": "worse"})
    assert (tmp_path / "curves.png").read_bytes()[1:4] == b"PNG"
