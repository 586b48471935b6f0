"""The training of RL^2 with the teammates of a release."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.methods.method import Method
from baselines.methods.options import ModelOptions
from baselines.methods.registry import get_method, overcooked_world
from baselines.online.rl2 import PlayTrainer, TaskGroup, chosen_teammates, make_groups
from baselines.training.histories import filter_histories, training_cells
from baselines.training.options import ALL_LAYOUTS, HistoryOptions, PlayOptions, TrainOptions
from baselines.training.trainer import TrainingData
from generation.policy import Policy
from generation.teammates.registry import recover_teammate
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.provenance import read_provenance
from icrl4aht_data.format.schema import MANIFEST, PROVENANCE
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.utils.hashes import file_hash

FLAT_SHARE = 0.3
"""Number of tasks on a layout where the ego matters with no teammate, as a share of that on other layouts."""


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


def prepare_play(
    name: str, model: ModelOptions, options: TrainOptions, play: PlayOptions, histories: HistoryOptions
) -> PlayJob:
    """Returns the training of a method that plays with the teammates of a release's histories.

    Args:
        name: of the method.
        model: its architecture.
        options: of the training; `batch_size` is the number of tasks.
        play: hyper-parameters of playing and learning.
        histories: whose teammates to play with, on which layouts.

    Raises:
        EmptySelectionError: if no history has a value that the choice of histories filters by.
        OptionError: for settings of histories that have no meaning here.
    """
    _check_unused(name, histories)
    names = None if ALL_LAYOUTS in histories.layouts else [get_layout(one).name for one in histories.layouts]
    release = load_icrl4aht(histories.root)
    dataset = filter_histories(release.filter(split=histories.split, layout=names), histories.filters)
    method = get_method(name)(model, overcooked_world(dataset.layouts, model.encoder, canonical=True))
    hidden = [get_layout(one).name for one in histories.hide_recipe]
    teammates = _teammates(dataset)
    policies = {key: list(found.values()) for key, found in teammates.items()}
    groups = make_groups(policies, options.batch_size, _shares(dataset), hidden)
    dataset = _played(dataset, teammates, groups)
    about = {
        "model": asdict(model),
        "play": asdict(play),
        "histories": asdict(histories)
        | {
            "root": str(dataset.origin if dataset.origin.remote else dataset.root.resolve()),
            "manifest_sha256": file_hash(dataset.root / MANIFEST),
            "layouts": [layout.name for layout in dataset.layouts],
            "hide_recipe": hidden,
            "channels": "canonical",
            "obs_shape": list(observation_shape(dataset.layouts[0], True)),
            "data_version": dataset.info.data_version,
            "groups": {group.name: len(group.teammates) for group in groups},
        },
        "trained_on": training_cells(dataset, "oracle" if play.imitation else None),
    }
    trainer = PlayTrainer(method, options, play, groups, histories.mirror)
    return PlayJob(method, trainer, TrainingData(None, {}), about)


def _check_unused(name: str, histories: HistoryOptions) -> None:
    default = HistoryOptions(histories.layouts)
    for field in ("order", "labels", "every", "held_out", "obs"):
        found = getattr(histories, field)
        if found != getattr(default, field):
            raise OptionError(f"{field} = {found}: {name} learns by playing, not from histories; leave it out")
    if histories.channels == "own":
        raise OptionError(f"channels = own: {name} takes canonical channels; leave it out")


def _teammates(dataset: Dataset) -> dict[tuple[Layout, str], dict[str, Policy]]:
    """Returns the teammates of all tasks of a selection: layout and family -> task id -> teammate."""
    found: dict[tuple[Layout, str], dict[str, Policy]] = {}
    of_task = {str(task): int(number) for task, number in zip(dataset.column("task_id"), dataset.ids, strict=True)}
    for task_id, history_id in of_task.items():
        entry = dataset.index.entry(history_id)
        key = get_layout(entry.layout), entry.teammate_kind
        found.setdefault(key, {})[task_id] = recover_teammate(dataset, history_id)
    return found


def _played(
    dataset: Dataset, teammates: dict[tuple[Layout, str], dict[str, Policy]], groups: list[TaskGroup]
) -> Dataset:
    """Returns the histories of the tasks whose teammates are played with; with few tasks not all are."""
    played = set()
    for group in groups:
        names = list(teammates[group.layout, group.family])
        played |= {names[number] for number in chosen_teammates(len(names), len(group.teammates))}
    return dataset.select(np.isin(dataset.column("task_id"), sorted(played)))


def _shares(dataset: Dataset) -> dict[str, float]:
    """Returns the share of the tasks on each layout of a selection, in units of those on layouts with headroom."""
    path = Path(dataset.root) / PROVENANCE
    provenance = read_provenance(path) if path.is_file() else {}
    shares = dict.fromkeys((layout.name for layout in dataset.layouts), FLAT_SHARE if provenance else 1.0)
    for layout, task_id in zip(dataset.column("layout"), dataset.column("task_id"), strict=True):
        made = provenance.get(str(task_id))
        if made is not None and (made.references is None or made.references.matters):
            shares[str(layout)] = 1.0
    return shares
