"""`make demo`: from the bundled release's histories to a model that learns within its context, and a report of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from icrl4aht_baselines.agents.egos import AGENTS, find_agent
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import Protocol, get_protocol
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.methods.options import SIZES, ModelOptions
from icrl4aht_baselines.plotting import plot_family_curves
from icrl4aht_baselines.report.lead import (
    FLOOR,
    FamilyReturns,
    describe_rise,
    family_returns,
    find_lead,
    lead_table,
    lead_verdict,
)
from icrl4aht_baselines.report.overlap import overlap_legend
from icrl4aht_baselines.report.page import write_page_with_episodes
from icrl4aht_baselines.report.rendering import check_can_render
from icrl4aht_baselines.report.results import EvaluationRun, note_results, read_run, shipped_validation_tasks
from icrl4aht_baselines.training.histories import prepare
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import RUN_CURVES
from icrl4aht_baselines.training.trainer import format_loss, train
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.plotting import check_can_draw, plot_layout_curves
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.utils.new_file import check_new_file
from icrl4aht_data.utils.progress import counted, progress_bars

DEMO_LAYOUT = "demo_wide"
_MODEL = ModelOptions(**SIZES["tiny"].model)
# 4,000 steps at a rate of 3e-3 without dropout fit as many histories better, and held-out ones much worse.
_TRAINING = TrainOptions(3000, batch_size=16, context=SIZES["tiny"].context, validate_every=500, validation_batches=4)
_PROTOCOL = get_protocol("seeded", 20)
_STEPS = 6


@dataclass(frozen=True)
class DemoSettings:
    """What the demo trains and measures; the defaults take at most 10 minutes on two cores.

    Attributes:
        root: folder of the release.
        model, training: AD's; by default of size tiny, with fewer steps than its own, chosen on validation tasks.
        sources: sources of the histories to train on; all if empty.
        labels: actions to learn: the labels of this kind, or None for those that were taken.
        tasks: tasks to evaluate on; None for the validation tasks of `DEMO_LAYOUT`.
        reference: bundled model to compare with; None for none.
        protocol, seeds: of the evaluation.
    """

    root: Path = MINI
    model: ModelOptions = _MODEL
    training: TrainOptions = _TRAINING
    sources: tuple[str, ...] = ("noise",)
    labels: Labels | None = "oracle"
    tasks: tuple[Task, ...] | None = None
    reference: str | None = "ad-reference"
    protocol: Protocol = _PROTOCOL
    seeds: Sequence[int] = range(10)


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
        OptionError: if matplotlib or Jinja2 is not installed.
    """
    check_can_draw()
    check_can_render()
    started = time.perf_counter()
    settings = settings or DemoSettings()
    model, training = settings.model, settings.training
    curves, episode, picture, page = _output_files(out)

    def say(number: int, text: str) -> None:
        console.print(f"[bold]{number}/{_STEPS}[/bold] ({time.perf_counter() - started:.0f} s) {text}")

    def write(text: str) -> None:
        console.print(text, highlight=False, markup=False)

    say(1, f'ds = load_icrl4aht(split="train", layout="{DEMO_LAYOUT}")')
    dataset = load_icrl4aht(settings.root, split="train", layout=DEMO_LAYOUT)
    plot_layout_curves(load_icrl4aht(settings.root), curves)
    _draw_best_episode(dataset, episode)
    write(f"{dataset!r}\nlearning curves: {curves}\nbest episode: {episode}")

    say(2, "ds.ad(batch_size=8, length=500)[0], then ds.dpt(batch_size=8, context=500)[0]")
    write(f"{dataset.ad(batch_size=8, length=500)[0].describe()}\n")
    write(dataset.dpt(batch_size=8, context=500)[0].describe())

    say(3, "verifying every byte and every step")
    write(_verify(settings.root))

    targets = f"{settings.labels} labels" if settings.labels else "the actions taken"
    size = f"{model.layers} layers of width {model.width}, K = {training.context}"
    say(4, f"training AD on {targets}, {size}: {training.steps} steps")
    _train_demo(out / "ad", settings)
    write(f"losses on training and held-out histories: {out / 'ad' / RUN_CURVES}")

    tasks = _demo_tasks() if settings.tasks is None else settings.tasks
    others = [*AGENTS, *([settings.reference] if settings.reference else [])]
    say(5, f"evaluating it and {', '.join(others)} on {len(tasks)} validation tasks of {DEMO_LAYOUT}")
    compared = _evaluate_all(out, tasks, settings)
    write(lead_table(compared.families, compared.agent))

    say(6, "drawing the curves and the report")
    _draw_families(compared, picture)
    write_page_with_episodes(compared.runs, page)
    write(f"return in each episode: {picture}\nreport: {page}")
    write(f"done in {time.perf_counter() - started:.0f} s\n\n{_conclusion(compared)}")
    return page


