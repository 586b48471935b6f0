"""Test tasks of the track `preference`: what splits share, and layouts that hide the recipe."""

from __future__ import annotations

from collections import Counter, defaultdict

import pytest
from icrl4aht_generation.layouts.families import generate_layouts, split_of
from icrl4aht_generation.layouts.grids import canonical_map
from icrl4aht_generation.teammates.instances import INSTANCES
from icrl4aht_generation.teammates.preference import (
    WATCHER,
    all_dishes,
    all_training_tasks,
    preference_tasks,
    training_dishes,
)

from icrl4aht_data.benchmark.facts import PREFERENCE_LAYOUTS
from icrl4aht_data.benchmark.tasks import Task, teammate_id
from icrl4aht_data.overcooked.layouts import LAYOUTS, get_layout


@pytest.fixture(scope="module")
def split_tasks() -> dict[str, list[Task]]:
    return {split: preference_tasks(split) for split in ("train", "validation", "test")}


def test_preference_training_shares_no_teammates_and_holds_out_layouts_and_recipes(split_tasks):
    """Training tasks have no test teammate, and half of the test tasks are on new layouts.

    Training tasks use all recipes of layouts with 4 recipes, and 7 recipes of layouts with 10 recipes.
    """
    layouts = {split: {task.layout_name for task in tasks} for split, tasks in split_tasks.items()}
    assert layouts["train"] == layouts["validation"] == set(PREFERENCE_LAYOUTS["train"])
    halves = Counter(task.layout_name in layouts["train"] for task in split_tasks["test"])
    assert halves == {True: 60, False: 60}
    mates = {split: {teammate_id(task.teammate) for task in tasks} for split, tasks in split_tasks.items()}
    assert not mates["train"] & (mates["test"] | mates["validation"])
    assert mates["validation"] & mates["test"] == {teammate_id(WATCHER)}
    dishes = {split: {(t.layout_name, t.recipes) for t in tasks} for split, tasks in split_tasks.items()}
    for name in PREFERENCE_LAYOUTS["train"]:
        layout = get_layout(name)
        new = len(all_dishes(layout)) - len(training_dishes(layout))
        assert new == {4: 0, 10: 3}[len(all_dishes(layout))]
    assert any(pair not in dishes["train"] for pair in dishes["test"] if pair[0] in layouts["train"])
    of_dish = defaultdict(set)
    for task in split_tasks["test"]:
        (dish,) = task.recipes or (None,)
        assert dish is not None
        held_out = dish not in training_dishes(task.layout)
        number = all_dishes(task.layout).index(dish) if held_out else None
        of_dish[number].add((task.teammate_family, task.teammate["theta_id"] == INSTANCES))
    assert of_dish.keys() == {None, 2, 5, 8}
    assert all(len(found) >= 4 for found in of_dish.values()), "each held-out recipe has teammates of several families"
    families = {split: {task.teammate_family for task in tasks} for split, tasks in split_tasks.items()}
    assert families["train"] == families["test"] == {"H1", "H2", "H3", "H4"}


def test_all_training_tasks_pair_each_teammate_with_each_dish(split_tasks):
    for name in ("asymm_both_plain", "rooms-0-46"):
        tasks = all_training_tasks(name)
        pairs = {(teammate_id(task.teammate), task.recipes) for task in tasks}
        dishes = {dishes for _, dishes in pairs}
        assert len(tasks) == len(pairs) == len({mate for mate, _ in pairs}) * len(dishes) == 20 * len(dishes)
        published = [task for task in split_tasks["train"] if task.layout_name == name]
        assert len(tasks) == 5 * len(published)
        assert {(teammate_id(task.teammate), task.recipes) for task in published} < pairs


def test_preference_layouts_hide_the_recipe_and_match_their_names():
    maps = Counter()
    generated = {one.name: one for family in ("rooms", "templates") for one in generate_layouts(family, 0, 300)}
    for split, names in PREFERENCE_LAYOUTS.items():
        for name in names:
            layout = get_layout(name)
            assert not {"R", "L"} & set("".join(layout.rows))
            assert not layout.indicates_delivery
            maps[canonical_map(layout)] += 1
            if name.endswith("_plain"):
                published = LAYOUTS[name.removesuffix("_plain")]
                expected = tuple(row.replace("R", "W").replace("L", "W") for row in published.rows)
                assert layout.rows == expected
            else:
                assert layout.rows == generated[name].rows
                assert (split_of(layout) == "train") == (split == "train")
    assert max(maps.values()) == 1
