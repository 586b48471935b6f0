"""H3 `assembly_line`: runs ingredients, or plates and delivers, with slips of many kinds (paper, App. B.2, tab. H3)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key, UInt8

from generation.policy import Noise, Policy, Sampling, as_params, draw, extra_split, first_key
from generation.teammates.heuristics.paths import Paths, Rule, Scene, is_ingredient
from icrl4aht_data.overcooked.actions import DOWN, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.layouts import Layout

KIND = "assembly_line"

RUNNER, PLATER, FLEX = range(3)
AT_POTS, CENTRAL, NEAR_PARTNER = range(3)

DEFAULTS: dict[str, float] = {
    "role_mode": FLEX,
    "handoff_style": AT_POTS,
    "plate_urgency": 0.5,
    "prestage_bias": 0.3,  # without effect: read by no rule
    "start_cook_bias": 0.7,  # without effect: pots start by themselves
    "hesitation_prob": 0.0,
    "wrong_action_prob": 0.0,
    "task_abandon_prob": 0.0,
    "stubbornness": 0.0,
    "timing_mismatch": 0.0,
}
"""Parameter -> default, in declaration order."""

PRESETS: dict[str, dict[str, float]] = {
    "default": {},
    "ingredient_runner": {
        "role_mode": RUNNER,
        "plate_urgency": 0.0,
        "prestage_bias": 0.5,
        "start_cook_bias": 0.8,
    },
    "plater_deliverer": {
        "role_mode": PLATER,
        "plate_urgency": 0.8,
        "prestage_bias": 0.0,
        "start_cook_bias": 0.3,
    },
}
"""Preset -> what differs from the defaults."""

CHOICES: dict[str, int] = {"role_mode": 3, "handoff_style": 3}
"""Parameters that are one of 0..n-1."""

UNBOUNDED = frozenset[str]()
"""Parameters without an upper limit; the others are in 0..1, or one of `CHOICES`."""

TRAIN = Sampling(
    ("default", "ingredient_runner"),
    {"role_mode": [0, 2], "plate_urgency": (0.0, 0.6), "prestage_bias": (0.2, 0.6)},
)
TEST = Sampling(
    ("plater_deliverer",),
    {"role_mode": [1], "plate_urgency": (0.6, 1.0), "prestage_bias": (0.0, 0.3)},
)
SPANS: dict[str, tuple[float, float]] = {
    "plate_urgency": (0.0, 1.0),
    "prestage_bias": (0.0, 1.0),
    "start_cook_bias": (0.0, 1.0),
}
"""Full ranges of the parameters that a sampler jitters around a preset."""

_MOVES_BY_DRAW = (RIGHT, DOWN, LEFT, UP)


class Memory(NamedTuple):
    key: Key[Array, ""]


def build(layout: Layout, theta: dict[str, float], slot: int = 1, noise: Noise = "seeded") -> Policy:
    """An H3 teammate.

    Args:
        layout: the kitchen.
        theta: every parameter of `DEFAULTS`.
        slot: 0 or 1, the agent it plays.
        noise: see `base.Noise`.
    """
    paths = Paths(layout)

    def init(params, key: Key[Array, ""]) -> Memory:
        return Memory(first_key(noise, slot, key))

    def act(params, memory: Memory, record: UInt8[Array, " S"], key: Key[Array, ""]):
        scene = Scene(paths, record, slot)
        link, u = draw(memory.key)
        idles = (u[0] < params["hesitation_prob"]) | (u[3] < params["timing_mismatch"] * _off_beat(scene))
        makes_room = _makes_room(scene)
        final, action = _decide(scene, params, abandons=u[2] < params["task_abandon_prob"])
        slips = ~(idles | makes_room | final)
        action, link = _slip(scene, params, action, slips, u[1], link)
        action = jnp.where(makes_room, _aside(scene), action)
        return jnp.where(idles, STAY, action).astype(jnp.int32), Memory(link)

    return Policy(as_params(theta, DEFAULTS), init, act, "state")


def _off_beat(scene: Scene) -> Array:
    """float32: how badly timed a step from my cell is, 0 to 0.9."""
    y, x = np.divmod(np.arange(scene.paths.layout.cells), scene.paths.layout.width)
    return jnp.asarray(((7 * x + 13 * y) % 10 / 10).astype(np.float32))[scene.me]


def _decide(scene: Scene, params, abandons: Bool[Array, ""]) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """The action, and whether it is one that no slip changes."""
    empty, plate, ingredient = scene.holds_nothing, scene.holds_plate, scene.holds_ingredient
    soup, cooking = jnp.any(scene.cooked), jnp.any(scene.cooking)
    final = scene.holds_dish | (ingredient & soup)
    ingredient &= ~soup
    plates_now = soup | (cooking & (params["plate_urgency"] > 0.5))
    plater = (params["role_mode"] == PLATER) | ((params["role_mode"] == FLEX) & plates_now)
    runner = ~plater
    chosen = scene.first(
        [
            Rule(scene.holds_dish, scene.goals),
            Rule(scene.holds_ingredient & soup, scene.empty_counters),
            Rule((plate | ingredient) & abandons, scene.empty_counters),
            Rule((runner & plate) | (plater & ingredient), scene.empty_counters),
            Rule(runner & ingredient, scene.nonfull),
            Rule(runner & ingredient, _handoff_counters(scene, params)),
            Rule(runner & empty, _needed_piles(scene)),
            Rule(plater & plate, scene.cooked),
            Rule(plater & empty, scene.plate_piles),
            Rule(plater & (plate | empty), scene.pots_in_use, waits=True),
            Rule((runner & empty) | (plater & plate), scene.pots, waits=True),
            Rule(empty | (plater & plate), scene.buttons, waits=True),
            Rule(empty, scene.indicators, waits=True),
        ]
    )
    action = scene.go_to(chosen.target, chosen.waits, _step(scene, chosen.target))
    return final, jnp.where(chosen.found, action, scene.wander())


def _step(scene: Scene, target: Int[Array, ""]) -> Int[Array, ""]:
    """The step towards a target; seat 1 stays if it leads onto the partner or beside it."""
    step, _ = scene.approach(target)
    if scene.slot == 0:
        return step
    distance = jnp.asarray(scene.paths.distance)[scene.partner, scene.destination(step)]
    return jnp.where((step < STAY) & (distance <= 1), STAY, step)


def _needed_piles(scene: Scene) -> Bool[Array, " cells"]:
    """The piles of what the recipe lacks over all pots, an ingredient in the partner's hand counting as in the pot."""
    brought = scene.counts(scene.partner_hand) * is_ingredient(scene.partner_hand)
    return scene.piles_of(scene.needed - brought > 0)


