"""Heuristic family H4 `utility_greedy`: follows the best of eight intents, scored by weight and distance (App. B.2)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from icrl4aht_data.overcooked.actions import STAY
from icrl4aht_data.overcooked.cells import POT
from icrl4aht_data.overcooked.state import ingredient_count
from icrl4aht_generation.paths import UNREACHABLE, Scene
from icrl4aht_generation.teammates.heuristics.heuristic import Heuristic, Sampling, next_key, parameters

DELIVER, PICK_UP, PLATE_UP, ADD, FETCH, STAGE, START, PRESS = range(8)


class GreedyMemory(NamedTuple):
    """Memory of an H4 teammate.

    Attributes:
        key: typed JAX key, scalar, the next key of the teammate's chain.
        intent: int32 scalar, the last intent, 0..7; -1 for none.
        wait: int32 scalar, remaining steps of waiting for the partner.
    """

    key: Key[Array, ""]
    intent: Int[Array, ""]
    wait: Int[Array, ""]


def act_utility_greedy(params, memory: GreedyMemory, scene: Scene) -> tuple[Int[Array, ""], GreedyMemory]:
    """Return the action of an H4 teammate, and the next memory."""
    intent, action = _choose_action(scene, params, memory.intent)
    action, wait = _yield_to_partner(scene, memory, action)
    # As in the published code, the key changes in every step, but the intent does not change during a wait.
    waiting = memory.wait > 0
    after = GreedyMemory(
        next_key(memory.key),
        jnp.where(waiting, memory.intent, intent),
        jnp.where(waiting, memory.wait - 1, wait),
    )
    return jnp.where(waiting, STAY, action), after


def _choose_action(scene: Scene, params, last_intent: Int[Array, ""]) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Return the best intent (-1 if no intent is feasible) and the action of this intent."""
    cooked, cooking, fillable = map(scene.reachable, (scene.cooked, scene.cooking, scene.fillable_pot_cells))
    # If no soup is finished, an agent with a plate goes to a soup that is still cooking.
    waits = scene.holds_plate & ~jnp.any(cooked) & jnp.any(cooking)
    needed = scene.reachable(scene.needed_piles)
    stageable = scene.empty_counters & scene.cells_near(POT)
    prefers_pots = jnp.any(stageable) & (params["counter_preference"] > 0.5)
    targets = jnp.stack(
        [
            scene.goals,
            jnp.where(waits, cooking, cooked),
            scene.plate_piles,
            fillable,
            jnp.where(jnp.any(needed), needed, scene.recipe_piles),
            jnp.where(prefers_pots, stageable, scene.empty_counters),
            jnp.zeros_like(scene.goals),  # the intent START has no targets
            scene.buttons,
        ]
    )
    values, allowed = _intent_values(scene, params, waits, jnp.any(needed))
    distance = jax.vmap(scene.nearest_distance)(targets)
    feasible = allowed & (distance < UNREACHABLE)
    bonus = 2.0 * params["inertia"] * (jnp.arange(8) == last_intent)  # prevents wavering between intents
    scores = jnp.where(feasible, values - params["dist_weight"] * distance + bonus, -jnp.inf)
    best = jnp.argmax(scores)
    target = scene.nearest_cell(targets[best])
    action = scene.go_to(target, waits=waits & (best == PICK_UP))
    # If all scores are -inf, `argmax` returns 0, so `some` shows whether any intent is feasible.
    some = jnp.any(feasible)
    return jnp.where(some, best, -1), jnp.where(some, action, scene.wander())


