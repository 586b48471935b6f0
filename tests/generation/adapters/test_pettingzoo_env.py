"""Test the PettingZoo environment of both agents: PettingZoo's checks, and replays of recorded histories."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from icrl4aht_generation.adapters.pettingzoo_env import BothAgentsEnv
from pettingzoo.test import parallel_api_test, parallel_seed_test

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.observe import observe_both


@pytest.mark.parametrize("channels", ["own", "canonical"])
def test_environment_passes_the_parallel_api_test_of_pettingzoo(channels):
    parallel_api_test(BothAgentsEnv("coord_simple", max_steps=30, channels=channels), num_cycles=100)


def test_environment_passes_the_seed_test_of_pettingzoo():
    parallel_seed_test(lambda: BothAgentsEnv("coord_simple"))


def test_recorded_actions_of_both_agents_reproduce_states_and_rewards():
    history = load_icrl4aht(layout="cramped_up", source="noise")[0]
    env = BothAgentsEnv("cramped_up", render_mode="rgb_array")
    first = 100 * int(history.returns().argmax())
    observations, _ = env.reset(options={"state": history.state[first]})
    pairs = zip(history.actions[first : first + 100], history.teammate_actions[first : first + 100], strict=True)
    delivered = np.flatnonzero(history.rewards[first : first + 100] > 0)
    assert len(delivered)
    # States are compared up to the first delivery, after which a new recipe is drawn.
    for t, (ego, teammate) in enumerate(pairs):
        if t > delivered[0]:
            break
        np.testing.assert_array_equal(env.state(), history.state[first + t])
        both = observe_both(env.layout, env.state()[None])[0]
        np.testing.assert_array_equal([observations["ego"], observations["teammate"]], both)
        observations, rewards, _, truncations, infos = env.step({"ego": ego, "teammate": teammate})
        assert rewards == dict.fromkeys(("ego", "teammate"), history.rewards[first + t])
        assert infos.keys() == {"ego", "teammate"} and not any(truncations.values())
    picture = env.render()
    assert picture is not None and picture.shape[2] == 3


def test_wrong_use_of_two_agent_environment_raises_errors():
    env = BothAgentsEnv("demo_wide", max_steps=1)
    assert repr(env) == "BothAgentsEnv(demo_wide, episodes of 1 step)"
    with pytest.raises(OptionError, match="call reset"):
        env.step({"ego": 0, "teammate": 0})
    with pytest.raises(OptionError, match="call reset"):
        env.state()
    env.reset(seed=0)
    with pytest.raises(OptionError, match=r"expected actions of ego and teammate, found \['ego'\]"):
        env.step({"ego": 0})
    with pytest.raises(OptionError, match=r"action of teammate: expected 0\.\.5"):
        env.step({"ego": 0, "teammate": 6})
    with pytest.raises(OptionError, match="state: expected integers"):
        env.reset(options={"state": [0]})
    env.step({"ego": 4, "teammate": 4})
    with pytest.raises(OptionError, match="no episode is running"):
        env.step({"ego": 4, "teammate": 4})
    wrong_options: list[dict[str, Any]] = [{"layout": "nowhere"}, {"channels": "all"}, {"render_mode": "human"}]
    for wrong in wrong_options:
        with pytest.raises(UnknownNameError, match=f"unknown {next(iter(wrong))}"):
            BothAgentsEnv(**{"layout": "demo_wide", **wrong})
    with pytest.raises(OptionError, match="max_steps = 0"):
        BothAgentsEnv("demo_wide", max_steps=0)
