"""`make demo`: from the bundled release's histories to a model that learns within its context, and a report of it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from icrl4aht_baselines.agents.egos import AGENTS, find_agent
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import Protocol, get_protocol
from icrl4aht_baselines.methods.options import SIZES, ModelOptions
from icrl4aht_baselines.plotting import plot_family_curves
from icrl4aht_baselines.report.page import write_page_with_episodes
from icrl4aht_baselines.report.results import EvaluationRun, bundled_by_id, note_results, read_run
from icrl4aht_baselines.report.statistics import MeanInterval, mean_interval
from icrl4aht_baselines.training.histories import prepare
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import RUN_CURVES
from icrl4aht_baselines.training.seen import overlap_legend
from icrl4aht_baselines.training.trainer import format_loss, train
from icrl4aht_data.benchmark.facts import KEPT_STEPS, family_order
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.plotting import check_can_draw, plot_layout_curves
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.progress import progress_bars

FLOOR = ("stay", "random")
"""Reference egos that an agent has to exceed before its return says anything."""

FamilyReturns = dict[str, dict[str, np.ndarray]]
"""Teammate family -> agent -> returns (U, E) of U pairs of a task and a seed in E episodes."""

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


class Lead(NamedTuple):
    """Difference between an agent's mean return and that of the better of two reference egos with one family.

    Attributes:
        difference: per episode, with its 95 % bootstrap interval over pairs of a task and a seed.
        better: whether the intervals of the differences to both reference egos are above 0.
    """

    difference: MeanInterval
    better: bool


def find_lead(returns: Mapping[str, np.ndarray], agent: str) -> Lead:
    """Return an agent's lead with one family: agent -> returns (U, E).

    Differences are paired, since episodes of a task and a seed start alike for all agents.
    """
    own = returns[agent].mean(axis=1)
    differences = [mean_interval(own - returns[name].mean(axis=1)) for name in FLOOR]
    return Lead(min(differences), all(found.low > 0 for found in differences))


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
    paths = [out / name for name in ("learning_curves.png", "episode.gif", "adaptation.png", "report.html")]
    for path in paths:
        check_output(path, overwrite=(out / "ad").is_dir())  # of a stopped run
    out.mkdir(parents=True, exist_ok=True)
    curves, episode, picture, page = paths

    def say(number: int, text: str) -> None:
        console.print(f"[bold]{number}/6[/bold] ({time.perf_counter() - started:.0f} s) {text}")

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
    verified = verify_release(settings.root, level="deep")
    if not verified.ok:
        raise ReleaseError(f"{settings.root}: {verified.findings[0].file}: {verified.findings[0].problem}")
    write(
        f"no problem in {verified.files} files, {verified.chunks} chunks, {verified.transitions:,} transitions replayed"
    )

    targets = f"{settings.labels} labels" if settings.labels else "the actions taken"
    model, training = settings.model, settings.training
    size = f"{model.layers} layers of width {model.width}, K = {training.context}"
    say(4, f"training AD on {targets}, {size}: {training.steps} steps")
    _train_demo(out / "ad", settings)
    write(f"losses on training and held-out histories: {out / 'ad' / RUN_CURVES}")

    tasks = settings.tasks
    if tasks is None:
        tasks = tuple(task for task in bundled_by_id("validation").values() if task.layout.name == DEMO_LAYOUT)
    others = [*AGENTS, *([settings.reference] if settings.reference else [])]
    say(5, f"evaluating it and {', '.join(others)} on {len(tasks)} validation tasks of {DEMO_LAYOUT}")
    played = [_evaluate(name, out, tasks, settings) for name in (*others, str(out / "ad"))]
    runs, agent = [run for run, _ in played], played[-1][0].agent
    names = sorted(played[0][1], key=family_order)
    families = {family: {run.agent: returns[family] for run, returns in played} for family in names}
    leads = {family: find_lead(found, agent) for family, found in families.items()}
    write(_lead_table(families, leads, agent))

    say(6, "drawing the curves and the report")
    title = f"{agent} on {DEMO_LAYOUT} with validation teammates: return in each episode of a task"
    notes = {family: f"{_signed(lead.difference)} above {' and '.join(FLOOR)}" for family, lead in leads.items()}
    plot_family_curves(families, agent, picture, title, notes)
    write_page_with_episodes(runs, page)
    write(f"return in each episode: {picture}\nreport: {page}")
    write(f"done in {time.perf_counter() - started:.0f} s\n")
    write("\n".join([*overlap_legend(runs[-1].overlaps(runs[-1].cells)), *_conclusion(families, leads, agent)]))
    return page


def _train_demo(folder: Path, settings: DemoSettings) -> None:
    histories = HistoryOptions((DEMO_LAYOUT,), str(settings.root), source=settings.sources, labels=settings.labels)
    job = prepare("ad", settings.model, settings.training, histories)
    with progress_bars(unit="steps") as show:

        def done(step: int, loss: float | None) -> None:
            show("AD", step, job.options.steps, format_loss(loss))

        train(job.method, job.data, job.options, folder, job.about, done=done)


def _evaluate(
    name: str, out: Path, tasks: Sequence[Task], settings: DemoSettings
) -> tuple[EvaluationRun, dict[str, np.ndarray]]:
    """Evaluate an agent. Return its results, and its returns (U, E) with each family, see `FamilyReturns`."""
    agent = find_agent(name)
    folder = out / "results" / agent.name
    rules: Any = {"seeds": settings.seeds, "out": folder, "details": agent.details}
    results = evaluate(agent.name, agent.make, tasks, settings.protocol, **rules)
    note_results(folder, agent.run, tasks)
    returns: dict[str, list[Any]] = defaultdict(list)
    for task, result in zip(tasks, results, strict=True):
        returns[task.teammate_family] += result.returns
    return read_run(folder), {family: np.array(found) for family, found in returns.items()}


def _signed(found: MeanInterval) -> str:
    return f"{found.mean:+.1f} (95 % interval {found.low:+.1f} to {found.high:+.1f})"


def _lead_table(families: FamilyReturns, leads: Mapping[str, Lead], agent: str) -> str:
    """Return text with a line per family: mean returns of all agents, and the lead of one of them."""
    names = list(next(iter(families.values())))
    widths = [max(9, len(name) + 2) for name in names]
    head = "".join(f"{name:>{width}}" for name, width in zip(names, widths, strict=True))
    lines = [f"family{head}   {agent} - better of {' and '.join(FLOOR)}"]
    for family, returns in families.items():
        means = "".join(f"{returns[name].mean():>{width}.1f}" for name, width in zip(names, widths, strict=True))
        lines.append(f"{family:6}{means}   {_signed(leads[family].difference)}")
    return "\n".join(lines)


def _conclusion(families: FamilyReturns, leads: Mapping[str, Lead], agent: str) -> list[str]:
    """Return what was measured and its limits, in a few lines; the last one is the verdict."""
    own = {family: returns[agent] for family, returns in families.items()}
    curve = np.mean([returns.mean(axis=0) for returns in own.values()], axis=0)
    half, pairs = len(curve) // 2, ", ".join(f"{family} {len(returns)}" for family, returns in own.items())
    better = [family for family, lead in leads.items() if lead.better]
    others, floor = [family for family in leads if family not in better], " and ".join(FLOOR)
    verdict = f"{agent} earns no more than {floor} with any of these families: {', '.join(others)}."
    if better:
        missed = f"; no more with {', '.join(others)}" if others else ""
        count = f"{len(better)} of {len(leads)} families"
        verdict = f"{agent} earns more than {floor} with {count}: {', '.join(better)}{missed}."
    return [
        f"Measured on {len(curve)} episodes of each task and seed ({pairs}). It is one training run: the intervals "
        f"leave out how much trainings differ. Validation tasks are for choosing models, so this is no test result.",
        f"Within a task, its first episode earns {curve[0]:.1f}, episodes {half + 1} to {len(curve)} "
        f"{curve[half:].mean():.1f}.",
        verdict,
    ]


def _draw_best_episode(dataset: Dataset, path: Path) -> None:
    """Draw the episode with the highest return of the history that ends best, the latest of several."""
    history = dataset[int(np.argmax(dataset.column("return_end")))]
    returns = history.returns()
    best = len(returns) - 1 - int(np.argmax(returns[::-1]))
    steps = slice(best * KEPT_STEPS, (best + 1) * KEPT_STEPS)
    save_episode(path, get_layout(history.entry.layout), history.state[steps], history.rewards[steps])
