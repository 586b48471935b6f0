"""Decision-Pretrained Transformer (paper, App. E.3): predict an expert's action from a context of transitions.

The query observation follows its context, [c_1 .. c_K, q], and the model's output at the query is the predicted action.
An acting ego therefore computes the context once for many queries. The loss has a prediction after every prefix of the
context, c_1 .. c_j for j = 0..K: the sequence has K + 1 copies of the query, and copy j attends to the first j
transitions and to itself. With several queries per context, copy j is of query j mod Q.

Shapes: `B` batch size, `Q` queries of a context, `K` transitions of a context, `D` width, `A` actions, `N` entries of
an observation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from icrl4aht_generation.learners.encoder import encoding_metrics
from jaxtyping import Array, Bool, Float, Int, Shaped

from icrl4aht_baselines.methods.method import (
    Method,
    World,
    apply_if,
    cross_entropy,
    make_next_obs_head,
    make_tokenizer,
    make_transformer,
    run_model,
    squared_error,
)
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.tokens import StepInput, Transition, TransitionTokenizer, batch_transitions
from icrl4aht_baselines.methods.transformer import Transformer, TransformerMemory
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.sampling.dpt import DPTBatch


class DPTOutput(NamedTuple):
    """Output of `DPT`.

    Attributes:
        logits: float (B, K + 1, A), logits of the policy after the first j transitions, j = 0..K.
        next_obs: float (B, K - 1, N), predicted next observations of transitions 2..K; None if not predicted.
    """

    logits: Float[Array, "B K+1 A"]
    next_obs: Float[Array, "B K-1 N"] | None


class DPTMemory(NamedTuple):
    """Memory of an acting ego: its latest transitions, in a ring buffer of S = K + KEPT_STEPS slots.

    Transitions of the running episode are stored, but the model does not use them before the episode ends.

    Attributes:
        tokens: float32 (S, D), tokens of the transitions; transition i is in slot i % S.
        written: int32 (), number of transitions so far.
        complete: int32 (), number of transitions in finished episodes.
        context: the transformer's memory of the last K transitions of finished episodes, and one slot for the query.
        last_obs: float32, observation before the last action.
        started: bool (), whether the ego has taken a step.
    """

    tokens: Float[Array, "S D"]
    written: Int[Array, ""]
    complete: Int[Array, ""]
    context: TransformerMemory
    last_obs: Array
    started: Bool[Array, ""]


class DPT(nn.Module):
    """Model that maps a context of transitions and a query observation to a policy.

    With `finished_episodes_only`, an acting ego's context grows by complete episodes, as in the paper; otherwise by
    single steps.
    """

    tokens: TransitionTokenizer
    trunk: Transformer
    head: nn.Module
    obs_shape: tuple[int, ...]
    next_obs: nn.Module | None = None
    finished_episodes_only: bool = True

    def __call__(self, context: Transition, query: Any, deterministic: bool = True) -> DPTOutput:
        """Return the predictions after every prefix of a context of K transitions.

        Queries have the shape (B, ..), or (B, Q, ..) for several queries of each context.
        """
        tokens_BxKxD, obs_features = self.tokens.context(context, deterministic)
        batch, length, width = tokens_BxKxD.shape
        queries_BxQxD = self.tokens.query(query, deterministic).reshape(batch, -1, width)
        sequence = jnp.concatenate([tokens_BxKxD, _repeat_in_turn(queries_BxQxD, length)], axis=1)
        features = self.trunk(sequence, context=length, deterministic=deterministic)
        features, answers = features[:, :length], features[:, length:]
        predicted = None
        if self.next_obs is not None:
            # A transition's token includes the next observation, so the prediction must not use this token.
            # It uses the features of the previous transition and the encoding of the observation before the action.
            known = jnp.concatenate([features[:, :-1], obs_features[:, 1:]], axis=-1)
            predicted = self.next_obs(known, context.action[:, 1:])
        return DPTOutput(self.head(answers), predicted)

    def start(self, context: int, cached: bool) -> DPTMemory:
        """Return the memory of an ego before its first step, with slots for K transitions and a running episode.

        `cached` has no effect, because the context is always computed again when it changes.
        """
        tokens, zero = jnp.zeros((context + KEPT_STEPS, self.tokens.width)), jnp.int32(0)
        return DPTMemory(tokens, zero, zero, self.trunk.start(context + 1), jnp.zeros(self.obs_shape), jnp.bool_(False))

    def act(self, step: StepInput, done: Bool[Array, ""], memory: DPTMemory) -> tuple[Float[Array, " A"], DPTMemory]:
        """Return the policy for one step of an acting ego, and the memory that includes the previous transition.

        The last transition of an episode is left out, because its next observation is never shown to the ego.
        """
        obs = step.obs.astype(jnp.float32)
        both = jnp.stack([memory.last_obs, obs])
        transition = Transition(both, step.prev_action, step.prev_reward, step.prev_teammate_action)
        token, query = self.tokens.context(transition)[0], self.tokens.query(obs)
        # If there is no new transition, `written` does not change, and the next step overwrites this token.
        tokens = memory.tokens.at[memory.written % len(memory.tokens)].set(token)
        written = memory.written + (memory.started & ~done)
        complete = jnp.where(done, written, memory.complete) if self.finished_episodes_only else written
        context = len(tokens) - KEPT_STEPS
        trunk, variables = self.trunk.unbind()

        def compute_context(inputs: Any, memory: TransformerMemory) -> Any:
            variables, tokens, complete = inputs
            first = jnp.maximum(complete - context, 0)
            window = tokens[(first + jnp.arange(context)) % len(tokens)]
            return trunk.apply(variables, window, context + 1, method="start_after")

        changed = done if self.finished_episodes_only else jnp.bool_(True)
        seen = apply_if(changed, compute_context, (variables, tokens, complete), memory.context)
        # The query takes the slot after the last transition, where the next query will overwrite it.
        feature, seen = self.trunk.advance(query, seen._replace(written=jnp.minimum(complete, context)))
        return self.head(feature), DPTMemory(tokens, written, complete, seen, obs, jnp.bool_(True))


def _repeat_in_turn(values: Shaped[Array, "B Q ..."], length: int) -> Shaped[Array, "B K+1 ..."]:
    """Return one of Q values for each of the K + 1 prefixes of a context, K = `length`: value j mod Q for prefix j."""
    return values[:, jnp.arange(length + 1) % values.shape[1]]


def dpt(options: ModelOptions, world: World, finished_episodes_only: bool = True) -> Method:
    """Return the method DPT; with default options and C = 40 channels its model has 3,285,022 parameters."""
    tokens = make_tokenizer(TransitionTokenizer, options, world)
    head, next_obs = nn.Dense(world.actions), make_next_obs_head(options, world)
    model = DPT(tokens, make_transformer(options), head, world.obs_shape, next_obs, finished_episodes_only)

    def loss(params: Any, slow: Any, batch: DPTBatch, key: Any) -> tuple[Array, dict[str, Array]]:
        context, query = batch_transitions(batch, world.view)
        output: DPTOutput = run_model(model, options, params, key, context, query)
        batch_size, answers = output.logits.shape[:2]
        target = _repeat_in_turn(jnp.asarray(batch.query_target).reshape(batch_size, -1), answers - 1)
        total = cross_entropy(output.logits, target, options.label_smoothing).mean()
        hits = output.logits.argmax(axis=-1) == target
        log = {"action_loss": total, "accuracy": hits[:, -1].mean(), "prior_accuracy": hits[:, 0].mean()}
        if output.next_obs is not None:
            after = world.observations(context.obs)[:, 1:, 1]
            log["next_obs_loss"] = squared_error(output.next_obs, after).mean()
            total += log["next_obs_loss"]
        return total, {"loss": total, **log, **encoding_metrics(context.obs)}

    both, none = jnp.zeros((1, 2, 2, *world.obs_shape)), jnp.zeros((1, 2), jnp.int32)
    example = (Transition(both, none, jnp.zeros((1, 2)), none), both[:, 0, 0])
    return Method("dpt", "DPT", "dpt", model, example, loss, lambda logits: logits)
