"""Commands of `icrl4aht-data` that generate releases, train teammates and maintain tasks."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click
from rich.console import Console

from icrl4aht_data.benchmark.facts import ALGORITHMS, PREFERENCE, TESTED_ON, TRACKS
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks, write_tasks
from icrl4aht_data.commands.dataclass_options import TopicCommand, topic
from icrl4aht_data.commands.options import (
    COUNT,
    LAYOUT,
    SEED,
    Folder,
    Names,
    NewFile,
    examples,
    json_option,
    overwrite_option,
    print_result,
)
from icrl4aht_data.errors import OptionError, TaskFormatError, check_choice
from icrl4aht_data.format.layouts_file import read_tasks_and_layouts
from icrl4aht_data.format.schema import KINDS, Kind
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.plotting import plot_layouts, save_figure
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.progress import bar_updater, progress_bars
from icrl4aht_data.utils.text import card_file
from icrl4aht_generation.jobs.options import queue_options, read_queue_options
from icrl4aht_generation.layouts.families import LAYOUT_FAMILIES, LAYOUT_SPLITS, generate_layouts, split_of
from icrl4aht_generation.learners.config import EncoderKind

if TYPE_CHECKING:
    from icrl4aht_generation.profiles import Profile  # only for type checkers, because the module imports JAX

console = Console(soft_wrap=True)

_profile_option = click.option(
    "--profile",
    "profile_name",
    default="smoke",
    metavar="PROFILE",
    help="Profile: smoke, noise, search, bundle, teach, billion, small, mini, cpu, paper, or a TOML file.",
)

_threads_option = click.option(
    "--xla-threads",
    type=COUNT,
    help="Number of CPU threads of an XLA operation; the last bits of results depend on it.",
    show_default="the profile's, else all cores",
)


@click.command(
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data generate --profile smoke --out build/smoke",
        "icrl4aht-data generate --profile mini --out build/mini --kind lite --kind full",
        "icrl4aht-data generate --profile paper --out build/paper --executor ray",
    ),
)
@_profile_option
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write artefacts and releases here.")
@click.option(
    "--kind",
    type=click.Choice(KINDS),
    multiple=True,
    default=("lite",),
    help="Kind of release, written to OUT/KIND; repeat for more.",
)
@click.option(
    "--suite", type=Folder(), metavar="FOLDER", help="Folder of the learned teammates.", show_default="OUT/suite"
)
@click.option("--seed", type=SEED, default=0, help="Seed of the learned teammates.")
@click.option(
    "--tasks",
    "task_file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Generate the tasks of this file, such as a release's meta/tasks.jsonl, with the release's sources. Trains no "
    "teammates: --suite is a suite that contains them, or the release's folder teammates.",
    show_default="the profile's tasks",
)
@click.option("--bundle", is_flag=True, help="Also replace the bundled release of the package by the lite release.")
@click.option(
    "--encoder",
    type=click.Choice(get_args(EncoderKind)),
    help="Encoder of the egos' network.",
    show_default="the profile's",
)
@topic("Machines", _threads_option, queue_options)
def generate(
    profile_name: str,
    out: Path,
    kind: tuple[Kind, ...],
    suite: Path | None,
    seed: int,
    task_file: Path | None,
    bundle: bool,
    encoder: EncoderKind | None,
    xla_threads: int | None,
    queue: dict[str, Any],
) -> None:
    """Generate a release, or resume an interrupted run.

    Trains the learned teammates of a profile, then generates histories of its tasks in OUT/artefacts, by egos that
    learn (source `ppo`) and by scripts (sources `noise` and `search`). Packs the release into OUT/lite or OUT/full.
    Unfinished work resumes from its last save. OUT/failed.jsonl lists the tasks that fail: the other tasks are
    finished, but nothing is packed and the exit code is 1.
    """
    from icrl4aht_generation.releases.build import build_releases
    from icrl4aht_generation.releases.package import bundle_release, recorded_sources

    if bundle and "lite" not in kind:
        raise click.UsageError("--bundle needs --kind lite")
    options = read_queue_options(queue)
    profile = _profile_with_threads(profile_name, xla_threads)
    if encoder:
        profile = profile.with_ego({"widths": {"encoder": encoder}})
    tasks = read_tasks_and_layouts(task_file) if task_file else None
    sources = recorded_sources(task_file.parent.parent) if task_file else {}
    built = build_releases(profile, out, kind, console, options, suite, seed, tasks, sources)
    releases = dict(zip(kind, built, strict=True))
    for release in releases.values():
        console.print(f"release: {release}")
    if bundle:
        console.print(f"bundled: {bundle_release(releases['lite'])}")


def _profile_with_threads(name: str, threads: int | None) -> Profile:
    """Load a profile by name, and limit XLA to the given number of threads, by default the profile's number."""
    from icrl4aht_generation.learners.resume import limit_xla_threads
    from icrl4aht_generation.profiles import load_profile

    def limit_threads(profile: Profile) -> None:
        if number := threads or profile.xla_threads:
            limit_xla_threads(number)

    profile = load_profile(name, limit_threads)
    return replace(profile, xla_threads=threads) if threads else profile


