"""Preparation of RL^2 training with the teammates of a release and of other tasks."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from icrl4aht_generation.layouts.rearranged import rearranged_layouts, with_four_recipes
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.registry import build_teammate, recover_teammate, with_equal_parameter_names
from icrl4aht_generation.teammates.spread import find_measured

from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.online.rl2 import PlayTask, PlayTrainer, make_group, make_play_tasks
from icrl4aht_baselines.online.teammates import tasks_on_layouts
from icrl4aht_baselines.training.histories import (
    filter_histories,
    history_settings,
    training_record,
    training_record_entry,
)
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.seen import TASKS_SOURCE, TRAINED_ON
from icrl4aht_baselines.training.trainer import TrainingData, TrainingTask
from icrl4aht_data.benchmark.facts import LEAST_HEADROOM
from icrl4aht_data.benchmark.tasks import Task, teammate_id
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.utils.groups import grouped

FLAT_SHARE = 0.3
"""Number of tasks on a layout on which measured egos earn about the same, relative to other layouts."""

FOUR_RECIPES_SHARE = 0.2
"""Number of tasks on a layout's version with four recipes, relative to other layouts."""

REARRANGED_SHARE = 1.5
"""Number of tasks on all rearranged versions of a layout, relative to the layout itself."""


_Teammates = dict[tuple[Layout, str], dict[str, Policy]]
"""(layout, kind of teammate) -> task id -> teammate. If a task fixes the dish, its layout has only this recipe."""


def prepare_play(
    name: str,
    model: ModelOptions,
    options: TrainOptions,
    play: PlayOptions,
    histories: HistoryOptions,
    tasks: Sequence[Task] = (),
) -> TrainingTask:
    """Return a `TrainingTask` for a method that plays with teammates from a release's histories and from other tasks.

    Args:
        name: name of the method.
        model: architecture of the model.
        options: options of the training; `batch_size` is the number of tasks that are played in parallel.
        play: hyper-parameters of playing and learning.
        histories: choice of histories, which determine the layouts and teammates to play with.
        tasks: tasks with additional heuristic teammates; tasks on other layouts are left out.

    Raises:
        UnknownNameError: if a filter has an unknown value.
        EmptySelectionError: if no history passes a filter.
        OptionError: if `histories` has options that do not apply to playing, none of `tasks` is on the chosen layouts,
            or one of `tasks` has a learned teammate.
    """
    _check_unused(name, histories)
    release, dataset, layouts = _chosen_histories(histories, tasks)
    tasks = tasks_on_layouts(tasks, layouts)
    teammates = _task_teammates(dataset, tasks)
    _check_layouts(layouts, teammates)
    # Channels are canonical, because one network plays on all layouts.
    method = get_method(name)(model, overcooked_world(layouts, model.encoder, canonical=True))
    hidden = [get_layout(one).name for one in histories.hide_recipe]
    # In tasks with a fixed dish that no indicator shows, the model imitates the script `search`.
    fixed = {layout for layout, _ in teammates if _fixes_dish(layout)}
    searched = {layout for layout in fixed if layout.name in hidden or not layout.shows_recipe}
    # With few tasks, some teammates have none, so the record of training data must not state them.
    played = [
        task._replace(searched=task.layout in searched)
        for task in _training_tasks(teammates, _shares(dataset, tasks), hidden, play, options.batch_size)
    ]
    # Actions of `search` are recorded as "oracle" labels too: `search` is the oracle with a guessed recipe.
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
            "groups": dict(Counter(task.name for task in played)),
            "searched": sorted({task.label for task in played if task.searched}),
        },
        TRAINED_ON: _training_record(dataset, tasks, {task.id for task in played}, labels),
    }
    trainer = PlayTrainer(method, options, play, played, histories.mirror)
    return TrainingTask(method, TrainingData(None, {}), options, about, trainer)


def _check_unused(name: str, histories: HistoryOptions) -> None:
    # Ignored options are refused, because they would be stored and make equal runs look different in tables.
    default = HistoryOptions(histories.layouts)
    for field in ("order", "queries", "labels", "every", "first", "at_start", "balance", "held_out"):
        found = getattr(histories, field)
        if found != getattr(default, field):
            raise OptionError(f"{field} = {found}: {name} learns by playing, not from histories; leave out this option")
    if histories.channels == "own":
        raise OptionError(f"channels = own: {name} takes canonical channels; leave out this option")


