"""Conversion of states to and from JaxMARL's OvercookedV2, the reference implementation of the rules."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxmarl.environments.overcooked_v2.common import Agent, Position
from jaxmarl.environments.overcooked_v2.overcooked import OvercookedV2
from jaxmarl.environments.overcooked_v2.overcooked import State as JaxmarlState

from icrl4aht_data.overcooked.actions import ACTIONS, PUBLISHED_ACTIONS
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import unpack
from tests.helpers.xla_flags import optimized

TO_JAXMARL_ACTION = np.array([PUBLISHED_ACTIONS.index(name) for name in ACTIONS])


def to_jaxmarl_item(layout: Layout, item: np.ndarray) -> np.ndarray:
    """Convert our item bytes to JaxMARL's item codes, which have two bits for every ingredient of the game."""
    item = item.astype(np.int32)
    code = item & 3
    for k, ingredient in enumerate(layout.ingredients):
        code |= (item >> (2 + 2 * k) & 3) << (2 + 2 * ingredient)
    return code


def to_our_item(layout: Layout, code: np.ndarray) -> np.ndarray:
    """Convert JaxMARL's item codes to our item bytes."""
    item = code & 3
    for k, ingredient in enumerate(layout.ingredients):
        item |= (code >> (2 + 2 * ingredient) & 3) << (2 + 2 * k)
    return item.astype(np.uint8)


def to_jaxmarl_state(layout: Layout, env: OvercookedV2, records: np.ndarray) -> JaxmarlState:
    """Convert state records, uint8 of shape (B, S), to JaxMARL's batched state."""
    ours = unpack(layout, records)
    batch, shape = len(records), (layout.height, layout.width)
    grid = np.zeros((batch, layout.cells, 3), np.int32)
    grid[..., 0] = np.asarray(env.layout.static_objects).reshape(-1)
    grid[:, list(layout.pots), 1] = to_jaxmarl_item(layout, ours.pot_items)
    grid[:, list(layout.pots), 2] = ours.pot_timers
    grid[:, list(layout.buttons), 2] = ours.buttons
    grid[:, list(layout.counters), 1] = to_jaxmarl_item(layout, ours.counters)
    positions = ours.positions.astype(np.int32)
    return JaxmarlState(
        agents=Agent(
            pos=Position(x=jnp.asarray(positions % layout.width), y=jnp.asarray(positions // layout.width)),
            dir=jnp.asarray(ours.facings.astype(np.int32)),
            inventory=jnp.asarray(to_jaxmarl_item(layout, ours.hands)),
        ),
        grid=jnp.asarray(grid.reshape(batch, *shape, 3)),
        step=jnp.zeros(batch, jnp.int32),
        done=jnp.zeros(batch, bool),
        recipe=jnp.asarray(to_jaxmarl_item(layout, ours.recipe)),
        new_correct_delivery=jnp.asarray(ours.delivered > 0),
    )


def from_jaxmarl_state(layout: Layout, state: JaxmarlState) -> np.ndarray:
    """Convert JaxMARL's batched state to records, uint8 of shape (B, S), without this package's function `pack`."""
    position = np.asarray(state.agents.pos.y) * layout.width + np.asarray(state.agents.pos.x)
    grid = np.asarray(state.grid).reshape(len(position), layout.cells, 3)
    columns = [
        position,
        state.agents.dir,
        to_our_item(layout, np.asarray(state.agents.inventory)),
        to_our_item(layout, np.asarray(state.recipe))[:, None],
        np.asarray(state.new_correct_delivery)[:, None],
        to_our_item(layout, grid[:, list(layout.pots), 1]),
        grid[:, list(layout.pots), 2],
        grid[:, list(layout.buttons), 2],
        to_our_item(layout, grid[:, list(layout.counters), 1]),
    ]
    return np.concatenate([np.asarray(column) for column in columns], axis=1).astype(np.uint8)


def jaxmarl_step(env: OvercookedV2):
    """Return JaxMARL's step function, jitted and batched.

    The function takes keys, states, and actions of shape (B, 2), which are JaxMARL's ids.
    """

    def single_step(key, state, actions):
        obs, state, reward, _, info = env.step_env(key, state, {"agent_0": actions[0], "agent_1": actions[1]})
        shaped = info["shaped_reward"]
        both = jnp.stack([obs["agent_0"], obs["agent_1"]])
        return both, state, reward["agent_0"], jnp.stack([shaped["agent_0"], shaped["agent_1"]])

    return optimized(jax.jit(jax.vmap(single_step)))