@click.command(
    epilog=examples(
        "icrl4aht-data layouts --family templates --count 24 --out sheet.png",
        "icrl4aht-data layouts --family rooms --seed 1 --split train --json",
    )
)
@click.option(
    "--family",
    type=Names("family of layouts", lambda: LAYOUT_FAMILIES),
    required=True,
    help="rearranged, templates or rooms.",
)
@click.option("--count", type=COUNT, default=24, help="Number of layouts.")
@click.option("--seed", type=SEED, default=0, help="Seed of the family's layouts.")
@click.option(
    "--split",
    type=Names("split of layouts", lambda: LAYOUT_SPLITS),
    help="Only layouts of this split: train, validation or test.",
)
@click.option(
    "--check",
    is_flag=True,
    help="Exit with 1 if on any layout neither the oracle nor a pair of oracles delivers a soup in 400 steps.",
)
@click.option("--out", type=NewFile(".png"), metavar="FILE", help="Write a picture of the layouts to this file.")
@overwrite_option
@json_option
def layouts(
    family: str, count: int, seed: int, split: str | None, check: bool, out: Path | None, overwrite: bool, as_json: bool
) -> None:
    """List generated layouts, and draw pictures of them.

    A layout such as templates-0-17 depends only on its family, seed and number. The family rearranged moves the
    fixtures of asymm_both and cramped_up to other cells; templates puts new fixtures into the rooms of the published
    layouts, mirrored and rotated; rooms generates new rooms.
    """
    if out:
        check_output(out, overwrite)
    found = generate_layouts(family, seed, count, split=split)
    if out:
        titles = [f"{layout.name}\n{split_of(layout)}, {len(layout.recipes)} recipes" for layout in found]
        save_figure(plot_layouts(found, titles), out)
    delivered = [None] * count
    if check:
        from icrl4aht_generation.layouts.playable import are_playable

        with progress_bars(unit="layouts") as show:
            delivered = are_playable(found, bar_updater(show, "check", count)).tolist()
    rows, lines = [], []
    for layout, one in zip(found, delivered, strict=True):
        row = {
            "name": layout.name,
            "split": split_of(layout),
            "rows": layout.rows,
            "recipes": layout.recipes,
            "indicates_delivery": layout.indicates_delivery,
        }
        rows.append(row | ({"delivered": one} if check else {}))
        size, fault = f"{layout.width}x{layout.height}", "  no soup delivered" if one is False else ""
        lines.append(f"{layout.name:<20} {row['split']:<10} {size:<5} {len(layout.recipes):>2} recipes{fault}")
    print_result(rows, "\n".join(lines), as_json)
    if out:
        click.echo(f"wrote {out}", err=as_json)
    sys.exit(int(False in delivered))


@click.command()
@_profile_option
@click.option("--devices", type=COUNT, default=8, help="Also estimate the hours on this many devices.")
@json_option
def plan(profile_name: str, devices: int, as_json: bool) -> None:
    """Estimate the cost of generating a release.

    Prints the number of tasks and environment steps, the disk space, and the hours at a speed that is measured on this
    machine. Writes nothing.
    """
    from icrl4aht_generation.planning.plan import cost_rows, estimate_cost

    cost = estimate_cost(_profile_with_threads(profile_name, None), devices)
    print_result(cost, "\n".join(f"{name:<28} {value}" for name, value in cost_rows(cost)), as_json)


