"""Test rollouts: agent slots, observations, memories that restart with each episode, and a restart hook.

Four environments have episodes of five steps. Two scripted players share the eight slots in mixed order; each
remembers the state record at the start of the episode and the number of steps since.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.rollout import (
    Choice,
    Player,
    Rollout,
    RolloutCarry,
    init_rollout,
    network_player,
    policy_player,
    roll_out,
    slot_records,
)
from icrl4aht_generation.policy import Policy

from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from tests.helpers.states import random_records

LAYOUT = get_layout("cramped_up")
ENVS, EPISODE, STEPS = 4, 5, 8
ENV = Environment(LAYOUT, max_steps=EPISODE)
SLOTS = np.array([5, 0, 3, 6]), np.array([2, 7, 4, 1])
"""Agent slots of the two scripted players: in some environments both agents have the same player."""

NETWORK = ActorCritic(Widths(pointwise=(4,), spatial=(4,), dense=8, gru=8, head=8), partners=3)


class ScriptMemory(NamedTuple):
    """Memory of a scripted player with M slots."""

    begun: jax.Array  # shape (M, S), state record at the start of the episode
    steps: jax.Array  # shape (M,), number of steps in the episode


def scripted_player(slots: np.ndarray) -> Player:
    """Return a player whose actions depend on the slot, the step and the record at the start of the episode."""

    def begin(state: EnvState) -> ScriptMemory:
        return ScriptMemory(state.record[slots % ENVS], jnp.zeros(slots.size, jnp.int32))

    def act(memory: ScriptMemory, state: EnvState, key):
        action = (slots + 2 * memory.steps + memory.begun.sum(axis=1, dtype=jnp.int32)) % len(ACTIONS)
        value = memory.steps.astype(jnp.float32)
        return Choice(jnp.asarray(action), jnp.full(slots.size, -1.0), value), memory._replace(steps=memory.steps + 1)

    return Player(slots, begin, act)


def expected_actions(record: np.ndarray) -> np.ndarray:
    """Return the scripted players' actions in a rollout that starts with new episodes, int of shape (T, N, 2)."""
    slot = np.arange(2 * ENVS).reshape(2, ENVS).T
    step = np.arange(len(record))
    begun = record[step - step % EPISODE].sum(axis=-1, dtype=np.int64)
    return (slot + 2 * (step % EPISODE)[:, None, None] + begun[..., None]) % len(ACTIONS)


def swap_positions(state: EnvState, done: jax.Array) -> EnvState:
    """Swap the agents' positions in environments that start an episode; this is a restart hook."""
    first = state.record.at[:, :2].set(state.record[:, 1::-1])
    return state._replace(record=jnp.where(done[:, None], first, state.record))


class JoinedRollouts(NamedTuple):
    start: RolloutCarry
    carry: RolloutCarry  # state after the last step
    rollout: Rollout  # steps of both rollouts


PLAYERS = [scripted_player(slots) for slots in SLOTS]
scripted_rollout = jax.jit(lambda carry, key: roll_out(ENV, PLAYERS, carry, STEPS, key))


def play(run: Any) -> JoinedRollouts:
    """Return two successive rollouts joined into one, as NumPy arrays."""
    start = init_rollout(ENV, PLAYERS, jax.random.split(jax.random.key(0), ENVS))
    middle, one = run(start, jax.random.key(1))
    carry, other = run(middle, jax.random.key(2))
    return JoinedRollouts(start, carry, jax.tree.map(lambda *parts: np.concatenate(parts), one, other))


@pytest.fixture(scope="module")
def joined_rollouts() -> JoinedRollouts:
    return play(scripted_rollout)


@pytest.fixture(scope="module")
def played_with_hook() -> JoinedRollouts:
    return play(jax.jit(lambda carry, key: roll_out(ENV, PLAYERS, carry, STEPS, key, swap_positions)))


@pytest.fixture(scope="module")
def params() -> Any:
    """Return random parameters of three policies, in leaves of shape (3, ...).

    Action probabilities are far from uniform.
    """
    shapes = jax.eval_shape(lambda key: NETWORK.untrained(key, LAYOUT.channels), jax.random.key(0))
    rng = np.random.default_rng(4)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=(3, *leaf.shape)), jnp.float32) * 0.4, shapes)


@pytest.fixture(scope="module")
def apply():
    """Return a function that applies the network for one step in M slots."""

    def apply(params, hidden, obs, partner):
        outputs: Any = NETWORK.apply(params, hidden, obs[None], jnp.zeros((1, obs.shape[0]), bool), partner)
        return outputs[0], outputs[1][0], outputs[2][0]

    return jax.jit(apply)


def env_state(record: np.ndarray) -> EnvState:
    """Return states of environments that have the given records and took one step of their first episode."""
    clock = jnp.ones(len(record), jnp.int32)
    return EnvState(jax.random.split(jax.random.key(0), len(record)), 0 * clock, clock, jnp.asarray(record))


