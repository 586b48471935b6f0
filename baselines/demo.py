"""`make demo`: from the bundled release's histories to a report of a model trained on them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from baselines.agents.egos import AGENTS, find_agent
from baselines.evaluate.evaluator import evaluate
from baselines.evaluate.protocols import PROTOCOLS, Protocol
from baselines.methods.options import SIZES, ModelOptions
from baselines.report.overlap import overlap_legend, overlap_marks
from baselines.report.page import write_page_with_episodes
from baselines.report.results import EvaluationRun, note_results, read_run
from baselines.training.histories import prepare
from baselines.training.options import HistoryOptions, TrainOptions
from baselines.training.trainer import format_loss, train
from generation.teammates.instances import published_task
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.commands.options import bars, counted
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.plotting import plot_learning_curves
from icrl4aht_data.utils.new_file import check_new_file

DEMO_LAYOUT = "demo_wide"
DEMO_MODEL = ModelOptions(**SIZES["tiny"].model)
DEMO_TRAINING = TrainOptions(steps=1000, batch_size=16, context=SIZES["tiny"].context, validate_every=250)
"""Size tiny, and fewer steps than its own."""

_STEPS = 6


def run_demo(
    out: Path,
    console: Console,
    *,
    model: ModelOptions = DEMO_MODEL,
    options: TrainOptions = DEMO_TRAINING,
    families: Sequence[str] = HEURISTICS,
    protocol: Protocol = PROTOCOLS["seeded"],
) -> Path:
    """Load, sample, verify, train, evaluate, report, and print what is done.

    Args:
        out: folder; the same call resumes a stopped one.
        console: receives text and progress.
        model, options: of the trained model.
        families: teammate families; one task of each is played.
        protocol: of the evaluation.

    Returns:
        Path of the report, an HTML page.

    Raises:
        ReleaseError: if the bundled release is damaged.
    """
    started = time.perf_counter()
    curves, episode, page = (out / name for name in ("learning_curves.png", "episode.gif", "report.html"))
    for path in (curves, episode, page):
        check_new_file(path, overwrite=(out / "ad").is_dir())  # of a stopped run
    out.mkdir(parents=True, exist_ok=True)

    def say(number: int, text: str) -> None:
        console.print(f"[bold]{number}/{_STEPS}[/bold] ({time.perf_counter() - started:.0f} s) {text}")

    say(1, f'ds = load_icrl4aht(split="train", layout="{DEMO_LAYOUT}")')
    dataset = load_icrl4aht(split="train", layout=DEMO_LAYOUT)
    console.print(repr(dataset), highlight=False)
    plot_learning_curves(load_icrl4aht(), curves)
    _draw_best_episode(dataset, episode)
    console.print(f"learning curves: {curves}\nbest episode: {episode}", highlight=False)

    say(2, "ds.ad(batch_size=8, length=500)[0], then ds.dpt(batch_size=8, context=500)[0]")
    console.print(dataset.ad(batch_size=8, length=500)[0].describe(), highlight=False)
    console.print()
    console.print(dataset.dpt(batch_size=8, context=500)[0].describe(), highlight=False)

    say(3, "verifying every byte and every step")
    report = verify_release(MINI, level="deep")
    if not report.ok:
        raise ReleaseError(f"{MINI}: {report.findings[0].file}: {report.findings[0].problem}")
    counts = f"{report.files} files, {report.chunks} chunks, {report.transitions:,} transitions replayed"
    console.print(f"no problem in {counts}")

    say(4, f"training AD, {model.layers} layers of width {model.width}, K = {options.context}: {options.steps} steps")
    _train_demo(out / "ad", model, options, console)

    say(5, f"evaluating it and {', '.join(AGENTS)} on {len(families)} tasks of {DEMO_LAYOUT}")
    tasks = [published_task(DEMO_LAYOUT, f"{family}/t0") for family in families]
    runs = [_evaluate_demo(agent, tasks, protocol, out / "results") for agent in (*AGENTS, str(out / "ad"))]
    console.print(_format_returns(runs), highlight=False)
    console.print("(a model this small, trained this briefly, shows the workflow, not the method's ability)")

    say(6, "drawing the report")
    write_page_with_episodes(runs, page)
    console.print(f"[bold]done[/bold] in {time.perf_counter() - started:.0f} s; the report is {page}", highlight=False)
    return page


def _train_demo(folder: Path, model: ModelOptions, options: TrainOptions, console: Console) -> None:
    job = prepare("ad", model, options, HistoryOptions((DEMO_LAYOUT,)))
    with bars(edges=True, unit="steps") as show:

        def done(step: int, loss: float | None) -> None:
            show("AD", step, options.steps, format_loss(loss))

        train(job.method, job.data, job.options, folder, job.about, done=done)
    console.print(f"losses on training and held-out histories: {folder / 'curves.png'}", highlight=False)


def _evaluate_demo(name: str, tasks: Sequence[Task], protocol: Protocol, results: Path) -> EvaluationRun:
    agent = find_agent(name)
    folder = results / agent.name
    with bars(edges=True, unit="episodes") as show:
        played = counted(show, agent.name, len(tasks) * protocol.episodes)
        evaluate(agent.name, agent.make, tasks, protocol, out=folder, details=agent.details, played=played)
    note_results(folder, Path(name) if agent.details else None)
    return read_run(folder)


def _format_returns(runs: list[EvaluationRun]) -> str:
    """Returns text with mean returns, one line per agent, and the meaning of marks behind them."""
    cells = list(runs[0].cells)
    lines = [f"{'return with':14}" + "".join(f"{family:>8}  " for _, family in cells)]
    for run in runs:
        scores = [f"{run.cells[cell].mean():8.1f}{overlap_marks(run.overlaps([cell])):2}" for cell in cells]
        lines.append(f"{run.agent:14}" + "".join(scores))
    return "\n".join([*lines, *overlap_legend(name for run in runs for name in run.overlaps(cells))])


def _draw_best_episode(dataset: Dataset, path: Path) -> None:
    """Draw the episode with the highest return of the first (best) history, the latest of several."""
    history = dataset[0]
    returns = history.returns()
    best = len(returns) - 1 - int(np.argmax(returns[::-1]))
    steps = slice(best * KEPT_STEPS, (best + 1) * KEPT_STEPS)
    save_episode(path, get_layout(history.entry.layout), history.state[steps], history.rewards[steps])