def _handoff_counters(scene: Scene, params) -> Bool[Array, " cells"]:
    """Empty counters where an ingredient may wait, by style; every empty one if the style finds none."""
    layout = scene.paths.layout
    y, x = np.divmod(np.arange(layout.cells), layout.width)
    middle_x, middle_y = int(x[layout.walkable].mean()), int(y[layout.walkable].mean())
    central = np.abs(x - middle_x) + np.abs(y - middle_y) <= 3
    near_partner = jnp.asarray(scene.paths.manhattan)[scene.partner] <= 2
    free = scene.empty_counters
    at_pots = free & scene.paths.near_pot
    near_partner = _or_else(free & near_partner, at_pots)
    style = params["handoff_style"]
    preferred = jnp.where(style == AT_POTS, at_pots, jnp.where(style == CENTRAL, free & central, near_partner))
    return _or_else(preferred, free)


def _or_else(mask: Bool[Array, " cells"], other: Bool[Array, " cells"]) -> Bool[Array, " cells"]:
    return jnp.where(jnp.any(mask), mask, other)


def _makes_room(scene: Scene) -> Bool[Array, ""]:
    """Whether seat 1, empty-handed, stands beside a partner who carries something."""
    if scene.slot == 0:
        return jnp.asarray(False)
    beside = jnp.asarray(scene.paths.manhattan)[scene.me, scene.partner] == 1
    return scene.holds_nothing & (scene.partner_hand > 0) & beside


def _aside(scene: Scene) -> Int[Array, ""]:
    """Straight away from the partner beside me; else to a side, right before left, down before up; else stay."""
    from_partner = jnp.asarray(scene.paths.neighbours)[scene.me] == scene.partner  # above, below, left, right
    across = from_partner[2] | from_partner[3]
    # Scores of right, down, left, up.
    beside_row = jnp.array([2, 0, 1, 0])
    beside_column = jnp.array([0, 2, 0, 1])
    away = 3 * from_partner[jnp.array([2, 0, 3, 1])]
    score = away + jnp.where(across, beside_column, beside_row)
    return scene.best_way(scene.free & (score > 0), score)


def _slip(scene: Scene, params, action: Int[Array, ""], slips: Bool[Array, ""], u: Array, link: Key[Array, ""]):
    """The action after a wrong move or a walk home, and the key chain's link after what these drew."""
    errs = slips & (u < params["wrong_action_prob"])
    link, own = extra_split(link, errs)
    wrong = jax.random.bits(jax.random.split(own)[1]) & 3
    action = jnp.where(errs, jnp.asarray(_MOVES_BY_DRAW)[wrong.astype(jnp.int32)], action)

    longs = slips & scene.holds_nothing & (params["stubbornness"] > 0)
    link, own = extra_split(link, longs)
    layout = scene.paths.layout
    home = (3 * scene.slot % layout.height) * layout.width + 5 * scene.slot % layout.width
    far = jnp.asarray(scene.paths.manhattan)[scene.me, home] > 2
    goes = longs & far & (jax.random.uniform(own) < params["stubbornness"]) & bool(layout.walkable[home])
    return jnp.where(goes, jnp.asarray(scene.paths.first_step)[scene.me, home], action), link
