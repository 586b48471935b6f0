"""Egos of the evaluator: reference egos that need no training, and trained models."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from icrl4aht_generation.experts.oracle import oracle
from icrl4aht_generation.experts.search import searcher
from icrl4aht_generation.policy import Policy

from icrl4aht_baselines.agents.bundled import bundled_models
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.tokens import input_step
from icrl4aht_baselines.methods.view_change import no_change
from icrl4aht_baselines.training.histories import TrainedModel, read_trained
from icrl4aht_baselines.training.run_folder import CONFIG
from icrl4aht_data.benchmark.facts import track_of
from icrl4aht_data.errors import OptionError, UnknownNameError, unknown
from icrl4aht_data.overcooked.actions import ACTIONS, STAY
from icrl4aht_data.overcooked.channels import Channels
from icrl4aht_data.overcooked.layouts import Layout

Acting = Literal["cached", "exact"]
ACTING: tuple[Acting, ...] = ("cached", "exact")
"""Ways of acting of a trained model with a context of K. Neither uses steps before the last K.

`exact` computes the complete context again at every step, as the paper's rolling buffer does. `cached` keeps the keys
and values of each step. When the window of AD, Hybrid-AD or AMAGO-Offline is full, its oldest fifth is dropped and the
rest is computed again: the window has between 4/5 K and K steps. The context of DPT changes only when an episode ends,
so both compute it once for each episode."""


OTHER_WAYS = ("greedy", "sampled")
"""Ways of choosing actions, see `PlayMode.greedy`. Results of a model that plays in another way than its own have the
way in their name, such as "ad-reference (sampled)"."""


class PlayMode(NamedTuple):
    """Way in which a trained model plays.

    Attributes:
        acting: how it remembers, see `ACTING`.
        greedy: whether it takes its most probable action, as published, or draws one.
    """

    acting: Acting = "cached"
    greedy: bool = True

    @classmethod
    def from_details(cls, details: Mapping[str, Any]) -> PlayMode:
        """Return the mode that the details of results state."""
        return cls(details.get("acting", "cached"), not details.get("sampled"))

    @property
    def details(self) -> dict[str, Any]:
        """Settings that results depend on."""
        return {"acting": self.acting} | ({} if self.greedy else {"sampled": True})


AS_PUBLISHED = PlayMode()
"""The way in which runs and most bundled models play unless another one is chosen."""


class NamedEgo(NamedTuple):
    """An ego that was chosen by name.

    Attributes:
        name: name of the ego in reports.
        make: layout -> policy.
        details: settings that results depend on in addition to the name; None for reference egos.
        run: run folder of a trained model; None for other egos.
    """

    name: str
    make: Callable[[Layout], Policy]
    details: dict[str, Any] | None = None
    run: Path | None = None


def _stay(params: Any, carry: Any, view: Any, key: Any) -> tuple[Any, Any]:
    return jnp.int32(STAY), carry


def _act_randomly(params: Any, carry: Any, view: Any, key: Any) -> tuple[Any, Any]:
    return jax.random.randint(key, (), 0, len(ACTIONS)), carry


def _no_memory(params: Any, key: Any) -> tuple[()]:
    return ()


def stay(layout: Layout) -> Policy:
    """Return an ego that always takes the action "stay", and so measures the teammate's return without help."""
    return Policy((), _no_memory, _stay, "situation")


def random(layout: Layout) -> Policy:
    """Return an ego that draws uniformly from the six actions: the column `Rnd` of the paper."""
    return Policy((), _no_memory, _act_randomly, "situation")


AGENTS: dict[str, Callable[[Layout], Policy]] = {"stay": stay, "random": random, "oracle": oracle, "search": searcher}
"""Reference egos: name -> function from a layout to the policy."""

SCRIPTED: tuple[Callable[..., Policy], ...] = (oracle, searcher)
"""Scripted reference egos. Their functions take one layout or several, since their parameters are tables of these."""


def agent_names() -> tuple[str, ...]:
    """Return the names that `find_agent` knows: reference egos and bundled models."""
    return (*AGENTS, *bundled_models())