@click.command(epilog=examples("icrl4aht-data check build/smoke build/again"))
@click.argument("a", type=Folder())
@click.argument("b", type=Folder())
@json_option
def check(a: Path, b: Path, as_json: bool) -> None:
    """Compare two generated releases bit for bit.

    A and B are releases, or other folders that `generate` wrote. Prints the differences, and exits with 1 if there are
    any. Times, logs of failures and measurements are not compared. Writes nothing.
    """
    from icrl4aht_generation.releases.check import compare_rebuilds

    compared = compare_rebuilds(a, b)
    lines = [f"{name}: {difference}" for name, difference in compared.differences.items()]
    for folder, threads in zip((a, b), compared.xla_threads, strict=True):
        numbers = " and ".join(map(str, threads)) or "an unknown number of"
        lines.append(f"{folder}: made with {numbers} XLA thread{'' if threads == [1] else 's'}")
    verdict = f"{len(compared.differences)} differ" if compared.differences else "bit-equal"
    lines.append(f"{a} and {b}: {compared.files} files compared, {verdict}")
    print_result({"equal": not compared.differences, **asdict(compared)}, "\n".join(lines), as_json)
    sys.exit(1 if compared.differences else 0)


@click.command()
@click.option("--check", is_flag=True, help="Write nothing; exit with 1 if the files differ.")
@click.option(
    "--out", type=Folder(), metavar="FOLDER", help="Write the manifests here.", show_default="the package's folder"
)
@overwrite_option
def manifests(check: bool, out: Path | None, overwrite: bool) -> None:
    """Write the package's manifests of tasks.

    For the tracks `teammate` and `layout`, writes TRACK_validation.jsonl, TRACK_diverse_train.jsonl and
    TRACK_diverse_validation.jsonl with the teammates that `research draws` sampled and measured; for the track
    `preference`, all three manifests. The published tasks of the other tracks are not written. An existing file with
    other tasks is only replaced with --overwrite.
    """
    from icrl4aht_generation.teammates.draws import diverse_tasks, validation_tasks
    from icrl4aht_generation.teammates.preference import preference_tasks

    made = [(manifest_path(track, "validation"), validation_tasks(track)) for track in TRACKS]
    made += [
        (manifest_path(track, split, "diverse"), diverse_tasks(track, split))
        for track in TRACKS
        for split in ("train", "validation")
    ]
    made += [(manifest_path(PREFERENCE, split), preference_tasks(split)) for split in ("train", "validation", "test")]
    for path, tasks in made:
        path = out / path.name if out else path
        if check or path.is_file():
            different = read_tasks(path) != tasks
            if different and (check or not overwrite):
                remedy = "run `icrl4aht-data research manifests --overwrite`" if check else "replace it by --overwrite"
                raise TaskFormatError(f"{path}: the file's tasks differ from the tasks of this version; {remedy}")
        if not check:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_tasks(path, tasks)
        console.print(f"{path}: {len(tasks)} tasks")


def _layouts_option(default_text: str) -> Callable[[Any], Any]:
    return click.option(
        "--layout", "layouts", type=LAYOUT, multiple=True, help="Layout; repeat for more.", show_default=default_text
    )


_algorithms_option = click.option(
    "--algorithm",
    "algorithms",
    type=Names("algorithm", lambda: ALGORITHMS),
    multiple=True,
    default=ALGORITHMS,
    help="fcp, brdiv, lbrdiv or comedi; repeat for more.",
    show_default="all",
)


_suite_option = click.option(
    "--suite", type=Folder(), metavar="FOLDER", default="build/suite", help="Folder of the populations."
)


