"""Self-play learning speed beside JaxMARL's own recurrent IPPO for OvercookedV2: `make bench-learner PEER=file`.

The peer is JaxMARL's `baselines/IPPO/ippo_rnn_overcooked_v2.py`, which its package does not contain: give the path of
a copy. Both learn on the same map with the same network, environments and hyper-parameters, in turn in one process.
What the peer imports only to log and to read its configuration (hydra, omegaconf, wandb) is left out; it also needs
distrax, from the extra `peers`.
"""

from __future__ import annotations

import importlib.util
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import jax

from benchmarks.peers import jaxmarl_environment
from generation.env import Environment
from generation.learners.population.fcp import FCP
from generation.learners.population.population import Population
from generation.learners.config import PPOConfig
from icrl4aht_data.overcooked.layouts import Layout, get_layout

_UPDATES = 2


def load_peer(path: Path) -> ModuleType:
    """The peer's file as a module."""
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


def peer_loop(module: ModuleType, layout: Layout, config: PPOConfig) -> Callable[[], None]:
    """A compiled call of the peer's own training, `_UPDATES` updates long."""
    module.jaxmarl.make = lambda name, **options: jaxmarl_environment(layout)
    table = {
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
    train = jax.jit(module.make_train(table)).lower(jax.random.PRNGKey(0)).compile()
    return lambda: jax.block_until_ready(train(jax.random.PRNGKey(0)))


def our_loop(layout: Layout, config: PPOConfig) -> Callable[[], None]:
    """The same of ours: initialisation and `_UPDATES` updates."""
    population = Population(Environment(layout), FCP(1), config)

    def whole(key):
        state = population.init(key)
        return jax.lax.scan(lambda state, _: population.update(state), state, length=_UPDATES)

    train = jax.jit(whole).lower(jax.random.key(0)).compile()
    return lambda: jax.block_until_ready(train(jax.random.key(0)))


def steps_per_second(loop: Callable[[], None], config: PPOConfig) -> float:
    started = time.perf_counter()
    loop()
    return _UPDATES * config.steps_per_update / (time.perf_counter() - started)


@click.command()
@click.option("--peer", type=click.Path(path_type=Path, exists=True, dir_okay=False), required=True)
@click.option("--layout", "layout_name", default="cramped_up", show_default=True)
@click.option("--environments", default=32, show_default=True)
@click.option("--rollout", default=64, show_default=True)
@click.option("--minibatches", default=8, show_default=True)
@click.option("--rounds", default=3, show_default=True)
def main(peer: Path, layout_name: str, environments: int, rollout: int, minibatches: int, rounds: int) -> None:
    """Environment steps/s of self-play learning at the paper's network, one JSON line."""
    layout = get_layout(layout_name)
    config = PPOConfig(environments=environments, rollout=rollout, minibatches=minibatches, warmup=0.05)
    ours, theirs = our_loop(layout, config), peer_loop(load_peer(peer), layout, config)
    pairs = [(steps_per_second(ours, config), steps_per_second(theirs, config)) for _ in range(rounds)]
    ratios = [a / b for a, b in pairs]
    line = {
        "benchmark": "learner",
        "layout": layout.name,
        "environments": environments,
        "rollout": rollout,
        "minibatches": minibatches,
        "steps_per_second": round(statistics.median(a for a, _ in pairs), 1),
        "jaxmarl_steps_per_second": round(statistics.median(b for _, b in pairs), 1),
        "ratio": round(statistics.median(ratios), 2),
        "ratio_min": round(min(ratios), 2),
        "ratio_max": round(max(ratios), 2),
    }
    click.echo(json.dumps(line))


if __name__ == "__main__":
    main()
