"""Egos of the evaluator: reference egos that need no training, and trained models."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from icrl4aht_generation.experts.oracle import oracle
from icrl4aht_generation.experts.search import searcher
from icrl4aht_generation.policy import Policy

from icrl4aht_baselines.agents.bundled import EVERY_TRACK, bundled_models
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.tokens import input_step
from icrl4aht_baselines.methods.view_change import no_change
from icrl4aht_baselines.training.histories import TrainedModel, read_trained
from icrl4aht_baselines.training.run_folder import CONFIG
from icrl4aht_baselines.training.seen import TRAINED_ON
from icrl4aht_data.errors import OptionError, UnknownNameError, check_choice, unknown_name
from icrl4aht_data.overcooked.actions import ACTIONS, STAY
from icrl4aht_data.overcooked.channels import Channels, canonical_positions
from icrl4aht_data.overcooked.layouts import Layout

Acting = Literal["cached", "exact"]
ACTING: tuple[Acting, ...] = ("cached", "exact")
"""How a trained model computes its context of K steps when it acts. Steps before the last K are never used.

`exact` computes the complete context again at every step, as the paper's rolling buffer does. `cached` keeps the keys
and values of each step. When the window of AD, Hybrid-AD or AMAGO-Offline is full, its oldest fifth is dropped and the
rest is computed again: the window has between 4/5 K and K steps. The context of DPT changes only when an episode ends,
so it is computed once for each episode with either value."""


OTHER_WAYS = ("greedy", "sampled")
"""Ways of choosing actions, see `PlayMode.greedy`. Results that were not made in a model's default way name the way
that was used, such as "rl2-reference (greedy)"."""


class PlayMode(NamedTuple):
    """Settings with which a trained model acts: how it computes its context and how it chooses its actions.

    Attributes:
        acting: how the context is computed, see `ACTING`.
        greedy: True to take the most probable action, as in the paper; False to sample an action.
    """

    acting: Acting = "cached"
    greedy: bool = True

    @property
    def details(self) -> dict[str, Any]:
        """The play mode as entries of the `details` of evaluation results."""
        return {"acting": self.acting} | ({} if self.greedy else {"sampled": True})


AS_PUBLISHED = PlayMode()
"""Default play mode of runs; bundled models sample their actions."""


class NamedEgo(NamedTuple):
    """An ego with its name in reports.

    Attributes:
        name: name of the ego in reports.
        make: function from a layout to the ego's policy.
        details: further settings that the ego's results depend on; None for reference egos.
        run: run folder of a trained model; None for other egos.
    """

    name: str
    make: Callable[[Layout], Policy]
    details: dict[str, Any] | None = None
    run: Path | None = None


def _always_stay(params: Any, carry: Any, view: Any, key: Any) -> tuple[Any, Any]:
    return jnp.int32(STAY), carry


def _act_randomly(params: Any, carry: Any, view: Any, key: Any) -> tuple[Any, Any]:
    return jax.random.randint(key, (), 0, len(ACTIONS)), carry


def _no_memory(params: Any, key: Any) -> tuple[()]:
    return ()


def stay(layout: Layout) -> Policy:
    """Return an ego that always takes the action "stay", to measure what the teammate earns without help."""
    return Policy((), _no_memory, _always_stay, "situation")


def random(layout: Layout) -> Policy:
    """Return an ego that samples uniformly from the six actions, as in the paper's column `Rnd`."""
    return Policy((), _no_memory, _act_randomly, "situation")


AGENTS: dict[str, Callable[[Layout], Policy]] = {"stay": stay, "random": random, "oracle": oracle, "search": searcher}
"""Reference egos: name -> function from a layout to the policy."""

SCRIPTED: tuple[Callable[..., Policy], ...] = (oracle, searcher)
"""Scripted reference egos. Their functions take one layout or a list of layouts."""


def agent_names() -> tuple[str, ...]:
    """Return the names of all agents that `find_agent` finds by name: reference egos and bundled models."""
    return (*AGENTS, *bundled_models())


