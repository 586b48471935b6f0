"""The training of RL^2 with the teammates of a release and of other tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.methods.method import Method
from baselines.methods.options import ModelOptions
from baselines.methods.registry import get_method, overcooked_world
from baselines.online.layouts import rearranged_layouts, with_four_recipes
from baselines.online.rl2 import PlayTrainer, TaskGroup, chosen_teammates, make_groups
from baselines.online.teammates import check_heuristics
from baselines.training.histories import filter_histories, history_settings, training_cells
from baselines.training.options import ALL_LAYOUTS, HistoryOptions, PlayOptions, TrainOptions
from baselines.training.trainer import TrainingData
from generation.policy import Policy
from generation.teammates.registry import build_teammate, recover_teammate
from icrl4aht_data.benchmark.tasks import Task, teammate_id
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.provenance import read_provenance
from icrl4aht_data.format.schema import PROVENANCE
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.utils.files import json_hash

FLAT_SHARE = 0.3
"""Number of tasks on a layout where the ego matters with no teammate, as a share of that on other layouts."""

OTHER_SHARE = 0.2
"""Number of tasks on a layout that is none of the benchmark's, as a share of that on others."""


class PlayJob(NamedTuple):
    """Arguments of `trainer.train`, except for a folder.

    Attributes:
        method: what to train.
        trainer: computes the steps.
        data: no batches.
        about: settings for config.json.
    """

    method: Method
    trainer: PlayTrainer
    data: TrainingData
    about: dict[str, Any]


class _Teammate(NamedTuple):
    """A training teammate on one layout.

    Attributes:
        entry: as in a task.
        policy: how it plays.
    """

    entry: dict[str, Any]
    policy: Policy


_Teammates = dict[tuple[Layout, str], dict[str, _Teammate]]
"""Layout and family -> task id -> teammate."""


def prepare_play(
    name: str,
    model: ModelOptions,
    options: TrainOptions,
    play: PlayOptions,
    histories: HistoryOptions,
    tasks: Sequence[Task] = (),
) -> PlayJob:
    """Returns the training of a method that plays with the teammates of a release's histories, and of other tasks.

    Args:
        name: of the method.
        model: its architecture.
        options: of the training; `batch_size` is the number of tasks.
        play: hyper-parameters of playing and learning.
        histories: whose teammates to play with, on which layouts.
        tasks: tasks with more teammates, heuristics. Those on other layouts are left out.

    Raises:
        EmptySelectionError: if no history has a value that the choice of histories filters by.
        OptionError: for settings of histories that have no meaning here, tasks none of which is on these layouts, and
            tasks with learned teammates.
    """
    _check_unused(name, histories)
    release, dataset, layouts = _chosen_histories(histories, tasks)
    tasks = _tasks_on(layouts, tasks)
    method = get_method(name)(model, overcooked_world(layouts, model.encoder, canonical=True))
    hidden = [get_layout(one).name for one in histories.hide_recipe]
    teammates = _teammates(dataset, tasks)
    everywhere = teammates | _on_other_layouts(teammates, play)
    policies = {key: [mate.policy for mate in found.values()] for key, found in everywhere.items()}
    shares = _shares(dataset, tasks)
    shares = {layout.name: shares.get(layout.name, OTHER_SHARE) for layout, _ in everywhere}
    hides = {layout.name for layout, _ in everywhere if layout.name.split()[0] in hidden}
    groups = make_groups(policies, options.batch_size, shares, hides)
    played = _played(teammates, groups)
    labels: Labels | None = "oracle" if play.imitation else None
    about = {
        "model": asdict(model),
        "play": asdict(play),
        "histories": asdict(histories)
        | history_settings(release)
        | {
            "layouts": [layout.name for layout in layouts],
            "hide_recipe": hidden,
            "channels": "canonical",
            "obs_shape": list(observation_shape(layouts[0], True)),
            "groups": {group.name: len(group.teammates) for group in groups},
        },
        "trained_on": _played_cells(dataset, tasks, played, labels),
    }
    trainer = PlayTrainer(method, options, play, groups, histories.mirror)
    return PlayJob(method, trainer, TrainingData(None, {}), about)


def _chosen_histories(histories: HistoryOptions, tasks: Sequence[Task]) -> tuple[Dataset, Dataset | None, list[Layout]]:
    """Returns the release, the histories on the chosen layouts, and these layouts.

    Where tasks are played as well, layouts need no histories.
    """
    release = load_icrl4aht(histories.root)
    if ALL_LAYOUTS in histories.layouts:
        dataset = filter_histories(release.filter(split=histories.split), histories.filters)
        return release, dataset, list(dataset.layouts)
    layouts = list(dict.fromkeys(get_layout(one) for one in histories.layouts))
    stored = {get_layout(layout.name) for layout in release.layouts}
    names = [layout.name for layout in layouts if not tasks or layout in stored]
    if not names:
        return release, None, layouts
    dataset = filter_histories(release.filter(split=histories.split, layout=names), histories.filters)
    return release, dataset, layouts


