"""Tokenizers of histories, for training and for acting (paper, App. E.2 and E.3).

AD has one token per `StepInput`, DPT has one token per `Transition`. Shapes: `*B` any leading axes (batch and time in
training, none when acting), `D` width of a token, `K` length of a context.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from icrl4aht_generation.learners.encoder import group_equal
from jaxtyping import Array, Float, Int

from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.sampling.ad import ADBatch
from icrl4aht_data.sampling.dpt import DPTBatch

FEATURES = 64
"""Number of features of an encoded observation and of an embedded action (d_emb in the paper)."""

BatchView = Callable[[Any, Any], Any]
"""Function from a batch's observations or state records, and its `layouts` or None, to the input of the encoder."""


class StepInput(NamedTuple):
    """Input of an ego before an action. Before a history's first step all `prev_*` fields are zero (paper, App. E.2).

    Attributes:
        obs: (*B, ..), the ego's observation, uint8 or float, or another form that the encoder takes.
        prev_action: int32 (*B,), the ego's action in the previous step.
        prev_reward: float32 (*B,), the team's reward in the previous step, unscaled.
        prev_teammate_action: int32 (*B,), the teammate's action in the previous step; None without +TA.
        partner: int32 (*B,), number of the teammate for informed egos; None for egos that do not observe it.
    """

    obs: Any
    prev_action: Int[Array, "*B"]
    prev_reward: Float[Array, "*B"]
    prev_teammate_action: Int[Array, "*B"] | None
    partner: Int[Array, "*B"] | None = None


class Transition(NamedTuple):
    """An action and its outcome, within one episode.

    Attributes:
        obs: (*B, 2, ..), the ego's observations before and after the action, or another form that the encoder takes.
        action: int32 (*B,), the ego's action.
        reward: float32 (*B,), the team's reward, unscaled.
        teammate_action: int32 (*B,), the teammate's action in the same step; None without +TA.
    """

    obs: Any
    action: Int[Array, "*B"]
    reward: Float[Array, "*B"]
    teammate_action: Int[Array, "*B"] | None


def plain_view(obs: Array, layouts: Array | None) -> Array:
    """Return the observations unchanged: the `BatchView` of encoders that take plain observations."""
    return obs


def batch_steps(batch: ADBatch, view: BatchView) -> StepInput:
    """Return an AD batch as a `StepInput`, with arrays of shape (B, L, ..)."""
    obs = group_equal(view(batch.obs, batch.layouts))
    return StepInput(obs, batch.prev_actions, batch.prev_rewards, batch.prev_teammate_actions)  # type: ignore[arg-type]


def input_step(ego_input: Any) -> StepInput:
    """Convert an `agents.EgoInput` to a `StepInput`."""
    return StepInput(ego_input.obs, ego_input.prev_action, ego_input.prev_reward, ego_input.prev_teammate_action)


def batch_transitions(batch: DPTBatch, view: BatchView) -> tuple[Transition, Any]:
    """Return a DPT batch as transitions of shape (B, K, ..) and queries of shape (B, ..) or (B, Q, ..)."""
    both = jnp.stack([jnp.asarray(batch.context_obs), jnp.asarray(batch.context_next_obs)], axis=2)
    obs, query = group_equal(view(both, batch.layouts)), view(batch.query_obs, batch.layouts)
    mate: Any = batch.context_teammate_actions
    return Transition(obs, batch.context_actions, batch.context_rewards, mate), query  # type: ignore[arg-type]


class Tokenizer(nn.Module):
    """Base class of tokenizers.

    Args:
        encoder: module from observations to features.
        width: width of a token.
        actions: number of actions.
        teammate_actions: whether tokens hold the teammate's actions (+TA).
        dropout: dropout rate in training.
        dtype: dtype of the tokens.
        reward_scale: factor of the rewards in tokens.
    """

    encoder: nn.Module
    width: int = 256
    actions: int = len(ACTIONS)
    teammate_actions: bool = False
    dropout: float = 0.1
    dtype: Any = jnp.float32
    reward_scale: float = 1.0


class StepTokenizer(Tokenizer):
    """Tokenizer of steps: projects the previous actions and reward and the encoded observation (paper, App. E.2).

    The teammate's previous action is an input only of the variants +TA.

    Args:
        partners: number of different values of `StepInput.partner`; 0 if the teammate's index is not an input.
    """

    partners: int = 0

    @nn.compact
    def __call__(self, step: StepInput, deterministic: bool = True) -> Float[Array, "*B D"]:
        """Return one token for each step."""
        parts = [nn.Embed(self.actions, FEATURES, name="action")(step.prev_action)]
        if self.teammate_actions:
            parts.append(nn.Embed(self.actions, FEATURES, name="teammate_action")(step.prev_teammate_action))
        if self.partners:
            parts.append(nn.Embed(self.partners, FEATURES, name="partner")(step.partner))
        parts += [self.reward_scale * step.prev_reward[..., None], self.encoder(step.obs)]
        token = nn.Dense(self.width, name="project")(jnp.concatenate(parts, -1, dtype=self.dtype))
        return nn.Dropout(self.dropout)(token, deterministic=deterministic)


class TransitionTokenizer(Tokenizer):
    """Tokenizer of transitions: [Enc(o); OneHot(a); OneHot(teammate's a) with +TA; Enc(o'); r], projected.

    A query observation becomes [Enc(o); zeros] with the same projection (paper, App. E.3).
    """

    def setup(self) -> None:
        self.project, self.drop = nn.Dense(self.width), nn.Dropout(self.dropout)

    def context(self, transition: Transition, deterministic: bool = True) -> tuple[Array, Float[Array, "*B F"]]:
        """Return a token for each transition, of shape (*B, D), and the encoded observations before the actions."""
        seen = self.encoder(transition.obs)
        before, after = seen[..., 0, :], seen[..., 1, :]
        parts = [before, jax.nn.one_hot(transition.action, self.actions)]
        if self.teammate_actions:
            parts.append(jax.nn.one_hot(transition.teammate_action, self.actions))
        return self._token([*parts, after, self.reward_scale * transition.reward[..., None]], deterministic), before

    def query(self, obs: Any, deterministic: bool = True) -> Float[Array, "*B D"]:
        """Return one token for each observation for which an action is to be predicted."""
        seen = self.encoder(obs)
        rest = self.actions * (1 + self.teammate_actions) + seen.shape[-1] + 1
        return self._token([seen, jnp.zeros((*seen.shape[:-1], rest))], deterministic)

    def _token(self, parts: list[Array], deterministic: bool) -> Array:
        return self.drop(self.project(jnp.concatenate(parts, -1, dtype=self.dtype)), deterministic=deterministic)