def _chosen_histories(histories: HistoryOptions, tasks: Sequence[Task]) -> tuple[Dataset, Dataset | None, list[Layout]]:
    """Return the release, its chosen histories (None if there are none), and the chosen layouts."""
    release = load_icrl4aht(histories.root)
    names: list[str] | None = None
    layouts: list[Layout] = []
    if ALL_LAYOUTS not in histories.layouts:
        layouts = list(dict.fromkeys(get_layout(one) for one in histories.layouts))
        stored = {get_layout(layout.name) for layout in release.layouts}
        # `release.filter` refuses layouts without histories, but `tasks` may be on such layouts.
        names = [layout.name for layout in layouts if not tasks or layout in stored]
        if not names:
            return release, None, layouts
    dataset = filter_histories(release.filter(split="train", layout=names), histories.filters)
    return release, dataset, layouts or list(dataset.layouts)


def _task_teammates(dataset: Dataset | None, tasks: Sequence[Task]) -> _Teammates:
    """Return the teammates in a selection of histories and in additional tasks."""
    found: _Teammates = {}
    scripted = [(task.layout, task.task_id, task.teammate) for task in tasks]
    if dataset is not None:
        # All histories of a task have the same teammate, so one history per task is enough.
        history_of = dict(zip(dataset.column("task_id").tolist(), dataset.ids.tolist(), strict=True))
        for task_id, history_id in history_of.items():
            layout, teammate = dataset.history_task(history_id).layout, dataset.recover_teammate(history_id)
            if teammate["kind"] == "rl":
                mates = found.setdefault((layout, teammate["family"]), {})
                mates[task_id] = recover_teammate(dataset, history_id)
            else:
                scripted.append((layout, task_id, teammate))
    # All heuristics of a family share one compiled program, so they need the same parameter names.
    entries = with_equal_parameter_names([teammate for _, _, teammate in scripted])
    for (layout, task_id, teammate), entry in zip(scripted, entries, strict=True):
        mates = found.setdefault((layout, teammate["family"]), {})
        mates[task_id] = build_teammate(None, entry)
    return found


def _check_layouts(layouts: Sequence[Layout], teammates: _Teammates) -> None:
    """Check that there are teammates for every chosen layout."""
    known = {layout.name for layout, _ in teammates}
    missing = [layout.name for layout in layouts if layout.name not in known]
    if missing:
        raise OptionError(
            f"{', '.join(missing)}: no chosen history and no task of a manifest is on these layouts; choose other "
            f"layouts, filters or manifests"
        )


def _training_tasks(
    teammates: _Teammates, shares: Mapping[str, float], hidden: Sequence[str], play: PlayOptions, tasks: int
) -> list[PlayTask]:
    """Return the training tasks, also on other versions of the layouts if `play` requests such versions.

    Args:
        teammates: the training teammates.
        shares: name of each layout -> relative number of its tasks.
        hidden: names of the layouts whose recipe indicators the model does not see.
        play: options that request other versions of the layouts.
        tasks: total number of tasks.

    Raises:
        OptionError: if other versions are requested, but a layout's teammates cannot play on them.
    """
    heuristics = _heuristic_teammates(teammates) if play.four_recipes or play.rearranged else {}
    everywhere, shares, hidden = dict(teammates), dict(shares), list(hidden)
    if play.four_recipes:
        for layout, kinds in heuristics.items():
            other, (kind, mates) = with_four_recipes(layout), next(iter(kinds.items()))
            everywhere[other, kind] = mates
            shares[other.name] = FOUR_RECIPES_SHARE
            # `hidden` contains names of layouts, and the version with four recipes has a name of its own.
            hidden += [other.name] * (layout.name in hidden)
    # Rearranged versions get a fixed part of the tasks; the other layouts divide the rest by their shares.
    total = sum(shares[name] for name in {layout.name for layout, _ in everywhere})
    rearranged = {layout: REARRANGED_SHARE * shares[layout.name] for layout in heuristics if play.rearranged}
    fixed = round(tasks * total / (total + sum(rearranged.values())))
    found = make_play_tasks(everywhere, fixed, shares, hidden)
    for layout, share in rearranged.items():
        count = round((tasks - fixed) * share / sum(rearranged.values()))
        found += _rearranged_tasks(layout, heuristics[layout], count, play.rearranged, layout.name in hidden)
    return found


