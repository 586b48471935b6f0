"""H2 `territory`: prefers targets in its part of the kitchen; five of its modes do not cooperate (paper, App. B.2,
table H2)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from generation.policy import Noise, Policy, Sampling, as_params, draw, first_key
from generation.teammates.heuristics.paths import Paths, Rule, Scene
from icrl4aht_data.overcooked.actions import DOWN, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.layouts import GOAL, PILE, PLATES, POT, Layout

KIND = "territory"

VERTICAL, HORIZONTAL, STATIONS = range(3)
NORMAL, BLOCKER, HOARDER, LAZY, COUNTER, INVADER = range(6)

DEFAULTS: dict[str, float] = {
    "split_mode": VERTICAL,
    "strictness": 0.7,
    "shared_margin": 1,
    "rescue_threshold": 0.6,
    "yield_bias": 0.3,
    "behavior_mode": NORMAL,
    "action_probability": 1.0,
}
"""Parameter -> default, in declaration order."""

PRESETS: dict[str, dict[str, float]] = {
    "default": {},
    "strict_vertical": {"strictness": 1.0, "shared_margin": 0, "rescue_threshold": 0.8, "yield_bias": 0.5},
    "strict_horizontal": {
        "split_mode": HORIZONTAL,
        "strictness": 1.0,
        "shared_margin": 0,
        "rescue_threshold": 0.8,
        "yield_bias": 0.5,
    },
    "object_stations": {"split_mode": STATIONS, "strictness": 0.8, "rescue_threshold": 0.5, "yield_bias": 0.4},
    "flexible": {"strictness": 0.3, "shared_margin": 2, "rescue_threshold": 0.3, "yield_bias": 0.2},
}
"""Preset -> what differs from the defaults."""

CHOICES: dict[str, int] = {"split_mode": 3, "behavior_mode": 6}
"""Parameters that are one of 0..n-1."""

UNBOUNDED = frozenset({"shared_margin"})
"""Parameters without an upper limit; the others are in 0..1, or one of `CHOICES`."""

TRAIN = Sampling(
    ("default", "flexible"),
    {"split_mode": [0, 1], "strictness": (0.0, 0.3), "shared_margin": [1, 2, 3], "rescue_threshold": (0.2, 0.4)},
)
TEST = Sampling(
    ("flexible", "object_stations"),
    {"split_mode": [1, 2], "strictness": (0.0, 0.3), "shared_margin": [1, 2, 3], "rescue_threshold": (0.2, 0.4)},
)
SPANS: dict[str, tuple[float, float]] = {
    "strictness": (0.0, 1.0),
    "rescue_threshold": (0.0, 1.0),
    "yield_bias": (0.0, 1.0),
}
"""Full ranges of the parameters that a sampler jitters around a preset."""

_STUCK = 3
_NOWHERE = -1


class Memory(NamedTuple):
    key: Key[Array, ""]
    cell: Int[Array, ""]  # where it stood at the last step, -1 before the first
    stuck: Int[Array, ""]  # steps since it last moved


class Areas(NamedTuple):
    """My territory, and the wider one that I share."""

    strict: Bool[Array, " cells"]
    relaxed: Bool[Array, " cells"]


def build(layout: Layout, theta: dict[str, float], slot: int = 1, noise: Noise = "seeded") -> Policy:
    """An H2 teammate.

    Args:
        layout: the kitchen.
        theta: every parameter of `DEFAULTS`.
        slot: 0 or 1, the agent it plays.
        noise: see `base.Noise`.
    """
    paths = Paths(layout)

    def init(params, key: Key[Array, ""]) -> Memory:
        return Memory(first_key(noise, slot, key), jnp.int32(_NOWHERE), jnp.int32(0))

    def act(params, memory: Memory, record: UInt8[Array, " S"], key: Key[Array, ""]):
        scene = Scene(paths, record, slot)
        link, u = draw(memory.key)
        mode = params["behavior_mode"]
        action = _work(scene, params, u[0], memory.stuck >= _STUCK)
        blocked = jnp.where(u[0] < 0.7, STAY, _to_the_middle(scene))
        action = jnp.where(mode == BLOCKER, blocked, action)
        action = jnp.where((mode == LAZY) & (u[0] > params["action_probability"]), STAY, action)
        stuck = jnp.where(scene.me == memory.cell, memory.stuck + 1, 0)
        return action.astype(jnp.int32), Memory(link, scene.me, stuck)

    return Policy(as_params(theta, DEFAULTS), init, act, "state")


def _to_the_middle(scene: Scene) -> Int[Array, ""]:
    """Across first, then along the middle column; stay where a wall bars the way."""
    layout = scene.paths.layout
    y, x = np.divmod(np.arange(layout.cells), layout.width)
    across = np.where(x < layout.width // 2, RIGHT, LEFT)
    along = np.where(y < layout.height // 2, DOWN, np.where(y > layout.height // 2, UP, STAY))
    action = np.where(x == layout.width // 2, along, across)
    barred = layout.moves[np.arange(layout.cells), action] == np.arange(layout.cells)
    return jnp.asarray(np.where(barred, STAY, action))[scene.me]


def _work(scene: Scene, params, u: Float[Array, ""], stuck: Bool[Array, ""]) -> Int[Array, ""]:
    """The action of every mode that does work."""
    empty, plate, dish, ingredient = scene.holds_nothing, scene.holds_plate, scene.holds_dish, scene.holds_ingredient
    hoards, counters = params["behavior_mode"] == HOARDER, params["behavior_mode"] == COUNTER
    soup, cooking, room = (jnp.any(mask) for mask in (scene.cooked, scene.cooking, scene.nonfull))
    keeps_dish = dish & (hoards | counters)
    spoils = [
        Rule(keeps_dish | (ingredient & hoards & (u < 0.8)), scene.empty_counters),
        Rule(empty & counters & soup, scene.needed_piles),
    ]
    goals, nonfull, put_down, cooked, heating, plates, staged, needed = _filter(
        scene,
        params,
        [
            (scene.goals, True),
            (scene.nonfull, True),
            (scene.empty_counters, True),
            (scene.cooked, False),
            (scene.cooking, False),
            (scene.plate_piles, False),
            (scene.staged, False),
            (scene.needed_piles, True),
        ],
    )
    fetches = empty & (room | ~cooking)
    chosen = scene.first(
        [
            *spoils,
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
    spoiling = chosen.found & (chosen.number < len(spoils))
    wanders = ~chosen.found | (stuck & ~spoiling) | (plate & hoards & (u < 0.7))
    worked = scene.go_to(chosen.target, chosen.waits, _step(scene, params, chosen.target))
    action = jnp.where(wanders, scene.wander(stay_score=150), worked)
    return jnp.where(keeps_dish & ~spoiling, STAY, action)


def _step(scene: Scene, params, target: Int[Array, ""]) -> Int[Array, ""]:
    """The step towards a target: seat 1 waits for a partner at the target's only access, and both walk around."""
    # A stored 0.1 or 0.3 is the float32 just above, which the published code takes for more than 0.1 or 0.3.
    step, cost = scene.approach(target)
    goes_around = scene.destination(step) == scene.partner
    if scene.slot == 0:
        goes_around &= params["yield_bias"] >= np.float32(0.3)
    step = jnp.where(goes_around, scene.sidestep(STAY), step)
    if scene.slot == 0:
        return step
    access = jnp.asarray(scene.paths.only_access)[target]
    near = jnp.asarray(scene.paths.distance)[scene.partner, access] <= 1
    waits = (access >= 0) & near & (cost <= 2) & (params["yield_bias"] >= np.float32(0.1))
    return jnp.where(waits, STAY, step)


