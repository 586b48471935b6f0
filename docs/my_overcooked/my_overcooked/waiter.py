"""`waiter`: takes a plate to a pot, waits for the soup and delivers it; never cooks."""

import jax.numpy as jnp
from icrl4aht_generation.paths import Rule, Scene
from icrl4aht_generation.teammates.heuristics.heuristic import Heuristic, Sampling, draw

from icrl4aht_data.overcooked.actions import STAY


def begin_waiter(key):
    """Memory at the start of an episode: the first key of its noise."""
    return key


def act_waiter(params, memory, scene: Scene):
    """One step: action and memory."""
    memory, u = draw(memory)
    chosen = scene.first(
        [
            Rule(scene.holds_dish, scene.goals),
            Rule(scene.holds_plate, scene.cooked),
            Rule(scene.holds_plate, scene.pots, waits=True),
            Rule(scene.holds_nothing, scene.plate_piles),
        ]
    )
    action = jnp.where(chosen.found, scene.go_to(chosen.target, chosen.waits), scene.wander())
    return jnp.where(u[0] < params["idle"], STAY, action), memory


WAITER = Heuristic(
    kind="waiter",
    begin=begin_waiter,
    act=act_waiter,
    defaults={"idle": 0.1},  # parameter -> default: the chance to do nothing in a step
    presets={"default": {}, "lazy": {"idle": 0.5}},  # preset -> what differs
    train=Sampling(("default",), {"idle": (0.0, 0.3)}),  # what a split's parameters are drawn from
    test=Sampling(("default",), {"idle": (0.0, 0.3)}),
    spans={"idle": (0.0, 1.0)},  # full ranges, for drawn parameters
)
