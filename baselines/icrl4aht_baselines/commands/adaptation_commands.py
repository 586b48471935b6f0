"""Commands that measure what an ego can earn with a teammate, and what adaptation can earn at most."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
from icrl4aht_generation.jobs.options import queue_options, read_queue_options

from icrl4aht_baselines.commands import options as shared
from icrl4aht_baselines.training.options import ResponseOptions
from icrl4aht_data.benchmark.best_responses import best_responses_file
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.commands.dataclass_options import TopicCommand, dataclass_options, topic
from icrl4aht_data.commands.options import COUNT, Folder, Names, examples
from icrl4aht_data.errors import EmptySelectionError
from icrl4aht_data.utils.options import replace_options

_STEPS = 8_000_000  # of the training of an informed or episodic ego


def _training_options(out: str, card: str, *own: Callable[[Any], Any], **default_text: str) -> Callable[[Any], Any]:
    """Return a decorator with the options of both commands; `own` are further options of the training."""
    training = dataclass_options(ResponseOptions, "training", exclude=("learning_rate",), default_text=default_text)
    seeds = click.option("--seeds", type=COUNT, default=3, help="Trainings of each ego, with different seeds.")
    options = [
        topic("Tasks", *shared.tasks_options),
        topic("Training", *own, seeds, training),
        topic("Machines", queue_options),
        click.option("--out", type=Folder(), metavar="FOLDER", default=out, help="Write trainings here."),
        click.option("--bundle", is_flag=True, help=f"Also update {card} of the package's cards."),
    ]
    return lambda command: shared.add_options(command, options)


def _run_trainings(
    make_jobs: Callable[[list[Task]], Sequence[Any]],
    write: Callable[[Sequence[Any], Path], Path],
    table: Callable[[Path], str],
    queue: dict[str, Any],
    out: Path,
    bundle: bool,
    choice: dict[str, Any],
) -> None:
    """Run the jobs of the chosen tasks, add their results to the files of results, and print the table."""
    options = read_queue_options(queue)
    from icrl4aht_generation.jobs.queue import run_jobs
    from icrl4aht_generation.learners.resume import limit_xla_threads
    from rich.console import Console

    limit_xla_threads(1)  # of every job, so that it resumes in this process and in workers alike
    console, jobs = Console(soft_wrap=True), make_jobs(shared.chosen_tasks(**choice))
    try:
        run_jobs(jobs, out, console, options)
    finally:
        for folder in (out, best_responses_file().parent)[: 1 + bundle]:
            console.print(f"wrote {write(jobs, folder)}")
        click.echo(table(out))


def _model_returns() -> dict[str, dict[str, float]]:
    """Return model -> task id -> mean return, of the stored results of models on test tasks.

    Results of controls do not count, in which an ego's memory is cleared or another teammate plays.
    """
    from icrl4aht_baselines.report.comparison import read_stored, results_file
    from icrl4aht_baselines.report.results import bundled_by_id, task_label

    ids, stored = {task_label(task): task for task in bundled_by_id("test")}, read_stored(results_file())
    return {
        agent: {
            ids[task]: float(values.mean())
            for of in cells.values()
            for task, values in zip(of.tasks, of.mean, strict=True)
        }
        for agent, cells in stored.with_other_ways(stored.returns()).items()
    }


@click.command(
    "best-response",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data best-response --layout demo_wide --family H3 --seeds 1 --steps 100000 --out runs/small",
        "icrl4aht-data best-response --split test --split validation --workers 2 --bundle",
    ),
)
@_training_options(
    "runs/best-responses",
    "best_responses.json",
    click.option(
        "--init",
        "inits",
        type=Names("start", lambda: ("oracle", "rl2-reference")),
        multiple=True,
        default=("oracle",),
        help="Start from random parameters and imitate the oracle at first (oracle), or from a bundled model as well; "
        "repeat for both.",
    ),
)
def best_response_command(
    inits: tuple[str, ...],
    seeds: int,
    training: dict[str, Any],
    queue: dict[str, Any],
    out: Path,
    bundle: bool,
    **choice: Any,
) -> None:
    """Train a best response to each teammate.

    An ego with the benchmark's own view learns with one teammate alone, by PPO that imitates the oracle in its first
    half. Teammates that act alike share one. Tasks in which the oracle earns no more than `stay` are left out. The
    best training is chosen on other episodes than those reported; a stored model that earns more takes its place.
    Writes OUT/best_responses.json and prints it; finished trainings are kept, stopped ones resume. Where the return
    still rises in the last quarter, give more --steps.
    """
    from icrl4aht_baselines.online.responses import (
        ResponseJob,
        find_behaviours,
        responses_table,
        with_headroom,
        write_responses,
    )

    def make_jobs(tasks: list[Task]) -> list[ResponseJob]:
        chosen = with_headroom(tasks)
        if not chosen:
            raise EmptySelectionError("none of these tasks has headroom; choose others")
        behaviours = find_behaviours(chosen)
        click.echo(f"{len(chosen)} tasks with headroom, {len(behaviours)} behaviours")
        settings = [ResponseOptions(**training, init=None if init == "oracle" else init) for init in inits]
        return [ResponseJob(one, seed, own, out) for seed in range(seeds) for own in settings for one in behaviours]

    def write(jobs: Sequence[ResponseJob], folder: Path) -> Path:
        return write_responses(jobs, folder, _model_returns())

    _run_trainings(make_jobs, write, responses_table, queue, out, bundle, choice)


@click.command(
    "adaptation-headroom",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data adaptation-headroom --layout demo_wide --seeds 1 --steps 100000 --out runs/small",
        "icrl4aht-data adaptation-headroom --track preference --workers 2 --bundle",
    ),
)
@_training_options(
    "runs/adaptation",
    "adaptation.json",
    click.option("--together", is_flag=True, help="One ego for all layouts instead of one for each."),
    steps=f"{_STEPS:,}",
)
def adaptation_headroom_command(
    together: bool,
    seeds: int,
    training: dict[str, Any],
    queue: dict[str, Any],
    out: Path,
    bundle: bool,
    **choice: Any,
) -> None:
    """Estimate what memory across episodes can earn.

    Trains two egos on the tasks of each layout: one that is told in every step which task it plays, and one that has to
    find out in each episode. Prints the difference of their returns with an interval over the seeds. Both learn for
    --steps only, so it is an estimate. Writes OUT/adaptation.json; finished trainings are kept, stopped ones resume.
    """
    from icrl4aht_baselines.online.adaptation import HeadroomJob, adaptation_table, headroom_jobs, write_adaptation

    def make_jobs(tasks: list[Task]) -> list[HeadroomJob]:
        sets: dict[str, list[Task]] = defaultdict(list)
        for task in tasks:
            where = "all" if together else task.layout.name
            sets["-".join((task.track, task.split, where, *choice["families"]))].append(task)
        return headroom_jobs(sets, seeds, replace_options(ResponseOptions(_STEPS), training), out)

    _run_trainings(make_jobs, write_adaptation, adaptation_table, queue, out, bundle, choice)