def policy_params(params: Any, policy: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[policy], params)


def test_actions_of_players_reach_their_agent_slots(joined_rollouts):
    np.testing.assert_array_equal(joined_rollouts.rollout.actions, expected_actions(joined_rollouts.rollout.record))
    for choice, slots in zip(joined_rollouts.rollout.choices, SLOTS, strict=True):
        agent, env = np.divmod(slots, ENVS)
        np.testing.assert_array_equal(choice.action, joined_rollouts.rollout.actions[:, env, agent])


def test_roll_out_equals_single_steps_of_the_environment(joined_rollouts):
    """Compare a rollout with a loop over steps of the environment."""
    step = jax.jit(ENV.step)
    state = joined_rollouts.start.env
    for t, actions in enumerate(joined_rollouts.rollout.actions):
        np.testing.assert_array_equal(joined_rollouts.rollout.record[t], state.record)
        outcome = step(state, actions)
        np.testing.assert_array_equal(joined_rollouts.rollout.reward[t], outcome.reward)
        np.testing.assert_array_equal(joined_rollouts.rollout.shaped[t], outcome.shaped)
        np.testing.assert_array_equal(joined_rollouts.rollout.done[t], outcome.done)
        state = outcome.state
    np.testing.assert_array_equal(joined_rollouts.carry.env.record, state.record)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_slot_records_give_each_agent_its_own_observation(batch):
    slots = np.array([7, 0, 3, 4, 5, 4])
    rng = np.random.default_rng(8)
    record = random_records(LAYOUT, 12, rng).reshape(3, ENVS, -1)[(0,) if batch == () else slice(None)]
    own = observe(LAYOUT, np.asarray(slot_records(jnp.asarray(record), slots)), EGO)
    assert own.shape[:-3] == (*batch, 6)
    differ = 0
    for m, slot in enumerate(slots):
        in_env = record[..., slot % ENVS, :]
        agent = TEAMMATE if slot >= ENVS else EGO
        np.testing.assert_array_equal(own[..., m, :, :, :], observe(LAYOUT, in_env, agent))
        differ += np.any(own[..., m, :, :, :] != observe(LAYOUT, in_env, 1 - agent))
    assert differ == len(slots)


def test_players_restart_only_in_environments_whose_episode_ended():
    """The third environment starts at step 2 of its episode, and the others start at step 0."""
    clock = np.array([0, 0, 2, 0])
    start = init_rollout(ENV, PLAYERS, jax.random.split(jax.random.key(0), ENVS))
    start = start._replace(env=start.env._replace(clock=jnp.asarray(clock)))
    carry, rollout = scripted_rollout(start, jax.random.key(1))
    np.testing.assert_array_equal(rollout.done, (np.arange(STEPS)[:, None] + clock) % EPISODE == EPISODE - 1)
    for notes, slots in zip(carry.memories, SLOTS, strict=True):
        np.testing.assert_array_equal(notes.steps, (clock[slots % ENVS] + STEPS) % EPISODE)


def test_returns_add_up_rewards_of_an_episode_across_rollouts(joined_rollouts):
    """The environment's rewards are replaced by synthetic ones, since scripted play earns few rewards."""

    class SyntheticRewards(Environment):
        def step(self, state, actions):
            return super().step(state, actions)._replace(reward=(actions.sum(axis=1) + state.clock).astype(jnp.float32))

    run = jax.jit(lambda carry, key: roll_out(SyntheticRewards(LAYOUT, EPISODE), PLAYERS, carry, STEPS, key))
    middle, first = run(joined_rollouts.start, jax.random.key(1))
    after, second = run(middle, jax.random.key(2))
    reward, returns = (
        np.concatenate([a, b]) for a, b in ((first.reward, second.reward), (first.returns, second.returns))
    )
    assert len(np.unique(reward)) > 5
    for start in (0, 5, 10):
        np.testing.assert_array_equal(returns[start : start + 5], reward[start : start + 5].cumsum(axis=0))
    np.testing.assert_array_equal(after.returns, reward[15])


def test_restart_hook_changes_only_first_states_of_episodes(joined_rollouts, played_with_hook):
    first, rollout = joined_rollouts.rollout.record, played_with_hook.rollout
    # The hook is not called before the first episode.
    np.testing.assert_array_equal(rollout.record[:EPISODE], first[:EPISODE])
    for start in (5, 10, 15):
        swapped_positions = first[start].copy()
        swapped_positions[:, :2] = first[start, :, 1::-1]
        np.testing.assert_array_equal(rollout.record[start], swapped_positions)


def test_players_start_with_the_state_after_the_restart_hook(played_with_hook):
    np.testing.assert_array_equal(played_with_hook.rollout.actions, expected_actions(played_with_hook.rollout.record))
    for notes, slots in zip(played_with_hook.carry.memories, SLOTS, strict=True):
        np.testing.assert_array_equal(notes.begun, played_with_hook.rollout.record[15][slots % ENVS])


