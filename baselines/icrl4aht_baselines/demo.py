"""`make demo`: from the bundled release's histories to a model that learns within its context, and a report of it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console

from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.protocols import Protocol, get_protocol
from icrl4aht_baselines.methods.options import SIZES, ModelOptions
from icrl4aht_baselines.report.page import write_page_with_episodes
from icrl4aht_baselines.report.results import EvaluationRun, ResultCell, bundled_by_id, evaluate_agent
from icrl4aht_baselines.report.statistics import MeanInterval, mean_interval
from icrl4aht_baselines.training.histories import prepare
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import RUN_CURVES
from icrl4aht_baselines.training.seen import overlap_legend
from icrl4aht_baselines.training.trainer import show_steps
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.reference_returns import REFERENCES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.plotting import check_can_draw, plot_learning_curves
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.progress import progress_bars

FLOOR = ("stay", "random")
"""Reference egos that an agent has to exceed before its return says anything."""

DEMO_LAYOUT = "demo_wide"
_MODEL = ModelOptions(**SIZES["tiny"].model)
# 4,000 steps at a rate of 3e-3 without dropout fit as many histories better, and held-out ones much worse.
_TRAINING = TrainOptions(3000, batch_size=16, context=SIZES["tiny"].context, validate_every=500, validation_batches=4)
_PROTOCOL = get_protocol("seeded", 20)


@dataclass(frozen=True)
class DemoSettings:
    """What the demo trains and measures; the defaults take at most 10 minutes on two cores.

    Attributes:
        root: folder of the release.
        model, training: AD's; by default of size tiny, with fewer steps than its own, chosen on validation tasks.
        tasks: tasks to evaluate on; None for the validation tasks of `DEMO_LAYOUT`.
        reference: bundled model to compare with; None for none.
        protocol, seeds: of the evaluation.
    """

    root: Path = MINI
    model: ModelOptions = _MODEL
    training: TrainOptions = _TRAINING
    tasks: tuple[Task, ...] | None = None
    reference: str | None = "ad-reference"
    protocol: Protocol = _PROTOCOL
    seeds: Sequence[int] = range(10)


def find_lead(returns: Mapping[str, np.ndarray], agent: str) -> MeanInterval:
    """Return the difference of an agent's mean return to that of a reference ego, the one with the lower interval.

    Differences are paired, since episodes of a task and a seed start alike for all agents. The interval is over pairs
    of a task and a seed; the agent earns more than both egos if it is above 0.

    Args:
        returns: agent -> mean returns (U, S) of U tasks and S seeds.
        agent: the agent.
    """
    differences = (mean_interval((returns[agent] - returns[name]).ravel()) for name in FLOOR)
    return min(differences, key=lambda found: found.low)


def run_demo(out: Path, console: Console, settings: DemoSettings | None = None) -> Path:
    """Load, sample, verify, train, evaluate, report, and print what is done.

    Args:
        out: folder; the same call resumes a stopped one.
        console: receives text and progress.
        settings: of training and evaluation.

    Returns:
        Path of the report, an HTML page.

    Raises:
        ReleaseError: if the release is damaged.
        OptionError: if matplotlib is not installed.
    """
    check_can_draw()
    started = time.perf_counter()
    settings = settings or DemoSettings()
    paths = [out / name for name in ("learning_curves.png", "episode.gif", "report.html")]
    for path in paths:
        check_output(path, overwrite=(out / "ad").is_dir())  # of a stopped run
    out.mkdir(parents=True, exist_ok=True)
    curves, episode, page = paths

    def say(number: int, text: str) -> None:
        console.print(f"[bold]{number}/6[/bold] ({time.perf_counter() - started:.0f} s) {text}")

    def write(text: str) -> None:
        console.print(text, highlight=False, markup=False)

    say(1, f'ds = load_icrl4aht(split="train", layout="{DEMO_LAYOUT}")')
    dataset = load_icrl4aht(settings.root, split="train", layout=DEMO_LAYOUT)
    plot_learning_curves(load_icrl4aht(settings.root), curves)
    _draw_best_episode(dataset, episode)
    write(f"{dataset!r}\nlearning curves: {curves}\nbest episode: {episode}")

    say(2, "ds.ad(batch_size=8, length=500)[0], then ds.dpt(batch_size=8, context=500)[0]")
    write(f"{dataset.ad(batch_size=8, length=500)[0].describe()}\n")
    write(dataset.dpt(batch_size=8, context=500)[0].describe())

    say(3, "verifying every byte and every step")
    verified = verify_release(settings.root, level="deep")
    if not verified.ok:
        raise ReleaseError(f"{settings.root}: {verified.findings[0].file}: {verified.findings[0].problem}")
    write(
        f"no problem in {verified.files} files, {verified.chunks} chunks, {verified.transitions:,} transitions replayed"
    )

    model, training = settings.model, settings.training
    size = f"{model.layers} layers of width {model.width}, K = {training.context}"
    say(4, f"training AD on oracle labels, {size}: {training.steps} steps")
    _train_demo(out / "ad", settings)
    write(f"losses on training and held-out histories: {out / 'ad' / RUN_CURVES}")

    tasks = settings.tasks
    if tasks is None:
        tasks = tuple(task for task in bundled_by_id("validation").values() if task.layout.name == DEMO_LAYOUT)
    others = [*REFERENCES, *([settings.reference] if settings.reference else [])]
    say(5, f"evaluating it and {', '.join(others)} on {len(tasks)} validation tasks of {DEMO_LAYOUT}")
    agents = [find_agent(name) for name in (*others, out / "ad")]
    runs = [
        evaluate_agent(agent, tasks, settings.protocol, out / "results" / agent.name, seeds=settings.seeds)
        for agent in agents
    ]
    own, cells = runs[-1], [*runs[0].cells]
    leads = {cell: find_lead({run.agent: run.returns[cell].mean for run in runs}, own.agent) for cell in cells}
    better = f"{own.agent} - better of {' and '.join(FLOOR)}"
    means = {
        cell.family: {run.agent: f"{run.returns[cell].mean.mean():.1f}" for run in runs} | {better: lead.text(sign="+")}
        for cell, lead in leads.items()
    }
    write(pd.DataFrame(means).T.to_string())

    say(6, "drawing the report")
    write_page_with_episodes(runs, page)
    write(f"report: {page}")
    write(f"done in {time.perf_counter() - started:.0f} s\n")
    write("\n".join([*overlap_legend(own.overlaps(cells)), *_conclusion(own, leads)]))
    return page


def _train_demo(folder: Path, settings: DemoSettings) -> None:
    histories = HistoryOptions((DEMO_LAYOUT,), str(settings.root), source=("noise",), labels="oracle")
    job = prepare("ad", settings.model, settings.training, histories)
    with progress_bars(unit="steps") as show:
        job.train(folder, done=show_steps(show, "AD", job.options.steps))


def _conclusion(own: EvaluationRun, leads: Mapping[ResultCell, MeanInterval]) -> list[str]:
    """Return the limits of what was measured, and the verdict."""
    floor, better = " and ".join(FLOOR), [cell.family for cell, lead in leads.items() if lead.low > 0]
    others = ", ".join(cell.family for cell in leads if cell.family not in better)
    verdict = f"{own.agent} earns more than {floor} with {len(better)} of {len(leads)} families"
    parts = [", ".join(better)] * bool(better) + [f"no more with {others}"] * bool(others)
    return [
        "It is one training run: the intervals leave out how much trainings differ. Validation tasks are for choosing "
        "models, so this is no test result.",
        f"{verdict}: {'; '.join(parts)}.",
    ]


def _draw_best_episode(dataset: Dataset, path: Path) -> None:
    """Draw the episode with the highest return of the history that ends best, the latest of several."""
    history = dataset[int(np.argmax(dataset.column("return_end")))]
    returns = history.returns()
    best = len(returns) - 1 - int(np.argmax(returns[::-1]))
    steps = slice(best * KEPT_STEPS, (best + 1) * KEPT_STEPS)
    save_episode(path, get_layout(history.entry.layout), history.state[steps], history.rewards[steps])