@click.command(epilog=examples("icrl4aht-data research draws --layout demo_wide --out draws.jsonl"))
@_layouts_option("all training layouts")
@click.option(
    "--out",
    type=NewFile(),
    metavar="FILE",
    help="Write the table here.",
    show_default="the package's file",
)
@click.option("--spread", is_flag=True, help="Choose the teammates that differ most instead, and print their measures.")
@click.option("--overwrite", is_flag=True, help="Measure layouts again that the table already contains.")
def draws(layouts: tuple[str, ...], out: Path | None, spread: bool, overwrite: bool) -> None:
    """Sample heuristic teammates for tasks, and measure them.

    Samples parameters from the training ranges and from wider ranges (diverse): for each layout and family 32 teammates
    for training and 8 for validation. For each of them, writes the test teammate with the most similar behaviour, and
    the returns of the egos stay, random and oracle with the sampled teammate. With --spread, chooses widely different
    teammates for tasks.spread of the profiles. A stopped command resumes: layouts that the table already contains are
    skipped.
    """
    import pandas as pd

    from icrl4aht_generation.teammates.distances import fill_table
    from icrl4aht_generation.teammates.draws import DRAWS_TABLE, read_measured
    from icrl4aht_generation.teammates.spread import SPREAD_TABLE, LayoutSpread, spread_rows

    names = list(dict.fromkeys(get_layout(name).name for name in layouts)) or list(TESTED_ON)
    for name in names:
        check_choice("training layout", name, TESTED_ON)
    path = out or (SPREAD_TABLE if spread else DRAWS_TABLE)
    with progress_bars(unit="layouts") as show:
        fill_table(path, names, lambda done, name: show("draws", done, len(names), name), overwrite, spread=spread)
    if spread:
        rows = pd.DataFrame(spread_rows(read_measured(path, LayoutSpread)))
        console.print(rows.to_string(index=False, float_format="{:.3f}".format))
    console.print(f"wrote {path}")


@click.command(
    cls=TopicCommand, epilog=examples("icrl4aht-data teammates --profile mini --layout cramped_up --algorithm fcp")
)
@_profile_option
@_layouts_option("the profile's")
@_algorithms_option
@_suite_option
@click.option("--seed", type=SEED, default=0, help="Seed of the training.")
@topic("Machines", _threads_option, queue_options)
def teammates(
    profile_name: str,
    layouts: tuple[str, ...],
    algorithms: tuple[str, ...],
    suite: Path,
    seed: int,
    xla_threads: int | None,
    queue: dict[str, Any],
) -> None:
    """Train populations of teammates.

    Writes five checkpoints of every member into SUITE/LAYOUT/ALGORITHM, selects checkpoints by their returns, and
    writes tasks with the selected checkpoints to SUITE/manifests. Finished populations are not trained again. Without
    --layout, trains the populations of the profile, or all algorithms on the profile's layouts if it names none.
    """
    from icrl4aht_generation.populations.build import build_suite

    options = read_queue_options(queue)
    profile = _profile_with_threads(profile_name, xla_threads)
    if layouts:
        wanted = dict.fromkeys((get_layout(name).name for name in layouts), tuple(dict.fromkeys(algorithms)))
    else:
        available = profile.algorithms or dict.fromkeys(profile.layouts, ALGORITHMS)
        wanted = {layout: [name for name in names if name in algorithms] for layout, names in available.items()}
        if not any(wanted.values()):
            raise OptionError(f"profile {profile.name} trains no teammates by {', '.join(algorithms)}; give --layout")
    build_suite(profile, suite, wanted, seed, console, options)


@click.command()
@_layouts_option("all that are finished")
@_algorithms_option
@_suite_option
@click.option("--greedy", is_flag=True, help="Let the teammate act greedily, as in the dataset.")
@click.option(
    "--release",
    type=Folder(),
    metavar="FOLDER",
    help="Compare the validation teammates of this release with its training teammates instead.",
)
@click.option("--bundle", is_flag=True, help="With --release, also write the distances to the package's cards.")
def diversity(
    layouts: tuple[str, ...], algorithms: tuple[str, ...], suite: Path, greedy: bool, release: Path | None, bundle: bool
) -> None:
    """Report how much a suite's or a release's teammates differ.

    Prints self-play and cross-play returns of each population, and mean Hamming distances (share of states in which two
    teammates act differently) between algorithms and families of heuristics. With --release, prints for each training
    layout the smallest distance of a validation teammate to a training teammate.
    """
    from icrl4aht_data.writing.splits import DISTANCES_FILE
    from icrl4aht_generation.populations.build import report_diversity, report_splits

    if bundle and not release:
        raise OptionError("--bundle stores the distances of a release; also give --release FOLDER")
    if release:
        report_splits(release, card_file("headroom.json").with_name(DISTANCES_FILE) if bundle else None, console)
    else:
        report_diversity(suite, layouts, algorithms, greedy, console)