def _filter(scene: Scene, params, masks: list[tuple[Array, bool]]) -> Bool[Array, "masks cells"]:
    """Of each mask the cells that I can reach and that lie in my territory; if none does, in the shared one; if none
    does, all that I can reach where the mask has its fallback."""
    urgency = jnp.minimum(jnp.sum(scene.cooked) / 2, 1)
    anywhere = (urgency > params["rescue_threshold"]) | (params["strictness"] <= 0.5)
    mine = areas(scene, params)
    reach = scene.reach(jnp.stack([mask for mask, _ in masks]))
    strict, relaxed = reach & mine.strict, reach & mine.relaxed
    fallback = jnp.asarray(np.array([[fallback] for _, fallback in masks]))
    found = jnp.where(
        jnp.any(strict, axis=1, keepdims=True),
        strict,
        jnp.where(jnp.any(relaxed, axis=1, keepdims=True), relaxed, reach & fallback),
    )
    return jnp.where(anywhere, reach, found)


def areas(scene: Scene, params) -> Areas:
    """The areas of my seat, or of the partner's if I invade."""
    beyond, stations = _borders(scene.paths)
    kind = jnp.where((params["split_mode"] == STATIONS) & (not stations), VERTICAL, params["split_mode"])
    beyond = jnp.asarray(beyond)[kind]
    margin = params["shared_margin"] * jnp.where(kind == STATIONS, jnp.float32(1.5), jnp.float32(1))
    second = (scene.slot == 1) ^ (params["behavior_mode"] == INVADER)
    strict = jnp.where(second, beyond >= 0, beyond < 0)
    near = beyond + margin
    shared = jnp.where(kind == STATIONS, near > 0, near >= 0)
    return Areas(strict, jnp.where(second, shared, beyond < margin))


def _borders(paths: Paths) -> tuple[np.ndarray, bool]:
    """float32 (3, cells): how far each cell lies on seat 1's side, by split mode; and whether the split into stations
    gives both seats some floor."""
    layout = paths.layout
    y, x = np.divmod(np.arange(layout.cells), layout.width)

    def distance_to(*kinds: int) -> np.ndarray:
        of = np.isin(layout.kinds, kinds)
        return np.abs(x - x[of].mean()) + np.abs(y - y[of].mean())

    stations = distance_to(POT, PILE) - distance_to(GOAL, PLATES)
    floor = stations[layout.walkable]
    table = np.stack([x - layout.width // 2, y - layout.height // 2, stations]).astype(np.float32)
    return table, bool((floor < 0).any() and (floor >= 0).any())
