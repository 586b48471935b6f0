"""`python -m baselines`: thin commands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from baselines.commands.options import (
    AGENT,
    CONTEXT,
    METHOD,
    PROTOCOL,
    STEPS,
    HostPort,
    acting_option,
    agent_of,
    batch_size_option,
    experiment_options,
    films_option,
    found_in,
    protocol_option,
    root_option,
    seeds_option,
    suite_option,
    tensorboard_option,
    variants,
)
from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, TRACKS
from icrl4aht_data.commands.options import (
    COUNT,
    COUNT_OR_NONE,
    LAYOUT,
    RATE,
    SEED,
    SETTINGS,
    TRACK,
    Folder,
    Names,
    NewFile,
    Sections,
    bars,
    counted,
    examples,
    run,
    version_option,
)
from icrl4aht_data.errors import EmptySelectionError, OptionError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.history import OBS
from icrl4aht_data.sampling.dpt import CONTEXT_ORDERS

console = Console(soft_wrap=True)


_SECTIONS = {
    "Train and evaluate": ("demo", "train", "evaluate", "report", "watch"),
    "The paper's experiments": ("tracks", "sweep", "ablate", "heldout-rl"),
    "Check": ("control", "drift", "headroom"),
}


@click.group(
    cls=Sections,
    sections=_SECTIONS,
    context_settings=SETTINGS,
    epilog=examples(
        "python -m baselines train ad --layout demo_wide --out runs/ad",
        "python -m baselines evaluate --agent runs/ad --layout demo_wide --out runs/ad-results",
        "python -m baselines report runs/ad-results",
    ),
)
@version_option
def cli() -> None:
    """Train reference learners and evaluate agents on the ICRL4AHT benchmark.

    Needs the extra baselines. What is finished is kept: after a stop the same command goes on. Exit codes: 0 done, 1 a
    failure or a check that failed, 2 a misused command.
    """


@cli.command(
    epilog=examples(
        "python -m baselines evaluate --agent random --out runs/random",
        "python -m baselines evaluate --agent runs/ad --layout demo_wide --out runs/ad-results",
    )
)
@click.option("--agent", type=AGENT, required=True, help="stay, random, oracle, or a folder that `train` has made.")
@acting_option
@protocol_option
@click.option(
    "--track", type=TRACK, multiple=True, default=tuple(TRACKS), help="Only the tasks of this track; again for more."
)
@click.option("--layout", type=LAYOUT, multiple=True, help="Only the tasks on this layout; again for more.")
@click.option(
    "--manifest",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="The tasks of this file instead of the tracks'.",
)
@suite_option
@seeds_option
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write the results here.")
def evaluate(
    agent: str,
    acting: Any,
    protocol: str,
    track: tuple[str, ...],
    layout: tuple[str, ...],
    manifest: Path | None,
    suite: Path | None,
    seeds: int,
    out: Path,
) -> None:
    """Evaluate an agent on the benchmark's test tasks.

    Plays 100 episodes of each task and writes one JSON a task into OUT/tasks. Tasks that are there are not played
    again.
    """
    from baselines.evaluate.evaluator import evaluate as evaluate_tasks
    from baselines.evaluate.protocols import get_protocol
    from baselines.report.provenance import note_results
    from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks

    paths = [manifest] if manifest else [manifest_path(name, "test") for name in track]
    ego = agent_of("--agent", agent, acting)
    wanted = {get_layout(name).name for name in layout}
    tasks = [task for path in paths for task in read_tasks(path) if not wanted or task.layout.name in wanted]
    if not tasks:
        raise EmptySelectionError(
            f"no task on {', '.join(sorted(wanted))} in {', '.join(map(str, paths))}: choose another --layout, or none"
        )
    for name in {task.layout.name for task in tasks}:
        ego.make(get_layout(name))  # a model that does not fit fails before any work
    with bars() as show:
        evaluate_tasks(
            ego.name,
            ego.make,
            tasks,
            get_protocol(protocol),
            seeds=range(seeds),
            suite=suite,
            out=out,
            details=ego.details,
            done=counted(show, f"{ego.name}, {protocol}", len(tasks)),
        )
    note_results(out, agent if ego.details else None, tasks if manifest else ())
    console.print(f"{len(tasks)} results in {out}; `python -m baselines report {out}` shows them")


@cli.command()
@click.argument("runs", nargs=-1, required=True, type=Folder(), metavar="RESULTS...")
@click.option(
    "--out", type=Folder(), metavar="FOLDER", help="Write it here.", show_default="report in the first RESULTS"
)
@click.option(
    "--html", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Also one self-contained page."
)
@films_option
@suite_option
def report(runs: tuple[Path, ...], out: Path | None, html: Path | None, films: bool, suite: Path | None) -> None:
    """Put results beside the paper's.

    RESULTS are folders that `evaluate` has made. Prints the paper's tables with its numbers beside ours, and writes
    them as Markdown, CSV and curves, and of trained models a card. Results of one agent on different layouts are put
    together.
    """
    from baselines.report.markdown import markdown
    from baselines.report.model_card import write_model_cards
    from baselines.report.results import merge, read_run
    from baselines.report.write import write_report

    loaded = merge([read_run(run) for run in runs])
    paths = write_report(loaded, out or runs[0] / "report")
    if html:
        from baselines.report.page import write_page_with_films

        paths.append(write_page_with_films(loaded, html, films=films, suite=suite))
    paths += write_model_cards(loaded, paths[0].parent)
    click.echo(markdown(loaded))
    for path in paths:
        click.echo(f"wrote {path}")


@cli.command(
    epilog=examples("python -m baselines watch --layout demo_wide --teammate H3/t1 --ego oracle --out episode.gif")
)
@click.option("--layout", type=LAYOUT, required=True, help="The layout.")
@click.option(
    "--teammate", metavar="FAMILY/tN", default="H4/t0", help="A published teammate: its family, H1 to H4, and number."
)
@click.option("--ego", type=AGENT, default="random", help="stay, random, oracle, or a folder that `train` has made.")
@protocol_option
@click.option("--seed", type=SEED, default=0, help="Of the episode.")
@click.option("--out", type=NewFile(".gif"), metavar="FILE", required=True, help="The GIF to write.")
def watch(layout: str, teammate: str, ego: str, protocol: str, seed: int, out: Path) -> None:
    """Play an episode and draw it as a GIF."""
    from baselines.evaluate.protocols import get_protocol
    from baselines.report.episode_gifs import episode_gif
    from generation.teammates.instances import named_task

    task = named_task(layout, teammate)
    earned = episode_gif(out, task, agent_of("--ego", ego).make, get_protocol(protocol), seed=seed)
    console.print(f"{ego} with {task.teammate_family}/t{task.teammate['theta_id']}: return {earned:g}; wrote {out}")


@cli.command()
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/headroom", help="Write the results here.")
@click.option(
    "--protocol",
    type=PROTOCOL,
    multiple=True,
    default=lambda: tuple(PROTOCOL.valid()),
    show_default="all",
    help="published or seeded; again for more.",
)
def headroom(out: Path, protocol: tuple[str, ...]) -> None:
    """Measure the reference egos on every test task.

    Writes their results, and cards/headroom.json and cards/headroom.md from them.
    """
    from baselines.report.headroom import measure, write_cards

    with bars() as show:
        runs = measure(out, protocol, show)
    for path in write_cards(runs):
        console.print(f"wrote {path}")


@cli.command()
@click.argument("run", type=Folder())
@click.option("--layout", type=LAYOUT, help="The layout.", show_default="the first that the model was trained on")
@click.option(
    "--family", type=Names("family", HEURISTIC_KINDS.values), default="H4", help="Of teammates: H1, H2, H3 or H4."
)
@protocol_option
@click.option("--episodes", type=COUNT, help="How many to play.", show_default="as many as fill the window three times")
def drift(run: Path, layout: str | None, family: str, protocol: str, episodes: int | None) -> None:
    """Measure how far cached acting drifts from exact.

    RUN is a folder that `train` has made. Prints a line an episode: how often both would act the same, and the total
    variation between them. Writes nothing.
    """
    import dataclasses

    from baselines.agents.egos import check_fits
    from baselines.evaluate.drift import measure
    from baselines.evaluate.protocols import get_protocol
    from baselines.training.histories import read_trained
    from generation.teammates.instances import INSTANCES, named_task

    trained, played = read_trained(run), get_protocol(protocol)
    full = -(-trained.context // played.steps)
    played = dataclasses.replace(played, episodes=episodes or 3 * full)
    name = get_layout(layout or trained.layouts[0]).name
    check_fits(trained, get_layout(name), run)
    tasks = [named_task(name, f"{family}/t{theta}") for theta in range(INSTANCES)]
    with bars() as show:
        found = []
        for episode in measure(trained.method, trained.params, trained.context, tasks, played):
            found.append(episode)
            show(f"{trained.label}, {family} on {name}", len(found), played.episodes)
    click.echo(f"{trained.label} on {name} beside {len(tasks)} teammates of {family}, K = {trained.context}")
    click.echo("episode  same action  total variation: mean     largest")
    for number, (distance, same) in enumerate(found):
        click.echo(f"{number:>7}  {same.mean():>11.1%}  {distance.mean():>21.6f}  {distance.max():>10.6f}")


@cli.command(
    epilog=examples(
        "python -m baselines train ad --layout demo_wide --out runs/ad",
        "python -m baselines train dpt --layout demo_wide --ta --out runs/dpt-ta",
        "python -m baselines train ad --layout demo_wide --steps 20 --context 50 --out runs/small",
    )
)
@click.argument("method", type=METHOD)
@click.option(
    "--layout",
    "layouts",
    type=LAYOUT,
    multiple=True,
    required=True,
    help="To train on; again for more, of one observation shape.",
)
@root_option
@click.option("--out", type=Folder(), metavar="FOLDER", help="Write the run here.", show_default="runs/METHOD")
@click.option(
    "--size",
    type=Names("size", found_in("baselines.methods.method", "SIZES")),
    default="small",
    help="small, medium or large: layers, width, steps.",
)
@click.option("--steps", **STEPS, show_default="the size's")
@click.option("--context", **CONTEXT, default=500)
@batch_size_option
@click.option("--accumulate", type=COUNT, default=1, help="Compute a batch in so many parts.")
@click.option("--learning-rate", type=RATE, default=1e-3, help="At its highest.")
@click.option(
    "--positions",
    type=Names("positions", found_in("baselines.methods.transformer", "POSITIONS")),
    default="none",
    help="none, as published, or rope.",
)
@click.option(
    "--order",
    type=Names("order", lambda: CONTEXT_ORDERS),
    default="contiguous",
    help="Of DPT's contexts: contiguous or random.",
)
@click.option("--teammate-actions", "--ta", is_flag=True, help="+TA: the teammate's previous action as input.")
@click.option("--next-obs", is_flag=True, help="+next_obs: an auxiliary loss.")
@click.option("--bfloat16", is_flag=True, help="Compute in bfloat16.")
@click.option("--remat", is_flag=True, help="Less memory, more computing.")
@click.option(
    "--obs",
    type=Names("obs", lambda: OBS),
    help="What batches hold: state, uint8 or float32.",
    show_default="state, or uint8 where there are no state records",
)
@click.option("--seed", type=SEED, default=0, help="Of parameters, batches and dropout.")
@click.option("--save-every", type=COUNT, default=1000, help="Steps between checkpoints.")
@tensorboard_option
@click.option("--coordinator", type=HostPort(), help="Of process 0, to train on several machines.")
@click.option("--processes", type=COUNT, default=1, help="With --coordinator: how many there are.")
@click.option("--process", type=COUNT_OR_NONE, default=0, help="With --coordinator: which one this is.")
def train(method: str, layouts: tuple[str, ...], root: Any, out: Path | None, **options: Any) -> None:
    """Train a model on learning histories.

    METHOD is ad, dpt, hybrid_ad or amago_offline. Writes settings, checkpoints, metrics.jsonl and curves.png into OUT;
    the same command goes on from the last checkpoint.
    """
    import jax

    if not options["coordinator"] and (options["processes"], options["process"]) != (1, 0):
        raise click.UsageError(
            "--processes and --process: expected a --coordinator HOST:PORT as well, the same for all"
        )
    if options["process"] >= options["processes"]:
        raise click.UsageError(f"--process {options['process']}: expected a number below {options['processes']}")
    if options["coordinator"]:
        jax.distributed.initialize(options["coordinator"], options["processes"], options["process"])
    from baselines.methods.method import SIZES, ModelOptions
    from baselines.training.histories import HistoryOptions, prepare
    from baselines.training.trainer import TrainOptions
    from baselines.training.trainer import train as run_training

    layers, width, steps = SIZES[options["size"]]
    names = ("positions", "teammate_actions", "next_obs", "bfloat16", "remat")
    model = ModelOptions(layers, width, **{name: options[name] for name in names})
    names = ("context", "accumulate", "learning_rate", "seed", "save_every")
    training = TrainOptions(
        steps=steps if options["steps"] is None else options["steps"],
        batch_size=options["batch_size"] or _default_batch_size(),
        **{name: options[name] for name in names},
    )
    histories = HistoryOptions(layouts, root and str(root), order=options["order"], obs=options["obs"])
    job = prepare(method, model, training, histories)
    folder = out or Path("runs") / method
    with bars() as show:

        def done(step: int, loss: float) -> None:
            show(method, step, training.steps, f", loss {loss:.3f}")

        log = options["tensorboard"]
        run_training(job.method, job.data, job.options, folder, job.about, tensorboard=log, done=done)
    console.print(
        f"{training.steps} steps in {folder}; `python -m baselines evaluate --agent {folder} --out ...` plays it"
    )


def _default_batch_size() -> int:
    """The paper's, or what a step in seconds allows."""
    import jax

    return 8 if jax.default_backend() == "cpu" else 1024


