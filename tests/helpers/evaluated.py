"""Results of evaluation as runs, without playing."""

from __future__ import annotations

import dataclasses

from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.report.results import EvaluationRun, as_run

from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks

TEST_TASKS = [task for track in TRACKS for task in read_tasks(manifest_path(track, "test"))]


def evaluated_run(
    agent: str,
    layouts=("demo_wide",),
    value=10.0,
    variant=None,
    families=HEURISTICS,
    protocol="seeded",
    tasks=None,
    trained_on=(),
    folder=None,
    acting=None,
    details=None,
    steps=100,
) -> EvaluationRun:
    """Every instance earns `value`, and 2 more in the second half.

    Args:
        tasks: by default the published test tasks of the layouts and families.
        trained_on: record of training data; None for results without one.
        acting: way of acting of a trained model; None for other agents.
        details: further details of the agent.
        steps: length of the episodes.
    """
    played = tasks or [task for task in TEST_TASKS if task.layout.name in layouts and task.teammate_family in families]
    details = dict(details or {}) | ({} if trained_on is None else {"trained_on": list(trained_on)})
    details |= {"variant": dict([variant])} if variant else {}
    details |= {"acting": acting} if acting else {}
    shortened = dataclasses.replace(PROTOCOLS[protocol], episodes=40, steps=steps)
    settings = {"agent": agent, "seeds": [0], "protocol": dataclasses.asdict(shortened), "code_version": "0"}
    settings |= {"details": details} if details else {}
    returns = [[value] * 20 + [value + 2.0] * 20]
    return as_run([Result(task.task_id, settings, returns) for task in played], folder or f"runs/{agent}", played)
