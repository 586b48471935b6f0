"""`python -m baselines`: thin commands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import Progress

from baselines.evaluate import PROTOCOLS
from icrl4aht_data.benchmark import TRACKS
from icrl4aht_data.cli import run
from icrl4aht_data.errors import EmptySelectionError, OptionError
from icrl4aht_data.overcooked.layouts import get_layout

console = Console(soft_wrap=True)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="icrl4aht-data")
def cli() -> None:
    """Train reference learners and evaluate agents on the ICRL4AHT benchmark."""


@cli.command()
@click.option("--agent", required=True, help="stay, random, oracle, or a folder that `train` has made.")
@click.option("--acting", default="cached", show_default=True, help="Of a trained model: cached, or exact and slower.")
@click.option("--protocol", default="seeded", show_default=True, help=f"One of {', '.join(PROTOCOLS)}.")
@click.option("--track", multiple=True, default=tuple(TRACKS), show_default=True)
@click.option("--layout", multiple=True, help="Only the tasks on these layouts.")
@click.option(
    "--manifest", type=click.Path(path_type=Path, exists=True), help="Tasks of a file instead of the tracks'."
)
@click.option("--suite", type=click.Path(path_type=Path, exists=True), help="Folder of learned teammates.")
@click.option("--seeds", default=1, show_default=True, type=click.IntRange(1), help="Play every task so often.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for one JSON per task.")
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
    """Evaluate an agent; goes on where a stopped run of the same settings ended."""
    from baselines.agents import find_agent
    from baselines.evaluate import evaluate as evaluate_tasks
    from baselines.evaluate import get_protocol
    from baselines.provenance import note_results
    from icrl4aht_data.tasks import manifest_path, read_tasks

    paths = [manifest] if manifest else [manifest_path(name, "test") for name in track]
    ego = find_agent(agent, acting)
    wanted = {get_layout(name).name for name in layout}
    tasks = [task for path in paths for task in read_tasks(path) if not wanted or task.layout.name in wanted]
    if not tasks:
        raise EmptySelectionError(f"no task on {', '.join(sorted(wanted))} in {', '.join(map(str, paths))}")
    for name in {task.layout.name for task in tasks}:
        ego.make(get_layout(name))  # a model that does not fit fails before any work
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task(f"{ego.name}, {protocol}", total=len(tasks))
        evaluate_tasks(
            ego.name,
            ego.make,
            tasks,
            get_protocol(protocol),
            seeds=range(seeds),
            suite=suite,
            out=out,
            details=ego.details,
            done=lambda n: bars.advance(bar, n),
        )
    note_results(out, agent if ego.details else None, tasks if manifest else ())
    console.print(f"{len(tasks)} results in {out}; `python -m baselines report {out}` shows them")


@cli.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the report; RUN/report of the first by default."
)
@click.option("--html", type=click.Path(path_type=Path, dir_okay=False), help="Also one self-contained page.")
@click.option("--episodes/--no-episodes", default=True, show_default=True, help="A GIF per family on the page.")
@click.option("--suite", type=click.Path(path_type=Path, exists=True), help="Of learned teammates, for their GIFs.")
def report(runs: tuple[Path, ...], out: Path | None, html: Path | None, episodes: bool, suite: Path | None) -> None:
    """The paper's tables with the published numbers beside ours, as Markdown, CSV and curves, and as one page.

    Results of one agent on different layouts are put together.
    """
    from baselines.report import markdown, merge, read_run, write_report

    loaded = merge([read_run(run) for run in runs])
    paths = write_report(loaded, out or runs[0] / "report")
    if html:
        from baselines.page import write_page_with_films

        paths.append(write_page_with_films(loaded, html, episodes=episodes, suite=suite))
    click.echo(markdown(loaded))
    for path in paths:
        click.echo(f"wrote {path}")


@cli.command()
@click.option("--layout", required=True, help="Short or environment name.")
@click.option("--teammate", default="H4/t0", show_default=True, help="Family and published instance, such as H3/t1.")
@click.option("--ego", default="random", show_default=True, help="An agent's name, or a run folder.")
@click.option("--protocol", default="seeded", show_default=True)
@click.option("--seed", default=0, show_default=True)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True, help="The GIF to write.")
def watch(layout: str, teammate: str, ego: str, protocol: str, seed: int, out: Path) -> None:
    """An episode to look at."""
    from baselines.agents import find_agent
    from baselines.evaluate import get_protocol
    from baselines.watching import film
    from generation.teammates.instances import named_task

    task = named_task(layout, teammate)
    earned = film(out, task, find_agent(ego).make, get_protocol(protocol), seed=seed)
    console.print(f"{ego} with {task.teammate_family}/t{task.teammate['theta_id']}: return {earned:g}; wrote {out}")


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


@cli.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--layout", help="Short or environment name; the first that the model was trained on if not given.")
@click.option("--family", default="H4", show_default=True, help="Of teammates.")
@click.option("--protocol", default="seeded", show_default=True, help=f"One of {', '.join(PROTOCOLS)}.")
@click.option("--episodes", type=click.IntRange(1), help="As many as fill the window three times if not given.")
def drift(run: Path, layout: str | None, family: str, protocol: str, episodes: int | None) -> None:
    """Measure how far cached acting drifts from exact acting once the window is full: a model's RUN folder."""
    import dataclasses

    from baselines.agents import find_agent
    from baselines.drift import measure
    from baselines.evaluate import get_protocol
    from baselines.histories import read_run
    from generation.teammates.instances import INSTANCES, named_task

    trained, played = read_run(run), get_protocol(protocol)
    full = -(-trained.context // played.steps)
    played = dataclasses.replace(played, episodes=episodes or 3 * full)
    name = get_layout(layout or trained.layouts[0]).name
    find_agent(str(run)).make(get_layout(name))  # a model that does not fit fails before any work
    tasks = [named_task(name, f"{family}/t{theta}") for theta in range(INSTANCES)]
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task(f"{trained.label}, {family} on {name}", total=played.episodes)
        found = []
        for episode in measure(trained.method, trained.params, trained.context, tasks, played):
            found.append(episode)
            bars.advance(bar)
    click.echo(f"{trained.label} on {name} beside {len(tasks)} teammates of {family}, K = {trained.context}")
    click.echo("episode  same action  total variation: mean     largest")
    for number, (distance, same) in enumerate(found):
        click.echo(f"{number:>7}  {same.mean():>11.1%}  {distance.mean():>21.6f}  {distance.max():>10.6f}")


@cli.command()
@click.argument("method")
@click.option(
    "--layout", "layouts", multiple=True, required=True, help="To train on; several of one observation shape."
)
@click.option("--root", help="A release, its folder or address; the bundled mini release if not given.")
@click.option("--out", type=click.Path(path_type=Path), help="The run folder; runs/METHOD by default.")
@click.option("--size", default="small", show_default=True, help="small, medium or large: layers, width, steps.")
@click.option("--steps", type=int, help="Training steps, instead of the size's.")
@click.option("--context", type=int, default=500, show_default=True, help="K: steps of a window, or transitions.")
@click.option("--batch-size", type=int, help="1024 as in the paper, or 8 where there is only a CPU.")
@click.option("--accumulate", type=int, default=1, show_default=True, help="Compute a batch in so many parts.")
@click.option("--learning-rate", type=float, default=1e-3, show_default=True)
@click.option("--positions", default="none", show_default=True, help="none, as published, or rope.")
@click.option("--order", default="contiguous", show_default=True, help="Of DPT's contexts: contiguous or random.")
@click.option("--teammate-actions", "--ta", is_flag=True, help="+TA: the teammate's previous action as input.")
@click.option("--next-obs", is_flag=True, help="+next_obs: an auxiliary loss.")
@click.option("--bfloat16", is_flag=True, help="Compute in bfloat16.")
@click.option("--remat", is_flag=True, help="Less memory, more computing.")
@click.option("--obs", help="state, uint8 or float32: what batches hold; state records where there are any.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--save-every", type=int, default=1000, show_default=True, help="Steps between checkpoints.")
@click.option("--tensorboard", is_flag=True, help="Also log for TensorBoard, into OUT/tensorboard.")
@click.option("--coordinator", help="HOST:PORT of process 0, to train on several machines.")
@click.option("--processes", type=int, default=1, show_default=True)
@click.option("--process", type=int, default=0, show_default=True, help="Which one this is.")
def train(method: str, layouts: tuple[str, ...], root: str | None, out: Path | None, **options: Any) -> None:
    """Train METHOD (ad, dpt, hybrid_ad, amago_offline) on learning histories, or go on with a stopped run."""
    import jax

    if not options["coordinator"] and (options["processes"], options["process"]) != (1, 0):
        raise OptionError("--processes and --process: expected a --coordinator HOST:PORT as well, the same for all")
    if options["coordinator"]:
        jax.distributed.initialize(options["coordinator"], options["processes"], options["process"])
    from baselines.histories import HistoryOptions, prepare
    from baselines.method import SIZES, ModelOptions
    from baselines.trainer import TrainOptions
    from baselines.trainer import train as run_training
    from icrl4aht_data.benchmark import unknown

    if options["size"] not in SIZES:
        raise unknown("size", options["size"], SIZES)
    layers, width, steps = SIZES[options["size"]]
    names = ("positions", "teammate_actions", "next_obs", "bfloat16", "remat")
    model = ModelOptions(layers, width, **{name: options[name] for name in names})
    names = ("context", "accumulate", "learning_rate", "seed", "save_every")
    training = TrainOptions(
        steps=steps if options["steps"] is None else options["steps"],
        batch_size=options["batch_size"] or _default_batch_size(),
        **{name: options[name] for name in names},
    )
    histories = HistoryOptions(layouts, root, order=options["order"], obs=options["obs"])
    job = prepare(method, model, training, histories)
    folder = out or Path("runs") / method
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task(method, total=training.steps)

        def done(step: int, loss: float) -> None:
            bars.update(bar, completed=step, description=f"{method}, loss {loss:.3f}")

        log = options["tensorboard"]
        run_training(job.method, job.data, job.options, folder, job.about, tensorboard=log, done=done)
    console.print(
        f"{training.steps} steps in {folder}; `python -m baselines evaluate --agent {folder} --out ...` plays it"
    )


def _default_batch_size() -> int:
    """The paper's, or what a step in seconds allows."""
    import jax

    return 8 if jax.default_backend() == "cpu" else 1024


def _experiment_options(command: Any) -> Any:
    """What all experiments take."""
    options = [
        click.option("--method", "methods", multiple=True, default=("ad", "dpt"), show_default=True),
        click.option("--layout", "layouts", multiple=True, help="To train on; the paper's that the release has."),
        click.option("--root", help="A release, its folder or address; the bundled mini release if not given."),
        click.option("--only", "values", multiple=True, help="Only these settings, such as K250, medium or ta."),
        click.option("--steps", type=int, help="Training steps, instead of the paper's."),
        click.option("--context", type=int, help="K, instead of 500; not in `sweep context`."),
        click.option("--batch-size", type=int, help="1024 as in the paper, or 8 where there is only a CPU."),
        click.option("--family", "families", multiple=True, help="Only these teammate families, such as H4."),
        click.option("--tasks", type=int, help="At most so many teammates of each family and layout."),
        click.option("--episodes", type=click.IntRange(1), help="Of a task, instead of 100."),
        click.option("--seeds", default=1, show_default=True, type=click.IntRange(1), help="Play every task so often."),
        click.option("--protocol", default="seeded", show_default=True, help=f"One of {', '.join(PROTOCOLS)}."),
        click.option("--acting", default="cached", show_default=True, help="cached, or exact and slower."),
        click.option("--films/--no-films", default=True, show_default=True, help="A GIF per family on the page."),
        click.option("--tensorboard", is_flag=True, help="Also log training for TensorBoard, in every run's folder."),
        click.option("--out", type=click.Path(path_type=Path), help="runs/EXPERIMENT by default."),
    ]
    for option in reversed(options):
        command = option(command)
    return command


@cli.command()
@click.argument("what")
@_experiment_options
def sweep(what: str, **options: Any) -> None:
    """Train, evaluate and report over WHAT: context (K of 250 to 10,000) or size (small, medium, large)."""
    _experiment(f"sweep {what}", **options)


@cli.command()
@click.argument("what")
@_experiment_options
def ablate(what: str, **options: Any) -> None:
    """Train, evaluate and report WHAT: ta (none, +TA, +next_obs, both)."""
    _experiment(f"ablate {what}", **options)


@cli.command()
@_experiment_options
def tracks(**options: Any) -> None:
    """Train, evaluate and report on both tracks (the paper's Tables 1 and 2; with other methods 4 and 5)."""
    _experiment("tracks", **options)


@cli.command("heldout-rl")
@click.option("--suite", type=click.Path(path_type=Path), default=Path("build/suite"), show_default=True)
@_experiment_options
def heldout_rl(suite: Path, **options: Any) -> None:
    """Train, evaluate beside a suite's learned teammates that are not in training, and report."""
    _experiment("heldout-rl", suite=suite, **options)


def _experiment(name: str, out: Path | None, root: str | None, suite: Path | None = None, **options: Any) -> None:
    from baselines.experiments import EXPERIMENTS, Plan, run_experiment
    from icrl4aht_data.benchmark import unknown

    if name not in EXPERIMENTS:
        raise unknown("experiment", name, EXPERIMENTS)
    given = {key: options.pop(key) for key in ("steps", "context", "batch_size")}
    training = {key: value for key, value in given.items() if value is not None}
    training.setdefault("batch_size", _default_batch_size())
    if name == "sweep context" and "context" in training:
        raise OptionError(f"--context {training['context']}: `sweep context` varies it; choose by --only, such as K250")
    plan = Plan(root=root, suite=suite, train=training, **options)
    with Progress(console=console, disable=not console.is_terminal) as bars:
        running: dict[str, Any] = {}

        def progress(task: str, done: int, of: int) -> None:
            if task not in running:
                running[task] = bars.add_task(task, total=of)
            bars.update(running[task], completed=done)

        found = run_experiment(name, plan, out or Path("runs") / name.replace(" ", "-"), progress)
    for note in found.notes:
        click.echo(note)
    for path in found.report:
        click.echo(f"wrote {path}")


@cli.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs/control"), show_default=True)
def control(out: Path) -> None:
    """Show that the models adapt where adaptation is possible, and not with their context cut off; about 10 minutes."""
    from baselines.control import run_control, table

    with Progress(console=console, disable=not console.is_terminal) as bars:
        running: dict[str, Any] = {}

        def done(name: str, of: int, step: int, loss: float) -> None:
            if name not in running:
                running[name] = bars.add_task(name, total=of)
            bars.update(running[name], completed=step, description=f"{name}, loss {loss:.3f}")

        checks = run_control(out, done=done)
    click.echo(table(checks))
    if not all(check.passed for check in checks):
        sys.exit(1)


@cli.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("build/demo"), show_default=True)
def demo(out: Path) -> None:
    """The whole way on the bundled release: load, sample, verify, train a small AD, evaluate it, report."""
    from baselines.demo import run_demo

    run_demo(out, console)


def main() -> None:
    """Entry point."""
    run(cli)
