"""The scripted oracle as the teammate. Shapes: `S` bytes of a state record."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key, UInt8

from icrl4aht_data.overcooked.actions import STAY
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.state import swapped
from icrl4aht_data.utils.forks import cached_property
from icrl4aht_generation.experts.oracle import OracleMemory, oracle
from icrl4aht_generation.policy import Policy


class _ExchangedAgents(Layout):
    """A layout whose agents are exchanged: the ego starts where the teammate does."""

    @cached_property
    def agent_cells(self) -> tuple[int, ...]:
        return super().agent_cells[::-1]


def oracle_teammate(layout: Layout) -> Policy:
    """Returns the oracle as agent 1, a policy that sees the state record, uint8 (S,).

    It does all of the work that its room allows, and leaves it to an ego that cooks and delivers. Its one parameter,
    float32 (), is the chance that it idles in a step.
    """
    exchanged = _ExchangedAgents(layout.name, layout.alias, layout.rows, layout.recipes, layout.indicates_delivery)
    script = oracle(exchanged)

    def act(idle: Any, memory: OracleMemory, record: UInt8[Array, " S"], key: Key[Array, ""]):
        action, memory = script.act((), memory, swapped(record), key)
        action = jnp.where(jax.random.bernoulli(key, idle), STAY, action).astype(jnp.int32)
        return action, memory._replace(action=action)

    return Policy(jnp.float32(0), lambda idle, key: script.init((), key), act, script.sees)
