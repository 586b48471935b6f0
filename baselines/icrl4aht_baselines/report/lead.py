"""Comparison of an agent with reference egos by teammate family: mean returns, differences and their intervals.

Shapes: U pairs of a task and a seed, E episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.report.intervals import bootstrap_interval
from icrl4aht_data.benchmark.facts import family_order
from icrl4aht_data.benchmark.tasks import Task

FLOOR = ("stay", "random")
"""Reference egos that an agent has to exceed before its return says anything."""


class FamilyReturns(NamedTuple):
    """Returns of several agents on the same tasks and seeds, with teammates of one family.

    Attributes:
        family: the family.
        returns: agent -> return of the team in each episode, float64 (U, E).
    """

    family: str
    returns: Mapping[str, Float[np.ndarray, "U E"]]

    def mean(self, agent: str) -> float:
        """Returns an agent's mean return over tasks, seeds and episodes."""
        return float(self.returns[agent].mean())


class Lead(NamedTuple):
    """What an agent earns above the better of two reference egos with one family, per episode.

    Attributes:
        mean: difference of the mean returns.
        low, high: 95 % bootstrap interval of that difference, resampled over pairs of a task and a seed.
        better: whether the intervals of the differences to both reference egos are above 0.
    """

    mean: float
    low: float
    high: float
    better: bool


def family_returns(tasks: Sequence[Task], results: Mapping[str, Sequence[Result]]) -> list[FamilyReturns]:
    """Returns the results of several agents on the same tasks and seeds by teammate family, in the paper's order.

    Args:
        tasks: the tasks.
        results: agent -> a result of each task, in the same order.
    """
    present = {task.teammate_family for task in tasks}
    found = []
    for family in sorted(present, key=family_order):
        chosen = [number for number, task in enumerate(tasks) if task.teammate_family == family]
        returns = {
            agent: np.concatenate([np.asarray(of_agent[number].returns) for number in chosen])
            for agent, of_agent in results.items()
        }
        found.append(FamilyReturns(family, returns))
    return found


def find_lead(of_family: FamilyReturns, agent: str) -> Lead:
    """Returns an agent's lead with one family. A task and a seed have the same starts of episodes for all agents."""
    rng = np.random.default_rng(0)
    own = of_family.returns[agent].mean(axis=1)
    differences = {name: own - of_family.returns[name].mean(axis=1) for name in FLOOR}
    intervals = {name: bootstrap_interval(values, rng) for name, values in differences.items()}
    nearest = min(FLOOR, key=lambda name: differences[name].mean())
    better = all(low > 0 for low, _ in intervals.values())
    return Lead(float(differences[nearest].mean()), *intervals[nearest], better)


def lead_table(families: Sequence[FamilyReturns], agent: str) -> str:
    """Returns text with a line per family: mean returns of all agents, and the lead of one of them."""
    names = list(families[0].returns)
    wide = {name: max(9, len(name) + 2) for name in names}
    head = "".join(f"{name:>{wide[name]}}" for name in names)
    lines = [f"family{head}   {agent} - better of {' and '.join(FLOOR)}"]
    for of_family in families:
        lead = find_lead(of_family, agent)
        means = "".join(f"{of_family.mean(name):>{wide[name]}.1f}" for name in names)
        lines.append(
            f"{of_family.family:6}{means}   {lead.mean:+.1f} (95 % interval {lead.low:+.1f} to {lead.high:+.1f})"
        )
    return "\n".join(lines)


def lead_verdict(families: Sequence[FamilyReturns], agent: str) -> str:
    """Returns one sentence: with which families an agent earns more than both reference egos, or that it does not."""
    better = [of_family.family for of_family in families if find_lead(of_family, agent).better]
    others = [of_family.family for of_family in families if of_family.family not in better]
    floor = " and ".join(FLOOR)
    if not better:
        return f"{agent} earns no more than {floor} with any of these families: {', '.join(others)}"
    missed = f"; no more with {', '.join(others)}" if others else ""
    return (
        f"{agent} earns more than {floor} with {len(better)} of {len(families)} families: {', '.join(better)}{missed}"
    )


def describe_rise(families: Sequence[FamilyReturns], agent: str) -> str:
    """Returns one sentence on an agent's first episode and the second half of its episodes, means over families."""
    curve = np.mean([of_family.returns[agent].mean(axis=0) for of_family in families], axis=0)
    half = len(curve) // 2
    return f"its first episode earns {curve[0]:.1f}, episodes {half + 1} to {len(curve)} {curve[half:].mean():.1f}"
