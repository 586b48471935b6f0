"""Heuristic family H3 `assembly_line`: one role fetches ingredients, one plates and delivers soups (App. B.2)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key

from icrl4aht_data.overcooked.actions import DOWN, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.cells import POT
from icrl4aht_generation.paths import Rule, Scene, is_ingredient
from icrl4aht_generation.teammates.heuristics.heuristic import (
    SHARES,
    Heuristic,
    Sampling,
    draw,
    parameters,
    split_key_again,
)

RUNNER, PLATER, FLEX = range(3)
AT_POTS, CENTRAL, NEAR_PARTNER = range(3)

_MOVES_BY_DRAW = (RIGHT, DOWN, LEFT, UP)
_HESITATION_FACTORS = (np.arange(10) / 10).astype(np.float32)


def act_assembly_line(params, memory: Key[Array, ""], scene: Scene) -> tuple[Int[Array, ""], Key[Array, ""]]:
    """Return the action of an H3 teammate, and the next memory, which is a random key."""
    following, u = draw(memory)
    idles = (u[0] < params["hesitation_prob"]) | (u[3] < params["timing_mismatch"] * _hesitation_factor(scene))
    makes_room = _should_step_aside(scene)
    # As in the published code, mistakes never replace deliveries, or putting down an ingredient once a soup is done.
    final, action = _choose_action(scene, params, abandons=u[2] < params["task_abandon_prob"])
    slips = ~(idles | makes_room | final)
    action, following = _with_mistakes(scene, params, action, slips, u[1], following)
    action = jnp.where(makes_room, _step_aside(scene), action)
    return jnp.where(idles, STAY, action), following


def _hesitation_factor(scene: Scene) -> Array:
    """Return the fixed factor of the agent's cell in the chance to hesitate, float32 in 0..0.9."""
    x, y = jnp.asarray(scene.tables.column)[scene.own_cell], jnp.asarray(scene.tables.row)[scene.own_cell]
    return jnp.asarray(_HESITATION_FACTORS)[(7 * x + 13 * y) % 10]


def _choose_action(scene: Scene, params, abandons: Bool[Array, ""]) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Return whether the action is exempt from mistakes, and the action chosen by the first rule that applies."""
    empty, plate, ingredient = scene.holds_nothing, scene.holds_plate, scene.holds_ingredient
    soup, cooking = jnp.any(scene.cooked), jnp.any(scene.cooking)
    final = scene.holds_dish | (ingredient & soup)
    # If a soup is done, an agent that carries an ingredient puts it down at once.
    ingredient &= ~soup
    plates_now = soup | (cooking & (params["plate_urgency"] > 0.5))
    plater = (params["role_mode"] == PLATER) | ((params["role_mode"] == FLEX) & plates_now)
    runner = ~plater
    # Count the partner's ingredient as already in the pot, or else both agents fetch the last missing piece.
    coming = scene.ingredient_counts(scene.partner_hand) * is_ingredient(scene.partner_hand)
    chosen = scene.first(
        [
            Rule(scene.holds_dish, scene.goals),
            Rule(scene.holds_ingredient & soup, scene.empty_counters),
            # Agents put their item down if they abandon the task, or if the item belongs to the other role.
            Rule((plate | ingredient) & abandons, scene.empty_counters),
            Rule((runner & plate) | (plater & ingredient), scene.empty_counters),
            Rule(runner & ingredient, scene.fillable_pot_cells),
            Rule(runner & ingredient, _handoff_counters(scene, params)),
            Rule(runner & empty, scene.piles_of(scene.needed - coming > 0)),
            Rule(plater & plate, scene.cooked),
            Rule(plater & empty, scene.plate_piles),
            # The remaining rules send an agent that can do nothing now to the target of its next task, where it waits.
            Rule(plater & (plate | empty), scene.pots_in_use, waits=True),
            Rule((runner & empty) | (plater & plate), scene.pots, waits=True),
            Rule(empty | (plater & plate), scene.buttons, waits=True),
            Rule(empty, scene.indicators, waits=True),
        ]
    )
    action = scene.go_to(chosen.target, chosen.waits, _step(scene, chosen.target))
    return final, jnp.where(chosen.found, action, scene.wander())


def _step(scene: Scene, target: Int[Array, ""]) -> Int[Array, ""]:
    """Return the step towards a target; agent 1 stays if the step leads to the partner's cell or a cell next to it."""
    step, _ = scene.approach(target)
    if scene.slot == 0:
        return step
    distance = scene.distances(scene.partner_cell)[scene.destination(step)]
    return jnp.where((step < STAY) & (distance <= 1), STAY, step)


