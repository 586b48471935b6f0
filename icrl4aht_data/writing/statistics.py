"""Statistics of a release: the paper's table "Dataset statistics per layout", and the rise of returns."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from operator import mul
from typing import Any

import numpy as np
from rich.console import Console

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.info import LayoutStatistics
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import Entry
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.utils.templates import markdown_table


def layout_statistics(
    entries: Sequence[Entry],
    tasks: Sequence[Task],
    provenance: Mapping[str, Provenance],
    kept_steps: int,
    sizes: Mapping[str, int],
) -> dict[str, LayoutStatistics]:
    """Return the statistics of every layout, in order of first appearance.

    Args:
        entries: the index.
        tasks: the release's tasks.
        provenance: task id -> how its histories were made.
        kept_steps: steps of every episode.
        sizes: shard -> size in bytes.
    """
    statistics = {}
    for layout in dict.fromkeys(entry.layout for entry in entries):
        members = [entry for entry in entries if entry.layout == layout]
        lengths = {entry.task_id: entry.T for entry in members}
        recorded = [provenance.get(task_id, Provenance()).streams_recorded for task_id in lengths]
        streams = [number for number in recorded if number is not None]
        original = sum(map(mul, streams, lengths.values())) if len(streams) == len(recorded) else None
        own = [task for task in tasks if task.task_id in lengths]
        teammates = {json.dumps(task.teammate, sort_keys=True) for task in own}
        steps = [entry.T for entry in members]
        statistics[layout] = LayoutStatistics(
            original_transitions=original,
            filtered_transitions=sum(steps),
            history_length=(min(steps), max(steps)),
            teammates=len(teammates) or None,
            steps_per_episode=kept_steps,
            obs_shape=members[0].obs_shape,
            actions=len(ACTIONS),
            mean_final_return=round(float(np.mean([entry.return_end for entry in members])), 3),
            independent_teammates=len(set(map(_policy, own))) or None,
            disk_bytes=sum(sizes[shard] for shard in {entry.shard for entry in members}),
        )
    return statistics


def _policy(task: Task) -> str:
    """Return a key that is equal only for checkpoints of the same policy."""
    checkpoint = task.teammate.get("theta", {}).get("checkpoint")
    if task.teammate_family != "rl" or checkpoint is None:
        return json.dumps(task.teammate, sort_keys=True)
    return f"{checkpoint.rpartition('/')[0]} {task.teammate.get('base_seed')}"


def print_learning(content: Mapping[str, Any], console: Console) -> None:
    """Print the card's table of learning curves, and the tasks that were left out.

    Args:
        content: result of `card.facts`.
        console: console to print to.
    """
    lines = ["Mean returns of the first and the last tenth of the episodes, and numbers of histories:"]
    lines.append(markdown_table(["layout", "split", *content["sources"]], content["curves"]))
    for task in content["left_out"]:
        source = f" ({task['source']})" if task["source"] else ""
        lines.append(f"left out: {task['layout']} with {task['teammate']}{source}: {task['reason']}")
    console.print(*lines, sep="\n", markup=False, highlight=False, soft_wrap=True)