@cli.command(
    epilog=examples(
        "python -m baselines sweep size --layout demo_wide",
        "python -m baselines sweep context --only K250 --steps 20 --layout demo_wide --tasks 1 --episodes 5",
    )
)
@click.argument("what", type=variants("sweep"))
@experiment_options
def sweep(what: str, **options: Any) -> None:
    """Train and evaluate over sizes, or context lengths.

    WHAT is context (K of 250 to 10,000) or size (small, medium, large). Writes runs, results and OUT/report.
    """
    _experiment(f"sweep {what}", **options)


@cli.command(epilog=examples("python -m baselines ablate ta --layout demo_wide"))
@click.argument("what", type=variants("ablate"))
@experiment_options
def ablate(what: str, **options: Any) -> None:
    """Train and evaluate with and without parts.

    WHAT is ta: none, +TA (teammate actions), +next_obs (auxiliary loss), both. Writes runs, results and OUT/report.
    """
    _experiment(f"ablate {what}", **options)


@cli.command()
@experiment_options
def tracks(**options: Any) -> None:
    """Train and evaluate on both tracks.

    The paper's Tables 1 and 2; with other methods 4 and 5. Writes runs, results and OUT/report.
    """
    _experiment("tracks", **options)


@cli.command("heldout-rl")
@click.option(
    "--suite",
    type=Folder(),
    metavar="FOLDER",
    default="build/suite",
    help="The learned teammates.",
)
@experiment_options
def heldout_rl(suite: Path, **options: Any) -> None:
    """Train, and evaluate beside held-out teammates.

    These are a suite's learned teammates that are not in training. Writes runs, results and OUT/report.
    """
    _experiment("heldout-rl", suite=suite, **options)


