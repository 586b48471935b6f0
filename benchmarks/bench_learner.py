"""Self-play learning speed compared with JaxMARL's recurrent IPPO for OvercookedV2: `make bench-learner PEER=file`.

The peer is JaxMARL's `baselines/IPPO/ippo_rnn_overcooked_v2.py`, which its package does not contain: give the path of
a copy. Both learn on the same map with the same network, environments and hyper-parameters, in turn in one process.
Modules that the peer imports only for logging and configuration (hydra, omegaconf, wandb) are replaced by stubs; it
also needs distrax, from the extra `peers`.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import jax

from benchmarks.common import print_line, rates_in_turn, ratio_facts
from benchmarks.peers import jaxmarl_environment
from generation.env import Environment
from generation.learners.config import PPOConfig
from generation.learners.population.fcp import FCP
from generation.learners.population.population import Population
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_UPDATES = 2


def load_peer(path: Path) -> ModuleType:
    """Import the peer's file as a module."""
    silent: Any = ModuleType("silent")
    silent.main = lambda **_: lambda function: function
    silent.log = lambda metric: None
    silent.OmegaConf = None
    for name in ("hydra", "omegaconf", "wandb"):
        sys.modules.setdefault(name, silent)
    spec = importlib.util.spec_from_file_location("jaxmarl_ippo", path)
    if spec is None or spec.loader is None:
        raise click.UsageError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def peer_training(module: ModuleType, layout: Layout, config: PPOConfig) -> Callable[[], None]:
    """A compiled call of the peer's training: initialisation and `_UPDATES` updates."""
    module.jaxmarl.make = lambda name, **options: jaxmarl_environment(layout)
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
        "TOTAL_TIMESTEPS": _UPDATES * config.steps_per_update,
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
    train = jax.jit(module.make_train(options)).lower(jax.random.PRNGKey(0)).compile()
    return lambda: jax.block_until_ready(train(jax.random.PRNGKey(0)))


def our_training(layout: Layout, config: PPOConfig) -> Callable[[], None]:
    """A compiled call of our training: initialisation and `_UPDATES` updates."""
    population = Population(Environment(layout), FCP(1), config)

    def train_through(key):
        state = population.init(key)
        return jax.lax.scan(lambda state, _: population.update(state), state, length=_UPDATES)

    train = jax.jit(train_through).lower(jax.random.key(0)).compile()
    return lambda: jax.block_until_ready(train(jax.random.key(0)))


@click.command()
@click.option("--peer", type=click.Path(path_type=Path, exists=True, dir_okay=False), required=True)
@click.option("--layout", "layout_name", default="cramped_up", show_default=True)
@click.option("--environments", type=COUNT, default=32, show_default=True)
@click.option("--rollout", type=COUNT, default=64, show_default=True)
@click.option("--minibatches", type=COUNT, default=8, show_default=True)
@click.option("--rounds", type=COUNT, default=3, show_default=True)
def main(peer: Path, layout_name: str, rounds: int, **sizes: int) -> None:
    """Compare environment steps/s of self-play learning with the paper's network; one JSON line."""
    layout, config = get_layout(layout_name), replace(PPOConfig(), warmup=0.05, **sizes)
    ours, theirs = our_training(layout, config), peer_training(load_peer(peer), layout, config)
    pairs = rates_in_turn(ours, theirs, _UPDATES * config.steps_per_update, rounds)
    print_line("learner", layout=layout.name, **sizes, **ratio_facts(pairs, "jaxmarl", 1, 2))


if __name__ == "__main__":
    main()