def find_agent(name: str | Path, *, acting: Acting | None = None, greedy: bool | None = None) -> NamedEgo:
    """Return a reference ego, a bundled model, or the trained model in a run folder of `icrl4aht-data train`.

    A bundled model has one set of parameters for all tracks, or one set for each track.

    Args:
        name: name of a reference ego or of a bundled model, or path of a run folder.
        acting: how a trained model computes its context, see `ACTING`; "cached" by default.
        greedy: True if a trained model takes its most probable action, False if it samples an action; by default True
            for a run folder, and False for a bundled model.

    Raises:
        UnknownNameError: if the name or the value of `acting` is unknown.
        OptionError: if the run has another format or no checkpoint; `NamedEgo.make` raises it for a layout that the
            model cannot play.
    """
    name = str(name)
    if name in AGENTS:
        return NamedEgo(name, AGENTS[name])
    model = bundled_models().get(name)
    if model is None and not Path(name).is_dir():
        hint = "A trained model is named by its folder, which `icrl4aht-data train` makes."
        raise UnknownNameError(f"{unknown_name('agent', name, agent_names())} {hint}")
    if model is None and not (Path(name) / CONFIG).is_file():
        raise UnknownNameError(
            f"{name}: expected a run folder, but {CONFIG} is missing; `icrl4aht-data train` makes run folders"
        )
    own_greedy = model is None
    mode = PlayMode(acting or "cached", own_greedy if greedy is None else greedy)
    suffix = "" if mode.greedy == own_greedy else f" ({OTHER_WAYS[not mode.greedy]})"
    if model is None:
        run = read_trained(Path(name))
        details = {"run": run.hash, "step": run.step, "context": run.context, "encoder": run.encoder, **mode.details}
        details[TRAINED_ON] = run.trained_on
        return NamedEgo(run.label + suffix, trained_ego(run, mode, name), details, Path(name))
    runs = {track: read_trained(folder) for track, folder in model.runs.items()}
    egos = {track: trained_ego(run, mode, str(model.runs[track])) for track, run in runs.items()}

    def make_ego(layout: Layout) -> Policy:
        track = model.run_key(layout.name)
        if track not in egos:
            raise OptionError(
                f"{name}: no model for layout {layout.name} of track {track}, only for tracks {' and '.join(egos)}: "
                f"choose tasks of these tracks, or another agent"
            )
        return egos[track](layout)

    hashes = {track: run.hash for track, run in runs.items()}
    trained_on = {track: run.trained_on for track, run in runs.items()}
    details = {"model": name, "run": hashes.get(EVERY_TRACK, hashes), **mode.details}
    details[TRAINED_ON] = trained_on.get(EVERY_TRACK, trained_on)
    return NamedEgo(name + suffix, make_ego, details)


def trained_ego(run: TrainedModel, mode: PlayMode, folder: str) -> Callable[[Layout], Policy]:
    """Return a function from a layout to the policy of a trained model.

    The function raises OptionError with the name of `folder` if the model cannot play on the layout. A model that sees
    a layout's own channels needs observations of the shape that it was trained on. A model that sees canonical channels
    needs ingredients that have canonical channels.
    """
    policy = trained_policy(run.method, run.params, run.context, mode)

    def make_ego(layout: Layout) -> Policy:
        if run.channels == "own" and layout.obs_shape != run.obs_shape:
            raise OptionError(
                f"{folder}: trained on {', '.join(run.layouts)} with observations {run.obs_shape}; "
                f"{layout.name} has {layout.obs_shape}; choose tasks on layouts with the same observation "
                f"shape, or train with --channels canonical"
            )
        if run.channels == "canonical":
            try:
                canonical_positions(layout)
            except OptionError as error:
                raise OptionError(f"{folder}: trained with canonical channels: {error}") from error
        return with_channels(policy, run.channels, layout.name in run.hide_recipe)

    return make_ego


def trained_policy(method: Method, params: Any, context: int, mode: PlayMode = AS_PUBLISHED) -> Policy:
    """Return a trained model as a policy, with a memory that lasts for a complete task.

    Args:
        method: the method with which the model was trained.
        params: parameters of the model, float32.
        context: K, number of steps or transitions in the memory.
        mode: how the context is computed and actions are chosen.

    Raises:
        UnknownNameError: if `mode.acting` is unknown.
    """
    check_choice("acting", mode.acting, ACTING)

    def act(params: Any, memory: Any, ego_input: Any, key: Any) -> tuple[Any, Any]:
        logits, memory = method.act(params, input_step(ego_input), ego_input.prev_done, memory)
        action = logits.argmax() if mode.greedy else jax.random.categorical(key, logits)
        return action.astype(jnp.int32), memory

    return Policy(params, lambda params, key: method.start(context, mode.acting == "cached"), act, "ego_input")


def with_channels(policy: Policy, channels: Channels, hide_recipe: bool = False) -> Policy:
    """Return a copy of a policy that receives observations with the given channels.

    The copies of policies with the same functions also have the same functions, so they can share a compiled program.

    Args:
        policy: policy for observations with these channels.
        channels: "own" for the channels of the layout, or "canonical" for those that all layouts share.
        hide_recipe: whether recipe indicators are observed as counters; possible with canonical channels only.
    """
    if channels == "own":
        return policy
    return policy._replace(act=_hide_recipe(policy.act) if hide_recipe else policy.act, sees="canonical_input")


@lru_cache(maxsize=16)
def _hide_recipe(act: Callable[..., Any]) -> Callable[..., Any]:
    change = no_change()._replace(hidden=jnp.bool_(True))

    def act_without_recipe(params: Any, memory: Any, ego_input: Any, key: Any) -> tuple[Any, Any]:
        return act(params, memory, ego_input._replace(obs=change.observations(ego_input.obs)), key)

    return act_without_recipe
