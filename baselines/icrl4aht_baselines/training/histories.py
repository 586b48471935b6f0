"""Training on learning histories: choice of histories, held-out parts, settings of the run, and the trained model."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from icrl4aht_generation.learners.config import EncoderKind
from icrl4aht_generation.learners.resume import Checkpoints, differing_settings

from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.options import UNUSED, ModelOptions
from icrl4aht_baselines.methods.registry import PLAYING, get_method, overcooked_world
from icrl4aht_baselines.methods.tokens import BatchView, plain_view
from icrl4aht_baselines.methods.view_change import changed_view, number_layouts
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import CHECKPOINTS, other_version, read_config
from icrl4aht_baselines.training.seen import TRAINED_ON
from icrl4aht_baselines.training.trainer import TrainingData, TrainingTask
from icrl4aht_data.dataset import Dataset, load_icrl4aht, teammate_ids, teammate_names
from icrl4aht_data.errors import EmptySelectionError, OptionError, UnknownNameError
from icrl4aht_data.fetch import Remote
from icrl4aht_data.format.layouts_file import LAYOUTS_NAME, read_layouts_file
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.overcooked.channels import Channels, canonical_positions, observation_shape
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.reading.splitting import choose_histories, choose_teammates
from icrl4aht_data.utils.files import file_hash, json_hash
from icrl4aht_data.utils.text import listed_names

_CELL_FIELDS = {
    "layout": "layout",
    "split": "split",
    "family": "teammate_family",
    "algorithm": "teammate_kind",
    "source": "source",
}
"""Name in an entry of `training_record` -> field of the release's index."""


def prepare(name: str, model: ModelOptions, options: TrainOptions, histories: HistoryOptions) -> TrainingTask:
    """Return a `TrainingTask` for a method that learns from histories; each process reads its share of the batches.

    The held-out part `teammates` has the release's validation histories that are on the training layouts and pass the
    filters. If there are none, some teammates of the training split are held out instead, see `hold_out`.

    Args:
        name: name of the method.
        model: architecture of the model.
        options: options of the training.
        histories: choice of the histories to train on.

    Raises:
        UnknownNameError: if a filter has an unknown value.
        EmptySelectionError: if no history passes a filter.
        OptionError: if a window or a context is longer than a history, own channels are requested for layouts with
            different numbers of channels, or labels are requested for a method that uses none.
        LabelsMissingError: if a history does not have the labels.
    """
    if name in PLAYING:
        raise OptionError(f"{name} learns by playing, not from histories: `icrl4aht-data train {name}` trains it")
    dataset, validation = _load_histories(histories)
    split = hold_out(dataset, histories.held_out, validation=validation)
    hidden = [get_layout(one).name for one in histories.hide_recipe]
    view, canonical = _batch_view(dataset, histories.mirror, hidden), dataset.channels == "canonical"
    method = get_method(name)(model, overcooked_world(dataset.layouts, model.encoder, view, canonical))
    labels: Labels | None = histories.labels or ("expert" if method.data == "dpt" else None)
    if labels is not None and not method.takes_labels:
        raise OptionError(
            f"labels = {labels}: {name} learns from the histories' own actions and rewards; leave out --labels, or "
            f"train another method"
        )
    samplers = {
        part: number_layouts(
            _sampler(method, selection, options, model, histories, labels),
            dataset.layouts,
            histories.mirror,
        )
        for part, selection in split._asdict().items()
        if selection is not None
    }
    about = {
        "model": asdict(model),
        "histories": asdict(histories)
        | history_settings(dataset)
        | {
            "hide_recipe": hidden,
            "obs": dataset.obs,
            "channels": dataset.channels,
            "labels": labels,
            "obs_shape": list(dataset.obs_shape),
            "selections": {part: sampler.options()["selection"] for part, sampler in samplers.items()},
            "sizes": {part: len(sampler.dataset) for part, sampler in samplers.items()},
            "teammates_split": None if split.teammates is None else " and ".join(split.teammates.counts("split")),
        },
        TRAINED_ON: training_record(split.train, labels),
    }
    return TrainingTask(method, TrainingData(samplers.pop("train"), samplers), options, about)


def history_settings(dataset: Dataset) -> dict[str, Any]:
    """Return settings that describe a run's release: root, hash of the manifest, data version, layouts."""
    return {
        "root": str(dataset.origin if isinstance(dataset.origin, Remote) else dataset.root.resolve()),
        "manifest_sha256": file_hash(dataset.root / MANIFEST),
        "data_version": dataset.info.data_version,
        "layouts": [layout.name for layout in dataset.layouts],
    }


