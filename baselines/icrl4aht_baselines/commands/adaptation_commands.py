"""Commands that measure what an ego can earn with a teammate, and what adaptation can earn at most."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import click
from icrl4aht_generation.jobs.command_line import queue_options, read_queue_options

from icrl4aht_baselines.commands import options as shared
from icrl4aht_baselines.training.options import ResponseOptions
from icrl4aht_data.benchmark.best_responses import best_responses_file
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.commands.dataclass_options import TopicCommand, dataclass_options, topic
from icrl4aht_data.commands.options import COUNT, FAMILY, Folder, Names, examples
from icrl4aht_data.errors import EmptySelectionError
from icrl4aht_data.utils.options import replace_options

_tasks_topic = topic(
    "Tasks",
    shared.track_option,
    click.option(
        "--split",
        "splits",
        type=shared.EVALUATION_SPLIT,
        multiple=True,
        default=("test",),
        help="test, validation or diverse; repeat for several.",
    ),
    shared.only_layouts_option,
    click.option("--family", "families", type=FAMILY, multiple=True, help="Only with this family; repeat."),
    shared.manifest_option,
)
_STEPS = 8_000_000  # of the training of an informed or episodic ego
_seeds_option = click.option("--seeds", type=COUNT, default=3, help="Trainings of each ego, with different seeds.")


def _model_returns(tasks: list[Task], protocol: str) -> dict[str, dict[str, float]]:
    """Return model -> task id -> mean return, of the stored results of models on some tasks."""
    from icrl4aht_baselines.agents.egos import OTHER_WAYS
    from icrl4aht_baselines.report.comparison import read_stored, results_file
    from icrl4aht_baselines.report.results import task_label

    table, names = read_stored(results_file()).table, {task_label(task.task_id): task.task_id for task in tasks}
    table = table[table["control"].isin(["", *OTHER_WAYS])]
    named = table["agent"].where(table["control"] == "", table["agent"] + " (" + table["control"] + ")")
    table = table.assign(agent=named)
    chosen = table[(table["protocol"] == protocol) & (table["block"] == "all")]
    means = chosen[chosen["task"].isin(list(names))].groupby(["agent", "task"])["return"].mean()
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for (agent, task), value in means.items():  # type: ignore[misc]
        found[str(agent)][names[str(task)]] = float(value)
    return found


@click.command(
    "best-response",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data best-response --layout demo_wide --family H3 --seeds 1 --steps 100000 --out runs/small",
        "icrl4aht-data best-response --split test --split validation --workers 2 --bundle",
    ),
)
@_tasks_topic
@topic(
    "Training",
    _seeds_option,
    dataclass_options(ResponseOptions, "training", exclude=("learning_rate",)),
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
@topic("Machines", queue_options)
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/best-responses", help="Write trainings here.")
@click.option("--bundle", is_flag=True, help="Also update best_responses.json of the package's cards.")
def best_response_command(
    seeds: int,
    training: dict[str, Any],
    inits: tuple[str, ...],
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
    options = read_queue_options(queue)
    from icrl4aht_generation.jobs.queue import run_jobs
    from icrl4aht_generation.learners.resume import limit_xla_threads
    from rich.console import Console

    from icrl4aht_baselines.online.responses import (
        PROTOCOL,
        RESPONSES_FILE,
        ResponseJob,
        find_behaviours,
        responses_table,
        with_headroom,
        write_responses,
    )

    limit_xla_threads(1)  # of every job, so that it resumes in this process and in workers alike
    chosen = with_headroom(shared.chosen_tasks(**choice))
    if not chosen:
        raise EmptySelectionError("none of these tasks has headroom; choose others")
    console, behaviours = Console(soft_wrap=True), find_behaviours(chosen)
    console.print(f"{len(chosen)} tasks with headroom, {len(behaviours)} behaviours")
    settings = [ResponseOptions(**training, init=None if init == "oracle" else init) for init in inits]
    jobs = [ResponseJob(one, seed, own, out) for seed in range(seeds) for own in settings for one in behaviours]
    try:
        run_jobs(jobs, out, console, options)
    finally:
        for path in (out / RESPONSES_FILE, best_responses_file())[: 1 + bundle]:
            write_responses(jobs, path, _model_returns(chosen, PROTOCOL))
            console.print(f"wrote {path}")
        click.echo(responses_table(out / RESPONSES_FILE))


@click.command(
    "adaptation-headroom",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data adaptation-headroom --layout demo_wide --seeds 1 --steps 100000 --out runs/small",
        "icrl4aht-data adaptation-headroom --track preference --workers 2 --bundle",
    ),
)
@_tasks_topic
@topic(
    "Training",
    click.option("--together", is_flag=True, help="One ego for all layouts instead of one for each."),
    _seeds_option,
    dataclass_options(ResponseOptions, "training", exclude=("learning_rate",), default_text={"steps": f"{_STEPS:,}"}),
)
@topic("Machines", queue_options)
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/adaptation", help="Write trainings here.")
@click.option("--bundle", is_flag=True, help="Also update adaptation.json of the package's cards.")
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
    options = read_queue_options(queue)
    from icrl4aht_generation.jobs.queue import run_jobs
    from icrl4aht_generation.learners.resume import limit_xla_threads
    from rich.console import Console

    from icrl4aht_baselines.online.adaptation import adaptation_table, headroom_jobs, write_adaptation

    limit_xla_threads(1)  # of every job, so that it resumes in this process and in workers alike
    sets: dict[str, list[Task]] = defaultdict(list)
    for task in shared.chosen_tasks(**choice):
        where = "all" if together else task.layout.name
        sets["-".join((task.track, task.split, where, *choice["families"]))].append(task)
    settings = replace_options(ResponseOptions(_STEPS), training)
    console, jobs = Console(soft_wrap=True), headroom_jobs(sets, seeds, settings, out)
    try:
        run_jobs(jobs, out, console, options)
    finally:
        for folder in (out, best_responses_file().parent)[: 1 + bundle]:
            console.print(f"wrote {write_adaptation(jobs, folder)}")
        click.echo(adaptation_table(out))
