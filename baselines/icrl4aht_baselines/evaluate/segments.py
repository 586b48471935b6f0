"""Segments of an evaluation: episodes in a row in which no task changes its teammate.

An ego keeps its memory from one segment to the next and gets no sign of the change. Keys of episodes are those of the
task whoever plays, so that the last episodes of a control differ from those of the plain evaluation in nothing but the
ego's memory.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

from icrl4aht_baselines.evaluate.protocols import Protocol
from icrl4aht_data.benchmark.tasks import Task, teammate_id
from icrl4aht_data.errors import OptionError

Control = Literal["cleared", "swapped"]
CONTROLS: dict[Control, str] = {"cleared": "forget", "swapped": "swapped"}
"""Control of an evaluation -> its mark in the details of results. `cleared`: the ego's memory is cleared before each
episode. `swapped`: the teammate of another task plays all episodes but the last ones, see `Protocol.last_episodes`."""


def controlled_name(agent: str, control: Control) -> str:
    """Return the name that the results of an agent's control have, such as "mine (cleared)"."""
    return f"{agent} ({control})"


class PlannedTask(NamedTuple):
    """A task with what is played in each segment.

    Attributes:
        task: the task.
        played: one task per segment: with the id of `task`, and the teammate and the recipes of a partner.
        partners: ids of the partners, one per segment; empty if there is one segment.
    """

    task: Task
    played: tuple[Task, ...]
    partners: tuple[str, ...] = ()


def segment_lengths(protocol: Protocol, control: Control | None = None) -> tuple[int, ...]:
    """Return the number of episodes of each segment.

    Raises:
        OptionError: if teammates are to be swapped in a task of one episode, or under a protocol that swaps them, too.
    """
    if control == "swapped":
        if protocol.swap_every or protocol.episodes < 2:
            raise OptionError(
                f"the control `swapped` with protocol {protocol.name} and episodes = {protocol.episodes}: expected a "
                f"protocol that keeps the teammate, such as seeded, and at least 2 episodes"
            )
        return protocol.episodes - protocol.last_episodes, protocol.last_episodes
    every = protocol.swap_every or protocol.episodes
    return tuple(min(every, protocol.episodes - first) for first in range(0, protocol.episodes, every))


def plan_tasks(tasks: Sequence[Task], protocol: Protocol, control: Control | None = None) -> list[PlannedTask]:
    """Return what tasks play in each segment.

    A task's partner is of the next other family on its layout, in the order of `tasks` and in turn: the first task of a
    family has the first one of the next family, and so on; if all are of one family, it is the next task with another
    teammate. Under the control `swapped` the partner's teammate plays first. Under a protocol that swaps teammates, the
    task's own is followed by that of its partner, of the partner's partner, and so on.

    Raises:
        OptionError: if a task has no partner; names the task. See also `segment_lengths`.
    """
    segments = len(segment_lengths(protocol, control))
    if segments == 1:
        return [PlannedTask(task, (task,)) for task in tasks]
    by_layout: dict[str, list[Task]] = defaultdict(list)
    for task in tasks:
        by_layout[task.layout.name].append(task)
    partner = {task.task_id: _partner(task, by_layout[task.layout.name]) for task in tasks}
    planned = []
    for task in tasks:
        chain = [task]
        for _ in range(segments - 1):
            chain.append(partner[chain[-1].task_id])
        chain = chain[::-1] if control == "swapped" else chain
        # The id stays, so that keys of episodes do, and the last episodes start as those of the plain evaluation.
        played = tuple(replace(task, teammate=one.teammate, recipes=one.recipes) for one in chain)
        planned.append(PlannedTask(task, played, tuple(one.task_id for one in chain)))
    return planned


def _partner(task: Task, on_layout: Sequence[Task]) -> Task:
    def other_dish(other: Task) -> bool:
        # A task with recipes of its own hides them from the ego, so that its partner has to want others, too.
        return task.recipes is None or other.recipes != task.recipes

    ids = [other.task_id for other in on_layout]
    following = [*on_layout[ids.index(task.task_id) + 1 :], *on_layout[: ids.index(task.task_id)]]
    families = [other.teammate_family for other in following if other_dish(other)]
    if other_families := [family for family in families if family != task.teammate_family]:
        # Of the next family the task of the same number, so that the tasks of a cell have different partners.
        partners = [one for one in on_layout if one.teammate_family == other_families[0] and other_dish(one)]
        own = [one.task_id for one in on_layout if one.teammate_family == task.teammate_family]
        return partners[own.index(task.task_id) % len(partners)]
    behaviour = teammate_id(task.teammate), task.recipes
    for other in following:
        if (teammate_id(other.teammate), other.recipes) != behaviour:
            return other
    raise OptionError(
        f"task {task.task_id}: needs a task on {task.layout.name} with another teammate to swap with, found none among "
        f"the {len(on_layout)} given ones on it: give more tasks, of several families if possible"
    )
