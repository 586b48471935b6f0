"""Test the environment that has JaxMARL's interface: base class, log wrapper, and equality with our environment."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.adapters.jaxmarl_env import JaxMARLEnv
from icrl4aht_generation.env import Environment
from jaxmarl.environments.multi_agent_env import MultiAgentEnv
from jaxmarl.wrappers.baselines import LogWrapper

from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe_both

N, STEPS, LENGTH = 4, 30, 12


def test_environment_implements_the_base_class_of_jaxmarl():
    """Every abstract method of JaxMARL's base class is implemented, and returns values within the declared spaces."""
    env = JaxMARLEnv("demo_wide", channels="canonical")
    assert isinstance(env, MultiAgentEnv)
    obs, state = env.reset(jax.random.PRNGKey(0))
    assert obs.keys() == env.get_avail_actions(state).keys() == set(env.agents) == {"agent_0", "agent_1"}
    for agent in env.agents:
        assert obs[agent].shape == env.observation_space(agent).shape == (5, 5, 46)
        assert env.observation_space(agent).contains(obs[agent])
        assert env.action_space(agent).n == env.num_actions == len(env.get_avail_actions(state)[agent])
        assert env.action_space(agent).contains(env.action_space(agent).sample(jax.random.PRNGKey(1)))
    assert env.agent_classes == {"chef": env.agents}
    assert env.name == "icrl4aht_demo_wide"


@pytest.mark.slow
def test_jaxmarl_training_loop_reproduces_steps_of_our_environment():
    """Use the loop of JaxMARL's IPPO: the log wrapper, `vmap` over environments and `scan` over steps."""
    env, layout = JaxMARLEnv("cramped_up", max_steps=LENGTH), get_layout("cramped_up")
    logged = LogWrapper(env, replace_info=False)
    keys = jax.random.split(jax.random.PRNGKey(3), N)
    actions = np.random.default_rng(0).integers(0, 6, (STEPS, N, 2))

    def step(state, inputs) -> Any:
        key, both = inputs
        by_agent = {agent: both[:, slot] for slot, agent in enumerate(env.agents)}
        obs, after, reward, done, info = jax.vmap(logged.step)(jax.random.split(key, N), state, by_agent)
        return after, (obs, after.env_state, reward, done, info)

    first, state = jax.jit(jax.vmap(logged.reset))(keys)
    inputs = jax.random.split(jax.random.PRNGKey(4), STEPS), jnp.asarray(actions)
    _, (obs, states, rewards, dones, info) = jax.jit(lambda s: jax.lax.scan(step, s, inputs))(state)

    ours = Environment(layout)
    running = ours.init(keys)
    play = jax.jit(lambda state, both: rules.step(layout, state.record, both, ours.next_recipe(state)))
    np.testing.assert_array_equal(first["agent_1"], observe_both(layout, running.record)[:, 1])
    for t in range(LENGTH - 1):
        outcome = play(running, jnp.asarray(actions[t]))
        running = running._replace(clock=running.clock + 1, record=outcome.state)
        np.testing.assert_array_equal(states.record[t], outcome.state)
        np.testing.assert_array_equal(rewards["agent_0"][t], outcome.reward)
        np.testing.assert_array_equal(rewards["agent_1"][t], outcome.reward)
        for slot, agent in enumerate(env.agents):
            np.testing.assert_array_equal(obs[agent][t], observe_both(layout, outcome.state)[:, slot])
            np.testing.assert_array_equal(info["shaped_reward"][agent][t], outcome.shaped[:, slot])
    expected = np.broadcast_to((np.arange(1, STEPS + 1) % LENGTH == 0)[:, None], (STEPS, N))
    np.testing.assert_array_equal(dones["__all__"], expected)
    np.testing.assert_array_equal(info["returned_episode"][..., 0], expected)
    np.testing.assert_array_equal(states.step[:, 0], np.arange(1, STEPS + 1) % LENGTH)