def _experiment(name: str, out: Path | None, root: Any, suite: Path | None = None, **options: Any) -> None:
    from baselines.experiments import ExperimentPlan, run_experiment

    given = {key: options.pop(key) for key in ("steps", "context", "batch_size")}
    training = {key: value for key, value in given.items() if value is not None}
    training.setdefault("batch_size", _default_batch_size())
    if name == "sweep context" and "context" in training:
        raise OptionError(f"--context {training['context']}: `sweep context` varies it; choose by --only, such as K250")
    plan = ExperimentPlan(root=root and str(root), suite=suite, train=training, **options)
    with bars() as show:
        found = run_experiment(name, plan, out or Path("runs") / name.replace(" ", "-"), show)
    for note in found.notes:
        click.echo(note)
    for path in found.report:
        click.echo(f"wrote {path}")


@cli.command()
@click.option("--out", type=Folder(), metavar="FOLDER", default="runs/control", help="Write the runs here.")
def control(out: Path) -> None:
    """Show that the models adapt where they can.

    Trains them on bandits and Dark Room (about 10 minutes), and prints a table of checks: they adapt there, and do not
    with their context cut off. Exits with 1 if a check fails.
    """
    from baselines.control.control import run_control, table

    with bars() as show:

        def done(name: str, of: int, step: int, loss: float) -> None:
            show(name, step, of, f", loss {loss:.3f}")

        checks = run_control(out, done=done)
    click.echo(table(checks))
    if not all(check.passed for check in checks):
        sys.exit(1)


@cli.command()
@click.option("--out", type=Folder(), metavar="FOLDER", default="build/demo", help="Write all of it here.")
def demo(out: Path) -> None:
    """Go the whole way on the bundled release.

    Loads, samples and verifies it, trains a small AD model, evaluates it, and writes a report of one page.
    """
    from baselines.demo import run_demo

    run_demo(out, console)


def main() -> None:
    """Entry point."""
    run(cli)
