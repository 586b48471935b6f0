"""The training of RL^2 with the teammates of a release and of other tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.experts.oracle_teammate import oracle_teammate
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.draws import find_draw
from icrl4aht_generation.teammates.registry import build_teammate, recover_teammate

from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.online.layouts import rearranged_layouts, with_four_recipes
from icrl4aht_baselines.online.rl2 import PlayTrainer, TaskGroup, chosen_teammates, make_groups
from icrl4aht_baselines.online.teammates import check_heuristics, mixed_chances, with_manners
from icrl4aht_baselines.training.histories import filter_histories, history_settings, training_cells
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.seen import TASKS_SOURCE
from icrl4aht_baselines.training.trainer import TrainingData
from icrl4aht_data.benchmark.facts import LEAST_HEADROOM
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

FOUR_RECIPES_SHARE = 0.2
"""Number of tasks on a layout with four recipes, as a share of that on others."""

REARRANGED_SHARE = 1.5
"""Number of tasks on all rearranged versions of a layout, as a share of that on the layout."""

ORACLE = "oracle"
"""Kind and family of the oracle as a teammate."""

ORACLE_IDLES = (0.0, 0.2, 0.4, 0.6, 0.8)
"""Chances that oracles as teammates idle in a step."""


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
    """Return the training of a method that plays with the teammates of a release's histories, and of other tasks.

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
    _check_layouts(layouts, teammates)
    if play.oracle_teammate:
        teammates |= _oracles(layouts)
    shares = _shares(dataset, tasks)
    groups, played = _groups(teammates, shares, hidden, play, options.batch_size)
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
    """Return the release, the histories on the chosen layouts, and these layouts.

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
    """Return the tasks on some layouts."""
    check_heuristics(tasks)
    found = [task for task in tasks if task.layout in layouts]
    if tasks and not found:
        on = ", ".join(sorted({task.layout.name for task in tasks}))
        raise OptionError(f"none of the {len(tasks)} tasks is on {', '.join(one.name for one in layouts)}, but on {on}")
    return found


def _check_unused(name: str, histories: HistoryOptions) -> None:
    default = HistoryOptions(histories.layouts)
    for field in ("order", "queries", "labels", "every", "weights", "curriculum", "held_out", "obs"):
        found = getattr(histories, field)
        if found != getattr(default, field):
            raise OptionError(f"{field} = {found}: {name} learns by playing, not from histories; leave it out")
    if histories.channels == "own":
        raise OptionError(f"channels = own: {name} takes canonical channels; leave it out")


def _teammates(dataset: Dataset | None, tasks: Sequence[Task]) -> _Teammates:
    """Return the teammates of all tasks of a selection of histories, and of some more."""
    found: _Teammates = {}
    if dataset is not None:
        history_of = dict(zip(dataset.column("task_id").tolist(), dataset.ids.tolist(), strict=True))
        for task_id, history_id in history_of.items():
            entry = dataset.index.entry(history_id)
            key = get_layout(entry.layout), entry.teammate_kind
            mate = _Teammate(dataset.recover_teammate(history_id), recover_teammate(dataset, history_id))
            found.setdefault(key, {})[task_id] = mate
    for task in tasks:
        mate = _Teammate(task.teammate, build_teammate(task.layout, task.teammate))
        found.setdefault((task.layout, task.teammate_kind), {})[task.task_id] = mate
    return found


def _oracles(layouts: Sequence[Layout]) -> _Teammates:
    """Return the oracle as a teammate of several speeds on each layout."""
    entries = {f"{ORACLE} that idles in {idle:.0%}": {"kind": ORACLE, "idle": idle} for idle in ORACLE_IDLES}
    return {
        (layout, ORACLE): {name: _Teammate(entry, _build(layout, entry)) for name, entry in entries.items()}
        for layout in layouts
    }


def _build(layout: Layout, entry: dict[str, Any]) -> Policy:
    """Return the policy of a teammate's entry, as in a task or of `_oracles`."""
    if entry["kind"] == ORACLE:
        return oracle_teammate(layout)._replace(params=jnp.float32(entry["idle"]))
    return build_teammate(layout, entry)


def _check_layouts(layouts: Sequence[Layout], teammates: _Teammates) -> None:
    """Check that every chosen layout has teammates."""
    missing = [layout.name for layout in layouts if layout not in {layout for layout, _ in teammates}]
    if missing:
        raise OptionError(
            f"{', '.join(missing)}: neither a chosen history nor a task of a manifest is on this layout; leave it out, "
            f"or choose other filters or manifests"
        )