def _output_files(out: Path) -> list[Path]:
    """Returns the paths of the files to write into a folder, which is made."""
    paths = [out / name for name in ("learning_curves.png", "episode.gif", "adaptation.png", "report.html")]
    for path in paths:
        check_new_file(path, overwrite=(out / "ad").is_dir())  # of a stopped run
    out.mkdir(parents=True, exist_ok=True)
    return paths


class _Compared(NamedTuple):
    """Evaluated agents, the trained one last."""

    agent: str
    runs: list[EvaluationRun]
    families: list[FamilyReturns]


def _verify(root: Path) -> str:
    """Returns text on what was verified."""
    report = verify_release(root, level="deep")
    if not report.ok:
        raise ReleaseError(f"{root}: {report.findings[0].file}: {report.findings[0].problem}")
    return f"no problem in {report.files} files, {report.chunks} chunks, {report.transitions:,} transitions replayed"


def _train_demo(folder: Path, settings: DemoSettings) -> None:
    histories = HistoryOptions((DEMO_LAYOUT,), str(settings.root), source=settings.sources, labels=settings.labels)
    job = prepare("ad", settings.model, settings.training, histories)
    with progress_bars(unit="steps") as show:

        def done(step: int, loss: float | None) -> None:
            show("AD", step, job.options.steps, format_loss(loss))

        train(job.method, job.data, job.options, folder, job.about, done=done)


def _demo_tasks() -> tuple[Task, ...]:
    return tuple(task for task in shipped_validation_tasks().values() if task.layout.name == DEMO_LAYOUT)


def _evaluate_all(out: Path, tasks: Sequence[Task], settings: DemoSettings) -> _Compared:
    """Evaluate the reference egos and the trained model."""
    protocol, seeds = settings.protocol, settings.seeds
    results: dict[str, list[Result]] = {}
    runs = []
    references = [settings.reference] if settings.reference else []
    for name in (*AGENTS, *references, str(out / "ad")):
        agent = find_agent(name)
        folder = out / "results" / agent.name
        with progress_bars(unit="episodes") as show:
            results[agent.name] = evaluate(
                agent.name,
                agent.make,
                tasks,
                protocol,
                seeds=seeds,
                out=folder,
                details=agent.details,
                played=counted(show, agent.name, len(tasks) * len(seeds) * protocol.episodes),
            )
        note_results(folder, agent.run, tasks)
        runs.append(read_run(folder))
    return _Compared(runs[-1].agent, runs, family_returns(tasks, results))


def _draw_families(compared: _Compared, path: Path) -> None:
    notes = {}
    for of_family in compared.families:
        lead = find_lead(of_family, compared.agent)
        notes[of_family.family] = f"{lead.mean:+.1f} above {' and '.join(FLOOR)} ({lead.low:+.1f} to {lead.high:+.1f})"
    panels = {of_family.family: of_family.returns for of_family in compared.families}
    title = f"{compared.agent} on {DEMO_LAYOUT} with validation teammates: return in each episode of a task"
    plot_family_curves(panels, compared.agent, path, title, notes)


def _conclusion(compared: _Compared) -> str:
    """Returns what was measured and its limits, in a few lines; the last one is the verdict."""
    run, families = compared.runs[-1], compared.families
    episodes = families[0].returns[compared.agent].shape[1]
    pairs = ", ".join(f"{of_family.family} {len(of_family.returns[compared.agent])}" for of_family in families)
    lines = [
        *overlap_legend(run.overlaps(run.cells)),
        f"Measured on {episodes} episodes of each task and seed ({pairs}). It is one training run: the intervals leave "
        f"out how much trainings differ. Validation tasks are for choosing models, so this is no test result.",
        f"Within a task, {describe_rise(families, compared.agent)}.",
        f"{lead_verdict(families, compared.agent)}.",
    ]
    return "\n".join(lines)


def _draw_best_episode(dataset: Dataset, path: Path) -> None:
    """Draw the episode with the highest return of the history that ends best, the latest of several."""
    history = dataset[int(np.argmax(dataset.column("return_end")))]
    returns = history.returns()
    best = len(returns) - 1 - int(np.argmax(returns[::-1]))
    steps = slice(best * KEPT_STEPS, (best + 1) * KEPT_STEPS)
    save_episode(path, get_layout(history.entry.layout), history.state[steps], history.rewards[steps])
