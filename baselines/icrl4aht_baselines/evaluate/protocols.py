"""Protocols and controls of evaluations, the choice of tasks, and the segments that a task is played in.

A segment is a sequence of episodes with the same teammate. An ego keeps its memory from one segment to the next and
does not observe that the teammate changes. The random keys of episodes depend on the task but not on the teammate, so
the last episodes of a control differ from those of the evaluation without it only in the ego's memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

from icrl4aht_generation.policy import Noise

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks, teammate_id
from icrl4aht_data.errors import EmptySelectionError, OptionError, check_choice
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.groups import grouped


@dataclass(frozen=True)
class Protocol:
    """Rules of an evaluation.

    Attributes:
        name: name of the protocol, one of `PROTOCOLS`.
        noise: source of the randomness of heuristic teammates, "fixed" or "seeded", see
            `icrl4aht_generation.policy.Noise`.
        four_recipes: whether layouts of the layout track sample from four recipes, as for the published numbers,
            instead of two.
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
        """The protocol's fields as stored with results; `swap_every` is left out if the teammate never changes."""
        return {name: value for name, value in asdict(self).items() if name != "swap_every" or value}

    @property
    def last_episodes(self) -> int:
        """Number of episodes at the end of a task that measure adaptation: 20, or half of all if that is less."""
        return max(1, min(LAST_EPISODES, self.episodes // 2))


LAST_EPISODES = 20
"""Largest number of episodes that count as the last ones of a task (paper, App. F)."""


EVALUATION_SPLITS = ("test", "validation", "diverse")
"""Splits of the package's tasks: the published test tasks, and two sets of validation tasks to choose models by.
Teammates of `validation` have parameters of the published training ranges, those of `diverse` vary more, see
`icrl4aht_generation.teammates.draws`."""


def test_tasks(track: str, layout: str | None = None, family: str | None = None) -> list[Task]:
    """Return the benchmark's test tasks of a track, optionally only those on one layout or with one teammate family.

    Args:
        track: "teammate" or "layout".
        layout: name of a layout, such as "demo_wide".
        family: family of the teammates, "H1" to "H4".

    Raises:
        UnknownNameError: for an unknown track or layout.
        EmptySelectionError: if the track has no test task on the layout with the family.
    """
    name = None if layout is None else get_layout(layout).name
    every = bundled_tasks(track, "test")
    found = [task for task in every if name in (None, task.layout.name) and family in (None, task.teammate_family)]
    if not found:
        layouts, families = ({getattr(task, of) for task in every} for of in ("layout_name", "teammate_family"))
        raise EmptySelectionError(
            f"layout = {layout}, family = {family}: no test task of track {track}, which has layouts "
            f"{', '.join(sorted(layouts))} and families {', '.join(sorted(families))}"
        )
    return found


def bundled_tasks(track: str, split: str) -> list[Task]:
    """Return the package's tasks of a track and a split.

    Args:
        track: name of the track.
        split: one of `EVALUATION_SPLITS`.

    Raises:
        UnknownNameError: for an unknown track or split.
    """
    check_choice("split to evaluate on", split, EVALUATION_SPLITS)
    diverse = split == "diverse"
    return read_tasks(manifest_path(track, "validation", "diverse") if diverse else manifest_path(track, split))


PROTOCOLS = {
    "published": Protocol("published", noise="fixed", four_recipes=True),
    "seeded": Protocol("seeded", noise="seeded", four_recipes=False),
    "swap": Protocol("swap", noise="seeded", four_recipes=False, swap_every=25),
}
"""Protocols by name: `published` to compare with the paper's numbers, `seeded` (the default) to report results, and
`swap`, which is `seeded` with an unannounced change of the teammate every 25 episodes."""


def get_protocol(name: str, episodes: int | None = None) -> Protocol:
    """Return a protocol by its name, optionally with another number of episodes per task.

    Raises:
        UnknownNameError: if the name is unknown; the message lists the valid names.
        OptionError: if the number of episodes is not positive.
    """
    check_choice("protocol", name, PROTOCOLS)
    if episodes is None:
        return PROTOCOLS[name]
    if episodes < 1:
        raise OptionError(f"episodes = {episodes}: expected at least 1")
    return replace(PROTOCOLS[name], episodes=episodes)


def hidden_recipe_note(tasks: Sequence[Task]) -> str:
    """Return a sentence that names layouts on which observations do not show the ordered dish, or an empty string.

    A layout with a single recipe is left out, since its dish is known, unless a task replaces the layout's recipes.
    """
    hidden = [task for task in tasks if not task.layout.shows_recipe]
    hidden = [task for task in hidden if len(task.layout.recipes) > 1 or task.recipes is not None]
    if not hidden:
        return ""
    names = ", ".join(dict.fromkeys(task.layout.name for task in hidden))
    fixed = " In tasks with one dish throughout, it can remember what was rewarded." if hidden[0].recipes else ""
    return f"no observation shows the wanted dish on {names}: an ego has to find it out from rewards.{fixed}"


def limit_tasks(tasks: Sequence[Task], count: int | None) -> list[Task]:
    """Return the first `count` tasks of each combination of layout and teammate kind; all tasks if `count` is None.

    A count of 2 chooses up to 2 tasks of each combination, not 2 tasks in all.

    Raises:
        OptionError: if `count` is not positive.
    """
    if count is not None and count < 1:
        raise OptionError(f"tasks = {count}: expected at least 1 task of each layout and teammate kind")
    groups = grouped(tasks, lambda task: (task.layout.name, task.teammate_kind))
    chosen = {task.task_id for group in groups.values() for task in group[:count]}
    return [task for task in tasks if task.task_id in chosen]


SUBMITTED_SEEDS = (0, 1, 2)
"""Seeds that every task of a submission must be played with; best responses are reported with the same seeds."""

Control = Literal["cleared", "swapped"]
CONTROLS: dict[Control, str] = {"cleared": "forget", "swapped": "swapped"}
"""Name of a control -> key that marks its results in their `details`. `cleared`: the ego's memory is cleared before
each episode. `swapped`: another task's teammate plays all episodes but the last, see `Protocol.last_episodes`."""


def controlled_name(agent: str, control: Control) -> str:
    """Return an agent's name in the results of a control, such as "mine (cleared)"."""
    return f"{agent} ({control})"


class PlannedTask(NamedTuple):
    """A task with the teammates that play its segments.

    Attributes:
        task: the evaluated task.
        played: for each segment, `task` with the teammate and the recipes of the segment's partner task.
        partners: ids of the partner tasks, one per segment; empty if there is only one segment.
    """

    task: Task
    played: tuple[Task, ...]
    partners: tuple[str, ...] = ()


def segment_lengths(protocol: Protocol, control: Control | None = None) -> tuple[int, ...]:
    """Return the number of episodes of each segment of a task.

    Raises:
        OptionError: for the control `swapped`, if tasks have one episode or the protocol already swaps teammates.
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
    """Return each task with the teammates of its segments, which come from the task itself or from partner tasks.

    A partner task is on the same layout and of the next teammate family, in the order of `tasks`: the first task of a
    family gets the first task of the next family, and so on. For a task with a fixed dish, only tasks with another dish
    count. If no other family is left, the partner is the next task with another teammate or another dish. Under the
    control `swapped`, the partner's teammate plays first. Under a protocol that swaps teammates, the task's teammate
    plays first, then the partner's teammate, then the teammate of the partner's partner.

    Raises:
        OptionError: if a task has no partner (the message names the task), or see `segment_lengths`.
    """
    segments = len(segment_lengths(protocol, control))
    if segments == 1:
        return [PlannedTask(task, (task,)) for task in tasks]
    by_layout = grouped(tasks, lambda task: task.layout.name)
    partner = {task.task_id: _find_partner_task(task, by_layout[task.layout.name]) for task in tasks}
    planned = []
    for task in tasks:
        chain = [task]
        for _ in range(segments - 1):
            chain.append(partner[chain[-1].task_id])
        chain = chain[::-1] if control == "swapped" else chain
        # The task id is kept, so that the keys and initial states of episodes are those of the evaluated task.
        played = tuple(replace(task, teammate=one.teammate, recipes=one.recipes) for one in chain)
        planned.append(PlannedTask(task, played, tuple(one.task_id for one in chain)))
    return planned


def _find_partner_task(task: Task, on_layout: Sequence[Task]) -> Task:
    def has_other_dish(other: Task) -> bool:
        # If the task fixes a dish, the ego has to find out the dish, so a partner task needs another dish.
        return task.recipes is None or other.recipes != task.recipes

    ids = [other.task_id for other in on_layout]
    following = [*on_layout[ids.index(task.task_id) + 1 :], *on_layout[: ids.index(task.task_id)]]
    families = [other.teammate_family for other in following if has_other_dish(other)]
    if other_families := [family for family in families if family != task.teammate_family]:
        # The partner task has the same number in the next family, so that tasks of a family get different partners.
        partners = [one for one in on_layout if one.teammate_family == other_families[0] and has_other_dish(one)]
        own = [one.task_id for one in on_layout if one.teammate_family == task.teammate_family]
        return partners[own.index(task.task_id) % len(partners)]
    behaviour = teammate_id(task.teammate), task.recipes
    for other in following:
        if (teammate_id(other.teammate), other.recipes) != behaviour:
            return other
    raise OptionError(
        f"task {task.task_id}: expected another task on {task.layout.name} with another teammate to swap with, found "
        f"none among {len(on_layout)} tasks: give more tasks, of several families if possible"
    )
