"""Commands that run experiments: positive control, headroom, best responses, adaptation, and training on a release."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import click
from icrl4aht_generation.jobs.options import queue_options, read_queue_options

from icrl4aht_baselines.commands import options as shared
from icrl4aht_baselines.training.options import ResponseOptions
from icrl4aht_data.benchmark.facts import ALL_TRACKS, SOURCES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.commands.dataclass_options import TopicCommand, dataclass_options, topic
from icrl4aht_data.commands.options import COUNT, Folder, Names, examples
from icrl4aht_data.errors import EmptySelectionError
from icrl4aht_data.utils.files import check_output, read_json
from icrl4aht_data.utils.options import replace_options
from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_data.utils.text import card_file
from icrl4aht_data.writing.proof import PROOF_FILE, proof_table

_STEPS = 8_000_000  # default environment steps to train each ego of `adaptation-headroom`

_Queued = tuple[Sequence[Any], Callable[[Path], Path], Callable[[Path], str]]
"""Result of a command that `_queue_command` decorates."""


def _queue_command(out: str, card: str) -> Callable[[Callable[..., _Queued]], Callable[..., None]]:
    """Return a decorator that adds --out, --bundle and the queue's options to a command that trains in a job queue.

    The function of the command returns the jobs and two functions. The first writes the jobs' results into a folder and
    returns the path of the file. The second returns the results in a folder as a table. Results of finished jobs are
    written and printed even if other jobs failed.

    Args:
        out: default folder of the training runs.
        card: file of the package's cards that --bundle updates.
    """

    def decorate(command: Callable[..., _Queued]) -> Callable[..., None]:
        @topic("Machines", queue_options)
        @click.option("--out", type=Folder(), metavar="FOLDER", default=out, help="Write training runs here.")
        @click.option("--bundle", is_flag=True, help=f"Also update {card} of the package's cards.")
        @wraps(command)
        def run_queue(queue: dict[str, Any], out: Path, bundle: bool, **choice: Any) -> None:
            options = read_queue_options(queue)  # sets environment variables, which JAX reads at its first use
            from icrl4aht_generation.jobs.queue import run_jobs
            from icrl4aht_generation.learners.resume import limit_xla_threads
            from rich.console import Console

            limit_xla_threads(1)  # as many threads as in workers: jobs resume only with an equal number
            # The path is absolute, as workers on a cluster have other working directories.
            jobs, write, table = command(out=out.resolve(), **choice)
            console = Console(soft_wrap=True)
            try:
                run_jobs(jobs, out, console, options)
            finally:
                for folder in (out, card_file("headroom.json").parent)[: 1 + bundle]:
                    console.print(f"wrote {write(folder)}")
                click.echo(table(out))

        return run_queue

    return decorate


def _ego_options(
    *own: Callable[[Any], Any], task_options: Sequence[Callable[[Any], Any]] = (), **default_text: str
) -> Callable[[Any], Any]:
    """Return a decorator that adds the options of a command that trains egos.

    Args:
        own: further options of the training.
        task_options: further options that choose tasks.
        default_text: name of a training option -> its default in the help.
    """
    training = dataclass_options(ResponseOptions, "training", exclude=("learning_rate",), default_text=default_text)
    seeds = click.option("--seeds", type=COUNT, default=3, help="Training runs of each ego, with different seeds.")
    tasks, train = topic("Tasks", *shared.tasks_options, *task_options), topic("Training", *own, seeds, training)
    return lambda command: tasks(train(command))


@click.command("control")
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/control", help="Write the runs here.")
def control_command(out: Path) -> None:
    """Check that AD and DPT adapt in context.

    Trains AD and DPT on bandits, and AD in Dark Room (about 10 minutes). Checks that the models adapt, and that they
    do not adapt when their context is cut off. Exits with 1 if a check fails.
    """
    from icrl4aht_baselines.control.control import format_checks, run_control

    with progress_bars(unit="steps") as show:
        checks = run_control(out, show)
    click.echo(format_checks(checks))
    if not all(check.passed for check in checks):
        sys.exit(1)


@click.command("headroom")
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/headroom", help="Write the results here.")
@click.option(
    "--protocol",
    type=shared.PROTOCOL_NAME,
    multiple=True,
    default=("published", "seeded"),
    help="published or seeded; repeat for several.",
)
@click.option("--bundle", is_flag=True, help="Also replace these files of the package's cards.")
def headroom_command(out: Path, protocol: tuple[str, ...], bundle: bool) -> None:
    """Measure the reference egos on every test task.

    Under protocol `seeded`, each task is played with the seeds 0, 1 and 2. The ego `stay` also plays the validation
    tasks and, under `seeded`, the test tasks of track `preference`, since scores are relative to its returns. Writes
    all results into OUT, their summaries into OUT/headroom.json, OUT/headroom.md and OUT/stay.json, and groups of test
    teammates that behave the same into OUT/behaviours.json.
    """
    from icrl4aht_baselines.headroom import HEADROOM_FILES, find_equal_teammates, measure_headroom, write_headroom_cards

    folders = [out, card_file("headroom.json").parent] if bundle else [out]
    for folder in folders:
        check_output(folder, overwrite=True, names=HEADROOM_FILES)
    runs = measure_headroom(out, protocol)
    alike = find_equal_teammates()
    for path in (path for folder in folders for path in write_headroom_cards(runs, alike, folder)):
        click.echo(f"wrote {path}")


def _model_returns() -> dict[str, dict[str, Any]]:
    """Return model -> task id -> mean return on test tasks with each of `SUBMITTED_SEEDS`, from the stored results.

    Each training run is a model. Results of controls, in which an ego's memory is cleared or another teammate plays,
    are left out.
    """
    from icrl4aht_baselines.evaluate.protocols import SUBMITTED_SEEDS
    from icrl4aht_baselines.report.results import bundled_tasks_by_id, task_label
    from icrl4aht_baselines.report.stored_results import read_stored, results_file

    ids = {task_label(task): task for task in bundled_tasks_by_id("test", ALL_TRACKS)}
    stored = read_stored(results_file())
    found: dict[str, dict[str, Any]] = defaultdict(dict)
    for agent, cells in stored.with_other_play_modes(stored.returns()).items():
        for of in (of for of in cells.values() if of.seeds == SUBMITTED_SEEDS):
            for training, returns in zip(of.trainings, of.blocks["all"], strict=True):
                model = f"{agent}, training run {training}" if training else agent
                found[model] |= {ids[task]: values for task, values in zip(of.tasks, returns, strict=True)}
    return found


@click.command(
    "best-response",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data best-response --layout demo_wide --family H3 --seeds 1 --steps 100000 --out runs/small",
        "icrl4aht-data best-response --split test --split validation --workers 2 --bundle",
    ),
)
@_ego_options(
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
@_queue_command("runs/best-responses", "best_responses.json")
def best_response_command(
    inits: tuple[str, ...], seeds: int, training: dict[str, Any], out: Path, **choice: Any
) -> _Queued:
    """Train a best response to each teammate.

    Trains an ego with the benchmark's observations by PPO, with one teammate. In the first half of the steps, the
    ego also imitates the oracle. Teammates that behave the same share one best response. Tasks in which the oracle
    earns no more than `stay` are left out. The best training run is chosen on other episodes than the reported
    ones. For each reported seed, a stored model that earns more with the other seeds is used instead. Writes
    OUT/best_responses.json and prints a table. Finished runs are reused, and stopped runs resume. Give more --steps
    if the return still rises in the last quarter.
    """
    from icrl4aht_baselines.online.responses import (
        ResponseJob,
        find_behaviours,
        initial_run,
        responses_table,
        tasks_with_headroom,
        write_responses,
    )

    tasks = tasks_with_headroom(shared.chosen_tasks(**choice))
    if not tasks:
        raise EmptySelectionError("none of the chosen tasks has headroom; choose other tasks")
    behaviours = find_behaviours(tasks)
    click.echo(f"{len(tasks)} tasks with headroom, {len(behaviours)} behaviours")
    settings = [ResponseOptions(**training, init=None if init == "oracle" else init) for init in inits]
    for own in settings:  # reports a model that does not fit now, not in every job
        for layout in {task.layout.name for task in tasks}:
            initial_run(layout, own)
    jobs = [ResponseJob(one, seed, own, out) for seed in range(seeds) for own in settings for one in behaviours]
    return jobs, lambda folder: write_responses(jobs, folder, _model_returns()), responses_table


@click.command(
    "adaptation-headroom",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data adaptation-headroom --layout demo_wide --seeds 1 --steps 100000 --out runs/small",
        "icrl4aht-data adaptation-headroom --track preference --workers 2 --bundle",
    ),
)
@_ego_options(task_options=[shared.suite_option], steps=f"{_STEPS:,}")
@_queue_command("runs/adaptation", "adaptation.json")
def adaptation_headroom_command(
    suite: Path | None, seeds: int, training: dict[str, Any], out: Path, **choice: Any
) -> _Queued:
    """Estimate how much memory across episodes can raise returns.

    Trains two egos on the tasks of each layout. An informed ego observes the task's number in every step; an episodic
    ego has to identify the teammate in each episode. Prints the difference of their returns, with an interval over the
    seeds. The difference is an estimate, because both egos are trained for --steps only. Writes OUT/adaptation.json.
    Finished training runs are reused, and stopped runs resume. On the track `preference` each teammate of a layout's
    tasks wants each of their dishes, scripts play the same tasks, and informed egos that played all test tasks of a
    layout are added to OUT/best_responses.json.
    """
    from icrl4aht_baselines.online.adaptation import adaptation_jobs, informed_responses, write_adaptation
    from icrl4aht_baselines.online.responses import add_responses
    from icrl4aht_data.benchmark.adaptation import adaptation_table, read_adaptation, task_set_name

    sets: dict[str, list[Task]] = defaultdict(list)
    for task in shared.chosen_tasks(**choice):
        sets[task_set_name(task.track, task.split, task.layout.name, choice["families"])].append(task)
    jobs = adaptation_jobs(sets, seeds, replace_options(ResponseOptions(_STEPS), training), out, suite)

    def write(folder: Path) -> Path:
        path = write_adaptation(jobs, folder)
        if found := informed_responses(jobs, folder):
            add_responses(found, folder, _model_returns())
        return path

    return jobs, write, lambda folder: adaptation_table(read_adaptation(folder))


@click.command(
    "proof",
    cls=TopicCommand,
    epilog=examples("icrl4aht-data research proof --histories all --learner ad-expert --seeds 1"),
)
@shared.root_option
@click.option(
    "--histories",
    type=click.Choice(["all", *SOURCES]),
    multiple=True,
    default=("all",),
    help="Train on all histories, or on those of one source; repeat for several.",
    show_default="all",
)
@click.option(
    "--learner",
    type=Names("learner", shared.lazy_attribute("icrl4aht_baselines.proof", "LEARNERS")),
    multiple=True,
    help="ad, ad-expert or dpt-expert: the method, and expert labels if it learns them; repeat for several.",
    show_default="all three",
)
@click.option("--seeds", type=COUNT, default=3, help="Training runs of each model, with different seeds.")
@_queue_command("runs/proof", PROOF_FILE)
def proof_command(root: Any, histories: tuple[str, ...], learner: tuple[str, ...], seeds: int, out: Path) -> _Queued:
    """Show what models learn from a release.

    Trains small AD and DPT models on the release only, and evaluates them on validation tasks. On track `preference`
    each model also plays with its memory cleared before each episode. On track `teammate` the models are compared
    with rl2-reference. Training and evaluating a model takes about 30 minutes on one core. Writes OUT/proof.json;
    with --bundle the card of the bundled release shows the results. Finished runs are reused, and stopped runs resume.
    """
    from icrl4aht_baselines.proof import LEARNERS, ProofJob, ProofOptions, run_references, write_proof

    chosen = ProofOptions(str(root.resolve()) if isinstance(root, Path) else root)
    models = dict.fromkeys((source, name) for source in histories for name in learner or LEARNERS)
    jobs = [ProofJob(source, name, seed, chosen, out) for seed in range(seeds) for source, name in models]
    references = run_references(chosen, out)

    def format_table(folder: Path) -> str:
        return proof_table(read_json(folder / PROOF_FILE))

    return jobs, lambda folder: write_proof(jobs, references, folder / PROOF_FILE), format_table