def _groups(
    teammates: _Teammates, shares: Mapping[str, float], hidden: Sequence[str], play: PlayOptions, tasks: int
) -> tuple[list[TaskGroup], set[str]]:
    """Return the groups of tasks, and the ids of the tasks whose teammates they play with; with few tasks not all are.

    Raises:
        OptionError: if other layouts are wanted and a layout has learned teammates alone, which play on it only.
    """
    heuristics = _heuristic_families(teammates) if play.four_recipes or play.rearranged else {}
    everywhere = dict(teammates)
    for layout, families in heuristics.items() if play.four_recipes else ():
        other, family = with_four_recipes(layout), next(iter(families))
        everywhere[other, family] = _rebuilt(families[family], other)
        shares = {**shares, other.name: FOUR_RECIPES_SHARE}
        hidden = [*hidden, *[other.name] * (layout.name in hidden)]
    total = sum(shares[name] for name in {layout.name for layout, _ in everywhere})
    rearranged = {layout: REARRANGED_SHARE * shares[layout.name] for layout in heuristics if play.rearranged}
    fixed = round(tasks * total / (total + sum(rearranged.values())))
    policies = {key: [mate.policy for mate in found.values()] for key, found in everywhere.items()}
    groups = make_groups(policies, fixed, shares, hidden)
    played: set[str] = set()
    for group in groups:
        names = list(everywhere[group.layouts[0], group.family])
        played |= {names[number] for number in chosen_teammates(len(names), len(group.teammates))}
    for layout, share in rearranged.items():
        count = round((tasks - fixed) * share / sum(rearranged.values()))
        for group, names in _rearranged_groups(
            layout, heuristics[layout], count, play.rearranged, layout.name in hidden
        ):
            groups.append(group)
            played |= names
    return groups, played


def _heuristic_families(teammates: _Teammates) -> dict[Layout, dict[str, dict[str, _Teammate]]]:
    """Return the families of each layout that are heuristics, which can play on other layouts as well."""
    found: dict[Layout, dict[str, dict[str, _Teammate]]] = {layout: {} for layout, _ in teammates}
    for (layout, family), mates in teammates.items():
        if all(mate.entry["kind"] in ("heuristic", ORACLE) for mate in mates.values()):
            found[layout][family] = mates
    for layout, families in found.items():
        if not families:
            raise OptionError(
                f"{layout.name}: rearranged layouts and four recipes need heuristic teammates, this layout has learned "
                f"ones alone; leave out --rearranged and --four-recipes, or give a manifest with heuristics"
            )
    return found


def _rearranged_groups(
    layout: Layout, families: Mapping[str, dict[str, _Teammate]], tasks: int, versions: int, hidden: bool
) -> list[tuple[TaskGroup, set[str]]]:
    """Return a group of each family on rearranged versions of a layout, and the tasks that its teammates are of.

    The versions are divided equally among the families, and the tasks of a family among its versions, at
    least one each.
    """
    layouts = rearranged_layouts(layout, versions)
    ends = [round(versions * k / len(families)) for k in range(len(families) + 1)]
    found = []
    for (family, mates), first, end in zip(families.items(), ends, ends[1:], strict=False):
        own = layouts[first:end]
        if not own:
            continue
        count = max(len(own), round(tasks * len(own) / versions))
        where = [own[task % len(own)] for task in range(count)]
        chosen = [list(mates)[k] for k in chosen_teammates(len(mates), count)]
        policies = [_build(one, mates[name].entry) for one, name in zip(where, chosen, strict=True)]
        manners = [
            with_manners([policy], chances[None])[0]
            for policy, chances in zip(policies, mixed_chances(count), strict=True)
        ]
        found.append((TaskGroup(where, family, manners, hidden, f"{layout.name} rearranged"), set(chosen)))
    return found


def _rebuilt(mates: Mapping[str, _Teammate], layout: Layout) -> dict[str, _Teammate]:
    """Return heuristics on another layout."""
    return {task_id: mate._replace(policy=_build(layout, mate.entry)) for task_id, mate in mates.items()}


def _shares(dataset: Dataset | None, tasks: Sequence[Task]) -> dict[str, float]:
    """Return the share of the tasks on each layout, in units of those on layouts where the ego matters.

    With a drawn teammate it matters if the oracle earns more than an ego that does nothing. Teammates without
    measurements count as ones with which it matters.
    """
    matters: dict[str, bool] = {}
    for task in tasks:
        draw = find_draw(task.layout.name, task.teammate)
        helps = draw is None or draw.oracle - draw.stay >= LEAST_HEADROOM
        matters[task.layout.name] = matters.get(task.layout.name, False) or helps
    if dataset is not None:
        path = Path(dataset.root) / PROVENANCE
        provenance = read_provenance(path) if path.is_file() else {}
        for layout, task_id in zip(dataset.column("layout"), dataset.column("task_id"), strict=True):
            made = provenance.get(str(task_id))
            own = made is None or made.references is None or made.references.matters
            matters[str(layout)] = matters.get(str(layout), False) or own
    return {layout: 1.0 if found else FLAT_SHARE for layout, found in matters.items()}


def _played_cells(
    dataset: Dataset | None, tasks: Sequence[Task], played: set[str], labels: Labels | None
) -> list[dict[str, Any]]:
    """Return the record of training data of the tasks that are played, see `training_cells`."""
    cells = []
    if dataset is not None:
        of_played = np.isin(dataset.column("task_id"), sorted(played))
        cells = training_cells(dataset.select(of_played), labels) if of_played.any() else []
    return cells + _task_cells([task for task in tasks if task.task_id in played], labels)


def _task_cells(tasks: Sequence[Task], labels: Labels | None) -> list[dict[str, Any]]:
    """Return what playing tasks without histories adds to the record of training data, see `training_cells`."""
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
            "source": TASKS_SOURCE,
            "labels": labels,
            "tasks": len(found),
            "histories": 0,
            "tasks_hash": json_hash(sorted(task.task_id for task in found)),
            "teammates": sorted({teammate_id(task.teammate) for task in found}),
        }
        for (layout, split, family, kind), found in cells.items()
    ]
