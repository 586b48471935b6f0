"""Histories as tokens, for training and acting alike (paper, App. E.2 and E.3).

AD's tokens are made of `StepInput`s, DPT's context of `Transition`s. Shapes: `*B` any leading axes (batch and time in
training, none when acting), `D` width of a token, `K` length of a context, `S` slots of a ring buffer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Num

from baselines.methods.encoder import FEATURES
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.sampling.ad import ADBatch
from icrl4aht_data.sampling.dpt import DPTBatch

BatchView = Callable[[Array, Array | None], Array]
"""Function (stored observations or state records of a batch, `layouts` of the batch or None) -> observations."""


class StepInput(NamedTuple):
    """Input of an ego before an action. Before a history's first step all `prev_*` fields are zero (paper, App. E.2).

    Attributes:
        obs: (*B, ..), the ego's observation, uint8 or float.
        prev_action: int32 (*B,), the ego's action in the previous step.
        prev_reward: float32 (*B,), the team's reward in the previous step, unscaled.
        prev_teammate_action: int32 (*B,), the teammate's action in the previous step; None without +TA.
    """

    obs: Num[Array, "*B ..."]
    prev_action: Int[Array, "*B"]
    prev_reward: Float[Array, "*B"]
    prev_teammate_action: Int[Array, "*B"] | None


class Transition(NamedTuple):
    """An action and its outcome, within one episode.

    Attributes:
        obs: (*B, ..), the ego's observation before the action.
        action: int32 (*B,), the ego's action.
        reward: float32 (*B,), the team's reward, unscaled.
        next_obs: (*B, ..), the ego's observation after the action.
        teammate_action: int32 (*B,), the teammate's action in the same step; None without +TA.
    """

    obs: Num[Array, "*B ..."]
    action: Int[Array, "*B"]
    reward: Float[Array, "*B"]
    next_obs: Num[Array, "*B ..."]
    teammate_action: Int[Array, "*B"] | None


def plain_view(obs: Array, layouts: Array | None) -> Array:
    """Returns the observations of batches that hold observations."""
    return obs


def state_view(layouts: Sequence[Layout], canonical: bool = False) -> BatchView:
    """Returns the view of batches that hold state records: uint8 (B, .., S) -> the ego's observations (B, .., 5, 5, C).

    Args:
        layouts: the layouts that `layouts` (B,) of a batch refers to by index, with observations of one shape.
        canonical: whether to render the canonical channels or the layouts' own.
    """

    def view(records: Array, which: Array | None) -> Array:
        # Every layout is rendered for all rows: under jit a row's layout is not known, and batches mostly have one.
        seen = [observe(layout, records[..., : record_size(layout)], EGO, canonical) for layout in layouts]
        if which is None:
            return seen[0]
        chosen = seen[0]
        for number, other in enumerate(seen[1:], start=1):
            rows = (which == number).reshape(-1, *[1] * (other.ndim - 1))
            chosen = jnp.where(rows, other, chosen)
        return chosen

    return view


def batch_steps(batch: ADBatch, view: BatchView) -> StepInput:
    """Returns the steps (B, L) of an AD batch."""
    obs = view(batch.obs, batch.layouts)  # type: ignore[arg-type]
    return StepInput(obs, batch.prev_actions, batch.prev_rewards, batch.prev_teammate_actions)  # type: ignore[arg-type]


def percept_step(percept: Any) -> StepInput:
    """Returns the input of an acting ego, converted from an `agents.Percept`."""
    return StepInput(percept.obs, percept.prev_action, percept.prev_reward, percept.prev_teammate_action)


def batch_transitions(batch: DPTBatch, view: BatchView) -> tuple[Transition, Array]:
    """Returns the context's transitions (B, K) and the query's observations (B, ..) of a DPT batch."""
    obs, following, query = (
        view(part, batch.layouts)  # type: ignore[arg-type]
        for part in (batch.context_obs, batch.context_next_obs, batch.query_obs)
    )
    mate: Any = batch.context_teammate_actions
    return Transition(obs, batch.context_actions, batch.context_rewards, following, mate), query  # type: ignore[arg-type]


class Tokens(nn.Module):
    """Base class of tokenizers.

    Args:
        encoder: module from observations to features.
        width: width of a token.
        actions: number of actions.
        teammate_actions: whether tokens hold the teammate's actions (+TA).
        dropout: rate in training.
        dtype: of the tokens.
    """

    encoder: nn.Module
    width: int = 256
    actions: int = len(ACTIONS)
    teammate_actions: bool = False
    dropout: float = 0.1
    dtype: Any = jnp.float32


class StepTokens(Tokens):
    """Tokens of steps: [Emb(a'); Emb(teammate's a') with +TA; r'; Enc(o)], projected (paper, App. E.2)."""

    @nn.compact
    def __call__(self, step: StepInput, deterministic: bool = True) -> Float[Array, "*B D"]:
        """Returns one token per step."""
        parts = [nn.Embed(self.actions, FEATURES, name="action")(step.prev_action)]
        if self.teammate_actions:
            parts.append(nn.Embed(self.actions, FEATURES, name="teammate_action")(step.prev_teammate_action))
        parts += [step.prev_reward[..., None], self.encoder(step.obs)]
        token = nn.Dense(self.width, name="project")(jnp.concatenate(parts, -1, dtype=self.dtype))
        return nn.Dropout(self.dropout)(token, deterministic=deterministic)


class TransitionTokens(Tokens):
    """Tokens of transitions: [Enc(o); OneHot(a); OneHot(teammate's a) with +TA; Enc(o'); r], projected.

    A query is [Enc(o); zeros] through the same projection (paper, App. E.3).
    """

    def setup(self) -> None:
        self.project, self.drop = nn.Dense(self.width), nn.Dropout(self.dropout)

    def context(self, transition: Transition, deterministic: bool = True) -> Float[Array, "*B D"]:
        """Returns one token per transition."""
        seen = self.encoder(jnp.stack([transition.obs, transition.next_obs]))
        parts = [seen[0], jax.nn.one_hot(transition.action, self.actions)]
        if self.teammate_actions:
            parts.append(jax.nn.one_hot(transition.teammate_action, self.actions))
        return self._token([*parts, seen[1], transition.reward[..., None]], deterministic)

    def query(self, obs: Num[Array, "*B ..."], deterministic: bool = True) -> Float[Array, "*B D"]:
        """Returns one token per observation for which an action is predicted."""
        seen = self.encoder(obs)
        rest = self.actions * (1 + self.teammate_actions) + seen.shape[-1] + 1
        return self._token([seen, jnp.zeros((*seen.shape[:-1], rest))], deterministic)

    def _token(self, parts: list[Array], deterministic: bool) -> Array:
        return self.drop(self.project(jnp.concatenate(parts, -1, dtype=self.dtype)), deterministic=deterministic)


class RingBuffer(NamedTuple):
    """Tokens that an acting ego keeps, as a ring: entry i is in slot i % S.

    Attributes:
        tokens: float32 (S, D).
        written: int32 (), entries so far.
    """

    tokens: Float[Array, "S D"]
    written: Int[Array, ""]

    @classmethod
    def empty(cls, slots: int, width: int) -> RingBuffer:
        """Returns a buffer without entries."""
        return cls(jnp.zeros((slots, width)), jnp.int32(0))

    def add(self, token: Float[Array, " D"]) -> RingBuffer:
        """Returns the buffer with one more entry, which replaces the oldest of a full buffer."""
        return RingBuffer(self.tokens.at[self.written % len(self.tokens)].set(token), self.written + 1)

    def last(self, context: int, stop: Int[Array, ""]) -> tuple[Float[Array, "K D"], Int[Array, ""]]:
        """Returns the entries stop - K .. stop - 1 in order, at the front of the array, and their number."""
        first = jnp.maximum(stop - context, 0)
        return self.tokens[(first + jnp.arange(context)) % len(self.tokens)], stop - first