def _fixes_dish(layout: Layout) -> bool:
    """Return whether a single dish replaces the layout's recipes, so that no other dish is ever rewarded."""
    return len(layout.recipes) == 1 and layout.recipes != get_layout(layout.name).recipes


def _heuristic_teammates(teammates: _Teammates) -> dict[Layout, dict[str, dict[str, Policy]]]:
    """Return the heuristic teammates of each layout, by kind.

    Heuristic teammates can also play on rearranged layouts, because they get the full state and the layout's tables.

    Raises:
        OptionError: if a layout has only learned teammates, or if its tasks have a fixed dish, because `--rearranged`
            and `--four-recipes` change the dishes.
    """
    for layout, _ in teammates:
        if layout.recipes != get_layout(layout.name).recipes:
            raise OptionError(
                f"{layout.name} has tasks with a fixed dish, and --rearranged and --four-recipes change the dishes; "
                f"leave out these options, or select other tasks"
            )
    found: dict[Layout, dict[str, dict[str, Policy]]] = {layout: {} for layout, _ in teammates}
    for (layout, kind), mates in teammates.items():
        if all(mate.sees == "situation" for mate in mates.values()):
            found[layout][kind] = mates
    for layout, kinds in found.items():
        if not kinds:
            raise OptionError(
                f"{layout.name}: rearranged layouts and four recipes need heuristic teammates, but this layout has "
                f"only learned ones; leave out --rearranged and --four-recipes, or give a manifest with heuristics"
            )
    return found


def _rearranged_tasks(
    layout: Layout, kinds: Mapping[str, dict[str, Policy]], tasks: int, versions: int, hidden: bool
) -> Iterator[PlayTask]:
    """Yield the tasks on rearranged versions of a layout, by kind of teammate.

    The versions are divided equally among the kinds of teammates, and the tasks of a kind equally among its versions.
    """
    layouts = rearranged_layouts(layout, versions)
    ends = [round(versions * k / len(kinds)) for k in range(len(kinds) + 1)]
    for (kind, mates), first, end in zip(kinds.items(), ends, ends[1:], strict=False):
        own = layouts[first:end]
        if not own:  # with fewer versions than kinds, some kinds get none
            continue
        count = max(len(own), round(tasks * len(own) / versions))
        # The numbers of tasks of two versions differ by at most one.
        where = [own[task % len(own)] for task in range(count)]
        yield from make_group(where, kind, mates, hidden, f"{layout.name} rearranged")


def _shares(dataset: Dataset | None, tasks: Sequence[Task]) -> dict[str, float]:
    """Return the relative number of tasks on each layout: 1, or `FLAT_SHARE` if measured egos earn about the same.

    A layout gets 1 if the measured returns of egos with one of its teammates differ by `LEAST_HEADROOM` or more (with
    drawn teammates those of `stay` and the oracle), or if one of its teammates was not measured.
    """
    matters: dict[str, bool] = defaultdict(bool)
    for task in tasks:
        draw = find_measured(task.layout.name, task.teammate)
        matters[task.layout.name] |= draw is None or draw.oracle - draw.stay >= LEAST_HEADROOM
    if dataset is not None:
        for layout, task_id in zip(dataset.column("layout"), dataset.column("task_id"), strict=True):
            made = dataset.provenance.get(str(task_id))
            matters[str(layout)] |= made is None or made.references is None or made.references.returns_differ
    return {layout: 1.0 if found else FLAT_SHARE for layout, found in matters.items()}


def _training_record(
    dataset: Dataset | None, tasks: Sequence[Task], played: set[str], labels: Labels | None
) -> list[dict[str, Any]]:
    """Return the record of training data for the tasks that are played; see `training_record`.

    The entries of tasks without histories have the source `TASKS_SOURCE`.
    """
    found = []
    if dataset is not None:
        of_played = np.isin(dataset.column("task_id"), sorted(played))
        found = training_record(dataset.select(of_played), labels) if of_played.any() else []
    of_cell = grouped(
        (task for task in tasks if task.task_id in played),
        lambda task: (task.layout.name, task.split, task.teammate_family, task.teammate_kind),
    )
    for cell, own in of_cell.items():
        ids, mates = [task.task_id for task in own], sorted({teammate_id(task.teammate) for task in own})
        found.append(training_record_entry((*cell, TASKS_SOURCE), labels, ids, 0, mates))
    return found
