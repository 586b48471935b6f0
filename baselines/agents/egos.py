"""Egos of the evaluator: reference egos that need no training, and trained models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from baselines.methods.method import Method
from baselines.methods.tokens import percept_step
from baselines.methods.view_change import no_change
from baselines.training.histories import TrainedModel, read_trained
from generation.experts.oracle import oracle
from generation.policy import Policy
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.overcooked.actions import ACTIONS, STAY
from icrl4aht_data.overcooked.channels import Channels, to_canonical
from icrl4aht_data.overcooked.layouts import Layout

Acting = Literal["cached", "exact"]
ACTING: tuple[Acting, ...] = ("cached", "exact")
"""Ways of acting of a trained model with a context of K. In neither has a step outside the last K a part.

`exact` computes the complete context again at every step, as the paper's rolling buffer does. `cached` keeps the keys
and values of each step. When the window of AD, Hybrid-AD or AMAGO-Offline is full, its oldest fifth is dropped and the
rest is computed again, so that it has between 4/5 K and K steps. The context of DPT changes only when an episode ends;
it is computed once for each episode and is that of `exact`."""


class NamedEgo(NamedTuple):
    """An ego that was chosen by name.

    Attributes:
        name: name of the ego in reports.
        make: layout -> policy.
        details: settings that results depend on in addition to the name; None for reference egos.
    """

    name: str
    make: Callable[[Layout], Policy]
    details: dict[str, Any] | None = None


def stay(layout: Layout) -> Policy:
    """Returns an ego that always takes the action "stay", and so measures the teammate's return without help."""
    return Policy((), lambda params, key: (), lambda params, carry, view, key: (jnp.int32(STAY), carry), "observation")


def random(layout: Layout) -> Policy:
    """Returns an ego that draws uniformly from the six actions: the column `Rnd` of the paper."""

    def act(params, carry, view, key):
        return jax.random.randint(key, (), 0, len(ACTIONS)), carry

    return Policy((), lambda params, key: (), act, "observation")


def learned(method: Method, params: Any, context: int, acting: Acting = "cached", greedy: bool = True) -> Policy:
    """Returns the ego of a trained model, whose memory lasts for the complete task.

    Args:
        method: the method with which the model was trained.
        params: parameters of the model, float32.
        context: K, number of steps or transitions in the memory.
        acting: "cached", the default of evaluations, or "exact"; see `ACTING`.
        greedy: whether to take the most probable action, as published, or to draw one from the policy.

    Raises:
        UnknownNameError: if there is no such way of acting.
    """
    if acting not in ACTING:
        raise unknown("acting", acting, ACTING)

    def act(params: Any, memory: Any, percept: Any, key: Any) -> tuple[Any, Any]:
        logits, memory = method.act(params, percept_step(percept), percept.prev_done, memory)
        action = logits.argmax() if greedy else jax.random.categorical(key, logits)
        return action.astype(jnp.int32), memory

    return Policy(params, lambda params, key: method.start(context, acting == "cached"), act, "percept")


def with_channels(policy: Policy, channels: Channels, layout: Layout) -> Policy:
    """Returns a policy for percepts of a layout, made of one that takes observations with these channels."""
    if channels == "own":
        return policy

    def act(params: Any, memory: Any, percept: Any, key: Any) -> tuple[Any, Any]:
        return policy.act(params, memory, percept._replace(obs=to_canonical(layout, percept.obs)), key)

    return policy._replace(act=act)


AGENTS: dict[str, Callable[[Layout], Policy]] = {"stay": stay, "random": random, "oracle": oracle}
"""Reference egos: name -> function from a layout to the policy."""


def get_agent(name: str) -> Callable[[Layout], Policy]:
    """Returns the function that makes a reference ego, layout -> policy.

    Raises:
        UnknownNameError: if there is no such ego; lists the valid names and the nearest.
    """
    if name not in AGENTS:
        raise unknown("agent", name, AGENTS)
    return AGENTS[name]


def with_hidden_recipe(policy: Policy, layout: Layout, hidden: Sequence[str]) -> Policy:
    """Returns a policy for percepts with canonical channels that does not see the recipe indicators of some layouts."""
    if layout.name not in hidden:
        return policy
    change = no_change()._replace(hidden=jnp.bool_(True))

    def act(params: Any, memory: Any, percept: Any, key: Any) -> tuple[Any, Any]:
        return policy.act(params, memory, percept._replace(obs=change.observations(percept.obs)), key)

    return policy._replace(act=act)


def find_agent(name: str, acting: Acting = "cached", greedy: bool = True) -> NamedEgo:
    """Returns the reference ego with a name, or the trained model in a run folder of `python -m baselines train`.

    Args:
        name: name of a reference ego, or path of a run folder.
        acting: way of acting of a trained model, see `ACTING`.
        greedy: whether a trained model takes its most probable action, or draws one.

    Raises:
        UnknownNameError: if the name is neither.
        OptionError: if the run has another format or no checkpoint; from `make`, if the model does not fit the layout.
    """
    folder = Path(name)
    if name in AGENTS or not folder.is_dir():
        return NamedEgo(name, get_agent(name))
    run = read_trained(folder)
    policy = learned(run.method, run.params, run.context, acting, greedy)

    def make(layout: Layout) -> Policy:
        check_fits(run, layout, folder)
        return with_channels(with_hidden_recipe(policy, layout, run.hide_recipe), run.channels, layout)

    details = {"run": run.hash, "step": run.step, "context": run.context, "encoder": run.encoder, "acting": acting}
    details |= {} if greedy else {"sampled": True}
    return NamedEgo(run.label, make, {**details, "trained_on": run.trained_on})


def check_fits(run: TrainedModel, layout: Layout, folder: Path) -> None:
    """Check that a trained model can play on a layout: with canonical channels on every one.

    Raises:
        OptionError: if the layout's observations have another shape; names `folder`.
    """
    if run.channels == "own" and layout.obs_shape != run.obs_shape:
        raise OptionError(
            f"{folder}: trained on {', '.join(run.layouts)} with observations {run.obs_shape}; "
            f"{layout.name} has {layout.obs_shape}: choose tasks of fitting layouts, or train with --channels "
            f"canonical, which all layouts share"
        )
