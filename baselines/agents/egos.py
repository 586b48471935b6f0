"""Egos: the protocol, those that need no training, trained models, and the adapter for agents outside JAX."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from baselines.agents.oracle import oracle
from baselines.methods.method import Method
from baselines.methods.tokens import step_of
from generation.policy import Policy
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.overcooked.actions import ACTIONS, STAY
from icrl4aht_data.overcooked.layouts import Layout

if TYPE_CHECKING:
    from baselines.training.histories import Trained

Acting = Literal["cached", "exact"]
ACTING: tuple[Acting, ...] = ("cached", "exact")
"""How a model remembers: what it computed of each step is kept, or everything is computed anew from the window. The
same while the window is not full; from then on what is kept bears traces of steps that have left it."""


def stay(layout: Layout) -> Policy:
    """Always stays: what a cell of the benchmark gives without an ego."""
    return Policy((), lambda params, key: (), lambda params, carry, view, key: (jnp.int32(STAY), carry), "observation")


def random(layout: Layout) -> Policy:
    """Uniform over the six actions: the paper's `Rnd` column."""

    def act(params, carry, view, key):
        return jax.random.randint(key, (), 0, len(ACTIONS)), carry

    return Policy((), lambda params, key: (), act, "observation")


def learned(method: Method, params: Any, context: int, acting: Acting = "cached", greedy: bool = True) -> Policy:
    """The ego of a trained model; its memory lives through the task.

    Args:
        method: as it was trained.
        params: float32.
        context: K, the steps or transitions that it remembers.
        acting: see `ACTING`.
        greedy: the likeliest action, as published; otherwise one drawn from the policy.
    """
    if acting not in ACTING:
        raise unknown("acting", acting, ACTING)

    def act(params: Any, memory: Any, percept: Any, key: Any) -> tuple[Any, Any]:
        logits, memory = method.act(params, step_of(percept), percept.prev_done, memory)
        action = logits.argmax() if greedy else jax.random.categorical(key, logits)
        return action.astype(jnp.int32), memory

    return Policy(params, lambda params, key: method.start(context, acting == "cached"), act, "percept")


AGENTS: dict[str, Callable[[Layout], Policy]] = {"stay": stay, "random": random, "oracle": oracle}
"""Name -> maker of the ego for a layout."""


class Agent(NamedTuple):
    """An ego by name."""

    name: str  # as tables show it
    make: Callable[[Layout], Policy]
    details: dict[str, Any] | None = None  # what results depend on beside the name


def get_agent(name: str) -> Callable[[Layout], Policy]:
    """The maker of that name.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    if name not in AGENTS:
        raise unknown("agent", name, AGENTS)
    return AGENTS[name]


def find_agent(name: str, acting: Acting = "cached") -> Agent:
    """The ego of that name, or of that run folder, which `python -m baselines train` made.

    Raises:
        UnknownNameError: for what is neither.
        OptionError: if the run is of another format or has no checkpoint; from `make`, if it does not fit the layout.
    """
    if name not in AGENTS and Path(name).is_dir():
        return _of_run(Path(name), acting)
    return Agent(name, get_agent(name))


def _of_run(folder: Path, acting: Acting) -> Agent:
    from baselines.training.histories import read_trained

    run = read_trained(folder)
    policy = learned(run.method, run.params, run.context, acting)

    def make(layout: Layout) -> Policy:
        check_fits(run, layout, folder)
        return policy

    return Agent(run.label, make, {"run": run.hash, "step": run.step, "context": run.context, "acting": acting})


def check_fits(run: Trained, layout: Layout, folder: Path) -> None:
    """Raises OptionError: if a run's model cannot play on a layout; `folder` is named."""
    if layout.obs_shape != run.obs_shape:
        raise OptionError(
            f"{folder}: trained on {', '.join(run.layouts)} with observations {run.obs_shape}; "
            f"{layout.name} has {layout.obs_shape}: choose tasks of fitting layouts"
        )
