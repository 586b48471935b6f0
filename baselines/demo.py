"""`make demo`: the whole way on the bundled release, from its histories to a report of a model trained on them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from baselines.agents.egos import AGENTS, find_agent
from baselines.evaluate.evaluator import evaluate
from baselines.evaluate.protocols import PROTOCOLS, Protocol
from baselines.methods.method import ModelOptions
from baselines.report.page import write_page_with_films
from baselines.report.provenance import note_results
from baselines.report.results import Run, read_run
from baselines.training.histories import HistoryOptions, prepare
from baselines.training.trainer import TrainOptions, train
from generation.teammates.instances import named_task
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

LAYOUT = "demo_wide"
MODEL = ModelOptions(layers=2, width=64)
OPTIONS = TrainOptions(steps=300, batch_size=16, context=100, validate_every=100)
"""Small enough for two cores; the paper's are the defaults of both."""

_STEPS = 6


def run_demo(
    out: Path,
    console: Console,
    *,
    model: ModelOptions = MODEL,
    options: TrainOptions = OPTIONS,
    families: Sequence[str] = HEURISTICS,
    protocol: Protocol = PROTOCOLS["seeded"],
) -> Path:
    """Load, sample, verify, train, evaluate, report; says what it does and where things are.

    Args:
        out: a folder; the same call goes on where a stopped one ended.
        console: what is said, and progress.
        model, options: of the model.
        families: of teammates; a task of each is played.
        protocol: how.

    Returns:
        The report, an HTML page.
    """
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)

    def say(number: int, text: str) -> None:
        console.print(f"[bold]{number}/{_STEPS}[/bold] ({time.perf_counter() - started:.0f} s) {text}")

    say(1, f'ds = load_icrl4aht(split="train", layout="{LAYOUT}")')
    dataset = load_icrl4aht(split="train", layout=LAYOUT)
    console.print(repr(dataset), highlight=False)
    curves, episode = out / "learning_curves.png", out / "episode.gif"
    plot_learning_curves(load_icrl4aht(), curves)
    _draw_best_episode(dataset, episode)
    console.print(f"learning curves: {curves}\nits best episode: {episode}", highlight=False)

    say(2, "ds.ad(batch_size=8, length=500)[0], then ds.dpt(batch_size=8, context=500)[0]")
    console.print(dataset.ad(batch_size=8, length=500)[0].describe(), highlight=False)
    console.print()
    console.print(dataset.dpt(batch_size=8, context=500)[0].describe(), highlight=False)

    say(3, "verifying every byte and every step")
    report = verify_release(MINI, level="deep")
    if not report.ok:
        raise ReleaseError(f"{MINI}: {report.findings[0].file}: {report.findings[0].problem}")
    console.print(f"whole: {report.files} files, {report.chunks} chunks, {report.transitions:,} transitions replayed")

    say(4, f"training AD, {model.layers} layers of width {model.width}, K = {options.context}: {options.steps} steps")
    _train(out / "ad", model, options, console)

    say(5, f"evaluating it beside {', '.join(AGENTS)} on {len(families)} tasks of {LAYOUT}")
    tasks = [named_task(LAYOUT, f"{family}/t0") for family in families]
    runs = [_evaluate(agent, tasks, protocol, out / "results", console) for agent in (*AGENTS, str(out / "ad"))]
    console.print(_table(runs), highlight=False)
    console.print("(so small a model, trained for so short, shows the way, not what the method can do)")

    say(6, "drawing the report")
    page = write_page_with_films(runs, out / "report.html")
    console.print(f"[bold]done[/bold] in {time.perf_counter() - started:.0f} s; the report is {page}", highlight=False)
    return page


def _train(folder: Path, model: ModelOptions, options: TrainOptions, console: Console) -> None:
    job = prepare("ad", model, options, HistoryOptions((LAYOUT,)))
    with bars() as show:

        def done(step: int, loss: float) -> None:
            show("AD", step, options.steps, f", loss {loss:.3f}")

        train(job.method, job.data, job.options, folder, job.about, done=done)
    console.print(f"losses on what it trains on and on held-out histories: {folder / 'curves.png'}", highlight=False)


def _evaluate(name: str, tasks: Sequence[Task], protocol: Protocol, results: Path, console: Console) -> Run:
    agent = find_agent(name)
    folder = results / agent.name
    with bars() as show:
        done = counted(show, agent.name, len(tasks))
        evaluate(agent.name, agent.make, tasks, protocol, out=folder, details=agent.details, done=done)
    note_results(folder, name if agent.details else None)
    return read_run(folder)


def _table(runs: list[Run]) -> str:
    """Mean returns, one line an agent."""
    cells = list(runs[0].cells)
    lines = [f"{'return beside':14}" + "".join(f"{family:>8}" for _, family in cells)]
    lines += [f"{run.agent:14}" + "".join(f"{run.cells[cell].mean():8.1f}" for cell in cells) for run in runs]
    return "\n".join(lines)


def _draw_best_episode(dataset: Dataset, path: Path) -> None:
    """The episode with the highest return of the first (best) history, latest among equals."""
    history = dataset[0]
    returns = history.returns()
    best = len(returns) - 1 - int(np.argmax(returns[::-1]))
    steps = slice(best * KEPT_STEPS, (best + 1) * KEPT_STEPS)
    save_episode(path, get_layout(history.entry.layout), history.state[steps], history.rewards[steps])
