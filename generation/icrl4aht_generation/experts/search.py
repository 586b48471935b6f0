"""Scripted ego that finds out which dish its teammate wants: it tries dishes, and repeats the dish that was rewarded.

This ego, called the searcher, plays like the oracle, but cooks a believed recipe instead of the current recipe. It
remembers over the episodes of a task which dishes earned no reward (refused) and which dish was rewarded (paid). Before
any reward, the searcher believes in the dish that best fits the ingredients that the teammate has put into pots, and
breaks ties at random. The belief changes only while nothing is being cooked. This ego is for tasks that reward only one
dish in all episodes, see `Task.recipes`.

The searcher can also advise another ego, which acts and learns to imitate the advice. The searcher then prefers to
believe in a dish that the acting ego has begun, because any dish that was not refused is worth trying.

Shapes: `D` dishes that can be made of the layout's ingredients, `S` bytes of a state record.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.cells import COOKED, GOAL, PLATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import State, columns, ingredient_count, possible_recipes, unpack
from icrl4aht_generation.experts.oracle import DISH, SITUATION_ORACLE, OracleMemory, oracle_params
from icrl4aht_generation.paths import Scene, is_ingredient
from icrl4aht_generation.policy import Policy, Situation

_NO_DISH = 0

MOST_DISHES = 10
"""Number D of dishes that can be made of three pieces of three ingredients."""


class SearchMemory(NamedTuple):
    """Memory of the policy from `searcher`, which lasts from one episode to the next.

    Attributes:
        oracle: memory of the oracle; its record has the believed recipe.
        order: float32 (D,), random numbers below 1 that decide among dishes which fit equally well.
        refused: bool (D,), dishes that were delivered without a reward.
        paid: bool (D,), the dish that was rewarded.
        seen: int32 (3,), pieces of each ingredient that the teammate put into pots.
        belief: int32 (), index of the dish that the ego cooks.
    """

    oracle: OracleMemory
    order: Float[Array, " D"]
    refused: Bool[Array, " D"]
    paid: Bool[Array, " D"]
    seen: Int[Array, " 3"]
    belief: Int[Array, ""]


def searcher(layouts: Layout | Sequence[Layout], advises: bool = False) -> Policy:
    """Return a scripted ego that tries dishes to find out which dish its teammate wants.

    Args:
        layouts: one layout, or several layouts in the environment's order.
        advises: whether another ego acts, while this script only proposes an action in every step.
    """
    known = [layouts] if isinstance(layouts, Layout) else list(layouts)
    script = _ADVISING_SEARCHER if advises else SITUATION_SEARCHER
    return script._replace(params={"oracle": oracle_params(known), "dishes": padded_dishes(known)})


def padded_dishes(layouts: Sequence[Layout]) -> np.ndarray:
    """Return the item bytes of the dishes that can be made on each layout, of shape (layouts, D), padded with 0."""
    dishes = np.full((len(layouts), MOST_DISHES), _NO_DISH, np.uint8)
    for own, layout in zip(dishes, layouts, strict=True):
        possible = possible_recipes(layout)
        own[: len(possible)] = possible
    return dishes


def with_taken_action(memory: OracleMemory | SearchMemory, action: Int[Array, "*B"]) -> Any:
    """Return a scripted ego's memory with the executed action, which may differ from the script's choice."""
    if isinstance(memory, SearchMemory):
        return memory._replace(oracle=memory.oracle._replace(action=action))
    return memory._replace(action=action)


def _initial_memory(params: Any, key: Key[Array, ""]) -> SearchMemory:
    dishes = params["dishes"].shape[-1]
    no = jnp.zeros(dishes, bool)
    order = jax.random.uniform(jax.random.fold_in(key, 1), (dishes,))
    seen = jnp.zeros(3, jnp.int32)
    return SearchMemory(SITUATION_ORACLE.init(params["oracle"], key), order, no, no, seen, order.argmax())


def _act(
    params: Any, memory: SearchMemory, view: Situation, key: Key[Array, ""], advises: bool = False
) -> tuple[Int[Array, ""], Any]:
    dishes = jnp.asarray(params["dishes"])[view.layout]
    memory = _update_belief(memory, view, dishes, advises)
    believed = dishes[memory.belief]
    facts, blank = params["oracle"]
    facts = facts._replace(recipes=jnp.full_like(jnp.asarray(facts.recipes), believed))
    record = view.record.at[columns(view.tables).recipe].set(believed)
    action, oracle = SITUATION_ORACLE.act((facts, blank), memory.oracle, view._replace(record=record), key)
    return action, memory._replace(oracle=oracle)


SITUATION_SEARCHER = Policy((), _initial_memory, _act, "situation")
"""The searcher for any layouts; the `params` to set are `oracle_params` and `padded_dishes` of the layouts."""

_ADVISING_SEARCHER = Policy((), _initial_memory, partial(_act, advises=True), "situation")


def _update_belief(memory: SearchMemory, view: Situation, dishes: UInt8[Array, " D"], advises: bool) -> SearchMemory:
    """Return the memory updated by the outcome of the previous step."""
    new, old = unpack(view.tables, view.record), unpack(view.tables, memory.oracle.record)
    # `follows` is almost always False at an episode's first step: few starts are one move from the last positions.
    moves = jnp.asarray(view.tables.moves)[old.positions.astype(jnp.int32)]
    follows = jnp.all(jnp.any(moves == new.positions[:, None], axis=1))
    ahead = jnp.asarray(view.tables.ahead)[old.positions.astype(jnp.int32), old.facings.astype(jnp.int32)]
    at_goal = jnp.asarray(view.tables.kinds)[ahead.astype(jnp.int32)] == GOAL
    same_pose = (new.positions == old.positions) & (new.facings == old.facings)
    gave = (old.hands & COOKED > 0) & (new.hands == 0) & at_goal & same_pose & follows
    is_dish = (old.hands[:, None] == dishes | DISH) & gave[:, None]  # shape (2, D)
    # If both agents deliver in one step, the reward does not show whose dish was right.
    paid = memory.paid | (is_dish.any(axis=0) & (new.delivered > 0) & ~gave.all())
    refused = memory.refused | (is_dish[EGO] & (new.delivered == 0))
    # The ingredients that the teammate cooks hint at the wanted dish, although the teammate may make mistakes.
    had = old.hands[TEAMMATE]
    into_pot = jnp.sum(ingredient_count(new.pot_items)) > jnp.sum(ingredient_count(old.pot_items))
    put = is_ingredient(had) & (new.hands[TEAMMATE] == 0) & into_pot
    seen = memory.seen + jnp.where(put, Scene.ingredient_counts(had), 0)
    fits = (Scene.ingredient_counts(dishes) @ seen) / jnp.maximum(seen.sum(), 1)
    score = jnp.where(paid, 100.0, fits + 0.1 * memory.order) - 1000.0 * (refused | (dishes == _NO_DISH))
    idle = jnp.all(new.pot_items == 0) & (new.hands[EGO] == 0)
    change = idle | refused[memory.belief] | paid.any()
    if advises:
        fitting = jnp.all(Scene.ingredient_counts(dishes) >= _begun_ingredients(new), axis=-1)
        score = score - 50.0 * ~fitting  # weighs more than the teammate's ingredients, less than a reward or refusal
        change |= ~fitting[memory.belief]
    belief = jnp.where(change, score.argmax(), memory.belief)
    return memory._replace(paid=paid, refused=refused, seen=seen, belief=belief)


def _begun_ingredients(state: State) -> Int[Array, " 3"]:
    """Return the number of pieces of each ingredient in the soup that the ego carries.

    If the ego carries no soup, count the ingredients in the fullest pot, and in the ego's hand if the pot has room.
    """
    hand, counts = state.hands[EGO], ingredient_count(state.pot_items)
    in_hand = Scene.ingredient_counts(hand)
    in_pot = Scene.ingredient_counts(state.pot_items[jnp.argmax(counts)])
    adds = (hand & PLATE == 0) & (counts.max() < 3)
    return jnp.where(hand & COOKED > 0, in_hand, in_pot + jnp.where(adds, in_hand, 0))
