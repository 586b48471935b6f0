"""Heuristic family H1 `recipe_aware_button`: cooks by the recipe, or presses a button to see it (paper, App. B.2)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from icrl4aht_data.overcooked.actions import STAY
from icrl4aht_data.overcooked.cells import GOAL, NOWHERE, PLATE, POT
from icrl4aht_data.overcooked.state import POT_STEPS
from icrl4aht_generation.paths import UNREACHABLE, Rule, Scene, is_dish, is_ingredient
from icrl4aht_generation.teammates.heuristics.heuristic import (
    SHARES,
    Heuristic,
    Sampling,
    draw,
    parameters,
    split_key_again,
)

_CRAMPED_CELLS = 8
"""Maximum number of floor cells of a cramped layout, on which agents give way to their partner."""

_NONE = -1
_NEVER = -1000
_URGENCY = np.float32(1) - np.arange(POT_STEPS + 1, dtype=np.float32) / np.float32(POT_STEPS)


class ButtonMemory(NamedTuple):
    """Memory of an H1 teammate.

    Attributes:
        key: typed JAX key, scalar, the next key of the teammate's chain.
        clock: int32 scalar, steps taken in the episode.
        recipe: uint8 scalar, item byte of the last recipe that the teammate saw; 0 for none.
        seen: int32 scalar, last step at which the teammate saw the recipe.
    """

    key: Key[Array, ""]
    clock: Int[Array, ""]
    recipe: UInt8[Array, ""]
    seen: Int[Array, ""]


def act_recipe_aware_button(params, memory: ButtonMemory, scene: Scene) -> tuple[Int[Array, ""], ButtonMemory]:
    """Return the action of a teammate of family H1, and its memory after the step."""
    # The teammate sees the recipe while a button is lit, and always on layouts with an indicator.
    shown = jnp.any(scene.indicators) | scene.button_lit
    recipe, seen = jnp.where(shown, scene.state.recipe, memory.recipe), jnp.where(shown, memory.clock, memory.seen)
    following, u = draw(memory.key)
    unsure = (recipe == 0) | (memory.clock - seen > params["refresh_interval"])
    idles = u[0] < params["idle_prob"]
    action, considered, pressed, erred = _choose_action(scene, params, recipe, unsure, u)
    # As in the published code, the key does not change if the button is considered but not pressed.
    key = jnp.where(considered & ~pressed & ~idles, memory.key, following)
    key, _ = split_key_again(key, erred & ~idles)
    action = jnp.where(idles, STAY, action)
    return action, ButtonMemory(key, memory.clock + 1, recipe, seen)


def _choose_action(scene: Scene, params, recipe: UInt8[Array, ""], unsure: Bool[Array, ""], u: Float[Array, " 4"]):
    """Return the action of a step without idling, and three flags that determine the next random key.

    The flags are whether the teammate considered pressing the button, whether it chose to press the button, and whether
    it tried to fetch a wrong ingredient.

    Args:
        scene: features of the state.
        params: the teammate's parameters.
        recipe: item byte of the last recipe that the teammate saw; 0 for none.
        unsure: whether the teammate has never seen the recipe, or not for a long time.
        u: uniform random numbers of the step.
    """
    # A specialist only cooks as agent 0, and only delivers as agent 1.
    specialist = params["task_specialization"] > 0.5
    cooks_only, delivers_only = specialist & (scene.slot == 0), specialist & (scene.slot == 1)
    empty, plate, dish, ingredient = scene.holds_nothing, scene.holds_plate, scene.holds_dish, scene.holds_ingredient
    cramped = jnp.sum(jnp.asarray(scene.tables.walkable)) <= _CRAMPED_CELLS
    # On a cramped layout only agent 1 gives way.
    second = cramped & (scene.slot == 1)
    ids = jnp.asarray(scene.tables.ingredients)

    considered = empty & unsure & ~scene.button_lit & jnp.any(scene.buttons)
    # As in the published code, the button uses the random number u1 a second time.
    presses = u[0] < params["press_L_when_unknown"] * (1 - params["cost_sensitivity"])
    fetches_plate = empty & ((_plate_is_urgent(scene, params) & ~cooks_only) | delivers_only)
    fetches_plate &= ~(second & _should_leave_plates(scene))
    cooks = empty & ~delivers_only
    errs = cooks & (u[1] < params["wrong_ingredient_prob"]) & (jnp.max(ids) > 0)
    right = _ingredient_to_fetch(scene, params, recipe, second)
    first_rules = [
        Rule(dish & cooks_only, scene.empty_counters),
        Rule(dish & ~cooks_only, scene.goals),
        Rule(plate, scene.cooked),
        Rule(plate, scene.pots_in_use, waits=True),
        Rule(ingredient, _pots_to_fill(scene, recipe)),
        Rule(ingredient, scene.empty_counters),
        Rule(considered & presses, scene.buttons),
        Rule(fetches_plate, scene.plate_piles),
    ]
    pot_rule, press_rule = 4, 6
    chosen = scene.first(
        [
            *first_rules,
            Rule(errs, scene.piles_of(ids == (right + 1) % (jnp.max(ids) + 1))),
            Rule(cooks, scene.piles_of(ids == right)),
            Rule(empty, scene.pots, waits=True),
        ]
    )
    # Blocking and wrong ingredients can only replace the rules after `first_rules`.
    settled = chosen.found & (chosen.number < len(first_rules))
    action = scene.go_to(chosen.target, chosen.waits, _step(scene, chosen.target, cramped))
    gives_way, aside = _give_way_at_pot(scene, chosen.target)
    action = jnp.where(second & chosen.found & (chosen.number == pot_rule) & gives_way, aside, action)
    action = jnp.where(chosen.found, action, scene.wander())
    blocks, step = _blocking_step(scene)
    blocks &= cooks & (u[2] < params["path_blocking"]) & ~settled
    action = jnp.where(blocks, step, action)
    clears = cramped & plate & is_dish(scene.partner_hand) & ~jnp.any(scene.reachable(scene.cooked))
    action = jnp.where(clears, _step_out_of_way(scene), action)
    pressed = chosen.found & (chosen.number == press_rule)
    return action, considered, pressed, errs & ~settled & ~blocks


def _plate_is_urgent(scene: Scene, params) -> Bool[Array, ""]:
    timers = scene.state.pot_timers
    # The urgency of a plate grows while a soup cooks.
    cooking = jnp.max(jnp.where(timers > 0, jnp.asarray(_URGENCY)[timers.astype(jnp.int32)], 0))
    urgency = jnp.where(jnp.any(scene.cooked), 1, cooking)
    return urgency >= 1 - params["plate_timing"]


def _recognized_types(scene: Scene) -> Bool[Array, " 3"]:
    """Return which ingredient types H1 recognizes in an item: all except id 3, as in the published code."""
    return jnp.asarray(scene.tables.ingredients) < 3


def _missing_ingredients(scene: Scene, recipe: UInt8[Array, ""]) -> Int[Array, "P 3"]:
    """Return the number of missing ingredients of the recipe in each pot; 0 for pots that take no ingredient."""
    missing = jnp.maximum(scene.ingredient_counts(recipe) - scene.ingredient_counts(scene.state.pot_items), 0)
    return missing * scene.fillable_pots[:, None] * _recognized_types(scene)


def _pots_to_fill(scene: Scene, recipe: UInt8[Array, ""]) -> Bool[Array, " cells"]:
    """Return pots that need the ingredient in the hand; if no pot needs it, all pots that take an ingredient."""
    # Pots with wrong ingredients also take ingredients, and H1 fills them if no pot needs its ingredient.
    held = scene.ingredient_counts(scene.hand)
    wanting = scene.values_on_cells(POT, _missing_ingredients(scene, recipe) @ held > 0)
    wanted_everywhere = jnp.any((held > 0) & ~_recognized_types(scene))
    return jnp.where(jnp.any(wanting) & ~wanted_everywhere, wanting, scene.fillable_pot_cells)


def _ingredient_to_fetch(scene: Scene, params, recipe: UInt8[Array, ""], second: Array) -> Int[Array, ""]:
    """Return the id of the ingredient to fetch, or -1; on a cramped layout, the agents fetch different ingredients."""
    ids = jnp.asarray(scene.tables.ingredients)
    missing = _missing_ingredients(scene, recipe).sum(axis=0) > 0
    # Two teammates share the work without communication by fetching different ingredients.
    nth = jnp.cumsum(missing)
    wanted = jnp.where(second & (jnp.sum(missing) > 1), nth == 2, nth == 1)
    known = jnp.where(jnp.any(missing), ids[jnp.argmax(wanted)], _NONE)
    guessed = jnp.where(params["strict_recipe"] < 0.5, second.astype(jnp.int32), _NONE)
    return jnp.where(recipe > 0, known, guessed)


def _blocking_step(scene: Scene) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether the agent can reach a cell next to a pot or goal, and the step to the nearest such cell."""
    critical = (scene.cells_near(POT) | scene.cells_near(GOAL)) & jnp.asarray(scene.tables.walkable)
    distance = jnp.where(critical, scene.distances(scene.own_cell), UNREACHABLE)
    nearest = jnp.argmin(distance)
    return distance[nearest] < UNREACHABLE, scene.first_step(nearest)


