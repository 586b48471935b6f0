"""Text about the controls of memory and partner."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np

from icrl4aht_baselines.evaluate.controls import ControlledResults
from icrl4aht_baselines.report.results import task_label
from icrl4aht_baselines.report.scores import behaviour_names, behaviour_stratum
from icrl4aht_baselines.report.statistics import ratio_interval
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.utils.text import counted_noun


def control_lines(results: ControlledResults, tasks: Sequence[Task]) -> list[str]:
    """Return two lines for each track: M and P, means over layouts and families with their 95 % intervals.

    The intervals are those of the scores: within each layout and family, behaviours of teammates are resampled, or the
    seeds of the tasks if there is one behaviour.

    Args:
        results: results of the tasks.
        tasks: the tasks, in the order of the results.
    """
    alike, lines = behaviour_names(), []
    names = [alike.get(task_label(task.task_id), task.task_id) for task in tasks]
    for track in dict.fromkeys(task.track for task in tasks):
        cells: dict[tuple[str, str], list[int]] = defaultdict(list)
        for number, task in enumerate(tasks):
            if task.track == track:
                cells[task.layout.name, task.teammate_family].append(number)
        memory, partner = (
            _mean_text(values, names, cells.values()) for values in map(np.asarray, (results.memory, results.partner))
        )
        last = counted_noun(results.last, "last episode")
        lines += [
            f"track {track}, memory M: {memory}, return minus return with the memory cleared before each episode",
            f"track {track}, partner P: {partner}, return in the {last} minus return in them after another teammate",
        ]
    return lines


def _mean_text(values: np.ndarray, names: Sequence[str], cells: Iterable[Sequence[int]]) -> str:
    """Return the mean over cells, with its interval, of the values (U, S) of tasks. `names` are those of behaviours."""
    strata = [behaviour_stratum(values[None, rows], np.ones(len(rows)), [names[row] for row in rows]) for rows in cells]
    return ratio_interval([[stratum] for stratum in strata]).text(sign="+")
