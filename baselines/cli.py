"""`python -m baselines`: thin commands."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.progress import Progress

from baselines.evaluate import PROTOCOLS
from icrl4aht_data.benchmark import TRACKS
from icrl4aht_data.cli import run

console = Console(soft_wrap=True)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="icrl4aht-data")
def cli() -> None:
    """Evaluate agents on the ICRL4AHT benchmark."""


@cli.command()
@click.option("--agent", required=True, help="stay, random or oracle.")
@click.option("--protocol", default="seeded", show_default=True, help=f"One of {', '.join(PROTOCOLS)}.")
@click.option("--track", multiple=True, default=tuple(TRACKS), show_default=True)
@click.option(
    "--manifest", type=click.Path(path_type=Path, exists=True), help="Tasks of a file instead of the tracks'."
)
@click.option("--suite", type=click.Path(path_type=Path, exists=True), help="Folder of learned teammates.")
@click.option("--seeds", default=1, show_default=True, type=click.IntRange(1), help="Play every task so often.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for one JSON per task.")
def evaluate(
    agent: str,
    protocol: str,
    track: tuple[str, ...],
    manifest: Path | None,
    suite: Path | None,
    seeds: int,
    out: Path,
) -> None:
    """Evaluate an agent; goes on where a stopped run of the same settings ended."""
    from baselines.agents import get_agent
    from baselines.evaluate import evaluate as evaluate_tasks
    from baselines.evaluate import get_protocol
    from icrl4aht_data.tasks import manifest_path, read_tasks

    paths = [manifest] if manifest else [manifest_path(name, "test") for name in track]
    tasks = [task for path in paths for task in read_tasks(path)]
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task(f"{agent}, {protocol}", total=len(tasks))
        evaluate_tasks(
            agent,
            get_agent(agent),
            tasks,
            get_protocol(protocol),
            seeds=range(seeds),
            suite=suite,
            out=out,
            done=lambda n: bars.advance(bar, n),
        )
    console.print(f"{len(tasks)} results in {out}; `python -m baselines report {out}` shows them")


@cli.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the report; RUN/report of the first by default."
)
def report(runs: tuple[Path, ...], out: Path | None) -> None:
    """The paper's tables with the published numbers beside ours, as Markdown, CSV and curves."""
    from baselines.report import markdown, read_run, write_report

    loaded = [read_run(run) for run in runs]
    paths = write_report(loaded, out or runs[0] / "report")
    click.echo(markdown(loaded))
    for path in paths:
        click.echo(f"wrote {path}")


@cli.command()
@click.option("--layout", required=True, help="Short or environment name.")
@click.option("--teammate", default="H4/t0", show_default=True, help="Family and published instance, such as H3/t1.")
@click.option("--ego", default="random", show_default=True, help="An agent's name.")
@click.option("--protocol", default="seeded", show_default=True)
@click.option("--seed", default=0, show_default=True)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True, help="The GIF to write.")
def watch(layout: str, teammate: str, ego: str, protocol: str, seed: int, out: Path) -> None:
    """An episode to look at."""
    import dataclasses

    import numpy as np

    from baselines.agents import get_agent
    from baselines.evaluate import get_protocol, play_tasks
    from generation.teammates.instances import named_task
    from icrl4aht_data.overcooked.render import save_episode

    task = named_task(layout, teammate)
    one = dataclasses.replace(get_protocol(protocol), episodes=1)
    (played,) = play_tasks(get_agent(ego), [task], one, [seed])
    record, reward = np.asarray(played.record[0]), np.asarray(played.reward[0])
    save_episode(out, task.layout, record, reward)
    console.print(
        f"{ego} with {task.teammate_family}/t{task.teammate['theta_id']}: return {reward.sum():g}; wrote {out}"
    )


@cli.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs/headroom"), show_default=True)
@click.option("--protocol", multiple=True, default=tuple(PROTOCOLS), show_default=True)
def headroom(out: Path, protocol: tuple[str, ...]) -> None:
    """Measure the reference egos on every test task and write cards/headroom.json and cards/headroom.md."""
    from baselines.headroom import measure, write_cards

    with Progress(console=console, disable=not console.is_terminal) as bars:
        runs = measure(out, protocol, bars)
    for path in write_cards(runs):
        console.print(f"wrote {path}")


def main() -> None:
    """Entry point."""
    run(cli)
