"""The policy type that egos and teammates share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, UInt8

from icrl4aht_data.format.provenance import LabelView
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.tables import Tables

Noise = Literal["fixed", "seeded"]
"""Source of a heuristic teammate's randomness: "fixed", the published PRNGKey(slot) in every episode, for results that
compare with the paper's; or "seeded", a new key in every episode."""


class Situation(NamedTuple):
    """Complete view of one environment, which scripted agents see.

    Attributes:
        tables: tables of the environment's layout.
        record: uint8 (S,), state record of the environment.
        layout: int32 (), index of the layout among all layouts of the environments.
    """

    tables: Tables
    record: UInt8[Array, " S"]
    layout: Int[Array, ""] | int = 0


class Policy(NamedTuple):
    """A policy for one agent of one environment, as pure functions without a batch axis; rollouts vmap them.

    Attributes:
        params: pytree of arrays that the functions take as an argument, so that policies which differ only in their
            parameters share one compilation.
        init: (params, key) -> memory, any pytree, at the start of an episode; for egos in evaluation, at the start
            of a task.
        act: (params, memory, view, key) -> action, int32 () in 0..5, and the memory after the step.
        sees: content of `view`: "state" for the state record, uint8 (S,); "situation" for a `Situation`, so one
            policy can play every layout; "observation" for uint8 (5, 5, C);
            "ego_input", only for egos in evaluation, for the observation with the outcome of the previous step
            (`icrl4aht_baselines.agents.EgoInput`), and "canonical_input" for this input with canonical channels.
    """

    params: Any
    init: Callable[[Any, Key[Array, ""]], Any]
    act: Callable[[Any, Any, Any, Key[Array, ""]], tuple[Int[Array, ""], Any]]
    sees: Literal["state", "situation", "observation", "ego_input", "canonical_input"]

    @property
    def label_view(self) -> LabelView:
        """Input of this policy when it labels histories: "state" for full states, "ego" for an ego's observations."""
        return "state" if self.sees in ("state", "situation") else "ego"


@lru_cache(maxsize=256)
def _act_on_layout(act: Callable[..., Any], layout: Layout) -> Callable[..., Any]:
    def on_layout(params: Any, memory: Any, record: UInt8[Array, " S"], key: Key[Array, ""]) -> Any:
        return act(params, memory, Situation(layout.tables, record), key)

    return on_layout


def on_layout(policy: Policy, layout: Layout) -> Policy:
    """Convert a policy that sees a `Situation` into a policy that sees state records of one layout.

    Two policies with equal functions also share compilations after the conversion.
    """
    return policy._replace(act=_act_on_layout(policy.act, layout), sees="state")


def randomize_action(key: Key[Array, ""], chance: Any, action: Int[Array, ""]) -> Int[Array, ""]:
    """Return the given action, or with probability `chance` one of the six actions at random."""
    whether, which = jax.random.split(key)
    drawn = jax.random.randint(which, (), 0, len(ACTIONS))
    return jnp.where(jax.random.uniform(whether) < chance, drawn, action)


def stacked(trees: Iterable[Any]) -> Any:
    """Return one pytree with the leaves of all trees stacked on a new first axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