def _handoff_counters(scene: Scene, params) -> Bool[Array, " cells"]:
    """Return the empty counters that the handoff style prefers for an ingredient, or else all empty counters."""
    x, y, floor = (jnp.asarray(table) for table in (scene.tables.column, scene.tables.row, scene.tables.walkable))
    middle_x, middle_y = (jnp.sum(axis * floor) // jnp.sum(floor) for axis in (x, y))
    central = jnp.abs(x - middle_x) + jnp.abs(y - middle_y) <= 3
    near_partner = scene.manhattan(scene.cells, scene.partner_cell) <= 2
    free = scene.empty_counters
    at_pots = free & scene.cells_near(POT)
    near_partner = _first_nonempty(free & near_partner, at_pots)
    style = params["handoff_style"]
    preferred = jnp.where(style == AT_POTS, at_pots, jnp.where(style == CENTRAL, free & central, near_partner))
    return _first_nonempty(preferred, free)


def _first_nonempty(mask: Bool[Array, " cells"], other: Bool[Array, " cells"]) -> Bool[Array, " cells"]:
    return jnp.where(jnp.any(mask), mask, other)


def _should_step_aside(scene: Scene) -> Bool[Array, ""]:
    """Return whether this is agent 1, empty-handed and adjacent to a partner who carries an item."""
    adjacent = scene.manhattan(scene.own_cell, scene.partner_cell) == 1
    return scene.holds_nothing & (scene.partner_hand > 0) & adjacent & (scene.slot == 1)


def _step_aside(scene: Scene) -> Int[Array, ""]:
    """Return a step away from the adjacent partner; else a step sideways (right or down first); else stay."""
    from_partner = scene.neighbours(scene.own_cell) == scene.partner_cell  # partner above, below, left or right
    across = from_partner[2] | from_partner[3]
    # Each array has the scores of the moves right, down, left and up.
    sideways_in_row = jnp.array([2, 0, 1, 0])
    sideways_in_column = jnp.array([0, 2, 0, 1])
    away = 3 * from_partner[jnp.array([2, 0, 3, 1])]
    score = away + jnp.where(across, sideways_in_column, sideways_in_row)
    return scene.best_move(scene.free_moves & (score > 0), score)


def _with_mistakes(scene: Scene, params, action: Int[Array, ""], slips: Bool[Array, ""], u: Array, key: Key[Array, ""]):
    """Return the action, perhaps replaced by a wrong move or a step to the home cell, and the next random key."""
    errs = slips & (u < params["wrong_action_prob"])
    key, own = split_key_again(key, errs)
    wrong = jax.random.bits(jax.random.split(own)[1]) & 3
    action = jnp.where(errs, jnp.asarray(_MOVES_BY_DRAW)[wrong.astype(jnp.int32)], action)

    may_return = slips & scene.holds_nothing & (params["stubbornness"] > 0)
    key, own = split_key_again(key, may_return)
    width, height = jnp.asarray(scene.tables.size)
    # This is the published formula of the home cell; if the cell is a wall, the teammate never walks home.
    home = (3 * scene.slot % height) * width + 5 * scene.slot % width
    far, is_floor = scene.manhattan(scene.own_cell, home) > 2, jnp.asarray(scene.tables.walkable)[home]
    goes = may_return & far & (jax.random.uniform(own) < params["stubbornness"]) & is_floor
    return jnp.where(goes, scene.first_step(home), action), key


ASSEMBLY_LINE = Heuristic(
    kind="assembly_line",
    begin=lambda key: key,
    act=act_assembly_line,
    **parameters(
        ("default", "ingredient_runner", "plater_deliverer"),
        {
            "role_mode": (None, FLEX, RUNNER, PLATER),
            "handoff_style": (None, AT_POTS, AT_POTS, AT_POTS),
            "plate_urgency": ((0.0, 1.0), 0.5, 0.0, 0.8),
            "prestage_bias": ((0.0, 1.0), 0.3, 0.5, 0.0),  # no effect: no rule uses this parameter
            "start_cook_bias": ((0.0, 1.0), 0.7, 0.8, 0.3),  # no effect: pots start by themselves
            "hesitation_prob": (None, 0.0, 0.0, 0.0),
            "wrong_action_prob": (None, 0.0, 0.0, 0.0),
            "task_abandon_prob": (None, 0.0, 0.0, 0.0),
            "stubbornness": (None, 0.0, 0.0, 0.0),
            "timing_mismatch": (None, 0.0, 0.0, 0.0),
        },
    ),
    train=Sampling(
        ("default", "ingredient_runner"),
        {"role_mode": [0, 2], "plate_urgency": (0.0, 0.6), "prestage_bias": (0.2, 0.6)},
    ),
    test=Sampling(
        ("plater_deliverer",),
        {"role_mode": [1], "plate_urgency": (0.6, 1.0), "prestage_bias": (0.0, 0.3)},
    ),
    diverse=Sampling(
        ("default",),
        {
            "role_mode": [RUNNER, PLATER, FLEX],
            "handoff_style": [0, 1, 2],
            "plate_urgency": (0.0, 1.0),
            "hesitation_prob": SHARES,
            "wrong_action_prob": SHARES,
            "task_abandon_prob": SHARES,
            "stubbornness": SHARES,
            "timing_mismatch": SHARES,
        },
    ),
    choices={"role_mode": 3, "handoff_style": 3},
)
"""Heuristic family H3, with parameters in the order of the published manifests."""