@pytest.mark.parametrize("greedy", [True, False])
def test_network_player_gives_the_outputs_of_its_network(params, apply, greedy):
    """Compare the player's choices and next hidden states with a call of the network, from a nonzero hidden state."""
    slots, partner = np.array([6, 1, 3, 4]), jnp.array([2, 0, 1, 1])
    own = policy_params(params, 1)
    player = network_player(ENV, NETWORK, own, slots, partner, greedy)
    record = random_records(LAYOUT, ENVS, np.random.default_rng(3))
    state = env_state(record)
    hidden = jnp.asarray(np.random.default_rng(5).normal(size=(4, 8)), jnp.float32)
    np.testing.assert_array_equal(player.init(state), np.zeros((4, 8)))
    choice, after = jax.jit(player.act)(hidden, state, jax.random.key(6))

    both = np.stack([observe(LAYOUT, record, agent) for agent in (EGO, TEAMMATE)])
    expected, logits, value = apply(own, hidden, both[slots // ENVS, slots % ENVS], partner)
    logits = np.asarray(logits, np.float64)
    log_probs = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    if greedy:
        np.testing.assert_array_equal(choice.action, logits.argmax(axis=1))
    np.testing.assert_allclose(choice.log_prob, log_probs[np.arange(4), choice.action], rtol=0, atol=1e-5)
    np.testing.assert_allclose(choice.value, value, rtol=0, atol=1e-5)
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-5)


def test_player_of_several_policies_equals_separate_players(params):
    slots = np.array([[6, 1], [3, 4], [0, 7]])
    partner = jnp.array([[2, 0], [1, 1], [0, 2]])
    record = random_records(LAYOUT, ENVS, np.random.default_rng(3))
    state = env_state(record)
    hidden = jnp.asarray(np.random.default_rng(5).normal(size=(6, 8)), jnp.float32)
    together = network_player(ENV, NETWORK, params, slots, partner, greedy=True)
    np.testing.assert_array_equal(together.agent_slots, slots.ravel())
    choice, after = jax.jit(together.act)(hidden, state, jax.random.key(0))
    for policy in range(3):
        alone = network_player(ENV, NETWORK, policy_params(params, policy), slots[policy], partner[policy], greedy=True)
        part = slice(2 * policy, 2 * policy + 2)
        own, own_after = jax.jit(alone.act)(hidden[part], state, jax.random.key(0))
        np.testing.assert_array_equal(choice.action[part], own.action)
        np.testing.assert_allclose(choice.log_prob[part], own.log_prob, rtol=0, atol=1e-5)
        np.testing.assert_allclose(choice.value[part], own.value, rtol=0, atol=1e-5)
        np.testing.assert_allclose(after[part], own_after, rtol=0, atol=1e-5)


def test_policy_player_can_have_parameters_for_each_environment():
    """Actions depend on the policy's parameters and on the episode's key, which differs between environments."""

    def begin(params, key):
        return jax.random.key_data(key)[1] % 5

    policy = Policy({}, begin, lambda params, memory, view, key: ((params["action"] + memory) % 6, memory), "state")
    own = policy_player(ENV, policy, {"action": jnp.arange(ENVS)}, TEAMMATE, ENVS, own_params=True)
    common = policy_player(ENV, policy, {"action": jnp.int32(3)}, EGO, ENVS)
    np.testing.assert_array_equal(own.agent_slots, np.arange(ENVS, 2 * ENVS))
    np.testing.assert_array_equal(common.agent_slots, np.arange(ENVS))
    state = env_state(random_records(LAYOUT, ENVS, np.random.default_rng(7)))
    for player, action, agent in ((own, np.arange(ENVS), TEAMMATE), (common, 3, EGO)):
        keys = jax.vmap(jax.random.fold_in)(ENV.episode_key(state), jnp.full(ENVS, agent))
        memory = np.asarray(jax.random.key_data(keys))[:, 1] % 5
        choice, _ = player.act(player.init(state), state, jax.random.key(0))
        np.testing.assert_array_equal(choice.action, (action + memory) % 6)


def test_policy_player_receives_the_observation_of_its_agent():
    policy = Policy(
        {}, lambda params, key: (), lambda params, memory, view, key: (view.sum(dtype=int), ()), "observation"
    )
    record = random_records(LAYOUT, ENVS, np.random.default_rng(11))
    state = env_state(record)
    sums = []
    for agent in (EGO, TEAMMATE):
        player = policy_player(ENV, policy, {}, agent, ENVS)
        sums.append(np.asarray(jax.jit(player.act)((), state, jax.random.key(0))[0].action))
        np.testing.assert_array_equal(sums[-1], observe(LAYOUT, record, agent).sum(axis=(1, 2, 3)))
    assert (sums[0] != sums[1]).any()
