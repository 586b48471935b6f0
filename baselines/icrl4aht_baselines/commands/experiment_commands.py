"""Commands of the positive control, of headroom, and of what a release teaches."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
from icrl4aht_generation.jobs.options import queue_options, read_queue_options

from icrl4aht_baselines.commands import options as shared
from icrl4aht_data.benchmark.facts import SOURCES
from icrl4aht_data.commands.dataclass_options import TopicCommand, topic
from icrl4aht_data.commands.options import COUNT, Folder, Names, examples
from icrl4aht_data.utils.files import check_output, parse_json, read_text
from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_data.utils.templates import card_file
from icrl4aht_data.writing.proof import PROOF_FILE, proof_table


@click.command("control")
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/control", help="Write the runs here.")
def control_command(out: Path) -> None:
    """Check that AD and DPT adapt in context.

    Trains them on bandits and Dark Room (about 10 minutes), and prints the checks: they adapt there, and do not with
    their context cut off. Exits with 1 if a check fails.
    """
    from icrl4aht_baselines.control.control import format_checks, run_control
    from icrl4aht_baselines.training.trainer import format_loss

    with progress_bars(unit="steps") as show:

        def done(name: str, total: int, step: int, loss: float | None) -> None:
            show(name, step, total, format_loss(loss))

        checks = run_control(out, done=done)
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

    `stay` also plays the validation tasks, since scores are relative to it. Under seeded each task is played with the
    seeds 0, 1 and 2. Writes their results into OUT, and OUT/headroom.json, OUT/headroom.md and OUT/stay.json from them,
    and OUT/behaviours.json: which test teammates act alike.
    """
    from icrl4aht_baselines.headroom import (
        HEADROOM_FILES,
        find_alike_tasks,
        measure_headroom,
        write_headroom_cards,
    )

    folders = [out, card_file("headroom.json").parent] if bundle else [out]
    for folder in folders:
        check_output(folder, overwrite=True, names=HEADROOM_FILES)
    with progress_bars(unit="episodes") as show:
        runs = measure_headroom(out, protocol, show)
    alike = find_alike_tasks()
    for path in (path for folder in folders for path in write_headroom_cards(runs, alike, folder)):
        click.echo(f"wrote {path}")


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
@click.option("--seeds", type=COUNT, default=3, help="Trainings of each, with different seeds.")
@topic("Machines", queue_options)
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/proof", help="Write trainings here.")
@click.option("--bundle", is_flag=True, help="Also update proof.json of the package's cards.")
def proof_command(
    root: Any,
    histories: tuple[str, ...],
    learner: tuple[str, ...],
    seeds: int,
    queue: dict[str, Any],
    out: Path,
    bundle: bool,
) -> None:
    """Show what a release teaches.

    Trains small models on the release alone, AD and DPT, and evaluates them on validation tasks: of the track
    preference with their memory and with it cleared before each episode, and of the track teammate beside
    rl2-reference. About 35 minutes each on one core. Writes OUT/proof.json, which the release's card shows; finished
    trainings are kept, stopped ones resume.
    """
    options = read_queue_options(queue)
    from icrl4aht_generation.jobs.queue import run_jobs
    from icrl4aht_generation.learners.resume import limit_xla_threads
    from rich.console import Console

    from icrl4aht_baselines.proof import LEARNERS, ProofJob, ProofOptions, run_references, write_proof

    limit_xla_threads(1)  # of every job, so that it resumes in this process and in workers alike
    chosen, console = ProofOptions(root and str(root)), Console(soft_wrap=True)
    models = [(source, name) for source in histories for name in learner or LEARNERS]
    jobs = [ProofJob(source, name, seed, chosen, out) for seed in range(seeds) for source, name in models]
    references = run_references(chosen, out)
    try:
        run_jobs(jobs, out, console, options)
    finally:
        for folder in (out, card_file("headroom.json").parent)[: 1 + bundle]:
            console.print(f"wrote {write_proof(jobs, references, folder / PROOF_FILE)}")
        click.echo(proof_table(parse_json(read_text(out / PROOF_FILE))))
