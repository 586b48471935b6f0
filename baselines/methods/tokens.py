"""Histories as tokens, in training and when acting alike (paper, App. E.2 and E.3).

A `Step` is what an ego knows when it acts; AD's tokens are made of steps. A `Transition` is a step with its outcome;
DPT's context is made of transitions. `*B` denotes any leading axes: batch and time in training, none when acting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from baselines.methods.encoder import FEATURES
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.sampling.ad import ADBatch
from icrl4aht_data.sampling.dpt import DPTBatch

View = Callable[[Array, Array | None], Array]
"""(what a batch holds of each step, its `layouts`) -> observations."""


class Step(NamedTuple):
    """Before an action. What precedes a history's first step is all zero (paper, App. E.2)."""

    obs: Num[Array, "*B ..."]
    prev_action: Int[Array, "*B"]
    prev_reward: Float[Array, "*B"]  # the team's, raw
    prev_teammate_action: Int[Array, "*B"] | None


class Transition(NamedTuple):
    """An action and its outcome, all within one episode."""

    obs: Num[Array, "*B ..."]
    action: Int[Array, "*B"]
    reward: Float[Array, "*B"]  # the team's, raw
    next_obs: Num[Array, "*B ..."]
    teammate_action: Int[Array, "*B"] | None


def plain_view(obs: Array, layouts: Array | None) -> Array:
    """The view of batches that hold observations."""
    return obs


def state_view(layouts: Sequence[Layout]) -> View:
    """The view of batches that hold state records uint8 (B, .., S): the ego's observations uint8 (B, .., 5, 5, C).

    Args:
        layouts: those that a batch's `layouts` (B,) points into; all with observations of one shape.
    """

    def view(records: Array, which: Array | None) -> Array:
        seen = [observe(layout, records[..., : record_size(layout)], EGO) for layout in layouts]
        if which is None:
            return seen[0]
        chosen = seen[0]
        for number, other in enumerate(seen[1:], start=1):
            rows = (which == number).reshape(-1, *[1] * (other.ndim - 1))
            chosen = jnp.where(rows, other, chosen)
        return chosen

    return view


def steps_of(batch: ADBatch, view: View) -> Step:
    """The steps (B, L) of an AD batch."""
    obs = view(batch.obs, batch.layouts)  # type: ignore[arg-type]
    return Step(obs, batch.prev_actions, batch.prev_rewards, batch.prev_teammate_actions)  # type: ignore[arg-type]


def step_of(percept: Any) -> Step:
    """The step of an `agents.Percept`."""
    return Step(percept.obs, percept.prev_action, percept.prev_reward, percept.prev_teammate_action)


def transitions_of(batch: DPTBatch, view: View) -> tuple[Transition, Array]:
    """The context's transitions (B, K) and the query's observations (B,) of a DPT batch."""
    obs, following, query = (
        view(part, batch.layouts)  # type: ignore[arg-type]
        for part in (batch.context_obs, batch.context_next_obs, batch.query_obs)
    )
    mate: Any = batch.context_teammate_actions
    return Transition(obs, batch.context_actions, batch.context_rewards, following, mate), query  # type: ignore[arg-type]


class Tokens(nn.Module):
    """What makes tokens has.

    Args:
        encoder: of observations.
        width: of a token.
        actions: how many there are.
        teammate_actions: +TA.
        dropout: rate, in training.
        dtype: of the tokens.
    """

    encoder: nn.Module
    width: int = 256
    actions: int = len(ACTIONS)
    teammate_actions: bool = False
    dropout: float = 0.1
    dtype: Any = jnp.float32


class StepTokens(Tokens):
    """Steps -> tokens: [Emb(a'); Emb(teammate's a') with +TA; r'; Enc(o)], projected (paper, App. E.2)."""

    @nn.compact
    def __call__(self, step: Step, deterministic: bool = True) -> Float[Array, "*B D"]:
        parts = [nn.Embed(self.actions, FEATURES, name="action")(step.prev_action)]
        if self.teammate_actions:
            parts.append(nn.Embed(self.actions, FEATURES, name="teammate_action")(step.prev_teammate_action))
        parts += [step.prev_reward[..., None], self.encoder(step.obs)]
        token = nn.Dense(self.width, name="project")(jnp.concatenate(parts, -1, dtype=self.dtype))
        return nn.Dropout(self.dropout)(token, deterministic=deterministic)


class TransitionTokens(Tokens):
    """Transitions -> tokens: [Enc(o); OneHot(a); OneHot(teammate's a) with +TA; Enc(o'); r], projected; a query is
    [Enc(o); zeros] through the same projection (paper, App. E.3)."""

    def setup(self) -> None:
        self.project, self.drop = nn.Dense(self.width), nn.Dropout(self.dropout)

    def context(self, transition: Transition, deterministic: bool = True) -> Float[Array, "*B D"]:
        """Tokens of transitions."""
        seen = self.encoder(jnp.stack([transition.obs, transition.next_obs]))
        parts = [seen[0], jax.nn.one_hot(transition.action, self.actions)]
        if self.teammate_actions:
            parts.append(jax.nn.one_hot(transition.teammate_action, self.actions))
        return self._token([*parts, seen[1], transition.reward[..., None]], deterministic)

    def query(self, obs: Num[Array, "*B ..."], deterministic: bool = True) -> Float[Array, "*B D"]:
        """Tokens of observations whose action is asked for."""
        seen = self.encoder(obs)
        rest = self.actions * (1 + self.teammate_actions) + seen.shape[-1] + 1
        return self._token([seen, jnp.zeros((*seen.shape[:-1], rest))], deterministic)

    def _token(self, parts: list[Array], deterministic: bool) -> Array:
        return self.drop(self.project(jnp.concatenate(parts, -1, dtype=self.dtype)), deterministic=deterministic)


class RingBuffer(NamedTuple):
    """What an ego remembers when it acts, as a ring: entry i stands in slot i % slots."""

    tokens: Float[Array, "slots D"]
    written: Int[Array, ""]  # entries so far

    def add(self, token: Float[Array, " D"]) -> RingBuffer:
        """With one more entry, in place of the oldest."""
        return RingBuffer(self.tokens.at[self.written % len(self.tokens)].set(token), self.written + 1)

    def last(self, context: int, stop: Int[Array, ""]) -> tuple[Float[Array, "K D"], Int[Array, ""]]:
        """The entries stop - K .. stop - 1 in order, from the front, and how many there are."""
        first = jnp.maximum(stop - context, 0)
        return self.tokens[(first + jnp.arange(context)) % len(self.tokens)], stop - first


def empty_log(slots: int, width: int) -> RingBuffer:
    """A log without entries."""
    return RingBuffer(jnp.zeros((slots, width)), jnp.int32(0))


def visible_slots(slots: int, written: Int[Array, ""], context: int, stop: Int[Array, ""]) -> Bool[Array, " slots"]:
    """The slots of a ring of `written` entries that hold the entries stop - K .. stop - 1."""
    entry = written - 1 - (written - 1 - jnp.arange(slots)) % slots
    return (entry >= jnp.maximum(stop - context, 0)) & (entry < stop)