# The functions below are for cramped layouts.


def _step(scene: Scene, target: Int[Array, ""], cramped: Bool[Array, ""]) -> Int[Array, ""]:
    """Return the step towards a target; on a cramped layout, agents prefer opposite corners and avoid each other."""
    x, y = jnp.asarray(scene.tables.column), jnp.asarray(scene.tables.row)
    width, height = jnp.asarray(scene.tables.size)
    # Of equally near access cells, choose the one nearest to the agent's corner: each cell of distance costs 0.1 steps.
    corner = y + x if scene.slot == 0 else (height - y) + (width - x)
    step, _ = scene.approach(target, jnp.where(cramped, np.float32(0.1) * corner, np.float32(0)))
    if scene.slot == 1:
        around = scene.sidestep(STAY)
    else:
        pushes = ~scene.holds_dish
        around = scene.sidestep(jnp.where(pushes, step, STAY))
        around = jnp.where(scene.holds_ingredient & (jnp.sum(scene.free_moves) < 2), step, around)
    return jnp.where(cramped & (scene.destination(step) == scene.partner_cell), around, step)


def _give_way_at_pot(scene: Scene, pot: Int[Array, ""]) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether a partner with an ingredient is about as near to a pot as the agent, and a step to give way."""
    access = scene.single_access_cell(pot)
    as_near = scene.manhattan(scene.partner_cell, access) <= scene.manhattan(scene.own_cell, access) + 1
    gives_way = is_ingredient(scene.partner_hand) & (access >= 0) & as_near
    return gives_way, scene.best_move(scene.free_moves, scene.manhattan(scene.move_cells, access))


def _should_leave_plates(scene: Scene) -> Bool[Array, ""]:
    """Return whether to leave plates to the partner: it holds none, and the first pile has a single access cell."""
    first = jnp.argmax(scene.plate_piles)
    single = jnp.any(scene.plate_piles) & (scene.single_access_cell(first) >= 0)
    carries = (scene.partner_hand == PLATE) | is_dish(scene.partner_hand)
    return ~carries & single


def _step_out_of_way(scene: Scene) -> Int[Array, ""]:
    """Return a step off the shortest paths that a partner with a dish can take to the goals."""
    exits, walkable = jnp.asarray(scene.tables.goal_access), jnp.asarray(scene.tables.walkable)
    if not len(exits):
        return jnp.int32(STAY)
    exists = exits < NOWHERE
    exits = jnp.where(exists, exits, 0)
    from_exit = scene.manhattan(scene.cells[:, None], exits)
    from_partner = scene.manhattan(scene.cells, scene.partner_cell)
    # A cell is between two other cells if a path through this cell is as short as the direct path.
    detour = from_partner[:, None] + from_exit
    between = jnp.any((detour == scene.manhattan(scene.partner_cell, exits)) & exists, axis=1)
    in_the_way = walkable & (between | (from_partner == 1))
    from_exits = jnp.min(jnp.where(exists, from_exit, UNREACHABLE), axis=1)
    leaves = scene.free_moves & ~in_the_way[scene.move_cells]
    # If all neighbour cells are in the way, move towards the free cell that is farthest from the goals.
    refuge = jnp.argmax(jnp.where(walkable & ~in_the_way, from_exits, -1))
    to_refuge = scene.manhattan(scene.move_cells, refuge)
    nearer = scene.free_moves & (to_refuge < scene.manhattan(scene.own_cell, refuge)) & jnp.any(walkable & ~in_the_way)
    step = scene.best_move(leaves, from_exits[scene.move_cells], scene.best_move(nearer, -to_refuge))
    return jnp.where(jnp.any(exists) & in_the_way[scene.own_cell], step, STAY)


RECIPE_AWARE_BUTTON = Heuristic(
    kind="recipe_aware_button",
    begin=lambda key: ButtonMemory(key, jnp.int32(0), jnp.uint8(0), jnp.int32(_NEVER)),
    act=act_recipe_aware_button,
    **parameters(
        ("default", "high_L_priority", "lazy_learner", "strict_adherent"),
        {
            "press_L_when_unknown": ((0.0, 1.0), 0.8, 1.0, 0.3, 0.9),
            "refresh_interval": (None, 100, 50, 200, 80),
            "cost_sensitivity": ((0.0, 1.0), 0.2, 0.0, 0.8, 0.1),
            "strict_recipe": ((0.0, 1.0), 0.9, 1.0, 0.3, 1.0),
            "exploration_bias": ((0.0, 1.0), 0.1, 0.0, 0.5, 0.0),  # no effect: no rule uses this parameter
            "plate_timing": ((0.0, 1.0), 0.5, 0.6, 0.4, 0.7),
            "dist_weight": ((0.1, 1.0), 0.3, 0.3, 0.4, 0.25),  # no effect: distances are not weighted
            "inertia": ((0.0, 1.0), 0.4, 0.3, 0.5, 0.5),  # no effect: no rule uses the last intent
            "task_specialization": (None, 0.0, 0.0, 0.0, 0.0),
            "stubbornness": (None, 0.0, 0.0, 0.0, 0.0),  # no effect: the published code ignores this parameter
            "wrong_ingredient_prob": (None, 0.0, 0.0, 0.0, 0.0),
            "idle_prob": (None, 0.0, 0.0, 0.0, 0.0),
            "path_blocking": (None, 0.0, 0.0, 0.0, 0.0),
        },
    ),
    train=Sampling(
        ("default", "high_L_priority"),
        {
            "press_L_when_unknown": (0.6, 1.0),
            "cost_sensitivity": (0.0, 0.4),
            "strict_recipe": (0.7, 1.0),
            "refresh_interval": [50, 80, 100],
        },
    ),
    test=Sampling(
        ("lazy_learner", "strict_adherent"),
        {
            "press_L_when_unknown": (0.2, 0.6),
            "cost_sensitivity": (0.4, 0.9),
            "strict_recipe": (0.2, 0.6),
            "refresh_interval": [100, 150, 200],
        },
    ),
    diverse=Sampling(
        ("default",),
        {
            "press_L_when_unknown": (0.0, 1.0),
            "cost_sensitivity": (0.0, 1.0),
            "strict_recipe": (0.0, 1.0),
            "refresh_interval": [50, 100, 200],
            "plate_timing": (0.0, 1.0),
            "task_specialization": [0.0, 0.0, 1.0],
            "wrong_ingredient_prob": SHARES,
            "idle_prob": SHARES,
            "path_blocking": SHARES,
        },
    ),
    unbounded=frozenset({"refresh_interval"}),
)
"""Heuristic family H1, with parameters in the order of the published manifests.

The first four parameters only have an effect while the recipe is unknown or not seen for a long time, which cannot
happen on a layout with a recipe indicator.
"""
