"""Commands of `icrl4aht-data` that train, evaluate and report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from icrl4aht_generation.teammates.instances import published_task

from icrl4aht_baselines.commands import options as shared
from icrl4aht_baselines.methods.options import SIZES
from icrl4aht_baselines.training.options import HistoryOptions
from icrl4aht_data.commands.dataclass_options import TopicCommand, dataclass_options, topic
from icrl4aht_data.commands.options import COUNT, LAYOUT, SEED, Folder, Names, NewFile, examples, overwrite_option
from icrl4aht_data.plotting import can_draw
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.utils.options import replace_options
from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_data.utils.text import counted_noun


@click.command(
    "evaluate",
    epilog=examples(
        "icrl4aht-data evaluate --agent random --out runs/random",
        "icrl4aht-data evaluate --agent runs/ad --layout demo_wide --out runs/ad-results",
        "icrl4aht-data evaluate --agent ad-reference --layout demo_wide --controls --out runs/ad-controls",
        "icrl4aht-data evaluate --agent runs/ad --split validation --layout demo_wide --out runs/ad-validation",
        "icrl4aht-data evaluate --agent oracle --layout demo_wide --tasks 1 --episodes 5 --out runs/oracle",
    ),
)
@click.option(
    "--agent",
    type=shared.EGO_NAME,
    required=True,
    help="stay, random, oracle, search, a bundled model such as ad-reference, or a folder that `train` made.",
)
@click.option(
    "--acting",
    type=Names("acting", shared.lazy_attribute("icrl4aht_baselines.agents.egos", "ACTING")),
    default="cached",
    help="Memory of a trained model: exact (the last K steps), or cached, which is faster (the last 4/5 K to K steps).",
)
@shared.greedy_option
@click.option("--forget", is_flag=True, help="Clear the agent's memory before each episode.")
@click.option(
    "--controls",
    is_flag=True,
    help="Also play with the memory cleared before each episode, into OUT/cleared, and with another task's teammate in "
    "all but the last 20 episodes, into OUT/swapped. Prints the gain by memory (M) and by knowing the partner (P).",
)
@shared.protocol_option
@topic("Options", *shared.tasks_options)
@click.option("--tasks", type=COUNT, help="At most this many tasks of each combination of layout and teammate family.")
@click.option("--episodes", type=COUNT, help="Episodes of a task.", show_default="100")
@shared.suite_option
@click.option("--seeds", type=COUNT, default=1, help="Play every task with the seeds 0 to N - 1.")
@click.option(
    "--seed", "chosen_seeds", type=SEED, multiple=True, help="Play every task with this seed, not --seeds; repeat."
)
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write the results here.")
def evaluate_command(
    agent: str,
    acting: Any,
    greedy: bool | None,
    forget: bool,
    controls: bool,
    protocol: str,
    tasks: int | None,
    episodes: int | None,
    suite: Path | None,
    seeds: int,
    chosen_seeds: tuple[int, ...],
    out: Path,
    **choice: Any,
) -> None:
    """Evaluate an agent on test tasks, or on validation tasks.

    Plays 100 episodes of each task, writes one JSON file per task into OUT/tasks, and prints a summary of OUT. Results
    of finished tasks are reused. Choose models by the validation tasks: their layouts are training layouts, their
    teammates are in neither training nor test. The split diverse has validation tasks with more diverse teammates than
    the published training ranges.
    """
    from icrl4aht_baselines.agents.egos import find_agent
    from icrl4aht_baselines.evaluate.evaluator import evaluate_controls
    from icrl4aht_baselines.evaluate.protocols import CONTROLS, get_protocol, hidden_recipe_note, limit_tasks
    from icrl4aht_baselines.evaluate.rollout import ProgramCache
    from icrl4aht_baselines.report.page import summary_lines
    from icrl4aht_baselines.report.results import evaluate_agent, write_run_and_tasks
    from icrl4aht_baselines.report.scores import control_lines

    if forget and controls:
        raise click.UsageError("--controls: cannot be used with --forget, which is a control; leave out one of the two")
    ego = find_agent(agent, acting=acting, greedy=greedy)
    chosen = limit_tasks(shared.chosen_tasks(**choice), tasks)
    if chosen_seeds:
        shared.check_conflicts("--seed", "seeds")
    rules, seeds_of_tasks = get_protocol(protocol, episodes), chosen_seeds or range(seeds)
    if note := hidden_recipe_note(chosen):
        click.echo(note, err=True)
    programs = ProgramCache()
    options: Any = {"seeds": seeds_of_tasks, "suite": suite, "out": out, "programs": programs}
    lines = []
    if controls:
        played = evaluate_controls(ego.name, ego.make, chosen, rules, details=ego.details, **options)
        lines = control_lines(played, chosen)
        for control in CONTROLS:
            write_run_and_tasks(out / control, ego.run, chosen)
    # With --controls, the results are in `out` already, so this call only reads them.
    run = evaluate_agent(ego, chosen, rules, control="cleared" if forget else None, **options)
    for line in [*summary_lines([run]), *lines]:
        click.echo(line)
    counted = f"{counted_noun(len(chosen), 'result')} in {out}, {counted_noun(len(programs), 'program')} compiled"
    click.echo(f"{counted}; `icrl4aht-data report {out}` shows them")


@click.command("report")
@click.argument("runs", nargs=-1, required=True, type=Folder(), metavar="RESULTS...")
@click.option(
    "--out", type=Folder(), metavar="FOLDER", help="Write the report here.", show_default="report in the first RESULTS"
)
@click.option(
    "--html",
    type=NewFile(".html", ".htm"),
    metavar="FILE",
    help="Also write one HTML page: the summary, curves, episodes, tables.",
)
@overwrite_option
@click.option("--gifs/--no-gifs", default=True, help="Show the first and last episode with each family on the page.")
@shared.suite_option
def report_command(
    runs: tuple[Path, ...], out: Path | None, html: Path | None, overwrite: bool, gifs: bool, suite: Path | None
) -> None:
    """Compare results with the paper's.

    RESULTS are folders that `evaluate` made. Prints a summary of each agent, and tables of returns. Results under the
    protocol `published` are shown next to the paper's numbers. Scores are marked if the teammates or layouts were used
    in training. Writes the tables as report.md, and all numbers as report.csv. Results of one agent on different
    layouts are merged.
    """
    from icrl4aht_baselines.report import page
    from icrl4aht_baselines.report.results import merge, read_run

    loaded, folder = merge([read_run(run) for run in runs]), out or runs[0] / "report"
    check_output(folder, overwrite, page.REPORT_FILES)
    if html:
        check_output(html, overwrite)
    pages = []
    if html:  # written first, since drawing takes minutes: a stopped command leaves no report that blocks the next one
        with progress_bars() as show:
            pages = [page.write_page(loaded, html, gifs=gifs, suite=suite, progress=show)]
    paths = [*page.write_report(loaded, folder), *pages]
    click.echo(paths[0].read_text(encoding="utf-8"))
    for path in paths:
        click.echo(f"wrote {path}")


@click.command(
    "watch",
    epilog=examples("icrl4aht-data watch --layout demo_wide --teammate H3/t1 --ego oracle --out episode.gif"),
)
@click.option("--layout", type=LAYOUT, required=True, help="Layout of the episode.")
@click.option(
    "--teammate", metavar="FAMILY/tN", default="H4/t0", help="A published teammate by family, H1 to H4, and number."
)
@click.option(
    "--ego",
    type=shared.EGO_NAME,
    default="random",
    help="stay, random, oracle, search, a model such as ad-reference, or a run.",
)
@shared.protocol_option
@click.option("--seed", type=SEED, default=0, help="Seed of the episode.")
@click.option("--out", type=NewFile(".gif"), metavar="FILE", required=True, help="The GIF to write.")
@overwrite_option
def watch_command(layout: str, teammate: str, ego: str, protocol: str, seed: int, out: Path, overwrite: bool) -> None:
    """Play an episode and draw it as a GIF."""
    from icrl4aht_baselines.agents.egos import find_agent
    from icrl4aht_baselines.evaluate.protocols import get_protocol
    from icrl4aht_baselines.report.gifs import save_episode_gifs

    check_output(out, overwrite)
    task = published_task(layout, teammate)
    (shown,) = save_episode_gifs({1: out}, task, find_agent(ego).make, get_protocol(protocol), seed=seed)
    mate = f"{task.teammate_family}/t{task.teammate['theta_id']}"
    click.echo(f"{ego} with {mate}: return {shown.earned:g}; wrote {out}")


@click.command(
    "train",
    cls=TopicCommand,
    epilog=examples(
        "icrl4aht-data train ad --layout demo_wide --out runs/ad",
        "icrl4aht-data train dpt --layout demo_wide --ta --out runs/dpt-ta",
        "icrl4aht-data train ad --layout demo_wide --steps 20 --context 50 --out runs/small",
        "icrl4aht-data train ad --layout all --out runs/ad-all",
    ),
)
@click.argument("method", type=shared.METHOD_NAME)
@topic(
    "Data",
    click.option(
        "--layout",
        "layouts",
        type=shared.TRAINING_LAYOUT,
        multiple=True,
        required=True,
        help="Training layout, such as demo_wide; repeat for several; all: every layout with histories in the release.",
    ),
    shared.root_option,
    dataclass_options(HistoryOptions, "histories"),
)
@topic(
    "Model",
    click.option(
        "--size",
        type=Names("size", lambda: SIZES),
        help="tiny, for a CPU, or the paper's small, medium or large: sets the options with the default `the size's`.",
        show_default="tiny on a CPU, small elsewhere",
    ),
    shared.model_options,
)
@topic(
    "Training",
    click.option("--init", type=Folder(), metavar="RUN", help="Start from the parameters of this run."),
    shared.training_options,
)
@topic("Playing (rl2 only)", shared.play_options, shared.manifests_option)
@topic(
    "Run",
    click.option("--out", type=Folder(), metavar="FOLDER", help="Write the run here.", show_default="runs/METHOD"),
    click.option(
        "--log",
        "log_to",
        type=Names("logger", shared.lazy_attribute("icrl4aht_baselines.training.loggers", "LOGGER_NAMES")),
        multiple=True,
        default=("json",),
        help="Also log for tensorboard, wandb or trackio, into OUT; repeat. json is metrics.jsonl, always written.",
    ),
)
@shared.process_options
def train_command(
    method: str,
    layouts: tuple[str, ...],
    root: Any,
    out: Path | None,
    init: Path | None,
    size: str | None,
    train: dict[str, Any],
    model: dict[str, Any],
    histories: dict[str, Any],
    play: dict[str, Any],
    manifests: tuple[Path, ...],
    log_to: tuple[str, ...],
    **machines: Any,
) -> None:
    """Train a model on learning histories.

    METHOD is ad, dpt, hybrid_ad, amago_offline or bc (cloning without memory), or rl2, which learns by playing with the
    teammates of the histories. Writes settings, checkpoints, metrics.jsonl and, if matplotlib is installed, curves.png
    into OUT. The same command resumes from the last checkpoint. SIGTERM and Ctrl-C save a checkpoint after the running
    step; a second Ctrl-C stops at once.
    """
    shared.join_processes(**machines)
    from icrl4aht_baselines.methods.registry import PLAYING
    from icrl4aht_baselines.training.histories import load_initial_params
    from icrl4aht_baselines.training.run_folder import RUN_CURVES
    from icrl4aht_baselines.training.trainer import show_steps

    choice = replace_options(HistoryOptions(layouts, root and str(root)), histories)
    folder = out or Path("runs") / method
    if method in PLAYING and machines["processes"] > 1:
        raise click.UsageError(f"--processes: {method} is trained by one process on one device; leave out --processes")
    job, description = shared.prepare_training(method, size, model, train, play, choice, manifests)
    click.echo(description)
    params, steps = None if init is None else load_initial_params(init, job.method, job.about), job.options.steps
    if init is not None:
        click.echo(f"starting from {init}, which was trained on data version {job.about['init']['data_version']}")
    with progress_bars(unit="steps") as show:
        job.train(folder, params=params, log_to=log_to, done=show_steps(show, method, steps))
    trained = counted_noun(steps, "step")
    click.echo(f"{trained} in {folder}; `icrl4aht-data evaluate --agent {folder} --out ...` plays it")
    if not can_draw():
        click.echo(f"{RUN_CURVES} was not drawn, matplotlib is not installed: {install_command('plot')}")


@click.command("demo")
@click.option("--out", type=Folder(), metavar="FOLDER", default="build/demo", help="Write everything here.")
def demo_command(out: Path) -> None:
    """Load data, train, evaluate and report on the bundled release.

    Loads, samples and verifies the release. Trains Hybrid-AD on histories of a script that finds out which dish its
    teammate wants. Evaluates the model on validation tasks, also with its memory cleared before each episode. Draws the
    return in each episode, writes a report of one page, and says whether the model's memory raises the return.
    """
    from icrl4aht_baselines.demo import run_demo

    run_demo(out)
