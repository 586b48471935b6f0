"""Argument types and options that several commands of `icrl4aht-data` share."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from icrl4aht_baselines.methods.options import RL2_SETTINGS, SIZES, UNUSED, ModelOptions
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.commands.dataclass_options import dataclass_options, topic
from icrl4aht_data.commands.options import (
    COUNT,
    COUNT_OR_NONE,
    FAMILY,
    LAYOUT,
    RELEASE_LAYOUT,
    TRACK,
    Folder,
    Names,
    ReleaseArgument,
    accept_any_name,
)
from icrl4aht_data.errors import EmptySelectionError
from icrl4aht_data.format.layouts_file import read_tasks_and_layouts
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.text import counted_noun, listed_names


def lazy_attribute(module: str, name: str) -> Callable[[], Any]:
    """Return a function that imports a module when called, and returns one of the module's attributes."""
    return lambda: getattr(import_module(module), name)


EGO_NAME = Names("agent", lambda: import_module("icrl4aht_baselines.agents.egos").agent_names(), accept_any_name)
"""Name of a reference ego, or folder of a run; checked by `icrl4aht_baselines.agents.egos.find_agent`."""
TRAINING_LAYOUT = Names("layout", lambda: [ALL_LAYOUTS, *LAYOUT.valid()], accept_any_name)
METHOD_NAME = Names("method", lambda: import_module("icrl4aht_baselines.methods.registry").all_methods())
PROTOCOL_NAME = Names("protocol", lazy_attribute("icrl4aht_baselines.evaluate.protocols", "PROTOCOLS"))

protocol_option = click.option(
    "--protocol",
    type=PROTOCOL_NAME,
    default="seeded",
    help="Teammates' noise: seeded, new in every episode, or published, as for the paper's numbers. Protocol `swap` is "
    "seeded, with another teammate every 25 episodes.",
)
greedy_option = click.option(
    "--greedy/--sampled",
    default=None,
    help="Take a trained model's most probable actions, or sample its actions.",
    show_default="greedy; sampled for a bundled model",
)
_ONLY_LAYOUTS: Any = {"multiple": True, "help": "Only on this layout; repeat for several."}
only_layouts_option = click.option("--layout", "layouts", type=LAYOUT, **_ONLY_LAYOUTS)
_MANIFEST: Any = {"type": click.Path(path_type=Path, exists=True, dir_okay=False), "metavar": "FILE"}
tasks_options = (
    click.option(
        "--track",
        type=TRACK,
        multiple=True,
        default=tuple(TRACKS),
        help="Only of this track; repeat for several.",
    ),
    click.option(
        "--split",
        type=Names("split", lazy_attribute("icrl4aht_baselines.evaluate.protocols", "EVALUATION_SPLITS")),
        multiple=True,
        default=("test",),
        help="Tasks to play: test; or validation and diverse, to choose models by; repeat for several.",
    ),
    # Layout names are checked after the manifest is read, because its release may define layouts.
    click.option("--layout", "layouts", type=RELEASE_LAYOUT, **_ONLY_LAYOUTS),
    click.option(
        "--family", "families", type=FAMILY, multiple=True, help="Only with teammates of this family; repeat."
    ),
    click.option("--manifest", **_MANIFEST, help="Tasks of this file instead of the tracks' tasks."),
)
"""Options that choose tasks; `chosen_tasks` takes their values."""

suite_option = click.option(
    "--suite", type=Folder("`icrl4aht-data teammates`"), metavar="FOLDER", help="Folder of learned teammates."
)
root_option = click.option(
    "--root",
    type=ReleaseArgument(),
    metavar="ROOT",
    help="A release: folder or address.",
    show_default="the bundled mini release",
)


