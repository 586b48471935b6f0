"""Tasks of the track `preference`: a teammate wants the same dish in all episodes, but observations do not show which.

The dish of a task is the current recipe in every episode, and only this dish is rewarded. The scripted teammates know
the dish. The layouts have no recipe indicator, so an ego must infer the dish from rewards or from what its teammate
cooks. Related work on partners with hidden preferences: Yu et al. 2023 (HSP), and the biased partners of ZSC-Eval (Wang
et al. 2024).

Test tasks have published test teammates; validation and test tasks also have a teammate that never acts. Half of the
test tasks are on training layouts, the other half on layouts with rooms that no training layout has. On some
layouts with ten dishes, up to three dishes only occur in test tasks.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations_with_replacement, product
from typing import Any

from icrl4aht_data.benchmark.facts import PLAIN, PREFERENCE, PREFERENCE_LAYOUTS
from icrl4aht_data.benchmark.tasks import Dish, Task, make_task
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_generation.teammates.draws import DIVERSE_SEEDS
from icrl4aht_generation.teammates.heuristics.territory import LAZY, TERRITORY
from icrl4aht_generation.teammates.instances import INSTANCES, TESTED_FAMILIES, published_teammates
from icrl4aht_generation.teammates.registry import heuristic_entry, sample_teammate

WATCHER = heuristic_entry(
    TERRITORY.kind, INSTANCES, 0, TERRITORY.defaults | {"behavior_mode": LAZY, "action_probability": 0.0}
)
"""Entry of a teammate that never acts."""

_TEST_TASKS = {"train": 5, "test": 10}
"""Number of test tasks on each layout, for layouts of training and other layouts."""


def all_dishes(layout: Layout) -> list[Dish]:
    """Return all dishes of a layout's ingredients: 4 dishes for two ingredients, or 10 dishes for three."""
    return list(combinations_with_replacement(layout.ingredients, 3))  # type: ignore[arg-type]


def training_dishes(layout: Layout) -> list[Dish]:
    """Return the dishes of training and validation tasks on a layout: all if it has 4 dishes, 7 if it has 10."""
    dishes = all_dishes(layout)
    return [dish for number, dish in enumerate(dishes) if len(dishes) < 10 or number % 3 != 2]


def preference_tasks(split: str) -> list[Task]:
    """Return the tasks of the track `preference` of a split: "train", "validation" or "test"."""
    tasks = []
    for part in PREFERENCE_LAYOUTS if split == "test" else ("train",):
        for number, name in enumerate(PREFERENCE_LAYOUTS[part]):
            for dish, mate in _dishes_and_teammates(get_layout(name), split, number, part):
                tasks.append(make_task(PREFERENCE, split, name, mate, 0, [dish]))
    return tasks


def all_training_tasks(layout: str) -> list[Task]:
    """Return a task for each training teammate and training dish of a layout of the track (short name).

    The training tasks of the track are a fifth of them. There most teammates want one dish only, so a model can learn
    which teammate wants which dish, instead of finding out the dish.
    """
    found = get_layout(layout)
    pairs = product(_teammates(found, "train"), training_dishes(found))
    return [make_task(PREFERENCE, "train", layout, mate, 0, [dish]) for mate, dish in pairs]


def _dishes_and_teammates(layout: Layout, split: str, number: int, part: str) -> Iterator[tuple[Dish, dict[str, Any]]]:
    """Yield dish and teammate of each task on a layout; `number` shifts the pairs, so they differ between layouts."""
    dishes = all_dishes(layout) if split == "test" else training_dishes(layout)
    mates = _teammates(layout, split)
    if split == "train":
        yield from ((dish, mates[(3 * k + number) % len(mates)]) for k, dish in enumerate(dishes * 4))
        return
    for k in range(_TEST_TASKS[part] if split == "test" else len(TESTED_FAMILIES)):
        # Each layout shifts dishes by 7 and teammates by 1, so every dish occurs with teammates of several families.
        yield dishes[(3 * k + 7 * number) % len(dishes)], mates[(6 * k + number) % len(mates)]


def _teammates(layout: Layout, split: str) -> list[dict[str, Any]]:
    """Return the teammates of a split on a layout; the families take turns.

    In validation and test, a teammate that never acts follows after each round of families.
    """
    found = []
    for instance in range(INSTANCES):
        for family in TESTED_FAMILIES:
            if split == "test":
                found.append(published_teammates(layout.name.removesuffix(PLAIN), family)[instance])
            else:
                found.append(sample_teammate(family, instance, "diverse", DIVERSE_SEEDS[split]))
        found += [] if split == "train" else [WATCHER]
    return found
