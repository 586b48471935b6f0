"""`python -m generation`: thin commands; the only place where exceptions become exit codes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
from rich.console import Console

from icrl4aht_data.errors import Icrl4ahtError
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
def generate(profile_name: str, out: Path, kind: tuple[Kind, ...]) -> None:
    """Train an ego for every task of a profile, record it, and pack the releases OUT/lite or OUT/full.

    Finished tasks are kept: after a stop, the same command goes on with the first unfinished one.
    """
    from generation.build import build_releases

    for release in build_releases(profile_name, out, kind, console):
        console.print(f"release: {release}")


@cli.command()
@_profile
@click.option("--layout", default="demo_wide", show_default=True, help="Short or environment name.")
def speed(profile_name: str, layout: str) -> None:
    """Measure the learner: steps/s, and the share of environment, forward pass and update. Prints one JSON line."""
    from generation.collect import make_learner
    from generation.profiles import load_profile
    from generation.speed import learner_speed
    from generation.teammates.registry import heuristic_teammate
    from icrl4aht_data.benchmark import track_of
    from icrl4aht_data.overcooked.layouts import get_layout
    from icrl4aht_data.tasks import make_task

    name = get_layout(layout).name
    task = make_task(track_of(name), "train", name, heuristic_teammate("utility_greedy", "default", 0), 0)
    measured = learner_speed(make_learner(task, load_profile(profile_name)))
    click.echo(json.dumps({"profile": profile_name, "layout": name, **measured}))


@cli.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("build/demo"), show_default=True)
@_profile
def demo(out: Path, profile_name: str) -> None:
    """From nothing to a verified dataset: generate, verify, load, sample, draw."""
    from generation.demo import run_demo

    run_demo(out, profile_name, console)


def main() -> None:
    """Entry point."""
    try:
        cli()
    except Icrl4ahtError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(1)
