"""Egos of the evaluator: reference egos that need no training, and trained models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from icrl4aht_generation.experts.oracle import oracle
from icrl4aht_generation.policy import Policy

from icrl4aht_baselines.agents.bundled import BundledModel, bundled_models
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.tokens import percept_step
from icrl4aht_baselines.methods.view_change import no_change
from icrl4aht_baselines.training.histories import TrainedModel, read_trained
from icrl4aht_data.benchmark.facts import track_of
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


FORGETS = " (forgets)"
"""End of the name of an agent whose memory is cleared at the start of each episode."""


class PlayMode(NamedTuple):
    """Way in which a trained model plays.

    Attributes:
        acting: how it remembers, see `ACTING`.
        greedy: whether it takes its most probable action, as published, or draws one.
        forget: whether its memory is cleared at the start of each episode, which cuts its context off.
    """

    acting: Acting = "cached"
    greedy: bool = True
    forget: bool = False

    @classmethod
    def from_details(cls, details: Mapping[str, Any]) -> PlayMode:
        """Returns the mode that the details of results state."""
        return cls(details.get("acting", "cached"), not details.get("sampled"), bool(details.get("forget")))

    def suffix(self, default: PlayMode) -> str:
        """Returns the end of the name of an agent that plays in another way than its default one, for reports."""
        drawn = "" if self.greedy == default.greedy else " (greedy)" if self.greedy else " (sampled)"
        return drawn + FORGETS * self.forget

    @property
    def details(self) -> dict[str, Any]:
        """Settings that results depend on."""
        changed = {"sampled": not self.greedy, "forget": self.forget}
        return {"acting": self.acting} | {name: True for name, value in changed.items() if value}


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


def stay(layout: Layout) -> Policy:
    """Returns an ego that always takes the action "stay", and so measures the teammate's return without help."""
    return Policy((), lambda params, key: (), lambda params, carry, view, key: (jnp.int32(STAY), carry), "observation")


def random(layout: Layout) -> Policy:
    """Returns an ego that draws uniformly from the six actions: the column `Rnd` of the paper."""

    def act(params, carry, view, key):
        return jax.random.randint(key, (), 0, len(ACTIONS)), carry

    return Policy((), lambda params, key: (), act, "observation")


AS_PUBLISHED = PlayMode()
"""The default way of playing of runs and of most bundled models, see `default_mode`."""


def learned(method: Method, params: Any, context: int, mode: PlayMode = AS_PUBLISHED) -> Policy:
    """Returns the ego of a trained model, whose memory lasts for the complete task, unless it is to forget.

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

    def act(params: Any, memory: Any, percept: Any, key: Any) -> tuple[Any, Any]:
        step, done = percept_step(percept), percept.prev_done
        if mode.forget:
            memory = jax.tree.map(lambda new, old: jnp.where(done, new, old), start(), memory)
            before = {name: jnp.where(done, 0, value) for name, value in step._asdict().items() if name != "obs"}
            step, done = step._replace(**before), jnp.bool_(False)
        logits, memory = method.act(params, step, done, memory)
        action = logits.argmax() if mode.greedy else jax.random.categorical(key, logits)
        return action.astype(jnp.int32), memory

    return Policy(params, lambda params, key: start(), act, "percept")


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


def default_mode(name: str) -> PlayMode:
    """Returns the way in which an agent plays unless another one is chosen; some bundled models draw their actions."""
    model = bundled_models().get(name)
    return AS_PUBLISHED if model is None else AS_PUBLISHED._replace(greedy=not model.sampled)


def find_agent(name: str, mode: PlayMode | None = None) -> NamedEgo:
    """Returns a reference ego, a bundled model, or the trained model in a run folder of `icrl4aht-data train`.

    Args:
        name: name of a reference ego or of a bundled model, or path of a run folder.
        mode: way in which a trained model plays; by default its own, see `default_mode`.

    Raises:
        UnknownNameError: if the name is none of these.
        OptionError: if the run has another format or no checkpoint, or `mode` is no `PlayMode`; from `make`, if the
            model does not fit the layout.
    """
    default = default_mode(name)
    mode = default if mode is None else mode
    if not isinstance(mode, PlayMode):
        raise OptionError(f"mode = {mode!r}: expected a PlayMode, such as PlayMode(acting='exact')")
    if name in AGENTS:
        return NamedEgo(name, AGENTS[name])
    folder, bundled = Path(name), bundled_models()
    if name in bundled:
        return _bundled_ego(bundled[name], mode, mode.suffix(default))
    if not folder.is_dir():
        raise unknown("agent", name, [*AGENTS, *bundled])
    run = read_trained(folder)
    details = {"run": run.hash, "step": run.step, "context": run.context, "encoder": run.encoder, **mode.details}
    details["trained_on"] = run.trained_on
    return NamedEgo(run.label + mode.suffix(default), _maker(run, mode, folder), details, folder)


def _bundled_ego(model: BundledModel, mode: PlayMode, suffix: str) -> NamedEgo:
    """Returns a bundled model as an ego, which plays each layout by the model of the layout's track."""
    runs = {track: read_trained(folder) for track, folder in model.runs.items()}

    def make(layout: Layout) -> Policy:
        track = track_of(layout.name)
        if track not in runs:
            raise OptionError(
                f"{model.name}: has no model of track {track}, whose layout is {layout.name}; it has "
                f"{' and '.join(runs)}: choose tasks of these, or another agent"
            )
        return _maker(runs[track], mode, model.runs[track])(layout)

    details = {"model": model.name, "run": {track: run.hash for track, run in runs.items()}, **mode.details}
    trained_on = {track: run.trained_on for track, run in runs.items()}
    return NamedEgo(model.name + suffix, make, {**details, "trained_on": trained_on})


def _maker(run: TrainedModel, mode: PlayMode, folder: Path) -> Callable[[Layout], Policy]:
    """Returns the function from a layout to the policy of a trained model."""
    policy = learned(run.method, run.params, run.context, mode)

    def make(layout: Layout) -> Policy:
        check_fits(run, layout, folder)
        return with_channels(with_hidden_recipe(policy, layout, run.hide_recipe), run.channels, layout)

    return make


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