def _batch_view(dataset: Dataset, mirror: bool, hidden: Sequence[str]) -> BatchView | None:
    """Return the function that turns a batch into the encoder's input; None for unchanged state records."""
    changed = [f"mirror = {mirror}"] * mirror + [f"hide_recipe = {', '.join(hidden)}"] * bool(hidden)
    if changed and (dataset.obs != "state" or dataset.channels != "canonical"):
        raise OptionError(
            f"{changed[0]}: expected state records and canonical channels, found {dataset.obs} and {dataset.channels} "
            f"channels; add --channels canonical, or choose a release with state records"
        )
    if changed:
        return changed_view(dataset.layouts, hidden)
    return None if dataset.obs == "state" else plain_view


def _load_histories(histories: HistoryOptions) -> tuple[Dataset, Dataset | None]:
    """Open the release that the training histories are chosen from, with state records if all histories have them.

    By default, channels are canonical if all layouts are chosen, or if the layouts' own channels differ.

    Returns:
        The chosen training histories, and the validation histories that pass the same filters, or None.
    """
    every = ALL_LAYOUTS in histories.layouts
    release = load_icrl4aht(histories.root, obs="uint8")  # the release may define layouts, so it is opened first
    names = None if every else [get_layout(name).name for name in histories.layouts]
    found = filter_histories(release.filter(split="train", layout=names), histories.filters)
    check_layouts(found, names or ())
    differ = len({layout.obs_shape for layout in found.layouts}) > 1
    channels = histories.channels or ("canonical" if every or differ else "own")
    if channels == "own" and differ:
        raise OptionError(
            f"channels = own: the layouts {', '.join(layout.name for layout in found.layouts)} have different "
            f"numbers of own channels: leave out --channels or choose canonical, or train on one layout, such as "
            f"--layout {found.layouts[0].name}"
        )
    for layout in found.layouts if channels == "canonical" else ():
        canonical_positions(layout)  # reports a layout without them before the run folder is made
    options: Any = {"obs": "state" if found.has_states else None, "channels": channels}
    validation = None
    with suppress(EmptySelectionError):
        validation = release.filter(split="validation", layout=[one.name for one in found.layouts], **histories.filters)
        validation = validation.with_options(**options)
    return found.with_options(**options), validation


def filter_histories(dataset: Dataset, filters: Mapping[str, Any]) -> Dataset:
    """Return the histories that pass all filters, see `HistoryOptions.filters`.

    Raises:
        UnknownNameError: if a value exists neither in the release nor in the benchmark.
        EmptySelectionError: if a value occurs in no history, or no history passes all filters.
    """
    for name, values in filters.items():
        for value in values:  # a value that occurs in no history is an error, even if other values occur
            dataset.filter(**{name: value})
    return dataset.filter(**filters)


def check_layouts(dataset: Dataset, names: Iterable[str]) -> None:
    """Check that a selection has histories on each of these layouts, given by their names.

    Raises:
        EmptySelectionError: if it has no history on one of them.
    """
    known = [layout.name for layout in dataset.layouts]
    if missing := [name for name in names if name not in known]:
        raise EmptySelectionError(
            f"{dataset.root}: no chosen history is on {', '.join(missing)}, only on {listed_names(known)}; leave out "
            f"{', '.join(missing)}, or choose another source or release"
        )


def training_record(dataset: Dataset, labels: Labels | None = None) -> list[dict[str, Any]]:
    """Return a record of training data, grouped by layout, split, teammate family, algorithm and source.

    Each entry has these five values, `labels`, the numbers of `tasks` and `histories`, `tasks_hash` (hash of the task
    ids), and `teammates` (their ids, see `dataset.teammate_ids`; None if the release does not describe teammates).

    Args:
        dataset: histories to train on, without held-out histories.
        labels: kind of the labels that the model learns; None for a method that uses none.
    """
    fields = _CELL_FIELDS | {"task": "task_id"}
    table = pd.DataFrame({name: dataset.column(field).astype(str) for name, field in fields.items()})
    table["history"] = dataset.ids
    cells = []
    for cell, own in table.groupby([*_CELL_FIELDS]):
        history_of = dict(zip(own["task"], own["history"].tolist(), strict=True))
        teammates = teammate_ids(dataset, [*history_of.values()])
        cells.append(training_record_entry(map(str, cell), labels, history_of, len(own), teammates))
    return cells


def training_record_entry(
    cell: Iterable[str], labels: Labels | None, tasks: Collection[str], histories: int, teammates: list[str] | None
) -> dict[str, Any]:
    """Return an entry for the record of training data, see `training_record`.

    Args:
        cell: layout, split, teammate family, algorithm and source.
        labels: kind of the labels, or None.
        tasks: ids of the tasks.
        histories: number of histories.
        teammates: ids of the teammates, or None.
    """
    sizes = {"labels": labels, "tasks": len(tasks), "histories": histories, "tasks_hash": json_hash(sorted(tasks))}
    return dict(zip(_CELL_FIELDS, cell, strict=True)) | sizes | {"teammates": teammates}


