"""Evaluation protocols, and smaller versions of the benchmark: fewer tasks, fewer episodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from icrl4aht_generation.policy import Noise

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
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
    """Return the protocol with a name, with another number of episodes per task if one is given.

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
