"""Decision-Pretrained Transformer (paper, App. E.3): the expert's action at a query, from a context of transitions.

The query stands behind its context, [c_1 .. c_K, q], so that the answer, read at the last position, has seen all of it,
and so that an ego's context need not be computed anew for every query. The loss with prior asks the query behind every
part of the context, c_1 .. c_j for j = 0..K: K + 1 copies of the query, each of which sees its part and itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from baselines.methods.method import Method, ModelOptions, World, cross_entropy, next_obs_head, run_model, squared_error
from baselines.methods.tokens import (
    RingBuffer,
    Step,
    Transition,
    TransitionTokens,
    empty_log,
    transitions_of,
    visible_slots,
)
from baselines.methods.transformer import Cache, Transformer
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.sampling.dpt import DPTBatch


class DPTOutput(NamedTuple):
    """What the model gives."""

    logits: Float[Array, "B K+1 A"]  # having seen the first j transitions, j = 0..K
    next_obs: Float[Array, "B K-1 N"] | None  # with +next_obs: of transitions 2..K, from those before each


class Memory(NamedTuple):
    """An acting ego's transitions, as a ring; those of the running episode are held, but not seen before it ends."""

    held: (
        RingBuffer | tuple[Cache, ...]
    )  # tokens, or what the transformer keeps of them and one slot more, for the query
    written: Int[Array, ""]  # transitions so far
    complete: Int[Array, ""]  # of finished episodes
    last_obs: Array  # float32, before the step just taken
    started: Bool[Array, ""]  # some step was taken


class DPT(nn.Module):
    """Transitions and queries -> policies.

    `whole_episodes` is whether an acting ego's context grows by whole episodes, as in the paper, or by steps.
    """

    tokens: TransitionTokens
    trunk: Transformer
    head: nn.Module
    obs_shape: tuple[int, ...]
    next_obs: nn.Module | None = None
    whole_episodes: bool = True

    def __call__(self, context: Transition, query: Num[Array, "B ..."], deterministic: bool = True) -> DPTOutput:
        """A context (B, K) and a query (B,), answered after every part of the context."""
        tokens, asked = self.tokens.context(context, deterministic), self.tokens.query(query, deterministic)
        length = tokens.shape[1]
        queries = jnp.broadcast_to(asked[:, None], (len(tokens), length + 1, tokens.shape[-1]))
        sequence = jnp.concatenate([tokens, queries], axis=1)
        features = self.trunk(sequence, context=length, deterministic=deterministic)
        features, answers = features[:, :length], features[:, length:]
        predicted = None
        if self.next_obs is not None:
            coming = self.tokens.encoder(context.obs[:, 1:])  # type: ignore[operator]
            known = jnp.concatenate([features[:, :-1], coming], axis=-1)
            predicted = self.next_obs(known, context.action[:, 1:])
        return DPTOutput(self.head(answers), predicted)

    def start(self, context: int, cached: bool) -> Memory:
        """The memory of an ego before its first step: K transitions, and room for a running episode."""
        slots = context + KEPT_STEPS
        held = self.trunk.empty(slots + 1) if cached else empty_log(slots, self.tokens.width)
        return Memory(held, jnp.int32(0), jnp.int32(0), jnp.zeros(self.obs_shape), jnp.bool_(False))

    def act(self, step: Step, done: Bool[Array, ""], memory: Memory) -> tuple[Float[Array, " A"], Memory]:
        """One step of an ego: the policy, the memory with what the step before it brought.

        An episode's last transition is left out: what followed it in that episode is never shown, and the first
        observation of the next episode is not its successor.
        """
        obs = step.obs.astype(jnp.float32)
        transition = Transition(memory.last_obs, step.prev_action, step.prev_reward, obs, step.prev_teammate_action)
        token, query = self.tokens.context(transition), self.tokens.query(obs)
        written = memory.written + (memory.started & ~done)
        complete = jnp.where(done, written, memory.complete) if self.whole_episodes else written
        recall = self._recompute if isinstance(memory.held, RingBuffer) else self._recall
        feature, held = recall(token, query, memory, written, complete)
        return self.head(feature), Memory(held, written, complete, obs, jnp.bool_(True))

    def _recompute(self, token: Array, query: Array, memory: Memory, written: Array, complete: Array) -> tuple:
        """The answer from all tokens of the context, anew."""
        log = RingBuffer(memory.held.add(token).tokens, written)  # type: ignore[union-attr]
        window, seen = log.last(len(log.tokens) - KEPT_STEPS, complete)
        sequence = jnp.append(window, query[None], axis=0).at[seen].set(query)  # what is behind it does not count
        return self.trunk(sequence[None])[0, seen], log

    def _recall(self, token: Array, query: Array, memory: Memory, written: Array, complete: Array) -> tuple:
        """The answer from what was kept of the context."""
        slots = memory.held[0].slots - 1  # type: ignore[union-attr]
        context, now = slots - KEPT_STEPS, memory.written
        own = jnp.append(visible_slots(slots, now + 1, context, now + 1), False)
        _, held = self.trunk.step(token, memory.held, now % slots, now, own)  # type: ignore[arg-type]
        sees = jnp.append(visible_slots(slots, written, context, complete), True)
        return self.trunk.step(query, held, jnp.int32(slots), complete, sees)


def dpt(options: ModelOptions, world: World, whole_episodes: bool = True) -> Method:
    """3,285,022 parameters at C = 40."""
    tokens = options.tokens(TransitionTokens, world)
    head, next_obs = nn.Dense(world.actions), next_obs_head(options, world)
    model = DPT(tokens, options.transformer(), head, world.obs_shape, next_obs, whole_episodes)

    def loss(params: Any, slow: Any, batch: DPTBatch, key: Any) -> tuple[Array, dict[str, Array]]:
        context, query = transitions_of(batch, world.view)
        output: DPTOutput = run_model(model, options, params, key, context, query)
        target = jnp.broadcast_to(jnp.asarray(batch.query_target)[:, None], output.logits.shape[:2])
        total = cross_entropy(output.logits, target, options.label_smoothing).mean()
        hits = output.logits.argmax(axis=-1) == target
        log = {"action_loss": total, "accuracy": hits[:, -1].mean(), "prior_accuracy": hits[:, 0].mean()}
        if output.next_obs is not None:
            log["next_obs_loss"] = squared_error(output.next_obs, context.next_obs[:, 1:]).mean()
            total += log["next_obs_loss"]
        return total, {"loss": total, **log}

    two, none = jnp.zeros((1, 2, *world.obs_shape)), jnp.zeros((1, 2), jnp.int32)
    example = (Transition(two, none, jnp.zeros((1, 2)), two, none), two[:, 0])
    return Method("dpt", "DPT", "dpt", model, example, loss, lambda logits: logits)
