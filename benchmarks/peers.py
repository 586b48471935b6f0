"""Peers for benchmarks and differential tests: JaxMARL's environment on our layouts, and JaxMARL's recurrent IPPO.

The learner is JaxMARL's script `baselines/IPPO/ippo_rnn_overcooked_v2.py`. JaxMARL's package does not contain the
script, so it is loaded from a copy. Modules that the script imports only for logging and configuration (hydra,
omegaconf, wandb) are replaced by stubs. The script also needs distrax, from the extra `peers`.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import jax
from icrl4aht_generation.learners.config import PPOConfig

from benchmarks.harness import compiled_call
from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked.layouts import Layout

with redirect_stdout(sys.stderr):  # JaxMARL prints when it is imported
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv
    from jaxmarl.environments.overcooked_v2.layouts import Layout as PeerLayout
    from jaxmarl.environments.overcooked_v2.overcooked import OvercookedV2


def jaxmarl_environment(layout: Layout, max_steps: int = EPISODE_STEPS) -> OvercookedV2:
    """Return JaxMARL's OvercookedV2 environment on the map of a layout, with the benchmark's options."""
    return OvercookedV2(
        PeerLayout.from_string("\n".join(layout.rows), possible_recipes=[list(r) for r in layout.recipes]),
        max_steps=max_steps,
        agent_view_size=2,
        random_agent_positions=True,
        negative_rewards=True,
        sample_recipe_on_delivery=True,
        indicate_successful_delivery=layout.indicates_delivery,
    )


def jaxmarl_training(script: Path, env: MultiAgentEnv, config: PPOConfig, updates: int) -> Callable[[], Any]:
    """Return a compiled function that trains JaxMARL's IPPO from the start and waits for the result.

    The result is that of the script's function `train`.

    Args:
        script: path of a copy of JaxMARL's script.
        env: environment to train in, instead of the one that the script makes.
        config: hyper-parameters of the training.
        updates: number of updates.

    Raises:
        click.UsageError: if `script` is not a Python file.
    """
    module = _load_script(script)
    module.jaxmarl.make = lambda name, **options: env
    options = {
        "ENV_NAME": "overcooked_v2",
        "ENV_KWARGS": {},
        "LR": config.learning_rate,
        "ANNEAL_LR": True,
        "LR_WARMUP": config.warmup,
        "NUM_ENVS": config.environments,
        "NUM_STEPS": config.rollout,
        "UPDATE_EPOCHS": config.epochs,
        "NUM_MINIBATCHES": config.minibatches,
        "TOTAL_TIMESTEPS": updates * config.steps_per_update,
        "REW_SHAPING_HORIZON": config.shaping_horizon,
        "FC_DIM_SIZE": config.widths.head,
        "GRU_HIDDEN_DIM": config.widths.gru,
        "CLIP_EPS": config.clip,
        "ENT_COEF": config.entropy,
        "GAMMA": config.discount,
        "GAE_LAMBDA": config.gae_lambda,
        "SCALE_CLIP_EPS": False,
        "VF_COEF": config.value,
        "MAX_GRAD_NORM": config.max_grad_norm,
        "ACTIVATION": "relu",
    }
    return compiled_call(module.make_train(options), jax.random.PRNGKey(0))


def _load_script(path: Path) -> ModuleType:
    """Import our copy of JaxMARL's training script as a module."""
    silent: Any = ModuleType("silent")
    silent.main = lambda **_: lambda function: function
    silent.log = lambda metric: None
    silent.OmegaConf = None
    for name in ("hydra", "omegaconf", "wandb"):
        sys.modules.setdefault(name, silent)
    spec = importlib.util.spec_from_file_location("jaxmarl_ippo", path)
    if spec is None or spec.loader is None:
        raise click.UsageError(f"{path}: not a Python file, expected a copy of JaxMARL's script")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