def _sampler(
    method: Method,
    dataset: Dataset,
    options: TrainOptions,
    model: ModelOptions,
    histories: HistoryOptions,
    labels: Labels | None,
) -> Any:
    """Return the method's sampler for a part of the histories."""
    every, episodes = histories.every, int(dataset.column("episodes").min())
    first = min(histories.first or episodes, episodes)
    steps = first // every * dataset.info.environment.kept_steps
    shared: Any = {
        "batch_size": options.batch_size,
        "seed": options.seed,
        "teammate_actions": model.teammate_actions,
        "labels": labels,
        "episodes": (0, histories.first) if histories.first else None,
        "process_index": jax.process_index(),
        "process_count": jax.process_count(),
    }
    if method.data == "dpt":
        if every > 1:
            raise OptionError(
                f"every = {every}: {method.name} learns from contexts, but only windows can skip episodes; leave out "
                "--every"
            )
        for name in ("balance", "at_start"):
            if value := getattr(histories, name):
                raise OptionError(
                    f"{name} = {value}: {method.name} draws tasks and contexts, and only windows can be drawn so; "
                    f"leave out --{name.replace('_', '-')}"
                )
        if histories.queries > options.context + 1:
            raise OptionError(
                f"queries = {histories.queries}: a context of {options.context} transitions has "
                f"{options.context + 1} prefixes with a query each; choose at most {options.context + 1} queries"
            )
        return dataset.dpt(context=options.context, order=histories.order, queries=histories.queries, **shared)
    if histories.queries > 1:
        raise OptionError(
            f"queries = {histories.queries}: {method.name} learns from windows without queries; leave out --queries"
        )
    if histories.order != "contiguous":
        raise OptionError(f"order = {histories.order}: {method.name} learns from windows in order; leave out --order")
    if options.context > steps:
        raise OptionError(
            f"context = {options.context}: the shortest history of {dataset!r} has {steps} steps for a window, with "
            f"every = {every} and first = {histories.first or 'all'}; reduce the context, or choose longer histories"
        )
    weights = _balanced(dataset) if histories.balance else "uniform"
    return dataset.ad(length=options.context, every=every, at_start=histories.at_start, weights=weights, **shared)


def _balanced(dataset: Dataset) -> np.ndarray:
    """Return weights of the histories that are equal in sum for each source, float64 (H,)."""
    _, source, counts = np.unique(dataset.column("source"), return_inverse=True, return_counts=True)
    return 1 / counts[source]


class HistorySplit(NamedTuple):
    """Disjoint parts of a selection of histories.

    Attributes:
        train: histories to train on.
        histories: held-out histories of the training tasks; None if each training task has only one history.
        teammates: validation histories, or histories with held-out teammates; None if there are neither. These
            teammates are in no other part, but teammates with other parameters may behave the same.
    """

    train: Dataset
    histories: Dataset | None
    teammates: Dataset | None


def hold_out(dataset: Dataset, share: float = 0.1, validation: Dataset | None = None) -> HistorySplit:
    """Hold out a share of the teammates, and a share of the histories with the other teammates.

    At least one teammate is held out, unless there is only one teammate, and at least one history, unless each task has
    only one history. Every task with a teammate that is not held out keeps a training history. The choice depends on
    names only, see `splitting`; `Dataset.split` makes the same choice.

    Args:
        dataset: histories to divide.
        share: share of the teammates, and of the histories with the other teammates, to hold out.
        validation: histories with other teammates, which become the part `teammates`; then no teammate of `dataset` is
            held out.

    Raises:
        OptionError: if the share is not between 0 and 1, or there is only one task with one history.
    """
    teammates = validation
    if validation is None:
        with_held = choose_teammates(teammate_names(dataset), share, 0)
        if with_held.any():
            dataset, teammates = dataset.select(~with_held), dataset.select(with_held)
    if teammates is not None and len(dataset) == len(set(dataset.column("task_id").tolist())):
        return HistorySplit(train=dataset, histories=None, teammates=teammates)
    held = choose_histories(dataset, share, 0)
    return HistorySplit(train=dataset.select(~held), histories=dataset.select(held), teammates=teammates)


