"""Make invented evaluation results, in memory or in folders, and invented best responses."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, bundled_tasks, get_protocol, plan_tasks
from icrl4aht_baselines.evaluate.results import Result, write_result
from icrl4aht_baselines.report.results import EvaluationRun, as_run

from icrl4aht_data.benchmark.best_responses import BestResponse, BestResponseCard, TrainingRun, write_best_responses
from icrl4aht_data.benchmark.facts import PREFERENCE, TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, has_headroom, read_reference_returns, stay_returns
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks

TEST_TASKS = [task for track in TRACKS for task in read_tasks(manifest_path(track, "test"))]


def evaluated_run(
    agent: str,
    layouts=("demo_wide",),
    value=10.0,
    note="",
    families=HEURISTICS,
    protocol="seeded",
    tasks=None,
    trained_on=(),
    folder=None,
    acting=None,
    details=None,
    steps=100,
) -> EvaluationRun:
    """Return an evaluation run with return `value` in the first half of the episodes and `value` + 2 in the second.

    Args:
        note: text that distinguishes the runs of one agent.
        tasks: evaluated tasks, by default the published test tasks of `layouts` and `families`.
        trained_on: the agent's record of training data; None for results without such a record.
        acting: how a trained model chooses actions, a detail of its results; None for other agents.
        details: further details of the agent, by name.
        steps: length of the episodes.
    """
    played = tasks or [task for task in TEST_TASKS if task.layout.name in layouts and task.teammate_family in families]
    details = dict(details or {}) | ({} if trained_on is None else {"trained_on": list(trained_on)})
    details |= {"acting": acting} if acting else {}
    shortened = dataclasses.replace(PROTOCOLS[protocol], episodes=40, steps=steps)
    settings = {"agent": agent, "seeds": [0], "protocol": shortened.settings, "code_version": "0"}
    settings |= {"details": details} if details else {}
    returns = [[value] * 20 + [value + 2.0] * 20]
    run = as_run([Result(task.task_id, settings, returns) for task in played], folder or f"runs/{agent}", played)
    return dataclasses.replace(run, note=note)


SPAN = 20.0
"""Margin over `stay` of the best responses that `write_invented_responses` invents, for teammates with headroom."""


def write_invented_responses(path: Path, preference: bool = False) -> Path:
    """Write invented best responses to all teammates of test tasks, and of the validation tasks on demo_wide.

    A layout's five H4 teammates share a response.

    Args:
        preference: whether the test tasks of the track `preference` also have best responses.
    """
    stays, headroom, behaviours = stay_returns("seeded"), read_reference_returns("seeded"), []
    for (layout, family), egos in headroom.items():
        tasks = [task for task in TEST_TASKS if (task.layout.name, task.teammate_family) == (layout, family)]
        for own in [tasks] if family == "H4" else [[task] for task in tasks]:
            best = float(np.mean([stays[task.task_id] for task in own])) + SPAN * has_headroom(egos)
            ids, trained = tuple(task.task_id for task in own), (TrainingRun(1, 10, best),)
            behaviours.append(BestResponse(layout, family, "test", ids, trained, best, "best response, seed 1"))
    for task in (task for task in bundled_tasks("teammate", "validation") if task.layout.name == "demo_wide"):
        names, best = ("demo_wide", task.teammate_family, "validation", (task.task_id,)), stays[task.task_id] + SPAN
        behaviours.append(BestResponse(*names, (TrainingRun(1, 10, best),), best, "best response, seed 1"))
    for task in bundled_tasks(PREFERENCE, "test") if preference else ():
        names, best = (task.layout.name, task.teammate_family, "test", (task.task_id,)), stays[task.task_id] + SPAN
        behaviours.append(BestResponse(*names, (TrainingRun(0, 10, best, tasks=2),), best, "informed ego, seed 0"))
    write_best_responses(path, BestResponseCard("7", "seeded", "Invented.", tuple(behaviours)))
    return path


def write_results(
    folder: Path,
    agent: str,
    curve: Sequence[float],
    track: str = "layout",
    trained_on=(),
    offset=0.0,
    **details,
) -> Path:
    """Write the result files of `evaluate` for all test tasks of a track, with equal returns for all three seeds.

    Args:
        curve: returns of the 100 episodes of a task.
        details: further details of the agent, such as `forget`.
        offset: number by which returns rise from one teammate of a family to the next.
    """
    settings = {"agent": agent, "seeds": [0, 1, 2], "protocol": get_protocol("seeded").settings}
    details |= {} if trained_on is None else {"trained_on": [*trained_on]}
    control = "swapped" if details.get("swapped") else None
    for plan in plan_tasks(bundled_tasks(track, "test"), get_protocol("seeded"), control):
        values = [value + offset * plan.task.teammate["theta_id"] for value in curve]
        found = {**settings, "code_version": version("icrl4aht-data"), "details": details}
        write_result(folder, Result(plan.task.task_id, found, [values] * 3, [*plan.partners]))
    return folder
