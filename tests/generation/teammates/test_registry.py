"""Test the registry of heuristic teammates: parameters, presets, and sampled teammates of each split."""

from __future__ import annotations

import pytest
from icrl4aht_generation.teammates.heuristics.heuristic import RANDOM_ACTIONS
from icrl4aht_generation.teammates.registry import (
    HEURISTIC_FAMILIES,
    build_teammate,
    heuristic_teammate,
    sample_teammate,
)

from icrl4aht_data.errors import TaskFormatError, UnknownNameError
from icrl4aht_data.overcooked.layouts import LAYOUTS

H1, H2, H3, H4 = "recipe_aware_button", "territory", "assembly_line", "utility_greedy"


@pytest.mark.parametrize("family", HEURISTIC_FAMILIES)
def test_missing_or_unknown_parameters_raise_error(family):
    theta = dict(HEURISTIC_FAMILIES[family].defaults)
    first = next(iter(theta))
    theta[f"{first}_"] = theta.pop(first)
    with pytest.raises(TaskFormatError, match=rf"{family}: parameters: Object .*`{first}_?`; expected {first}, "):
        build_teammate(LAYOUTS["demo_wide"], {"family": family, "theta": theta})


@pytest.mark.parametrize(
    ("family", "name", "value", "expected"),
    [
        (H1, "idle_prob", "often", r"expected `float`, got `str` - at `\$.idle_prob`"),
        (H1, "refresh_interval", 99.5, r"expected `int`, got `float` - at `\$.refresh_interval`"),
        (H2, "behavior_mode", 6, r"expected `int` <= 5 - at `\$.behavior_mode`"),
        (H2, "shared_margin", True, r"expected `int`, got `bool` - at `\$.shared_margin`"),
        (H2, RANDOM_ACTIONS, 1.5, r"expected `float` <= 1.0 - at `\$.random_actions`"),
        (H3, "role_mode", -1, r"expected `int` >= 0 - at `\$.role_mode`"),
        (H4, "inertia", None, r"expected `float`, got `null` - at `\$.inertia`"),
    ],
)
def test_parameters_of_wrong_type_or_range_raise_error(family, name, value, expected):
    with pytest.raises(TaskFormatError, match=f"teammate {family}: parameters: {expected}; .*, found "):
        build_teammate(
            LAYOUTS["demo_wide"], {"family": family, "theta": HEURISTIC_FAMILIES[family].defaults | {name: value}}
        )


def test_unknown_presets_splits_and_families_raise_errors():
    with pytest.raises(UnknownNameError, match=r"preset of assembly_line 'plater'; valid: default"):
        heuristic_teammate(H3, "plater", 0)
    with pytest.raises(UnknownNameError, match=r"split 'tests'.*Did you mean 'test'"):
        sample_teammate(H1, 0, "tests")
    with pytest.raises(UnknownNameError, match=r"teammate family 'territori'.*Did you mean 'territory'"):
        sample_teammate("territori", 0, "test")


RANGES = """
recipe_aware_button train default,high_L_priority 0.6-1 50,80,100 0-0.4 0.7-1 *1 *1 *0.9 *1 . . . . .
recipe_aware_button test lazy_learner,strict_adherent 0.2-0.6 100,150,200 0.4-0.9 0.2-0.6 *1 *1 *0.9 *1 . . . . .
territory train default,flexible 0,1 0-0.3 1,2,3 0.2-0.4 *1 . .
territory test flexible,object_stations 1,2 0-0.3 1,2,3 0.2-0.4 *1 . .
assembly_line train default,ingredient_runner 0,2 . 0-0.6 0.2-0.6 *1 . . . . .
assembly_line test plater_deliverer 1 . 0.6-1 0-0.3 *1 . . . . .
utility_greedy train default,delivery_focused 8-18 6-14 *8 3-8 *8 *4.5 *12 *7 0.2-0.7 0.1-0.5 *1
utility_greedy test prep_focused,high_inertia,distance_sensitive 5-12 3-8 *8 7-12 *8 *4.5 *12 *7 0.6-1.2 0.5-0.9 *1
"""
"""Ranges of the published code for the splits of the paper's App. B.3. Each line has family, split, presets and, for
each parameter, a range low-high, a list of values, * and the width of the full range around the preset's value, or .
for the preset's value."""


@pytest.mark.parametrize("line", RANGES.split("\n")[1:-1])
def test_sampled_parameters_stay_in_published_ranges(line):
    family, split, presets, *ranges = line.split()
    heuristic = HEURISTIC_FAMILIES[family]
    entries = [sample_teammate(family, number, split) for number in range(12)]
    assert entries == [sample_teammate(family, number, split) for number in range(12)]
    assert len({str(entry["theta"]) for entry in entries}) == 12
    assert sample_teammate(family, 0, split, 1)["theta"] != entries[0]["theta"]
    assert sample_teammate(family, 0, ("train", "test")[split == "train"])["theta"] != entries[0]["theta"]
    for entry in entries:
        assert list(entry) == ["kind", "family", "theta_id", "base_seed", "theta"]
        assert list(entry["theta"]) == list(heuristic.defaults)
        build_teammate(LAYOUTS["demo_wide"], entry)
        for (name, value), text in zip(entry["theta"].items(), ranges, strict=True):
            assert type(value) is type(heuristic.defaults[name])
            bases = [(heuristic.defaults | heuristic.presets[preset])[name] for preset in presets.split(",")]
            assert in_range(value, text, bases), (name, value)


def in_range(value: float, text: str, bases: list[float]) -> bool:
    if text == "." or text.startswith("*"):
        away = 0.2 * float(text[1:] or 0)
        return min(abs(value - base) for base in bases) <= away + 1e-6
    if "-" in text:
        low, high = map(float, text.split("-"))
        return low - 1e-6 <= value <= high + 1e-6
    return str(value) in text.split(",")
