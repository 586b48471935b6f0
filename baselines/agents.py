"""Egos: the protocol, those that need no training, trained models, and the adapter for agents outside JAX."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from baselines.context import step_of
from baselines.method import Method
from baselines.oracle import oracle
from generation.teammates.base import Policy
from icrl4aht_data.benchmark import ACTIONS, STAY, unknown
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import Layout

if TYPE_CHECKING:
    from baselines.histories import Trained

Acting = Literal["cached", "exact"]
ACTING: tuple[Acting, ...] = ("cached", "exact")
"""How a model remembers: what it computed of each step is kept, or everything is computed anew from the window. The
same while the window is not full; from then on what is kept bears traces of steps that have left it."""


class Percept(NamedTuple):
    """What an ego with memory is given (`sees = "percept"`): what it sees, and what its last step brought.

    As in training, the last step before an episode's first is the previous episode's last; nothing precedes a task's
    first step, there all are zero.
    """

    obs: Any  # uint8 (5, 5, C)
    prev_action: Any  # int32
    prev_reward: Any  # float32, the team's
    prev_teammate_action: Any  # int32
    prev_done: Any  # bool: the last step ended an episode


class HostPolicy(NamedTuple):
    """A `Policy` whose functions take a whole batch: for agents that cannot be vmapped, see `from_host`."""

    params: Any
    init: Callable[[Any, Any], Any]
    act: Callable[[Any, Any, Any, Any], tuple[Any, Any]]
    sees: Literal["state", "observation", "percept"]


class HostAgent(Protocol):
    """An ego in NumPy, PyTorch or anything else. B tasks are played at once; the agent keeps its own memory."""

    def reset(self, batch: int) -> None:
        """A new set of B tasks begins: forget everything."""
        ...

    def act(self, percept: Percept) -> np.ndarray:
        """Integers (B,) in 0..5 for a `Percept` of arrays with leading axis B: obs uint8 (B, 5, 5, C), ..."""
        ...


def from_host(agent: HostAgent) -> Callable[[Layout], HostPolicy]:
    """The evaluator's ego of a `HostAgent`; its `act` is called once a step, in order, with all tasks of a group.

    Raises:
        OptionError: during evaluation, if `act` returns other than B integers.
    """

    def make(layout: Layout) -> HostPolicy:
        def init(params, keys):
            agent.reset(keys.shape[0])
            return ()

        def call(*percept) -> np.ndarray:
            batch = len(percept[1])
            actions = np.asarray(agent.act(Percept(*(np.asarray(part) for part in percept))))
            if actions.shape != (batch,) or not np.issubdtype(actions.dtype, np.integer):
                raise OptionError(
                    f"the agent's act returned {actions.dtype} of shape {actions.shape}, expected integers ({batch},)"
                )
            return actions.astype(np.int32)

        def act(params, carry, percept: Percept, keys):
            shape = jax.ShapeDtypeStruct(keys.shape, jnp.int32)
            return io_callback(call, shape, *percept, ordered=True), carry

        return HostPolicy((), init, act, "percept")

    return make


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
    from baselines.histories import read_trained

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
