"""`python -m generation`: thin commands."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import click
from rich.console import Console

from generation.options import EXECUTORS, Executor, Options, ask_for_determinism, leave_memory_to_workers
from icrl4aht_data.cli import run
from icrl4aht_data.schema import KINDS, Kind

console = Console(soft_wrap=True)

_profile = click.option("--profile", "profile_name", default="smoke", show_default=True, help="Name or TOML file.")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="icrl4aht-data")
def cli() -> None:
    """Rebuild the ICRL4AHT dataset from the environment and the teammates."""


@cli.command()
@_profile
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for artefacts and releases.")
@click.option("--kind", type=click.Choice(KINDS), multiple=True, default=("lite",), show_default=True)
@click.option("--suite", type=click.Path(path_type=Path), help="Folder of the learned teammates.  [default: OUT/suite]")
@click.option("--seed", default=0, show_default=True, help="Of the learned teammates.")
@click.option("--bundle", is_flag=True, help="Also make the lite release the one that the package bundles.")
@click.option("--executor", type=click.Choice(EXECUTORS), default="local", show_default=True)
@click.option(
    "--address", help="Of a running Ray cluster; by default a Ray on this machine is started for the occasion."
)
@click.option("--workers", type=click.IntRange(min=1), help="Tasks at a time on a Ray of our own; default: all cores.")
@click.option("--retries", type=click.IntRange(min=0), default=0, show_default=True, help="Of a task that failed.")
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
    """Train the teammates and an ego for every task of a profile, record it, and pack OUT/lite or OUT/full.

    What is finished is kept, and what is not goes on from its last saved update: after a stop or a kill the same
    command goes on where it was. Teammates are trained by this process, tasks by the executor. Tasks that fail are
    listed in OUT/failed.jsonl; the others are finished, nothing is packed, and the exit code is 1.
    """
    from generation.build import build_releases
    from generation.package import bundle_release

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
@click.option("--devices", type=click.IntRange(min=1), default=8, show_default=True, help="The N of the last lines.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def plan(profile_name: str, devices: int, as_json: bool) -> None:
    """Say what a rebuild will cost: tasks, environment steps, disk, and hours at this machine's measured speed."""
    from generation.plan import cost
    from generation.profiles import load_profile

    costs = cost(load_profile(profile_name), devices)
    if as_json:
        click.echo(json.dumps(costs.to_json(), indent=2))
    else:
        for name, value in costs.in_words():
            click.echo(f"{name:<28} {value}")


@cli.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def check(a: Path, b: Path, as_json: bool) -> None:
    """Compare two rebuilds bit for bit: releases, artefacts, or whole folders. Exits with 1 if they differ."""
    from generation.check import compare

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
@click.option("--layout", default="demo_wide", show_default=True, help="Short or environment name.")
def speed(profile_name: str, layout: str) -> None:
    """Measure the learner: steps/s, and the share of environment, forward pass and update. Prints one JSON line."""
    from generation.plan import task_learner
    from generation.profiles import load_profile
    from generation.speed import learner_speed
    from icrl4aht_data.overcooked.layouts import get_layout

    name = get_layout(layout).name
    profile = load_profile(profile_name)
    measured = learner_speed(task_learner(replace(profile, layouts=(name,)), profile.ego))
    click.echo(json.dumps({"profile": profile_name, "layout": name, **measured}))


@cli.command()
@click.option("--check", is_flag=True, help="Write nothing; fail if the files differ.")
def manifests(check: bool) -> None:
    """Write the published test tasks into icrl4aht_data/manifests, from the parameter tables."""
    from generation.teammates.instances import published_tasks
    from icrl4aht_data.benchmark import TRACKS
    from icrl4aht_data.errors import TaskFormatError
    from icrl4aht_data.tasks import manifest_path, read_tasks, write_tasks

    for track in TRACKS:
        path, tasks = manifest_path(track, "test"), published_tasks(track)
        if not check:
            write_tasks(path, tasks)
        elif read_tasks(path) != tasks:
            raise TaskFormatError(f"{path}: differs from the parameter tables; run `python -m generation manifests`")
        console.print(f"{path}: {len(tasks)} tasks")


_suite = click.option(
    "--suite",
    type=click.Path(path_type=Path),
    default=Path("build/suite"),
    show_default=True,
    help="Folder of the learned teammates.",
)
_layouts = click.option("--layout", "layouts", multiple=True, help="Again for more; the profile's by default.")
_algorithms = click.option("--algorithm", "algorithms", multiple=True, help="Again for more; all by default.")


@cli.command()
@_profile
@_layouts
@_algorithms
@_suite
@click.option("--seed", default=0, show_default=True)
def teammates(profile_name: str, layouts: tuple[str, ...], algorithms: tuple[str, ...], suite: Path, seed: int) -> None:
    """Train populations of teammates, filter their checkpoints and write manifests of tasks with them.

    Finished populations are kept: after a stop, the same command goes on where it was.
    """
    from generation.build_suite import build_suite
    from generation.profiles import load_profile

    build_suite(load_profile(profile_name), suite, layouts, algorithms, seed, console)


@cli.command()
@click.option("--layout", "layouts", multiple=True, help="Again for more; all finished ones by default.")
@_algorithms
@_suite
@click.option("--greedy", is_flag=True, help="In seat 1 act greedily, as teammates do.")
def diversity(layouts: tuple[str, ...], algorithms: tuple[str, ...], suite: Path, greedy: bool) -> None:
    """Self-play and cross-play of each population, and Hamming distances of all teammates; tables and pictures."""
    from generation.build_suite import report_diversity

    report_diversity(suite, layouts, algorithms, greedy, console)


def main() -> None:
    """Entry point."""
    run(cli)