def chosen_tasks(
    track: Sequence[str],
    split: Sequence[str],
    layouts: Sequence[str],
    families: Sequence[str],
    manifest: Path | None,
) -> list[Task]:
    """Return the tasks that the values of `tasks_options` choose, from a manifest or from the package.

    Raises:
        UnknownNameError: if a layout is unknown.
        EmptySelectionError: if one of the chosen layouts or families has no task.
        click.UsageError: if both a manifest and a split are given, because a manifest states the split of its tasks.
    """
    from icrl4aht_baselines.evaluate.protocols import bundled_tasks

    if manifest:
        check_conflicts("--manifest", "split")
        given = read_tasks_and_layouts(manifest)
    else:
        given = [task for of_split in split for name in track for task in bundled_tasks(name, of_split)]
    names = {get_layout(name).name for name in layouts}
    chosen = [task for task in given if not names or task.layout.name in names]
    chosen = [task for task in chosen if not families or task.teammate_family in families]
    # Tasks of some layouts or families only would be a smaller evaluation than the user asked for.
    played = {task.layout.name for task in chosen} | {task.teammate_family for task in chosen}
    if not chosen or not played.issuperset({*names, *families}):
        found = manifest or f"the tasks of split {' and '.join(split)}, track {' and '.join(track)}"
        given_values = (("on", names), ("with", {*families}))
        wanted = "".join(f" {word} {', '.join(sorted(of - played or of))}" for word, of in given_values if of)
        raise EmptySelectionError(f"no task{wanted} in {found}: choose another --layout or --family, or leave them out")
    return chosen


manifests_option = click.option(
    "--manifest",
    "manifests",
    **_MANIFEST,
    multiple=True,
    help="Also play with the heuristic teammates of the tasks in this file; repeat for several.",
)
_PAPER_OR_CPU = "1024 as in the paper; on a CPU 16 of tiny, 8 of others"
_BY_SIZE = dict.fromkeys(SIZES["tiny"].model | SIZES["tiny"].train, "the size's")
training_options = dataclass_options(TrainOptions, "train", default_text={**_BY_SIZE, "batch_size": _PAPER_OR_CPU})
play_options = dataclass_options(PlayOptions, "play")
model_options = dataclass_options(ModelOptions, "model", default_text=_BY_SIZE)


def training_summary(histories: dict[str, Any]) -> str:
    """Return one line about a run's training data (layouts, channels, labels), from its `histories` settings."""
    shape, sizes, split = " x ".join(map(str, histories["obs_shape"])), histories["sizes"], histories["teammates_split"]
    held = [f"{sizes['histories']} with the same teammates"] if "histories" in sizes else []
    held += [f"{sizes['teammates']} with others (split {split})"] if split else []
    parts = [
        f"training on {', '.join(histories['layouts'])}",
        f"{histories['channels']} channels, observations of {shape}",
        f"{sizes['train']} histories",
        f"held out {' and '.join(held)}",
    ]
    parts += [f"windows of every {histories['every']}-th episode"] if histories["every"] > 1 else []
    return "; ".join(parts + ([f"{histories['labels']} labels"] if histories["labels"] else []))


