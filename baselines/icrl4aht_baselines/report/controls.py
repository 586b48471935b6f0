"""Text about the controls of memory and partner."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from icrl4aht_baselines.evaluate.controls import ControlledResults
from icrl4aht_baselines.report.statistics import mean_interval
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.utils.text import counted_noun


def control_lines(results: ControlledResults, tasks: Sequence[Task]) -> list[str]:
    """Return two lines for each track: M and P, means over layouts and families with their 95 % intervals.

    Args:
        results: results of the tasks.
        tasks: the tasks, in the order of the results.
    """
    lines = []
    for track in dict.fromkeys(task.track for task in tasks):
        cells: dict[tuple[str, str], list[int]] = defaultdict(list)
        for number, task in enumerate(tasks):
            if task.track == track:
                cells[task.layout.name, task.teammate_family].append(number)
        memory, partner = (
            mean_interval(*(values[rows] for rows in cells.values())).text(sign="+")
            for values in (np.asarray(results.memory), np.asarray(results.partner))
        )
        last = counted_noun(results.last, "last episode")
        lines += [
            f"track {track}, memory M: {memory}, return minus return with the memory cleared before each episode",
            f"track {track}, partner P: {partner}, return in the {last} minus return in them after another teammate",
        ]
    return lines