def find_agent(name: str | Path, *, acting: Acting | None = None, greedy: bool | None = None) -> NamedEgo:
    """Return a reference ego, a bundled model, or the trained model in a run folder of `icrl4aht-data train`.

    A bundled model plays each layout by its model of the layout's track.

    Args:
        name: name of a reference ego or of a bundled model, or path of a run folder.
        acting: how a trained model remembers, see `ACTING`; "cached" by default.
        greedy: whether a trained model takes its most probable action or draws one; by default as its published
            results were made.

    Raises:
        UnknownNameError: if the name is none of these, or the way of acting is unknown.
        OptionError: if the run has another format or no checkpoint; from `make`, if the model does not fit the layout.
    """
    name = str(name)
    if name in AGENTS:
        return NamedEgo(name, AGENTS[name])
    model = bundled_models().get(name)
    if model is None and not Path(name).is_dir():
        hint = "A trained model is named by its folder, which `icrl4aht-data train` makes."
        raise UnknownNameError(f"{unknown('agent', name, agent_names())} {hint}")
    if model is None and not (Path(name) / CONFIG).is_file():
        raise UnknownNameError(f"{name}: not a run: {CONFIG} is missing; `icrl4aht-data train` makes runs")
    own_greedy = model is None or not model.sampled
    mode = PlayMode(acting or "cached", own_greedy if greedy is None else greedy)
    suffix = "" if mode.greedy == own_greedy else f" ({OTHER_WAYS[not mode.greedy]})"
    if model is None:
        run = read_trained(Path(name))
        details = {"run": run.hash, "step": run.step, "context": run.context, "encoder": run.encoder, **mode.details}
        details["trained_on"] = run.trained_on
        return NamedEgo(run.label + suffix, trained_ego(run, mode, name), details, Path(name))
    runs = {track: read_trained(folder) for track, folder in model.runs.items()}
    egos = {track: trained_ego(run, mode, str(model.runs[track])) for track, run in runs.items()}

    def make(layout: Layout) -> Policy:
        track = track_of(layout.name)
        if track not in egos:
            raise OptionError(
                f"{name}: has no model of track {track}, whose layout is {layout.name}; it has "
                f"{' and '.join(egos)}: choose tasks of these, or another agent"
            )
        return egos[track](layout)

    details = {"model": name, "run": {track: run.hash for track, run in runs.items()}, **mode.details}
    details["trained_on"] = {track: run.trained_on for track, run in runs.items()}
    return NamedEgo(name + suffix, make, details)


def trained_ego(run: TrainedModel, mode: PlayMode, folder: str) -> Callable[[Layout], Policy]:
    """Return the function from a layout to the policy of a trained model.

    The function raises OptionError, which names `folder`, if the layout's observations have another shape; models of
    canonical channels play on every layout.
    """
    policy = learned(run.method, run.params, run.context, mode)

    def make(layout: Layout) -> Policy:
        if run.channels == "own" and layout.obs_shape != run.obs_shape:
            raise OptionError(
                f"{folder}: trained on {', '.join(run.layouts)} with observations {run.obs_shape}; "
                f"{layout.name} has {layout.obs_shape}: choose tasks of fitting layouts, or train with --channels "
                f"canonical, which all layouts share"
            )
        return with_view(policy, run.channels, layout.name in run.hide_recipe)

    return make


def learned(method: Method, params: Any, context: int, mode: PlayMode = AS_PUBLISHED) -> Policy:
    """Return the ego of a trained model. Its memory lasts for the complete task.

    Args:
        method: the method with which the model was trained.
        params: parameters of the model, float32.
        context: K, number of steps or transitions in the memory.
        mode: way in which it plays.

    Raises:
        UnknownNameError: if there is no such way of acting.
    """
    if mode.acting not in ACTING:
        raise unknown("acting", mode.acting, ACTING)

    def start() -> Any:
        return method.start(context, mode.acting == "cached")

    def act(params: Any, memory: Any, ego_input: Any, key: Any) -> tuple[Any, Any]:
        logits, memory = method.act(params, input_step(ego_input), ego_input.prev_done, memory)
        action = logits.argmax() if mode.greedy else jax.random.categorical(key, logits)
        return action.astype(jnp.int32), memory

    return Policy(params, lambda params, key: start(), act, "ego_input")


def with_view(policy: Policy, channels: Channels, hide_recipe: bool = False) -> Policy:
    """Return a policy that takes inputs of an ego with some channels.

    Policies with the same functions have the same functions afterwards.

    Args:
        policy: takes inputs with observations of these channels.
        channels: "own" for those of the layout, or "canonical".
        hide_recipe: whether recipe indicators look like counters; with canonical channels only.
    """
    if channels == "own":
        return policy
    return policy._replace(act=_without_recipe(policy.act) if hide_recipe else policy.act, sees="canonical_input")


@lru_cache(maxsize=16)
def _without_recipe(act: Callable[..., Any]) -> Callable[..., Any]:
    change = no_change()._replace(hidden=jnp.bool_(True))

    def act_unseeing(params: Any, memory: Any, ego_input: Any, key: Any) -> tuple[Any, Any]:
        return act(params, memory, ego_input._replace(obs=change.observations(ego_input.obs)), key)

    return act_unseeing
