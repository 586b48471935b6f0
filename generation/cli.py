"""`python -m generation`: thin commands."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from generation.collection.options import EXECUTORS, Executor, Options, ask_for_determinism, leave_memory_to_workers
from icrl4aht_data.benchmark.facts import ALGORITHMS
from icrl4aht_data.commands.options import (
    COUNT,
    COUNT_OR_NONE,
    LAYOUT,
    SEED,
    SETTINGS,
    Folder,
    Names,
    Sections,
    examples,
    json_option,
    run,
    version_option,
)
from icrl4aht_data.format.schema import KINDS, Kind

console = Console(soft_wrap=True)

_profile = click.option(
    "--profile", "profile_name", default="smoke", metavar="PROFILE", help="smoke, mini or paper, or a TOML file."
)

_SECTIONS = {
    "Rebuild": ("plan", "generate", "check"),
    "Learned teammates": ("teammates", "diversity"),
    "Maintain": ("speed", "manifests"),
}


@click.group(
    cls=Sections,
    sections=_SECTIONS,
    context_settings=SETTINGS,
    epilog=examples(
        "python -m generation plan --profile mini",
        "python -m generation generate --profile smoke --out build/smoke",
        "python -m generation teammates --profile mini --layout cramped_up",
    ),
)
@version_option
def cli() -> None:
    """Rebuild the ICRL4AHT dataset from the environment and the teammates.

    Needs the extra generation. What a command has finished is kept: after a stop the same command goes on. Exit codes:
    0 done, 1 a failure or a difference, 2 a misused command.
    """


@cli.command(
    epilog=examples(
        "python -m generation generate --profile smoke --out build/smoke",
        "python -m generation generate --profile mini --out build/mini --kind lite --kind full",
        "python -m generation generate --profile paper --out build/paper --executor ray",
    )
)
@_profile
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write artefacts and releases here.")
@click.option(
    "--kind",
    type=click.Choice(KINDS),
    multiple=True,
    default=("lite",),
    help="Of release, in OUT/KIND; again for more.",
)
@click.option("--suite", type=Folder(), metavar="FOLDER", help="The learned teammates.", show_default="OUT/suite")
@click.option("--seed", type=SEED, default=0, help="Of the learned teammates.")
@click.option("--bundle", is_flag=True, help="Also make the lite release the one that the package bundles.")
@click.option("--executor", type=click.Choice(EXECUTORS), default="local", help="One task at a time here, or Ray.")
@click.option("--address", metavar="HOST:PORT", help="Of a running Ray cluster.", show_default="a Ray made here")
@click.option(
    "--workers",
    type=COUNT,
    help="Tasks at a time on the Ray made here.",
    show_default="one per GPU, or per core",
)
@click.option("--retries", type=COUNT_OR_NONE, default=0, help="Of a task that failed.")
@click.option("--fail-fast", is_flag=True, help="Begin no task after one has failed.")
def generate(
    profile_name: str,
    out: Path,
    kind: tuple[Kind, ...],
    suite: Path | None,
    seed: int,
    bundle: bool,
    executor: Executor,
    address: str | None,
    workers: int | None,
    retries: int,
    fail_fast: bool,
) -> None:
    """Rebuild a release, from nothing or from where it was.

    Trains the teammates of a profile and an ego for each of its tasks, records how they learn (OUT/artefacts), and
    packs the release OUT/lite or OUT/full. What is not finished goes on from its last saved update. Teammates are
    trained by this process, tasks by the executor. Tasks that fail are listed in OUT/failed.jsonl; the others are
    finished, nothing is packed, and the exit code is 1.
    """
    from generation.releases.build import build_releases
    from generation.releases.package import bundle_release

    if bundle and "lite" not in kind:
        raise click.UsageError("--bundle needs --kind lite")
    if executor == "local" and (address or workers):
        raise click.UsageError("--address and --workers need --executor ray")
    ask_for_determinism()
    if executor == "ray":
        leave_memory_to_workers()
    options = Options(executor, address, workers, retries, fail_fast)
    releases = dict(zip(kind, build_releases(profile_name, out, kind, console, options, suite, seed), strict=True))
    for release in releases.values():
        console.print(f"release: {release}")
    if bundle:
        console.print(f"bundled: {bundle_release(releases['lite'])}")


@cli.command()
@_profile
@click.option("--devices", type=COUNT, default=8, help="Also say the hours on so many of these devices.")
@json_option
def plan(profile_name: str, devices: int, as_json: bool) -> None:
    """Say what a rebuild will cost.

    Prints tasks, environment steps, disk, and hours at the speed that is measured here. Writes nothing.
    """
    from generation.planning.plan import cost
    from generation.profiles import load_profile

    costs = cost(load_profile(profile_name), devices)
    if as_json:
        click.echo(json.dumps(costs.to_json(), indent=2))
    else:
        for name, value in costs.in_words():
            click.echo(f"{name:<28} {value}")


@cli.command(epilog=examples("python -m generation check build/smoke build/again"))
@click.argument("a", type=Folder())
@click.argument("b", type=Folder())
@json_option
def check(a: Path, b: Path, as_json: bool) -> None:
    """Compare two rebuilds bit for bit.

    A and B are releases, artefacts, or folders that `generate` has made. Prints what differs, and exits with 1 if
    anything does. Writes nothing.
    """
    from generation.releases.check import compare

    compared = compare(a, b)
    if as_json:
        click.echo(json.dumps(compared.to_json(), indent=2))
    else:
        for name, how in compared.differences.items():
            click.echo(f"{name}: {how}")
        verdict = f"{len(compared.differences)} differ" if compared.differences else "bit-equal"
        click.echo(f"{a} and {b}: {compared.files} files compared, {verdict}")
    sys.exit(1 if compared.differences else 0)


@cli.command()
@_profile
@click.option("--layout", type=LAYOUT, default="demo_wide", help="The layout.")
def speed(profile_name: str, layout: str) -> None:
    """Measure how fast a profile's ego learns.

    Prints one JSON line: steps/s, and the shares of environment, forward pass and update. Writes nothing.
    """
    from generation.planning.plan import task_learner
    from generation.planning.speed import learner_speed
    from generation.profiles import load_profile
    from icrl4aht_data.overcooked.layouts import get_layout

    name = get_layout(layout).name
    profile = load_profile(profile_name)
    measured = learner_speed(task_learner(replace(profile, layouts=(name,)), profile.ego))
    click.echo(json.dumps({"profile": profile_name, "layout": name, **measured}))


@cli.command()
@click.option("--check", is_flag=True, help="Write nothing; exit with 1 if the files differ.")
def manifests(check: bool) -> None:
    """Write the lists of published test tasks anew.

    Makes icrl4aht_data/manifests/*.jsonl from the parameter tables.
    """
    from generation.teammates.instances import published_tasks
    from icrl4aht_data.benchmark.facts import TRACKS
    from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks, write_tasks
    from icrl4aht_data.errors import TaskFormatError

    for track in TRACKS:
        path, tasks = manifest_path(track, "test"), published_tasks(track)
        if not check:
            write_tasks(path, tasks)
        elif read_tasks(path) != tasks:
            raise TaskFormatError(f"{path}: differs from the parameter tables; run `python -m generation manifests`")
        console.print(f"{path}: {len(tasks)} tasks")


def _layouts(shown: str) -> Callable[[Any], Any]:
    return click.option(
        "--layout",
        "layouts",
        type=LAYOUT,
        multiple=True,
        help="On this layout; again for more.",
        show_default=shown,
    )


_algorithms = click.option(
    "--algorithm",
    "algorithms",
    type=Names("algorithm", lambda: ALGORITHMS),
    multiple=True,
    default=ALGORITHMS,
    help="fcp, brdiv, lbrdiv or comedi; again for more.",
    show_default="all",
)


@cli.command(epilog=examples("python -m generation teammates --profile mini --layout cramped_up --algorithm fcp"))
@_profile
@_layouts("the profile's")
@_algorithms
@click.option("--suite", type=Folder(), metavar="FOLDER", default="build/suite", help="Write them here.")
@click.option("--seed", type=SEED, default=0, help="Of their training.")
def teammates(profile_name: str, layouts: tuple[str, ...], algorithms: tuple[str, ...], suite: Path, seed: int) -> None:
    """Train populations of teammates.

    Writes five checkpoints of every member into SUITE/LAYOUT/ALGORITHM, filters them by what they earn, and writes
    the lists of tasks with those that are left, SUITE/manifests. Finished populations are kept. Without --layout these
    are the populations that the profile names, or all on its layouts if it names none.
    """
    from generation.populations.build import build_suite
    from generation.profiles import load_profile
    from icrl4aht_data.errors import OptionError
    from icrl4aht_data.overcooked.layouts import get_layout

    ask_for_determinism()
    profile = load_profile(profile_name)
    if layouts:
        wanted = dict.fromkeys((get_layout(name).name for name in layouts), algorithms)
    else:
        of_profile = profile.algorithms or dict.fromkeys(profile.layouts, ALGORITHMS)
        wanted = {layout: [name for name in names if name in algorithms] for layout, names in of_profile.items()}
        if not any(wanted.values()):
            raise OptionError(f"profile {profile.name} has no teammates by {', '.join(algorithms)}: name a --layout")
    build_suite(profile, suite, wanted, seed, console)


@cli.command()
@_layouts("all that are finished")
@_algorithms
@click.option(
    "--suite",
    type=Folder(),
    metavar="FOLDER",
    default="build/suite",
    help="What `teammates` has made.",
)
@click.option("--greedy", is_flag=True, help="In seat 1 act greedily, as teammates do.")
def diversity(layouts: tuple[str, ...], algorithms: tuple[str, ...], suite: Path, greedy: bool) -> None:
    """Show how much the teammates of a suite differ.

    Prints self-play and cross-play of each population, and the Hamming distances of all teammates, and draws them into
    SUITE/LAYOUT.
    """
    from generation.populations.build import report_diversity

    report_diversity(suite, layouts, algorithms, greedy, console)


def main() -> None:
    """Entry point."""
    run(cli)
