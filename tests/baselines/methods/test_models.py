"""Test models: parameter counts, causality, and equal outputs in training and in cached and exact acting."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from icrl4aht_baselines.agents.host import EgoInput
from icrl4aht_baselines.methods import attention
from icrl4aht_baselines.methods.method import Method, apply_if
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.methods.tokens import Transition, batch_steps, batch_transitions, input_step, plain_view

from icrl4aht_data import get_layout
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.sampling.ad import ADBatch
from tests.helpers.small_models import FLAT, TINY, ad_batch, dpt_batch, random_parameters

STEPS = ("ad", "hybrid_ad", pytest.param("amago_offline", marks=pytest.mark.slow))


@cache
def tiny_method(name: str, **changes: Any) -> tuple[Method, Any]:
    """Return a small method for flat observations, and random parameters for its model."""
    method = get_method(name)(dataclasses.replace(TINY, **changes), FLAT)
    return method, random_parameters(method)


def apply_model(method: Method, params: Any, *inputs: Any, **named: Any) -> Any:
    """Apply the model of a method to inputs and return the output."""
    return method.model.apply({"params": params}, *inputs, **named)


class TestModelOptions:
    @pytest.mark.parametrize(("name", "parameters"), [("ad", 3_283_870), ("dpt", 3_285_022), ("hybrid_ad", 913_310)])
    def test_default_models_have_the_published_parameter_counts(self, name, parameters):
        method = get_method(name)(ModelOptions(), overcooked_world([get_layout("coord_simple")]))
        shapes = jax.eval_shape(method.init, jax.random.key(0))
        assert sum(leaf.size for leaf in jax.tree.leaves(shapes)) == parameters

    def test_invalid_model_options_raise_errors(self):
        with pytest.raises(OptionError, match="width = 30: expected a multiple of twice the heads"):
            get_method("ad")(ModelOptions(width=30), overcooked_world([get_layout("coord_simple")]))
        get_method("hybrid_ad")(ModelOptions(width=30), overcooked_world([get_layout("coord_simple")]))
        with pytest.raises(OptionError, match="dropout = 1"):
            ModelOptions(dropout=1.0)
        with pytest.raises(UnknownNameError, match=r"unknown positions 'rop'.*Did you mean 'rope'"):
            ModelOptions(positions="rop")  # type: ignore[arg-type]
        with pytest.raises(UnknownNameError, match=r"unknown method 'DTP'; valid: ad, dpt"):
            get_method("DTP")


def dependence_masks(f, *inputs) -> list[np.ndarray]:
    """Return a mask of shape (O, T) for each input of T rows: whether the O outputs of `f` depend on the rows."""
    jacobians = jax.jit(jax.jacobian(f, argnums=tuple(range(len(inputs)))))(*inputs)
    return [
        np.abs(np.asarray(jacobian).reshape(len(jacobian), -1, len(x), x[0].size)).max(axis=(1, 3)) > 0
        for jacobian, x in zip(jacobians, inputs, strict=True)
    ]


KINDS = [
    ("ad", "rope"),
    ("hybrid_ad", "none"),
    pytest.param("ad", "none", marks=pytest.mark.slow),
    pytest.param("amago_offline", "none", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "positions"), KINDS)
def test_outputs_depend_only_on_past_and_present_steps(name, positions):
    method, params = tiny_method(name, positions=positions)
    steps = batch_steps(ad_batch(rows=1), plain_view)

    def policy(obs, rewards):
        changed = steps._replace(obs=obs[None], prev_reward=rewards[None])
        return method.logits(apply_model(method, params, changed).head)[0]

    for found in dependence_masks(policy, steps.obs[0], steps.prev_reward[0]):
        np.testing.assert_array_equal(found, np.tril(np.ones((7, 7), bool)))


def test_behaviour_cloning_sees_the_present_observation_only():
    method, params = tiny_method("bc")
    steps = batch_steps(ad_batch(rows=1), plain_view)

    def policy(obs, rewards):
        changed = steps._replace(obs=obs[None], prev_reward=rewards[None])
        return apply_model(method, params, changed).head[0]

    seen, rewarded = dependence_masks(policy, steps.obs[0], steps.prev_reward[0])
    np.testing.assert_array_equal(seen, np.eye(7, dtype=bool))
    assert not rewarded.any()
    other = steps._replace(prev_action=(steps.prev_action + 1) % 4, prev_teammate_action=steps.prev_action)
    np.testing.assert_array_equal(*(apply_model(method, params, one).head for one in (steps, other)))


@pytest.mark.parametrize("name", STEPS)
def test_policies_depend_on_earlier_actions_of_both_agents(name):
    method, params = tiny_method(name)
    steps = batch_steps(ad_batch(rows=1), plain_view)

    @jax.jit
    def policy(mine, theirs):
        changed = steps._replace(prev_action=mine, prev_teammate_action=theirs)
        return method.logits(apply_model(method, params, changed).head)[0]

    mine, theirs = steps.prev_action, steps.prev_teammate_action
    other = np.arange(7) == 2
    for changed in (((mine + other) % 4, theirs), (mine, (theirs + other) % 4)):
        moved = np.abs(policy(mine, theirs) - policy(*changed)).max(axis=-1)
        assert (moved[:2] == 0).all()
        assert (moved[2:] > 1e-6).all()


@pytest.mark.parametrize("positions", [pytest.param("none", marks=pytest.mark.slow), "rope"])
def test_dpt_outputs_depend_on_the_query_and_context(positions):
    method, params = tiny_method("dpt", positions=positions)
    batch = dpt_batch(rows=1)

    def query_logits(obs, rewards, query):
        changed = batch._replace(context_obs=obs[None], context_rewards=rewards[None], query_obs=query)
        return apply_model(method, params, *batch_transitions(changed, plain_view)).logits[0]

    of_obs, of_rewards, of_query = dependence_masks(
        query_logits, batch.context_obs[0], batch.context_rewards[0], batch.query_obs
    )
    seen = np.tril(np.ones((7, 6), bool), k=-1)  # output j depends on the first j transitions
    assert seen[-1].all()
    np.testing.assert_array_equal(of_obs, seen)
    np.testing.assert_array_equal(of_rewards, seen)
    assert of_query.all()


def test_several_dpt_queries_give_the_same_outputs_as_single_queries():
    method, params = tiny_method("dpt")
    batch = dpt_batch(rows=2)
    other = batch._replace(query_obs=batch.query_obs[::-1], query_target=1 + batch.query_target)
    both = batch._replace(
        query_obs=np.stack([batch.query_obs, other.query_obs], axis=1),
        query_target=np.stack([batch.query_target, other.query_target], axis=1),
    )

    @jax.jit
    def logits(asked):
        return apply_model(method, params, *batch_transitions(asked, plain_view)).logits

    found, first, second = map(logits, (both, batch, other))
    np.testing.assert_allclose(found[:, 0::2], first[:, 0::2], atol=1e-6)
    np.testing.assert_allclose(found[:, 1::2], second[:, 1::2], atol=1e-6)
    losses = [
        float(optax.softmax_cross_entropy_with_integer_labels(answers, asked.query_target[:, None]).mean(axis=0)[j])
        for answers, asked in ((first, batch), (second, other))
        for j in range(7)
    ]
    expected = np.mean([losses[j if j % 2 == 0 else 7 + j] for j in range(7)])
    assert jax.jit(method.loss)(params, None, both, None)[1]["action_loss"] == pytest.approx(expected, rel=1e-5)


def query_mask(context: int) -> np.ndarray:
    """Return the attention mask of c_1 .. c_K, q_0 .. q_K: c_i attends to c_1 .. c_i, and q_j to c_1 .. c_j and q_j."""
    to_context = np.concatenate([np.tri(context), np.tri(context + 1, context, -1)])
    to_queries = np.concatenate([np.zeros((context, context + 1)), np.eye(context + 1)])
    return np.concatenate([to_context, to_queries], axis=1).astype(bool)


def test_causal_attention_equals_attention_with_a_mask(monkeypatch):
    """Values and gradients agree to float32 rounding, also if attention is computed in blocks of rows."""
    q, k, v, to = np.random.default_rng(0).normal(size=(4, 2, 15, 2, 8)).astype(np.float32)

    def masked_attention(q, k, v):
        return jax.nn.dot_product_attention(q, k, v, mask=jnp.asarray(query_mask(7))[None, None])

    def context_and_query_attention(q, k, v):
        context = attention.causal_attention(q[:, :7], k[:, :7], v[:, :7])
        queries = attention.causal_attention(q[:, 7:], k[:, :7], v[:, :7], k[:, 7:], v[:, 7:])
        return jnp.concatenate([context, queries], axis=1)

    def value_and_gradients(attend):
        return jax.jit(jax.value_and_grad(lambda *qkv: (attend(*qkv) * to).sum(), argnums=(0, 1, 2)))(q, k, v)

    expected = value_and_gradients(masked_attention)
    for short, long in ((attention.SHORT_ROWS, attention.LONG_ROWS), (3, 15), (3, 5)):
        monkeypatch.setattr(attention, "SHORT_ROWS", short)
        monkeypatch.setattr(attention, "LONG_ROWS", long)
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=2e-5, atol=5e-6),
            value_and_gradients(context_and_query_attention),
            expected,
        )


def intermediate_arrays(jaxpr: Any) -> Iterator[Any]:
    """Yield all intermediate arrays of a computation."""
    for equation in jaxpr.eqns:
        yield from (out.aval for out in equation.outvars)
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda leaf: hasattr(leaf, "eqns")):
            if hasattr(inner, "eqns"):
                yield from intermediate_arrays(inner)


@pytest.mark.parametrize("name", ["ad", "dpt"])
def test_memory_of_long_contexts_is_not_quadratic(name):
    method, params = tiny_method(name, layers=1)
    batch = ad_batch(rows=1, length=3072) if name == "ad" else dpt_batch(rows=1, context=3072)
    made = jax.make_jaxpr(jax.grad(lambda p: method.loss(p, p, batch, jax.random.key(0))[0]))(params)
    largest = max(array.size for array in intermediate_arrays(made.jaxpr))
    assert largest < TINY.heads * 3072 * 1024


@pytest.mark.parametrize("name", STEPS)
def test_padding_does_not_change_the_loss(name):
    method, params = tiny_method(name, layers=1)
    batch = ad_batch(rows=3)
    lengths = np.array([7, 4, 1])
    mask = np.arange(7) < lengths[:, None]
    garbage = ad_batch(rows=3, seed=5)
    other = jax.tree.map(lambda a, b: np.where(mask.reshape(3, 7, *[1] * (a.ndim - 2)), a, b), batch, garbage)
    batch, other = (b._replace(attention_mask=mask) for b in (batch, other))

    def loss_of(batch):
        return method.loss(params, params, batch, None)

    loss = jax.jit(loss_of)
    assert loss(batch)[0] != loss(batch._replace(attention_mask=np.ones_like(mask)))[0]
    for one, two in zip(*(jax.tree.leaves(loss(b)) for b in (batch, other)), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6)
    gradient = jax.jit(jax.grad(lambda obs: loss_of(batch._replace(obs=obs))[0]))(batch.obs)
    assert not np.abs(gradient)[~mask].any()


def test_bfloat16_loss_is_close_to_float32_loss():
    full, params = tiny_method("ad", layers=1)
    half, batch = tiny_method("ad", layers=1, bfloat16=True)[0], ad_batch()
    one, two = (jax.jit(method.loss)(params, params, batch, None)[0] for method in (full, half))
    assert one != two
    np.testing.assert_allclose(one, two, rtol=0.03)


@pytest.mark.slow
def test_rematerialization_does_not_change_gradients():
    gradients = []
    for remat in (False, True):
        method, params = tiny_method("ad", layers=1, remat=remat)
        key = jax.random.key(0)
        gradients.append(jax.jit(jax.grad(lambda p, m=method: m.loss(p, p, ad_batch(), key)[0]))(params))  # noqa: B023
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), *gradients)


def test_next_observation_loss_uses_taken_actions_within_an_episode():
    method, params = tiny_method("ad", layers=1)
    batch = ad_batch()
    log = jax.jit(lambda b: method.loss(params, params, b, None)[1])

    def loss(b: ADBatch) -> Any:
        return log(b)["next_obs_loss"]

    after_the_end, within = batch.obs.copy(), batch.obs.copy()
    after_the_end[:, 4] += 100  # the episode ends at step 3, so step 4 is in the next episode
    within[:, 3] += 100
    assert loss(batch._replace(dones=np.ones_like(batch.dones))) == 0
    last = batch._replace(dones=np.broadcast_to(np.arange(7) != 2, (2, 7)))  # all steps but step 2 end an episode
    assert loss(last) == loss(last._replace(obs=after_the_end)) != loss(last._replace(obs=within))
    labelled = batch._replace(target_actions=(batch.target_actions + 1) % 4)
    assert loss(batch) == loss(labelled) != 0
    assert log(batch)["action_loss"] != log(labelled)["action_loss"]


def ego_inputs(steps: int, episode: int, seed=0) -> EgoInput:
    """Return random inputs of an ego for consecutive steps."""
    rng = np.random.default_rng(seed)
    t = np.arange(steps)
    zero_first = t > 0
    return EgoInput(
        obs=jnp.asarray(rng.normal(size=(steps, 3)), jnp.float32),
        prev_action=jnp.asarray(rng.integers(0, 4, steps) * zero_first),
        prev_reward=jnp.asarray(rng.normal(size=steps) * zero_first, jnp.float32),
        prev_teammate_action=jnp.asarray(rng.integers(0, 4, steps) * zero_first),
        prev_done=jnp.asarray(zero_first & (t % episode == 0)),
    )


@cache
def compiled_player(name: str, context: int, cached: bool, **changes: Any):
    method, params = tiny_method(name, **changes)

    @jax.jit
    def play(seen: EgoInput):
        def step(memory, ego_input):
            logits, memory = method.act(params, input_step(ego_input), ego_input.prev_done, memory)
            return memory, logits

        return jax.lax.scan(step, method.start(context, cached), seen)[1]

    return play


@pytest.mark.parametrize(("name", "positions"), KINDS)
def test_cached_acting_equals_exact_acting_until_the_window_is_full(name, positions):
    seen = ego_inputs(12, episode=4)
    exact, cached = (compiled_player(name, 12, way, positions=positions)(seen) for way in (False, True))
    np.testing.assert_allclose(exact, cached, rtol=1e-4, atol=1e-5)
    assert np.abs(np.diff(exact, axis=0)).min() > 0


@pytest.mark.parametrize("name", [*STEPS, "bc"])
def test_outputs_while_acting_equal_outputs_in_training(name):
    method, params = tiny_method(name)
    seen = ego_inputs(9, episode=4)
    steps = jax.tree.map(lambda x: x[None], input_step(seen))
    policy = jax.jit(lambda steps: method.logits(apply_model(method, params, steps).head)[0])
    expected = policy(steps)
    np.testing.assert_allclose(compiled_player(name, 12, False)(seen), expected, rtol=1e-4, atol=1e-5)
    # A full window contains the last K steps, like a window of training data.
    last = policy(jax.tree.map(lambda x: x[:, -4:], steps))[-1]
    np.testing.assert_allclose(compiled_player(name, 4, False)(seen)[-1], last, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("context", "first", "positions"),
    [
        pytest.param(12, 0, "none", marks=pytest.mark.slow),
        pytest.param(4, 2, "none", marks=pytest.mark.slow),
        (4, 2, "rope"),
    ],
)
def test_dpt_uses_the_transitions_of_finished_episodes(context, first, positions):
    method, params = tiny_method("dpt", positions=positions)
    seen = ego_inputs(11, episode=4)  # two finished episodes, then three steps
    known = np.array([0, 1, 2, 4, 5, 6])[first:]  # steps 3 and 7 end episodes and have no next observation
    after = jax.tree.map(lambda x: x[known + 1][None], seen)
    both = jnp.stack([seen.obs[known][None], after.obs], axis=2)
    transitions = Transition(both, after.prev_action, after.prev_reward, after.prev_teammate_action)
    answer = jax.jit(lambda query: apply_model(method, params, transitions, query).logits[0, -1])
    expected = [answer(seen.obs[t][None]) for t in (8, 9, 10)]
    np.testing.assert_allclose(
        compiled_player("dpt", context, True, positions=positions)(seen)[8:], np.stack(expected), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize(
    ("name", "context", "first_without", "cached"),
    [
        ("ad", 5, 5, True),
        ("ad", 5, 5, False),
        ("hybrid_ad", 5, 5, True),
        ("hybrid_ad", 5, 5, False),
        ("dpt", 5, 8, True),
    ],
)
def test_steps_outside_the_context_do_not_affect_outputs(name, context, first_without, cached):
    """The first step leaves AD's window after 5 steps, and DPT's context after two episodes of 3 transitions."""
    seen = ego_inputs(12, episode=4)
    play = compiled_player(name, context, cached)
    changed = seen._replace(obs=seen.obs.at[0].add(3.0))
    difference = np.abs(play(seen) - play(changed)).max(axis=-1)
    assert (difference[first_without - 4 : first_without] > 0).all()
    assert not difference[first_without:].any()


def test_full_cached_window_drops_a_fifth_of_its_steps():
    """With K = 10, a full window drops its 2 oldest steps before a new one, so it has 9 or 10 steps in turn."""
    seen = ego_inputs(16, episode=4)
    cached, ten, nine = (
        compiled_player("ad", context, way)(seen) for context, way in ((10, True), (10, False), (9, False))
    )
    np.testing.assert_allclose(cached[:10], ten[:10], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(cached[11::2], ten[11::2], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(cached[10::2], nine[10::2], rtol=1e-4, atol=1e-5)
    assert np.abs(ten - nine)[10:].max() > 1e-3


class TestChangeIf:
    """`apply_if` computes a change only if the condition of at least one row of the batch is true."""

    CONDITION = jnp.array([True, False, True])

    @staticmethod
    def change(params, memory):
        return {"a": memory["a"] * params["scale"], "b": memory["b"] + params["add"]}

    def change_row(self, condition, add, memory):
        return apply_if(condition, self.change, {"scale": jnp.float32(3), "add": add}, memory)

    def test_rows_change_only_if_their_condition_is_true(self):
        add, memory = jnp.array([10, 20, 30]), {"a": jnp.arange(6.0).reshape(3, 2), "b": jnp.arange(3)}
        changed = jax.jit(jax.vmap(self.change_row))(self.CONDITION, add, memory)
        np.testing.assert_array_equal(changed["a"], [[0, 3], [2, 3], [12, 15]])
        np.testing.assert_array_equal(changed["b"], [10, 1, 32])
        one = jax.jit(self.change_row)(self.CONDITION[0], add[0], {"a": memory["a"][0], "b": memory["b"][0]})
        np.testing.assert_array_equal(one["b"], changed["b"][0])
        alike = jax.vmap(self.change_row, in_axes=(0, None, None))(
            self.CONDITION, 5, {"a": jnp.ones(2), "b": jnp.int32(1)}
        )
        np.testing.assert_array_equal(alike["b"], [6, 1, 6])

    def test_change_is_not_computed_if_no_row_needs_it(self):
        calls = []

        def count_call(params, memory):
            jax.debug.callback(lambda: calls.append(1))
            return memory

        for condition in (jnp.zeros(3, bool), self.CONDITION):
            jax.block_until_ready(jax.vmap(lambda c: apply_if(c, count_call, (), jnp.float32(0)))(condition))
            jax.effects_barrier()
            assert bool(calls) == bool(condition.any())


@pytest.mark.slow
def test_amago_learns_to_choose_the_rewarded_action():
    """Train on random actions with reward for action 2; a model that only imitates would act randomly."""
    options = ModelOptions(layers=1, width=16, heads=2, dropout=0.0, discounts=(0.5, 0.8))
    method = get_method("amago_offline")(options, FLAT)
    params = slow = random_parameters(method)
    optimizer = optax.adam(5e-3)

    def batch(key):
        actions = jax.random.randint(key, (8, 9), 0, 4)
        rewards = 20.0 * (actions == 2)
        none = jnp.zeros((8, 8), jnp.int32)
        obs, mask = jnp.ones((8, 8, 3)), jnp.ones((8, 8), bool)
        return ADBatch(obs, actions[:, :-1], rewards[:, :-1], actions[:, 1:], none > 0, mask)  # type: ignore[arg-type]

    @jax.jit
    def train(params, state):
        def step(carry, key):
            params, slow, state = carry
            gradient = jax.grad(lambda p: method.loss(p, slow, batch(key), None)[0])(params)
            change, state = optimizer.update(gradient, state)
            params = optax.apply_updates(params, change)
            return (params, optax.incremental_update(params, slow, 0.05), state), None

        return jax.lax.scan(step, (params, slow, state), jax.random.split(jax.random.key(3), 200))[0]

    params, slow, _ = train(params, optimizer.init(params))
    steps = batch_steps(batch(jax.random.key(9)), plain_view)
    policy = jax.nn.softmax(method.logits(apply_model(method, params, steps).head))
    assert float(policy[..., 2].mean()) > 0.9