def prepare_training(
    method: str,
    size: str | None,
    model: dict[str, Any],
    train: dict[str, Any],
    play: dict[str, Any],
    histories: HistoryOptions,
    manifests: Sequence[Path] = (),
) -> tuple[Any, str]:
    """Return a training run as an `icrl4aht_baselines.training.trainer.TrainingTask`, and its description as text.

    Args:
        method: name of the method.
        size: name of the model's size; None for tiny on a CPU and small elsewhere. Must be None for rl2.
        model: values of `ModelOptions` that differ from the defaults.
        train: values of `TrainOptions` that differ from the defaults.
        play: values of `PlayOptions` that differ from the defaults.
        histories: histories to train on; rl2 plays with the teammates of these histories.
        manifests: files of tasks; rl2 also plays with the teammates of these tasks.

    Raises:
        click.UsageError: for options that the method does not have.
    """
    import jax

    from icrl4aht_baselines.methods.registry import PLAYING
    from icrl4aht_baselines.online.prepare import prepare_play
    from icrl4aht_baselines.training.histories import prepare

    if method in PLAYING:
        if unused := {"size"} if size else UNUSED[method] & (train.keys() | model.keys()):
            raise click.UsageError(f"{_flags(unused)}: cannot be used with {method}, which learns by playing")
        sized = ModelOptions(**RL2_SETTINGS["model"] | model)
        options = TrainOptions(**RL2_SETTINGS["train"] | train)
        tasks = [task for manifest in manifests for task in read_tasks_and_layouts(manifest)]
        job = prepare_play(method, sized, options, PlayOptions(**play), histories, tasks)
        played, episodes = job.about["histories"], counted_noun(job.trainer.play.episodes, "episode")
        text = (
            f"{method}: layers {sized.recurrent_layers}, width {sized.width}, encoder {sized.encoder}, steps "
            f"{options.steps}, in each {len(job.trainer.tasks)} tasks of {episodes}\nplaying on "
            f"{listed_names(played['layouts'])}, canonical channels, with the teammates of {len(played['groups'])} "
            f"families and layouts"
        )
        return job, text
    if given := {*play, *(["manifest"] if manifests else [])}:
        raise click.UsageError(f"{_flags(given)}: cannot be used with {method}, only with rl2, which learns by playing")
    if unused := UNUSED.get(method, set()) & model.keys():  # ignored options would be stored and printed
        raise click.UsageError(f"{_flags(unused)}: cannot be used with {method}, which does not have these options")
    on_cpu = jax.default_backend() == "cpu"
    name = size or ("tiny" if on_cpu else "small")
    sized = ModelOptions(**SIZES[name].model | model)
    # On a CPU the default batch is smaller than the paper's, so that a step takes at most a second.
    batch_size = SIZES[name].cpu_batch if on_cpu else TrainOptions.batch_size
    options = TrainOptions(**SIZES[name].train | {"batch_size": batch_size} | train)
    job = prepare(method, sized, options, histories)
    reason = "" if size else f", the default {'on a CPU' if on_cpu else 'on this device'}"
    layers = f"GRU layers {sized.recurrent_layers}" if method == "hybrid_ad" else f"layers {sized.layers}"
    positions = "" if "positions" in UNUSED.get(method, ()) else f", positions {sized.positions}"
    text = (
        f"size {name}{reason}: {layers}, width {sized.width}, encoder {sized.encoder}{positions}, K = "
        f"{options.context}, steps {options.steps}, batch size {options.batch_size}\n"
        f"{training_summary(job.about['histories'])}"
    )
    return job, text


def check_conflicts(option: str, *others: str) -> None:
    """Check that no option in `others` was given on the command line, because `option` replaces these options.

    Raises:
        click.UsageError: if an option was given; the message names all such options.
    """
    source = click.get_current_context().get_parameter_source
    if given := [name for name in others if source(name) is ParameterSource.COMMANDLINE]:
        raise click.UsageError(f"{option}: cannot be used with {_flags(given)}; leave out one or the other")


def _flags(names: Iterable[str]) -> str:
    flags = {parameter.name: parameter.opts[-1] for parameter in click.get_current_context().command.params}
    return ", ".join(flags.get(name, "--" + name.replace("_", "-")) for name in sorted(names))


process_options = topic(
    "Machines",
    click.option("--coordinator", metavar="HOST:PORT", help="Address of process 0, to train on several machines."),
    click.option("--processes", type=COUNT, default=1, help="With --coordinator: number of processes."),
    click.option("--process", type=COUNT_OR_NONE, default=0, help="With --coordinator: number of this process."),
)
"""Options for training on several machines; `join_processes` takes their values."""


def join_processes(coordinator: str | None, processes: int, process: int) -> None:
    """Connect this process to the other processes of a training run, if a coordinator is given.

    Raises:
        click.UsageError: if the options contradict each other.
    """
    import jax

    if coordinator and not re.fullmatch(r".+:\d{1,5}", coordinator):
        raise click.UsageError(f"--coordinator {coordinator}: expected HOST:PORT, such as 10.0.0.1:6000")
    if not coordinator and (processes, process) != (1, 0):
        raise click.UsageError(
            "--processes and --process: expected --coordinator HOST:PORT as well, the same in all processes"
        )
    if process >= processes:
        raise click.UsageError(f"--process {process}: expected a number below {processes}")
    if coordinator:
        jax.distributed.initialize(coordinator, processes, process)
