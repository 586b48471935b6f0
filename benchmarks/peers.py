"""Peers for benchmarks and differential tests: JaxMARL's environment on our layouts, and JaxMARL's recurrent IPPO.

The learner is JaxMARL's script `baselines/IPPO/ippo_rnn_overcooked_v2.py`. JaxMARL's package does not contain the
script, so it is loaded from a copy. Modules that the script imports only for logging and configuration (hydra,
omegaconf, wandb) are replaced by stubs while it is loaded. The script also needs distrax, from the extra `peers`.
"""

from __future__ import annotations

import runpy
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


def jaxmarl_environment(layout: Layout) -> OvercookedV2:
    """Return JaxMARL's OvercookedV2 environment on the map of a layout, with the benchmark's options."""
    return OvercookedV2(
        PeerLayout.from_string("\n".join(layout.rows), possible_recipes=[list(r) for r in layout.recipes]),
        max_steps=EPISODE_STEPS,
        agent_view_size=2,
        random_agent_positions=True,
        negative_rewards=True,
        sample_recipe_on_delivery=True,
        indicate_successful_delivery=layout.indicates_delivery,
    )


def jaxmarl_training(script: Path, env: MultiAgentEnv, config: PPOConfig, updates: int) -> Callable[[], Any]:
    """Return a compiled function that trains JaxMARL's IPPO from the start and waits for the result.

    A call of the function returns the result of the script's function `train`.

    Args:
        script: path of a copy of JaxMARL's script.
        env: environment to train in, instead of the one that the script makes.
        config: hyper-parameters of the training.
        updates: number of updates.

    Raises:
        click.UsageError: if `script` is not a Python file.
    """
    defined = _load_script(script)
    defined["jaxmarl"].make = lambda name, **options: env
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
    return compiled_call(defined["make_train"](options), jax.random.PRNGKey(0))


def _load_script(path: Path) -> dict[str, Any]:
    """Run a copy of JaxMARL's training script, and return the names that the script defines."""
    if path.suffix != ".py":
        raise click.UsageError(f"{path}: not a Python file, expected a copy of JaxMARL's script")
    silent: Any = ModuleType("silent")
    silent.main = lambda **_: lambda function: function
    silent.log = lambda metric: None
    silent.OmegaConf = None
    stubs = {"hydra", "omegaconf", "wandb"} - sys.modules.keys()
    sys.modules.update((name, silent) for name in stubs)
    try:
        return runpy.run_path(str(path))
    finally:
        for name in stubs:
            del sys.modules[name]
