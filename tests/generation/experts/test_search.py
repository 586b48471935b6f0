"""Test which dish the scripted ego `searcher` believes to be wanted, if it acts itself or if another ego acts."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.experts.search import SearchMemory, searcher
from icrl4aht_generation.policy import Situation

from icrl4aht_data.overcooked.cells import COOKED, PLATE
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import possible_recipes
from tests.helpers.states import state_record

LAYOUT = get_layout("asymm_both_plain")
DISHES = possible_recipes(LAYOUT)
FIRST, SECOND, MIXED, OTHER_MIXED = 3 << 2, 3 << 4, (2 << 2) + (1 << 4), (1 << 2) + (2 << 4)


jitted = cache(jax.jit)


def believed_dish(advises: bool, memory: Mapping[str, Any], **fields: Any) -> int:
    """Return the dish, as an item byte, that an ego with the given memory believes to be wanted after a new state."""
    script = searcher(LAYOUT, advises)
    start: SearchMemory = script.init(script.params, jax.random.key(0))
    start = start._replace(**{name: jnp.asarray(value) for name, value in memory.items()})
    record = jnp.asarray(state_record(LAYOUT, (1, 1, "left"), (7, 1, "left"), **fields))[0]
    _, after = jitted(script.act)(
        script.params, start, Situation(LAYOUT.tables, record, jnp.int32(0)), jax.random.key(0)
    )
    return int(DISHES[after.belief])


def dish_mask(*dishes: int) -> np.ndarray:
    """Return a mask of the given dishes among all dishes, bool of shape (10,)."""
    return np.isin(np.pad(DISHES, (0, 10 - len(DISHES))), dishes)


@pytest.mark.parametrize(
    ("fields", "memory", "expected"),
    [
        ({"pot_items": [2 << 2, 0]}, {}, {FIRST, MIXED}),
        ({"pot_items": [2 << 2, 0]}, {"refused": dish_mask(FIRST)}, {MIXED}),
        ({"pot_items": [2 << 2, 0], "hands": [1 << 4, 0]}, {}, {MIXED}),
        ({"pot_items": [0, FIRST]}, {}, {FIRST}),
        ({"pot_items": [0, FIRST]}, {"refused": dish_mask(FIRST)}, {SECOND, MIXED, OTHER_MIXED}),
        ({"hands": [MIXED | PLATE | COOKED, 0]}, {}, {MIXED}),
        ({"pot_items": [2 << 2, 0]}, {"paid": dish_mask(SECOND)}, {SECOND}),
    ],
)
def test_belief_follows_a_dish_that_another_acting_ego_has_begun(fields, memory, expected):
    orders = np.pad(np.eye(4, dtype=np.float32), ((0, 0), (0, 6)))
    found = {believed_dish(True, {"order": order, **memory}, **fields) for order in orders}
    assert found == expected


def test_belief_stays_while_a_pot_is_in_use_if_the_scripted_ego_acts():
    belief = {"belief": np.int32(list(DISHES).index(SECOND))}
    assert believed_dish(False, belief, pot_items=[2 << 2, 0]) == SECOND
    assert believed_dish(True, belief, pot_items=[2 << 2, 0]) in {FIRST, MIXED}
