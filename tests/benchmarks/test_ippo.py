"""JaxMARL's interface under IPPO: the benchmark's learner and JaxMARL's own do 10 updates on our environment."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from icrl4aht_generation.adapters.jaxmarl_env import JaxMARLEnv
from icrl4aht_generation.learners.config import PPOConfig
from jaxmarl.environments import spaces
from jaxmarl.environments.multi_agent_env import MultiAgentEnv

from benchmarks import bench_env
from benchmarks.ippo import train_ippo
from benchmarks.peers import jaxmarl_training

UPDATES, STEPS = 10, 8
PEER = os.environ.get("PEER", "")
"""Path of a copy of JaxMARL's `ippo_rnn_overcooked_v2.py`, which its package does not contain."""


def config(environments: int) -> PPOConfig:
    return PPOConfig(
        total_steps=UPDATES * STEPS * environments,
        environments=environments,
        rollout=STEPS,
        minibatches=2,
        learning_rate=0.02,
    )


class Bandit(MultiAgentEnv):
    """Both agents earn 1 for action 3 and nothing else, in episodes of one step."""

    def __init__(self) -> None:
        super().__init__(num_agents=2)
        self.agents = ["a", "b"]
        self.action_spaces = dict.fromkeys(self.agents, spaces.Discrete(6))

    def reset(self, key: Any) -> Any:  # type: ignore[override]
        return dict.fromkeys(self.agents, jnp.ones((5, 5, 1))), jnp.int32(0)

    def step_env(self, key: Any, state: Any, actions: Any) -> Any:
        earned = {agent: (action == 3) * 1.0 for agent, action in actions.items()}
        done = dict.fromkeys([*self.agents, "__all__"], jnp.bool_(True))
        return self.reset(key)[0], state, earned, done, {"shaped_reward": dict.fromkeys(self.agents, 0.0)}


@pytest.mark.slow
def test_the_learner_learns():
    _, log = jax.jit(train_ippo(Bandit(), config(32)))(jax.random.key(0))
    assert log.reward[0] < 0.4
    assert log.reward[-1] > 0.9
    assert (log.episodes == 32 * STEPS).all()


@pytest.mark.slow
def test_ten_updates_on_our_environment():
    env = JaxMARLEnv("cramped_up", max_steps=20)
    params, log = jax.jit(train_ippo(env, config(4)))(jax.random.key(1))
    assert log.loss.shape == (UPDATES,)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((params, log)))
    # 80 steps of 4 environments are 4 episodes of each; they end in steps 20, 40, 60 and 80.
    np.testing.assert_array_equal(log.episodes, [0, 0, 4, 0, 4, 0, 0, 4, 0, 4])
    assert log.entropy[0] == pytest.approx(np.log(6), abs=0.05) and log.entropy[-1] < log.entropy[0]


@pytest.mark.slow
@pytest.mark.skipif(not PEER, reason="needs PEER, the path of a copy of JaxMARL's ippo_rnn_overcooked_v2.py")
def test_ten_updates_of_jaxmarls_script_on_our_environment(monkeypatch):
    pytest.importorskip("distrax", reason="needs the extra peers")
    monkeypatch.setattr("jaxmarl.make", None)  # restored after the test
    env = JaxMARLEnv("cramped_up", max_steps=20)
    trained = jaxmarl_training(Path(PEER), env, config(4), UPDATES)()
    np.testing.assert_array_equal(trained["metrics"]["update_step"], np.arange(1, UPDATES + 1))
    params = trained["runner_state"][0].params
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
    assert trained["metrics"]["env_step"][-1] == UPDATES * STEPS * 4


SCRIPT = """
import hydra, jax, jaxmarl, wandb
from omegaconf import OmegaConf

def make_train(config):
    env = jaxmarl.make(config["ENV_NAME"], **config["ENV_KWARGS"])
    print("training", env.name, config["TOTAL_TIMESTEPS"], config["NUM_ENVS"])

    def train(rng):
        obs, state = env.reset(rng)
        return env.step(rng, state, dict.fromkeys(env.agents, 0))[2]["agent_0"]

    return train

@hydra.main(version_base=None)
def main(config):
    wandb.log(OmegaConf)
"""


@pytest.mark.slow
@pytest.mark.parametrize("own_script", [False, True])
def test_the_benchmark_compares_both_environments(tmp_path, monkeypatch, own_script):
    """Both environments are passed to the script of `--peer`: here a small one, as JaxMARL's package has none."""
    monkeypatch.setattr("jaxmarl.make", None)  # restored after the test
    script = tmp_path / "ippo.py"
    script.write_text(SCRIPT)
    options = [
        "--part",
        "ippo",
        "--layout",
        "cramped_up",
        "--ippo-environments",
        "2",
        "--rollout",
        "4",
        "--rounds",
        "1",
    ]
    options += ["--peer", str(script)] * own_script
    result = CliRunner().invoke(bench_env.main, options, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    *said, last = result.stdout.splitlines()
    line = json.loads(last)
    assert (line["part"], line["updates"], line["environments"]) == ("ippo", 10, 2)
    assert line["learner"] == ("ippo.py" if own_script else "benchmarks.ippo")
    assert line["steps_per_second"] > 0 and line["jaxmarl_steps_per_second"] > 0 and line["ratio"] > 0
    if own_script:
        assert said == ["training icrl4aht_cramped_up 80 2", "training Overcooked V2 80 2"]
