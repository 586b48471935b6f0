"""Evaluation protocols, smaller versions of the benchmark, and segments of an evaluation.

A segment is a number of episodes in a row in which no task changes its teammate. An ego keeps its memory from one
segment to the next and gets no sign of the change. The keys of episodes are those of the task whoever plays, so the
last episodes of a control differ from those of the plain evaluation in nothing but the ego's memory.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

from icrl4aht_generation.policy import Noise

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks, teammate_id
from icrl4aht_data.errors import EmptySelectionError, OptionError, unknown
from icrl4aht_data.overcooked.layouts import get_layout


@dataclass(frozen=True)
class Protocol:
    """Rules of an evaluation.

    Attributes:
        name: name of the protocol, one of `PROTOCOLS`.
        noise: source of the randomness of heuristic teammates, "fixed" or "seeded", see
            `icrl4aht_generation.policy.Noise`.
        four_recipes: whether the layouts of the layout track draw from four recipes, as for the published numbers, and
            not from their own two.
        episodes: number of episodes of each task.
        steps: number of steps of each episode.
        swap_every: number of episodes after which another teammate plays; None if a task keeps its teammate.
    """

    name: str
    noise: Noise
    four_recipes: bool
    episodes: int = 100
    steps: int = KEPT_STEPS
    swap_every: int | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that results store; they name `swap_every` only if teammates change."""
        fields = asdict(self)
        return fields if self.swap_every else {name: fields[name] for name in fields if name != "swap_every"}

    @property
    def last_episodes(self) -> int:
        """Number of episodes at the end of a task that show what the ego has learned in it: half if they are few."""
        return max(1, min(LAST_EPISODES, self.episodes // 2))


LAST_EPISODES = 20
"""Most episodes that count as the last ones of a task (paper, App. F)."""


EVALUATION_SPLITS = ("test", "validation", "diverse")
"""Tasks in the package: the published test tasks, and two sets of validation tasks, by which models are chosen. Their
teammates are of the published training ranges, or diverse, see `icrl4aht_generation.teammates.draws`."""


def test_tasks(track: str, layout: str | None = None, family: str | None = None) -> list[Task]:
    """Return the benchmark's test tasks of a track, perhaps only those on a layout or with a teammate family.

    Args:
        track: "teammate" or "layout".
        layout: name of a layout, such as "demo_wide".
        family: family of the teammates, "H1" to "H4".

    Raises:
        UnknownNameError: for an unknown track or layout.
        EmptySelectionError: if the track has no such test task.
    """
    name = None if layout is None else get_layout(layout).name
    every = bundled_tasks(track, "test")
    found = [task for task in every if name in (None, task.layout.name) and family in (None, task.teammate_family)]
    if not found:
        layouts, families = ({getattr(task, of) for task in every} for of in ("layout_name", "teammate_family"))
        raise EmptySelectionError(
            f"layout = {layout}, family = {family}: no test task of track {track}; it has layouts "
            f"{', '.join(sorted(layouts))} and families {', '.join(sorted(families))}"
        )
    return found


def bundled_tasks(track: str, split: str) -> list[Task]:
    """Return the tasks of a track that are in the package.

    Args:
        track: the track.
        split: one of `EVALUATION_SPLITS`.

    Raises:
        UnknownNameError: for an unknown track or split.
    """
    if split not in EVALUATION_SPLITS:
        raise unknown("split to evaluate on", split, EVALUATION_SPLITS)
    diverse = split == "diverse"
    return read_tasks(manifest_path(track, "validation", "diverse") if diverse else manifest_path(track, split))


PROTOCOLS = {
    "published": Protocol("published", noise="fixed", four_recipes=True),
    "seeded": Protocol("seeded", noise="seeded", four_recipes=False),
    "swap": Protocol("swap", noise="seeded", four_recipes=False, swap_every=25),
}
"""Protocols by name: `published`, to compare with the paper's numbers; `seeded`, the default, to report; `swap`, the
same with another teammate every 25 episodes, without a sign."""


def get_protocol(name: str, episodes: int | None = None) -> Protocol:
    """Return the protocol called `name`; `episodes`, if given, replaces its number of episodes per task.

    Raises:
        UnknownNameError: if there is no such protocol; lists the valid names and the nearest.
        OptionError: if the number of episodes is not positive.
    """
    if name not in PROTOCOLS:
        raise unknown("protocol", name, PROTOCOLS)
    if episodes is None:
        return PROTOCOLS[name]
    if episodes < 1:
        raise OptionError(f"episodes = {episodes}: expected at least 1")
    return replace(PROTOCOLS[name], episodes=episodes)


def hidden_recipe_note(tasks: Sequence[Task]) -> str:
    """Return a sentence that names the layouts on which no observation shows the ego the wanted dish; empty if none.

    Layouts with a single recipe do not count, unless the tasks fix one of several.
    """
    hidden = [task for task in tasks if not task.layout.shows_recipe]
    hidden = [task for task in hidden if len(task.layout.recipes) > 1 or task.recipes is not None]
    if not hidden:
        return ""
    names = ", ".join(dict.fromkeys(task.layout.name for task in hidden))
    fixed = " In tasks with one dish throughout, it can remember what was paid." if hidden[0].recipes else ""
    return f"no observation shows the wanted dish on {names}: an ego has to find it out from what is paid.{fixed}"


def limit_tasks(tasks: Sequence[Task], count: int | None) -> list[Task]:
    """Return the first `count` tasks of each cell, a layout with a teammate kind, in order; all tasks for None.

    A count of 2 chooses up to 2 tasks in each of the cells, not 2 tasks in all.

    Raises:
        OptionError: if `count` is not positive.
    """
    if count is None:
        return list(tasks)
    if count < 1:
        raise OptionError(f"tasks = {count}: expected at least 1 of each family and layout")
    taken: dict[tuple[str, str], int] = defaultdict(int)
    chosen = []
    for task in tasks:
        group = task.layout.name, task.teammate_kind
        if taken[group] < count:
            chosen.append(task)
        taken[group] += 1
    return chosen


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