class TrainedModel(NamedTuple):
    """Trained model with the parameters of the last checkpoint.

    Attributes:
        method: training method, which contains the model.
        params: pytree of float32 arrays.
        step: number of training steps so far.
        context: K, number of steps or transitions in the memory.
        layouts: names of the training layouts.
        channels: channels of the model's observations: the layouts' own, or the canonical ones.
        obs_shape: shape of the model's observations.
        label: name in reports.
        encoder: kind of the encoder.
        hash: hash of the run's settings.
        trained_on: record of the training data, see `training_record`.
        hide_recipe: names of layouts whose recipe indicators are hidden from the model.
    """

    method: Method
    params: Any
    step: int
    context: int
    layouts: tuple[str, ...]
    channels: Channels
    obs_shape: tuple[int, ...]
    label: str
    encoder: EncoderKind
    hash: str
    trained_on: list[dict[str, Any]]
    hide_recipe: tuple[str, ...] = ()


_MEANINGS = {"heads", "positions", "reward_scale", "discounts", "channels"}
"""Options that change what parameters do, but not their shapes."""


def load_initial_params(run: Path, method: Method, about: dict[str, Any]) -> Any:
    """Return an old run's parameters as the start of a new run, and add the old run to the new run's settings.

    Args:
        run: run folder of the old run.
        method: method of the new run.
        about: settings of the new run, to which the old run and its record of training data are added.

    Raises:
        OptionError: if the parameters are of another model; the message states the options that differ.
    """
    before, config = read_trained(run), read_config(run)
    shapes = jax.eval_shape(method.init, jax.random.key(0))
    found, expected = (
        {"method": name, **asdict(ModelOptions()), **one["model"]}
        | {field: one["histories"][field] for field in ("obs_shape", "channels")}
        for name, one in ((config["method"], config), (method.name, about))
    )
    differ = differing_settings(found, expected)
    differ = {name: values for name, values in differ.items() if name not in UNUSED.get(method.name, ())}
    if jax.tree.map(jnp.shape, before.params) != jax.tree.map(jnp.shape, shapes) or differ.keys() & _MEANINGS:
        listed = "; ".join(f"{k} = {a!r}, not {b!r}" for k, (a, b) in differ.items())
        raise OptionError(f"{run}: trained with other options ({listed}); give these options, or another run")
    release = {name: config["histories"][name] for name in ("data_version", "manifest_sha256")}
    earlier = {"init": config["init"]} if "init" in config else {}
    versions = {"package_version": config["package_version"], **release}
    about["init"] = {"run": before.hash, "step": before.step, **versions, **earlier}
    about[TRAINED_ON] = [*about[TRAINED_ON], *(cell for cell in before.trained_on if cell not in about[TRAINED_ON])]
    return before.params


def read_trained(folder: Path) -> TrainedModel:
    """Return the trained model in a run folder.

    Raises:
        OptionError: if the folder is not a run or has another format, or the checkpoint is missing or does not fit the
            settings.
    """
    config = read_config(folder)
    try:
        histories, train = config["histories"], config["train"]
        # An option that this version does not have is an error only if the run used it.
        stated = {k: v for k, v in config["model"].items() if v or hasattr(ModelOptions(), k)}
        model = ModelOptions(**stated)
        read_layouts_file(folder / LAYOUTS_NAME)
        layouts = [get_layout(name) for name in histories["layouts"]]
        channels, obs_shape = histories["channels"], tuple(histories["obs_shape"])
        expected = observation_shape(layouts[0], channels == "canonical")
        world = overcooked_world(layouts, model.encoder, canonical=channels == "canonical")
        method = get_method(config["method"])(model, world)
        context, cells = train["context"], config[TRAINED_ON]
    except (KeyError, TypeError, AttributeError, IndexError, UnknownNameError) as error:
        raise OptionError(
            f"{folder}: its config.json does not describe a run on learning histories: {error!r}{other_version(config)}"
        ) from error
    if expected != obs_shape:
        raise OptionError(
            f"{folder}: trained on observations of shape {obs_shape}, but {layouts[0].name} with {channels} channels "
            f"has observations of shape {expected} in this version; train again{other_version(config)}"
        )
    try:
        params, step = Checkpoints(folder / CHECKPOINTS).load(jax.eval_shape(method.init, jax.random.key(0)), "params")
    except OptionError as error:
        raise OptionError(f"{error}{other_version(config)}") from error
    label = method.label + "+TA" * model.teammate_actions + "+next_obs" * model.next_obs
    label += "+mlp" if model.encoder == "mlp" else ""  # encoders `words` and `paper` compute the same features
    names, digest = tuple(layout.name for layout in layouts), json_hash(config)
    hidden = tuple(histories.get("hide_recipe", ()))
    return TrainedModel(
        method, params, step, context, names, channels, obs_shape, label, model.encoder, digest, cells, hidden
    )
