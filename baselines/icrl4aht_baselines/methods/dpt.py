"""Decision-Pretrained Transformer (paper, App. E.3): the expert's action at a query, from a context of transitions.

The query follows its context, [c_1 .. c_K, q]. Its answer, read at the last position, has seen all of the context, and
an acting ego computes the context once for many queries. The loss with prior poses the query after every part of the
context, c_1 .. c_j for j = 0..K, as K + 1 copies of the query that each see their part and themselves. Several queries
of one context are posed in turn: query j mod Q after the first j transitions.

Shapes: `B` batch size, `Q` queries of a context, `K` transitions of a context, `D` width, `A` actions, `N` entries of
an observation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_generation.learners.encoder import encoding_log
from jaxtyping import Array, Bool, Float, Int, Shaped

from icrl4aht_baselines.methods.method import (
    Method,
    World,
    change_if,
    cross_entropy,
    make_next_obs_head,
    make_tokens,
    make_transformer,
    run_model,
    squared_error,
)
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import StepInput, Transition, TransitionTokens, batch_transitions
from icrl4aht_baselines.methods.transformer import Transformer, TransformerMemory
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.sampling.dpt import DPTBatch


class DPTOutput(NamedTuple):
    """Output of `DPT`.

    Attributes:
        logits: float (B, K + 1, A), the policy after the first j transitions, j = 0..K.
        next_obs: float (B, K - 1, N), predictions for transitions 2..K from those before each; None without +next_obs.
    """

    logits: Float[Array, "B K+1 A"]
    next_obs: Float[Array, "B K-1 N"] | None


class DPTMemory(NamedTuple):
    """Memory of an acting ego: its transitions, as a ring of S = K + KEPT_STEPS slots.

    The transitions of the running episode are stored, but not visible before the episode ends.

    Attributes:
        tokens: float32 (S, D), tokens of the transitions; transition i is in slot i % S.
        written: int32 (), transitions so far.
        complete: int32 (), transitions of finished episodes.
        context: the transformer's memory of the last K transitions of finished episodes, with one slot more, for the
            query.
        last_obs: float32, observation before the last action.
        started: bool (), whether a step was taken.
    """

    tokens: Float[Array, "S D"]
    written: Int[Array, ""]
    complete: Int[Array, ""]
    context: TransformerMemory
    last_obs: Array
    started: Bool[Array, ""]


class DPT(nn.Module):
    """Model that maps a context of transitions and a query to a policy.

    `finished_episodes_only`: an acting ego's context grows by complete episodes, as in the paper; otherwise by steps.
    """

    tokens: TransitionTokens
    trunk: Transformer
    head: nn.Module
    obs_shape: tuple[int, ...]
    next_obs: nn.Module | None = None
    finished_episodes_only: bool = True

    def __call__(self, context: Transition, query: Any, deterministic: bool = True) -> DPTOutput:
        """Return the answers to one query (B, ..) or several (B, Q, ..) after every part of a context (B, K)."""
        tokens_BxKxD, obs_features = self.tokens.context(context, deterministic)
        batch, length, width = tokens_BxKxD.shape
        queries_BxQxD = self.tokens.query(query, deterministic).reshape(batch, -1, width)
        sequence = jnp.concatenate([tokens_BxKxD, _in_turn(queries_BxQxD, length)], axis=1)
        features = self.trunk(sequence, context=length, deterministic=deterministic)
        features, answers = features[:, :length], features[:, length:]
        predicted = None
        if self.next_obs is not None:
            # A transition's token holds its outcome, so the prediction reads the features before it, and its first
            # observation by itself.
            known = jnp.concatenate([features[:, :-1], obs_features[:, 1:]], axis=-1)
            predicted = self.next_obs(known, context.action[:, 1:])
        return DPTOutput(self.head(answers), predicted)

    def start(self, context: int, cached: bool) -> DPTMemory:
        """Return the memory of an ego before its first step: room for K transitions and a running episode.

        The context is computed when it changes, which is exact, so `cached` has no effect.
        """
        tokens, zero = jnp.zeros((context + KEPT_STEPS, self.tokens.width)), jnp.int32(0)
        return DPTMemory(tokens, zero, zero, self.trunk.start(context + 1), jnp.zeros(self.obs_shape), jnp.bool_(False))

    def act(self, step: StepInput, done: Bool[Array, ""], memory: DPTMemory) -> tuple[Float[Array, " A"], DPTMemory]:
        """Return the policy for one step of an ego, and the memory with the outcome of the step before.

        An episode's last transition is left out: its successor in that episode is never shown, and the first
        observation of the next episode is not its successor.
        """
        obs = step.obs.astype(jnp.float32)
        both = jnp.stack([memory.last_obs, obs])
        transition = Transition(both, step.prev_action, step.prev_reward, step.prev_teammate_action)
        token, query = self.tokens.context(transition)[0], self.tokens.query(obs)
        # Without a new transition `written` stays, and the next step overwrites the token added here.
        tokens = memory.tokens.at[memory.written % len(memory.tokens)].set(token)
        written = memory.written + (memory.started & ~done)
        complete = jnp.where(done, written, memory.complete) if self.finished_episodes_only else written
        context = len(tokens) - KEPT_STEPS
        trunk, variables = self.trunk.unbind()

        def compute(inputs: Any, memory: TransformerMemory) -> Any:
            variables, tokens, complete = inputs
            first = jnp.maximum(complete - context, 0)
            window = tokens[(first + jnp.arange(context)) % len(tokens)]
            return trunk.apply(variables, window, context + 1, method="start_after")

        changed = done if self.finished_episodes_only else jnp.bool_(True)
        seen = change_if(changed, compute, (variables, tokens, complete), memory.context)
        # The query follows the valid transitions, and the next query takes its slot.
        feature, seen = self.trunk.advance(query, seen._replace(written=jnp.minimum(complete, context)))
        return self.head(feature), DPTMemory(tokens, written, complete, seen, obs, jnp.bool_(True))


def _in_turn(values: Shaped[Array, "B Q ..."], length: int) -> Shaped[Array, "B K+1 ..."]:
    """Return one value for every part of a context of K = `length` transitions: value j mod Q after the first j."""
    return values[:, jnp.arange(length + 1) % values.shape[1]]


def dpt(options: ModelOptions, world: World, finished_episodes_only: bool = True) -> Method:
    """Return the Decision-Pretrained Transformer; 3,285,022 parameters at C = 40 channels."""
    tokens = make_tokens(TransitionTokens, options, world)
    head, next_obs = nn.Dense(world.actions), make_next_obs_head(options, world)
    model = DPT(tokens, make_transformer(options), head, world.obs_shape, next_obs, finished_episodes_only)

    def loss(params: Any, slow: Any, batch: DPTBatch, key: Any) -> tuple[Array, dict[str, Array]]:
        context, query = batch_transitions(batch, world.view)
        output: DPTOutput = run_model(model, options, params, key, context, query)
        batch_size, answers = output.logits.shape[:2]
        target = _in_turn(jnp.asarray(batch.query_target).reshape(batch_size, -1), answers - 1)
        total = cross_entropy(output.logits, target, options.label_smoothing).mean()
        hits = output.logits.argmax(axis=-1) == target
        log = {"action_loss": total, "accuracy": hits[:, -1].mean(), "prior_accuracy": hits[:, 0].mean()}
        if output.next_obs is not None:
            after = world.observations(context.obs)[:, 1:, 1]
            log["next_obs_loss"] = squared_error(output.next_obs, after).mean()
            total += log["next_obs_loss"]
        return total, {"loss": total, **log, **encoding_log(context.obs)}

    both, none = jnp.zeros((1, 2, 2, *world.obs_shape)), jnp.zeros((1, 2), jnp.int32)
    example = (Transition(both, none, jnp.zeros((1, 2)), none), both[:, 0, 0])
    return Method("dpt", "DPT", "dpt", model, example, loss, lambda logits: logits)
