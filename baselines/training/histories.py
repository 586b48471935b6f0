"""Training on learning histories: which ones, what of them is held out, and how a run says so."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from baselines.methods.method import Method, ModelOptions
from baselines.methods.registry import get_method, overcooked_world
from baselines.methods.tokens import plain_view
from baselines.training.run_folder import Checkpoints, read_config
from baselines.training.trainer import Data, TrainOptions
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.history import Obs
from icrl4aht_data.sampling.dpt import ContextOrder
from icrl4aht_data.utils.files import json_hash
from icrl4aht_data.utils.hashes import file_hash


@dataclass(frozen=True)
class HistoryOptions:
    """Which histories a run is trained on."""

    layouts: tuple[str, ...]  # with observations of one shape
    root: str | None = None  # a release, its folder or address; the bundled mini release by default
    split: str = "train"
    order: ContextOrder = "contiguous"  # of DPT's contexts
    held_out: float = 0.1  # share of the tasks, and of the histories of every other task
    obs: Obs | None = None  # how batches hold what the ego sees; state records where there are any


class TrainingTask(NamedTuple):
    """All that `trainer.train` needs but a folder."""

    method: Method
    data: Data
    options: TrainOptions
    about: dict[str, Any]


def prepare(name: str, model: ModelOptions, options: TrainOptions, histories: HistoryOptions) -> TrainingTask:
    """A method on histories; every process of a group gets its share of the batches.

    Raises:
        OptionError: if a window or a context is longer than a history, or the layouts' observations differ in shape.
        LabelsMissingError: for DPT on histories without expert actions.
    """
    dataset = _load(histories)
    split = hold_out(dataset, histories.held_out)
    shown = dataset.obs != "state"
    method = get_method(name)(model, overcooked_world(dataset.layouts, plain_view if shown else None))
    parts = {"train": split.train, "histories": split.histories, "teammates": split.teammates}
    samplers = {
        part: _sampler(method, selection, options, model.teammate_actions, histories.order)
        for part, selection in parts.items()
        if selection is not None
    }
    about = {
        "model": asdict(model),
        "histories": asdict(histories)
        | {
            "root": str(dataset.origin if dataset.origin.remote else dataset.root.resolve()),
            "manifest_sha256": file_hash(dataset.root / MANIFEST),
            "layouts": [layout.name for layout in dataset.layouts],
            "obs": dataset.obs,
            "obs_shape": list(dataset.layouts[0].obs_shape),
            "data_version": dataset.info.data_version,
            "selections": {part: sampler.options()["selection"] for part, sampler in samplers.items()},
            "sizes": {part: len(sampler.dataset) for part, sampler in samplers.items()},
        },
    }
    return TrainingTask(method, Data(samplers.pop("train"), samplers), options, about)


def _load(histories: HistoryOptions) -> Dataset:
    names = [get_layout(name).name for name in histories.layouts]
    found = load_icrl4aht(histories.root, split=histories.split, layout=names, obs=histories.obs or "uint8")
    return (
        found
        if histories.obs or not found.has_states
        else load_icrl4aht(histories.root, split=histories.split, layout=names, obs="state")
    )


def _sampler(method: Method, dataset: Dataset, options: TrainOptions, mates: bool, order: ContextOrder) -> Any:
    shortest = int(dataset.column("T").min())
    if options.context > shortest:
        raise OptionError(
            f"context = {options.context}: the shortest history of {dataset!r} has {shortest} steps; take fewer"
        )
    shared: Any = {
        "batch_size": options.batch_size,
        "seed": options.seed,
        "teammate_actions": mates,
        "process_index": jax.process_index(),
        "process_count": jax.process_count(),
    }
    if method.data == "ad":
        return dataset.ad(length=options.context, **shared)
    return dataset.dpt(context=options.context, order=order, **shared)


class Split(NamedTuple):
    """Disjoint parts of a selection."""

    train: Dataset
    histories: Dataset  # other histories of the training tasks
    teammates: Dataset | None  # tasks, and so teammates, without a history in the other two; None if there is one task


def hold_out(dataset: Dataset, share: float = 0.1, seed: int = 0) -> Split:
    """Hold out a share of the tasks, and of every other task a share of its histories; at least one each.

    Which ones depends on their names and the seed alone: a history stays where it is when others are added to it.

    Raises:
        OptionError: if the share is not between 0 and 1, or a task has one history only.
    """
    if not 0 < share < 1:
        raise OptionError(f"share = {share}: expected a number between 0 and 1")
    names, codes = dataset.index.values("task_id"), dataset.column("task_id")
    tasks = sorted(np.unique(codes).tolist(), key=lambda code: _rank(seed, names[code]))
    apart = tasks[: _count(share, len(tasks)) if len(tasks) > 1 else 0]
    streams, held = dataset.column("env_idx"), np.zeros(len(dataset), bool)
    for code in tasks[len(apart) :]:
        rows = sorted(np.flatnonzero(codes == code), key=lambda row: _rank(seed, names[code], int(streams[row])))
        if len(rows) < 2:
            raise OptionError(
                f"task {names[code]} has one history: expected two or more, one to train on and one to hold out"
            )
        held[rows[: _count(share, len(rows))]] = True
    others = np.isin(codes, apart)
    return Split(
        train=dataset.select(dataset.ids[~held & ~others]),
        histories=dataset.select(dataset.ids[held]),
        teammates=dataset.select(dataset.ids[others]) if len(apart) else None,
    )


def _count(share: float, of: int) -> int:
    return max(1, min(round(share * of), of - 1))


def _rank(seed: int, *name: object) -> bytes:
    return hashlib.blake2b(repr((seed, *name)).encode(), digest_size=8).digest()


class Trained(NamedTuple):
    """A trained model."""

    method: Method
    params: Any
    step: int
    context: int
    layouts: tuple[str, ...]
    obs_shape: tuple[int, ...]
    label: str
    hash: str  # of its settings


def read_trained(folder: Path) -> Trained:
    """A run's model, at its last checkpoint.

    Raises:
        OptionError: if the folder is not a run on histories, or one of another format, or has no checkpoint.
    """
    config = read_config(folder)
    try:
        histories, table = config["histories"], config["model"]
        options: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in table.items()}
        model = ModelOptions(**options)
        layouts = [get_layout(name) for name in histories["layouts"]]
        method, context = get_method(config["method"])(model, overcooked_world(layouts)), config["train"]["context"]
    except (KeyError, TypeError) as error:
        raise OptionError(f"{folder}: its config.json is not of a run on learning histories: {error!r}") from error
    if list(layouts[0].obs_shape) != histories["obs_shape"]:
        raise OptionError(
            f"{folder}: trained on observations {histories['obs_shape']}, those of {layouts[0].name} are "
            f"{layouts[0].obs_shape} in this version; train again"
        )
    checkpoints = Checkpoints(folder)
    try:
        found = checkpoints.restore(jax.eval_shape(method.init, jax.random.key(0)))
    finally:
        checkpoints.close()
    label = method.label + "+TA" * model.teammate_actions + "+next_obs" * model.next_obs
    names = tuple(layout.name for layout in layouts)
    return Trained(method, found.params, found.step, context, names, layouts[0].obs_shape, label, json_hash(config))