def _tasks_on(layouts: Sequence[Layout], tasks: Sequence[Task]) -> list[Task]:
    """Returns the tasks on some layouts."""
    check_heuristics(tasks)
    found = [task for task in tasks if task.layout in layouts]
    if tasks and not found:
        on = ", ".join(sorted({task.layout.name for task in tasks}))
        raise OptionError(f"none of the {len(tasks)} tasks is on {', '.join(one.name for one in layouts)}, but on {on}")
    return found


def _check_unused(name: str, histories: HistoryOptions) -> None:
    default = HistoryOptions(histories.layouts)
    for field in ("order", "labels", "every", "weights", "curriculum", "held_out", "obs"):
        found = getattr(histories, field)
        if found != getattr(default, field):
            raise OptionError(f"{field} = {found}: {name} learns by playing, not from histories; leave it out")
    if histories.channels == "own":
        raise OptionError(f"channels = own: {name} takes canonical channels; leave it out")


def _teammates(dataset: Dataset | None, tasks: Sequence[Task]) -> _Teammates:
    """Returns the teammates of all tasks of a selection of histories, and of some more."""
    found: _Teammates = {}
    for task_id, history_id in _history_of_task(dataset).items():
        assert dataset is not None
        entry = dataset.index.entry(history_id)
        key = get_layout(entry.layout), entry.teammate_kind
        mate = _Teammate(dataset.recover_teammate(history_id), recover_teammate(dataset, history_id))
        found.setdefault(key, {})[task_id] = mate
    for task in tasks:
        mate = _Teammate(task.teammate, build_teammate(task.layout, task.teammate))
        found.setdefault((task.layout, task.teammate_kind), {})[task.task_id] = mate
    return found


def _history_of_task(dataset: Dataset | None) -> dict[str, int]:
    """Returns a history of each task of a selection."""
    if dataset is None:
        return {}
    return {str(task): int(number) for task, number in zip(dataset.column("task_id"), dataset.ids, strict=True)}


def _on_other_layouts(teammates: _Teammates, play: PlayOptions) -> _Teammates:
    """Returns heuristics on further layouts: all of a layout's families with four recipes, and one on each of its
    rearranged layouts, in turn."""
    families: dict[Layout, list[str]] = {}
    for (layout, family), mates in teammates.items():
        if all(mate.entry["kind"] == "heuristic" for mate in mates.values()):
            families.setdefault(layout, []).append(family)
    chosen: list[tuple[Layout, Layout, str]] = []
    for layout, names in families.items():
        if play.four_recipes:
            chosen += [(layout, with_four_recipes(layout), family) for family in names[:1]]
        other = rearranged_layouts(layout, play.rearranged) if play.rearranged else []
        chosen += [(layout, one, names[number % len(names)]) for number, one in enumerate(other)]
    return {
        (other, family): {
            task_id: mate._replace(policy=build_teammate(other, mate.entry))
            for task_id, mate in teammates[layout, family].items()
        }
        for layout, other, family in chosen
    }


def _played(teammates: _Teammates, groups: Sequence[TaskGroup]) -> set[str]:
    """Returns the tasks whose teammates are played with; with few tasks not all are."""
    played: set[str] = set()
    for group in groups:
        names = list(teammates.get((group.layout, group.family), ()))
        if names:
            played |= {names[number] for number in chosen_teammates(len(names), len(group.teammates))}
    return played


def _shares(dataset: Dataset | None, tasks: Sequence[Task]) -> dict[str, float]:
    """Returns the share of the tasks on each layout, in units of those on layouts where the ego matters."""
    shares = {task.layout.name: 1.0 for task in tasks}
    if dataset is None:
        return shares
    path = Path(dataset.root) / PROVENANCE
    provenance = read_provenance(path) if path.is_file() else {}
    shares |= {layout.name: FLAT_SHARE if provenance else 1.0 for layout in dataset.layouts}
    for layout, task_id in zip(dataset.column("layout"), dataset.column("task_id"), strict=True):
        made = provenance.get(str(task_id))
        if made is not None and (made.references is None or made.references.matters):
            shares[str(layout)] = 1.0
    return shares


def _played_cells(
    dataset: Dataset | None, tasks: Sequence[Task], played: set[str], labels: Labels | None
) -> list[dict[str, Any]]:
    """Returns the record of training data of the tasks that are played, see `training_cells`."""
    cells = []
    if dataset is not None:
        of_played = np.isin(dataset.column("task_id"), sorted(played))
        cells = training_cells(dataset.select(of_played), labels) if of_played.any() else []
    return cells + _task_cells([task for task in tasks if task.task_id in played], labels)


def _task_cells(tasks: Sequence[Task], labels: Labels | None) -> list[dict[str, Any]]:
    """Returns what playing tasks without histories adds to the record of training data, see `training_cells`."""
    cells: dict[tuple[str, str, str, str], list[Task]] = {}
    for task in tasks:
        key = task.layout.name, task.split, task.teammate_family, task.teammate_kind
        cells.setdefault(key, []).append(task)
    return [
        {
            "layout": layout,
            "split": split,
            "family": family,
            "algorithm": kind,
            "source": "tasks",
            "labels": labels,
            "tasks": len(found),
            "histories": 0,
            "tasks_hash": json_hash(sorted(task.task_id for task in found)),
            "teammates": sorted({teammate_id(task.teammate) for task in found}),
        }
        for (layout, split, family, kind), found in cells.items()
    ]