def _intent_values(scene: Scene, params, waits, needed_reachable) -> tuple[Float[Array, " 8"], Array]:
    """Return the weighted values of the eight intents, and whether each intent is allowed, arrays of shape (8,)."""
    cooking, cooked, nonfull = (jnp.sum(mask) for mask in (scene.cooking, scene.cooked, scene.fillable_pot_cells))
    can_add = jnp.any(scene.reachable(scene.fillable_pot_cells))
    can_put_down = jnp.any(scene.reachable(scene.empty_counters))
    plate = jnp.where(cooking + cooked > 0, 1 + 0.3 * cooking + 0.5 * cooked, jnp.where(nonfull == 0, 0.8, 0.2))
    fetch = jnp.where(
        needed_reachable,
        jnp.where(can_add, 1 + 0.2 * nonfull, 0.8),
        jnp.where(can_add, 0.4 + 0.05 * nonfull, 0.15),
    )
    # As in the published code, the value of adding an ingredient depends on the fullest pot, not the nearest pot.
    fullest = jnp.max(ingredient_count(scene.state.pot_items)).astype(jnp.int32)
    finished = 1 + 0.5 * cooked
    no_pot_in_use = cooking + cooked + nonfull == 0
    rows = [
        (params["w_deliver"] * finished, scene.holds_dish),
        (params["w_pickup_cooked"] * jnp.where(waits, 1.5, finished), scene.holds_plate),
        (params["w_get_plate"] * plate, scene.holds_nothing),
        (params["w_add_ingredient"] * (1 + 0.2 * (3 - fullest)), scene.holds_ingredient),
        (
            params["w_fetch_ingredient"] * fetch,
            scene.holds_nothing & (can_add | can_put_down) & jnp.any(scene.needed_piles),
        ),
        (
            params["w_stage_on_counter"] * (0.5 + 0.1 * nonfull),
            (scene.holds_ingredient & ~can_add) | (scene.holds_plate & no_pot_in_use),
        ),
        (jnp.float32(0), jnp.asarray(False)),  # START: pots start by themselves
        (params["w_press_L"], (params["w_press_L"] > 0) & scene.holds_nothing & ~scene.button_lit),
    ]
    values, allowed = zip(*rows, strict=True)
    return jnp.stack([jnp.asarray(v, jnp.float32) for v in values]), jnp.stack(allowed)


def _yield_to_partner(scene: Scene, memory: GreedyMemory, action: Int[Array, ""]):
    """Return the action, which is sometimes `stay` next to the partner, and the number of steps to wait."""
    distance = scene.manhattan(scene.destination(action), scene.partner_cell)
    # As in the published code, the random number is the key's first word, not a number drawn with the key.
    roll = jax.random.key_data(memory.key)[0] % 100
    yields = (action < STAY) & (distance <= 1) & (roll < 20 + 20 * scene.slot)
    return jnp.where(yields, STAY, action), jnp.where(yields, 1 + (roll % 2).astype(jnp.int32), 0)


_TABLE = parameters(
    ("default", "delivery_focused", "prep_focused", "high_inertia", "distance_sensitive"),
    {
        "w_deliver": ((5.0, 20.0), 10.0, 15.0, 8.0, 10.0, 10.0),
        "w_pickup_cooked": ((3.0, 15.0), 8.0, 12.0, 5.0, 8.0, 8.0),
        "w_get_plate": ((2.0, 10.0), 5.0, 8.0, 3.0, 5.0, 5.0),
        "w_add_ingredient": ((3.0, 12.0), 6.0, 3.0, 10.0, 6.0, 6.0),
        "w_fetch_ingredient": ((2.0, 10.0), 4.0, 2.0, 8.0, 4.0, 4.0),
        "w_stage_on_counter": ((0.5, 5.0), 2.0, 1.0, 4.0, 2.0, 2.0),
        "w_start_cooking": ((3.0, 15.0), 7.0, 4.0, 12.0, 7.0, 7.0),  # no effect: pots start by themselves
        "w_press_L": ((1.0, 8.0), 3.0, 2.0, 5.0, 3.0, 3.0),
        "dist_weight": ((0.1, 1.5), 0.5, 0.3, 0.4, 0.5, 1.0),
        "inertia": ((0.0, 1.0), 0.3, 0.4, 0.5, 0.7, 0.3),
        "counter_preference": ((0.0, 1.0), 0.5, 0.3, 0.7, 0.5, 0.5),
    },
)
_SPANS = _TABLE["spans"]

UTILITY_GREEDY = Heuristic(
    kind="utility_greedy",
    begin=lambda key: GreedyMemory(key, jnp.int32(-1), jnp.int32(0)),
    act=act_utility_greedy,
    **_TABLE,
    train=Sampling(
        ("default", "delivery_focused"),
        {
            "w_deliver": (8.0, 18.0),
            "w_pickup_cooked": (6.0, 14.0),
            "w_add_ingredient": (3.0, 8.0),
            "dist_weight": (0.2, 0.7),
            "inertia": (0.1, 0.5),
        },
    ),
    test=Sampling(
        ("prep_focused", "high_inertia", "distance_sensitive"),
        {
            "w_deliver": (5.0, 12.0),
            "w_pickup_cooked": (3.0, 8.0),
            "w_add_ingredient": (7.0, 12.0),
            "dist_weight": (0.6, 1.2),
            "inertia": (0.5, 0.9),
        },
    ),
    diverse=Sampling(
        ("default",),
        {name: span for name, span in _SPANS.items() if name != "w_start_cooking"} | {"w_press_L": (0.0, 8.0)},
    ),
    unbounded=frozenset(_SPANS.keys() - {"inertia", "counter_preference"}),
)
"""Heuristic family H4, with parameters in the order of the published manifests."""
