"""Heuristic family H2 `territory`: prefers targets in its part of the layout; some modes do not cooperate."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from icrl4aht_data.overcooked.actions import DOWN, LEFT, RIGHT, STAY, UP
from icrl4aht_generation.paths import Rule, Scene
from icrl4aht_generation.teammates.heuristics.heuristic import Heuristic, Sampling, draw, parameters

VERTICAL, HORIZONTAL, STATIONS = range(3)
NORMAL, BLOCKER, HOARDER, LAZY, COUNTER, INVADER = range(6)

_STUCK = 3
_NOWHERE = -1


class TerritoryMemory(NamedTuple):
    """Memory of an H2 teammate.

    Attributes:
        key: typed JAX key, scalar, the next key of the teammate's chain.
        cell: int32 scalar, the teammate's cell at the last step; -1 before the first step.
        stuck: int32 scalar, steps since the teammate last moved.
    """

    key: Key[Array, ""]
    cell: Int[Array, ""]
    stuck: Int[Array, ""]


def act_territory(params, memory: TerritoryMemory, scene: Scene) -> tuple[Int[Array, ""], TerritoryMemory]:
    """Return the action of an H2 teammate, and the next memory."""
    following, u = draw(memory.key)
    mode = params["behavior_mode"]
    action = _rule_action(scene, params, u[0], memory.stuck >= _STUCK)
    # As in the published code, all modes use the same random number u1.
    blocked = jnp.where(u[0] < 0.7, STAY, _step_to_middle(scene))
    action = jnp.where(mode == BLOCKER, blocked, action)
    action = jnp.where((mode == LAZY) & (u[0] > params["action_probability"]), STAY, action)
    # Steps of deliberate waiting count too. Two agents that wait for each other therefore start to wander.
    stuck = jnp.where(scene.own_cell == memory.cell, memory.stuck + 1, 0)
    return action, TerritoryMemory(following, scene.own_cell, stuck)


def _step_to_middle(scene: Scene) -> Int[Array, ""]:
    """Return the step towards the middle: first to the middle column, then along this column; stay at a wall."""
    x, y = jnp.asarray(scene.tables.column)[scene.own_cell], jnp.asarray(scene.tables.row)[scene.own_cell]
    middle_x, middle_y = jnp.asarray(scene.tables.size) // 2
    # On most layouts, no agent can pass a blocker in the middle column.
    across = jnp.where(x < middle_x, RIGHT, LEFT)
    along = jnp.where(y < middle_y, DOWN, jnp.where(y > middle_y, UP, STAY))
    action = jnp.where(x == middle_x, along, across)
    blocked = jnp.asarray(scene.tables.moves)[scene.own_cell, action] == scene.own_cell
    return jnp.where(blocked, STAY, action)


def _rule_action(scene: Scene, params, u: Float[Array, ""], stuck: Bool[Array, ""]) -> Int[Array, ""]:
    """Return the action in a mode other than BLOCKER; the first of the rules that applies decides."""
    empty, plate, dish, ingredient = scene.holds_nothing, scene.holds_plate, scene.holds_dish, scene.holds_ingredient
    hoards, counters = params["behavior_mode"] == HOARDER, params["behavior_mode"] == COUNTER
    soup, cooking, room = (jnp.any(mask) for mask in (scene.cooked, scene.cooking, scene.fillable_pot_cells))
    keeps_dish = dish & (hoards | counters)
    sabotage = [  # rules of modes that withhold dishes and ingredients
        Rule(keeps_dish | (ingredient & hoards & (u < 0.8)), scene.empty_counters),
        Rule(empty & counters & soup, scene.needed_piles),
    ]
    # Each mask comes with a flag: whether the agent may use targets outside its territory as a fallback.
    goals, nonfull, put_down, cooked, heating, plates, staged, needed = _territory_targets(
        scene,
        params,
        [
            (scene.goals, True),
            (scene.fillable_pot_cells, True),
            (scene.empty_counters, True),
            (scene.cooked, False),
            (scene.cooking, False),
            (scene.plate_piles, False),
            (scene.counter_ingredients, False),
            (scene.needed_piles, True),
        ],
    )
    fetches = empty & (room | ~cooking)
    chosen = scene.first(
        [
            *sabotage,
            Rule(dish, goals),
            Rule(ingredient, nonfull),
            Rule(plate, cooked),
            Rule(plate, heating, waits=True),
            Rule(ingredient | plate, put_down),
            Rule(empty & soup, plates),
            Rule(fetches, staged),
            Rule(fetches, needed),
            Rule(empty, plates),
        ]
    )
    # A stuck agent wanders unless it sabotages; hoarders with a plate also wander at random.
    sabotages = chosen.found & (chosen.number < len(sabotage))
    wanders = ~chosen.found | (stuck & ~sabotages) | (plate & hoards & (u < 0.7))
    worked = scene.go_to(chosen.target, chosen.waits, _step(scene, params, chosen.target))
    action = jnp.where(wanders, scene.wander(stay_score=150), worked)
    return jnp.where(keeps_dish & ~sabotages, STAY, action)


def _step(scene: Scene, params, target: Int[Array, ""]) -> Int[Array, ""]:
    """Return the step towards a target, around the partner; agent 1 waits if the partner is at the only access cell."""
    # Thresholds are float32 like the parameters, so a parameter of 0.1 or 0.3 equals its threshold despite rounding.
    step, cost = scene.approach(target)
    goes_around = scene.destination(step) == scene.partner_cell
    if scene.slot == 0:
        goes_around &= params["yield_bias"] >= np.float32(0.3)
    step = jnp.where(goes_around, scene.sidestep(STAY), step)
    if scene.slot == 0:
        return step
    access = scene.single_access_cell(target)
    near = scene.distances(scene.partner_cell)[access] <= 1
    waits = (access >= 0) & near & (cost <= 2) & (params["yield_bias"] >= np.float32(0.1))
    return jnp.where(waits, STAY, step)


def _territory_targets(scene: Scene, params, masks: list[tuple[Array, bool]]) -> Bool[Array, "masks cells"]:
    """Return the reachable cells of each mask in the agent's territory, or else in the shared territory.

    If both are empty, the result is all reachable cells for masks with a fallback, and no cells for other masks. With
    low strictness or urgent soups, the result is all reachable cells of each mask.
    """
    # Two finished soups give the highest urgency: then even strict teammates help outside their territory.
    urgency = jnp.minimum(jnp.sum(scene.cooked) / 2, 1)
    anywhere = (urgency > params["rescue_threshold"]) | (params["strictness"] <= 0.5)
    reach = scene.reachable(jnp.stack([mask for mask, _ in masks]))
    strict, relaxed = (reach & area for area in territories(scene, params))
    fallback = jnp.asarray(np.array([[fallback] for _, fallback in masks]))
    found = jnp.where(
        jnp.any(strict, axis=1, keepdims=True),
        strict,
        jnp.where(jnp.any(relaxed, axis=1, keepdims=True), relaxed, reach & fallback),
    )
    return jnp.where(anywhere, reach, found)


def territories(scene: Scene, params) -> tuple[Bool[Array, " cells"], Bool[Array, " cells"]]:
    """Return the agent's territory, and the territory with the shared margin.

    An agent in mode INVADER has the territory of its partner.
    """
    # Small layouts where the split by stations leaves one agent without floor cells are split vertically.
    tables = scene.tables
    stations, floor = jnp.asarray(tables.stations), jnp.asarray(tables.walkable)
    divides = jnp.any(floor & (stations < 0)) & jnp.any(floor & (stations >= 0))
    kind = jnp.where((params["split_mode"] == STATIONS) & ~divides, VERTICAL, params["split_mode"])
    middle_x, middle_y = jnp.asarray(tables.size) // 2
    from_middle = (jnp.asarray(tables.column) - middle_x, jnp.asarray(tables.row) - middle_y)
    # Signed distance of each cell from the border for each split mode, positive on agent 1's side.
    beyond = jnp.stack([*(one.astype(jnp.float32) for one in from_middle), stations])[kind]
    margin = params["shared_margin"] * jnp.where(kind == STATIONS, jnp.float32(1.5), jnp.float32(1))
    # An invader works in its partner's territory, on the other side of the border.
    second = (scene.slot == 1) ^ (params["behavior_mode"] == INVADER)
    strict = jnp.where(second, beyond >= 0, beyond < 0)
    near = beyond + margin
    # As in the published code, cells exactly at the margin are shared, except in the split by stations.
    shared = jnp.where(kind == STATIONS, near > 0, near >= 0)
    return strict, jnp.where(second, shared, beyond < margin)


TERRITORY = Heuristic(
    kind="territory",
    begin=lambda key: TerritoryMemory(key, jnp.int32(_NOWHERE), jnp.int32(0)),
    act=act_territory,
    **parameters(
        ("default", "strict_vertical", "strict_horizontal", "object_stations", "flexible"),
        {
            "split_mode": (None, VERTICAL, VERTICAL, HORIZONTAL, STATIONS, VERTICAL),
            "strictness": ((0.0, 1.0), 0.7, 1.0, 1.0, 0.8, 0.3),
            "shared_margin": (None, 1, 0, 0, 1, 2),
            "rescue_threshold": ((0.0, 1.0), 0.6, 0.8, 0.8, 0.5, 0.3),
            "yield_bias": ((0.0, 1.0), 0.3, 0.5, 0.5, 0.4, 0.2),
            "behavior_mode": (None, NORMAL, NORMAL, NORMAL, NORMAL, NORMAL),
            "action_probability": (None, 1.0, 1.0, 1.0, 1.0, 1.0),
        },
    ),
    train=Sampling(
        ("default", "flexible"),
        {"split_mode": [0, 1], "strictness": (0.0, 0.3), "shared_margin": [1, 2, 3], "rescue_threshold": (0.2, 0.4)},
    ),
    test=Sampling(
        ("flexible", "object_stations"),
        {"split_mode": [1, 2], "strictness": (0.0, 0.3), "shared_margin": [1, 2, 3], "rescue_threshold": (0.2, 0.4)},
    ),
    diverse=Sampling(
        ("default",),
        {
            "split_mode": [VERTICAL, HORIZONTAL, STATIONS],
            "strictness": (0.0, 1.0),
            "shared_margin": [0, 1, 2, 3],
            "rescue_threshold": (0.0, 1.0),
            "yield_bias": (0.0, 1.0),
            "behavior_mode": [NORMAL, BLOCKER, HOARDER, LAZY, COUNTER, INVADER],
            "action_probability": [1.0, 1.0, 0.75, 0.5, 0.25],
        },
    ),
    choices={"split_mode": 3, "behavior_mode": 6},
    unbounded=frozenset({"shared_margin"}),
)
"""Heuristic family H2, with parameters in the order of the published manifests."""
