"""Controls of memory and partner: how much an ego earns by remembering its earlier episodes with the same teammate."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from icrl4aht_baselines.agents.egos import SCRIPTED
from icrl4aht_baselines.evaluate.evaluator import MakeEgo, evaluate
from icrl4aht_baselines.evaluate.programs import Programs
from icrl4aht_baselines.evaluate.protocols import Protocol, get_protocol
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.evaluate.segments import CONTROLS, plan_tasks
from icrl4aht_data.benchmark.tasks import Task


class ControlledResults(NamedTuple):
    """Results of an ego and of its controls: U tasks with S seeds, equal episodes with equal random keys.

    Attributes:
        plain: results of the ego.
        cleared: those with its memory cleared before each episode.
        swapped: those in which another task's teammate plays all episodes but the last ones.
        last: number of these last episodes.
    """

    plain: list[Result]
    cleared: list[Result]
    swapped: list[Result]
    last: int

    @property
    def memory(self) -> Float[np.ndarray, "U S"]:
        """M: return minus return with the memory cleared before each episode, mean over all episodes."""
        return (_returns(self.plain) - _returns(self.cleared)).mean(axis=-1)

    @property
    def partner(self) -> Float[np.ndarray, "U S"]:
        """P: return in the last episodes minus return in them after episodes with another teammate."""
        return (_returns(self.plain) - _returns(self.swapped))[..., -self.last :].mean(axis=-1)


def _returns(results: Sequence[Result]) -> Float[np.ndarray, "U S E"]:
    return np.array([result.returns for result in results], np.float64)


def evaluate_controls(
    agent: str,
    make_ego: MakeEgo,
    tasks: Sequence[Task],
    protocol: Protocol | str = "seeded",
    *,
    out: Path | None = None,
    programs: Programs | None = None,
    **options: Any,
) -> ControlledResults:
    """Evaluate an ego and its controls, see `segments.CONTROLS`.

    Args:
        agent, make_ego, tasks, protocol, programs: see `evaluate`.
        out: folder of the ego's results; those of the controls are in its folders `cleared` and `swapped`.
        options: `seeds`, `suite` and `details` of `evaluate`.

    Raises:
        OptionError: as `evaluate`; if a task has no partner, if there are less than 2 episodes, or if the protocol
            swaps teammates.
    """
    rules = protocol if isinstance(protocol, Protocol) else get_protocol(protocol)
    plan_tasks(tasks, rules, "swapped")  # fails before hours of work
    # Equal egos share compiled programs, and an adapter makes new functions each time it is called.
    make = make_ego if make_ego in SCRIPTED else cache(make_ego)
    options["programs"] = Programs() if programs is None else programs
    results = {
        control: evaluate(agent, make, tasks, rules, control=control, out=out and out / (control or ""), **options)
        for control in (None, *CONTROLS)
    }
    return ControlledResults(results[None], results["cleared"], results["swapped"], rules.last_episodes)
