"""`make demo`: train a model on bundled histories, and show whether it learns within its context."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from icrl4aht_baselines.agents.egos import NamedEgo, find_agent
from icrl4aht_baselines.evaluate.protocols import Protocol, bundled_tasks, get_protocol
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.plotting import panel_grid
from icrl4aht_baselines.report.page import write_page
from icrl4aht_baselines.report.results import EPISODE_BLOCKS, EvaluationRun, evaluate_agent, mean_of
from icrl4aht_baselines.report.statistics import MeanInterval, mean_interval
from icrl4aht_baselines.training.histories import prepare
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import RUN_CURVES
from icrl4aht_baselines.training.trainer import show_steps
from icrl4aht_data.benchmark.facts import KEPT_STEPS, PREFERENCE
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.plotting import check_can_draw, legend_below, plot_learning_curves, save_figure
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.progress import progress_bars

DEMO_LAYOUT = "rooms-0-46"
_SOURCE = "search"
_EPISODES = 5  # episodes of a window, in which the script of the histories finds out the dish

_MODEL = ModelOptions(
    width=128, recurrent_layers=1, dropout=0.0, encoder="mlp", teammate_actions=True, reward_scale=0.05
)
_TRAINING = TrainOptions(
    900, batch_size=32, context=_EPISODES * KEPT_STEPS, learning_rate=2e-3, validate_every=500, validation_batches=1
)
_PROTOCOL = get_protocol("seeded", 10)

_AGENTS = {"stay": "never moves", "search": "the script that it imitates", "oracle": "a script that is told the dish"}
"""Reference ego in the figure -> description of its behaviour."""

_OWN_STYLE: dict[str, Any] = {"color": "C0", "linewidth": 2.2}


@dataclass(frozen=True)
class DemoSettings:
    """Settings of the demo; the defaults take at most 7 minutes on two cores.

    Attributes:
        root: folder of the release.
        model: architecture of Hybrid-AD, which trains fastest.
        training: settings of the training, chosen on validation tasks.
        tasks: tasks to evaluate on; None for the validation tasks of `DEMO_LAYOUT`.
        protocol: protocol of the evaluation.
        seeds: seeds of the evaluation.
    """

    root: Path = MINI
    model: ModelOptions = _MODEL
    training: TrainOptions = _TRAINING
    tasks: tuple[Task, ...] | None = None
    protocol: Protocol = _PROTOCOL
    seeds: Sequence[int] = range(24)


def run_demo(out: Path, console: Console, settings: DemoSettings | None = None) -> Path:
    """Run the demo: load, sample and verify a release; train a model; evaluate it with and without memory; draw.

    Args:
        out: output folder; the same call with this folder resumes a stopped demo.
        console: console for the printed text.
        settings: settings of the demo.

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
        check_output(path, overwrite=(out / "run").is_dir())  # a stopped demo is resumed
    out.mkdir(parents=True, exist_ok=True)
    curves, episode, picture, page = paths

    def print_stage(number: int, text: str) -> None:
        console.print(f"[bold]{number}/6[/bold] ({time.perf_counter() - started:.0f} s) {text}")

    def print_text(text: str) -> None:
        console.print(text, highlight=False, markup=False)

    print_stage(1, f'ds = load_icrl4aht(split="train", layout="{DEMO_LAYOUT}", source="{_SOURCE}")')
    dataset = load_icrl4aht(settings.root, split="train", layout=DEMO_LAYOUT, source=_SOURCE)
    plot_learning_curves(load_icrl4aht(settings.root), curves)
    _draw_best_episode(dataset, episode)
    print_text(f"{dataset!r}\nlearning curves: {curves}\nbest episode: {episode}")

    print_stage(2, 'ds.ad(batch_size=8, length=500, labels="expert")[0]')
    print_text(dataset.ad(batch_size=8, length=500, labels="expert")[0].describe())

    print_stage(3, "verifying every byte and every step")
    verified = verify_release(settings.root, level="deep")
    if not verified.ok:
        raise ReleaseError(f"{settings.root}: {verified.findings[0].file}: {verified.findings[0].problem}")
    print_text(
        f"no problem in {verified.files} files, {verified.chunks} chunks, {verified.transitions:,} transitions replayed"
    )

    training = settings.training
    print_stage(4, f"training Hybrid-AD on windows of {training.context:,} steps: {training.steps} steps")
    run = out / "run"
    histories = HistoryOptions((DEMO_LAYOUT,), str(settings.root), source=(_SOURCE,), labels="expert", first=_EPISODES)
    job = prepare("hybrid_ad", settings.model, training, histories)
    with progress_bars(unit="steps") as show:
        job.train(run, done=show_steps(show, "Hybrid-AD", training.steps))
    print_text(f"losses on training and held-out histories: {run / RUN_CURVES}")

    every = bundled_tasks(PREFERENCE, "validation")  # new teammates, but the dishes of training
    tasks = settings.tasks or [task for task in every if task.layout.name == DEMO_LAYOUT]
    print_stage(5, f"evaluating it and {', '.join(_AGENTS)} on {len(tasks)} validation tasks")
    agent = find_agent(run, greedy=False)

    def evaluate_into(one: NamedEgo, folder: str, **control: Any) -> EvaluationRun:
        rules, where = settings.protocol, out / "results" / folder
        return evaluate_agent(one, tasks, rules, where, seeds=settings.seeds, **control)

    own, cleared = evaluate_into(agent, agent.name), evaluate_into(agent, "cleared", control="cleared")
    runs = [own, cleared, *(evaluate_into(find_agent(name), name) for name in _AGENTS)]
    print_text(block_table(runs).to_string())

    print_stage(6, "drawing")
    draw_adaptation(runs, picture)
    write_page(runs, page)
    print_text(f"return by episode: {picture}\nreport: {page}")
    print_text(f"done in {time.perf_counter() - started:.0f} s\n\n{conclusion(own, cleared)}")
    return page


def block_table(runs: Sequence[EvaluationRun]) -> pd.DataFrame:
    """Return a table of mean returns, with a row for each agent and a column for each block of episodes."""
    means = {
        run.agent: {block: mean_of(of.blocks[block] for of in run.returns.values()) for block in _played_blocks(run)}
        for run in runs
    }
    return pd.DataFrame(means).T.map("{:z.1f}".format).rename(columns="episodes {}".format)


def _played_blocks(run: EvaluationRun) -> list[str]:
    """Return the names of the blocks of episodes that were played in all tasks of a run."""
    return [block for block in EPISODE_BLOCKS if all(block in of.blocks for of in run.returns.values())]


def mean_gain(run: EvaluationRun, other: EvaluationRun | None = None) -> MeanInterval:
    """Return a run's return in its last block of episodes minus that in its first episode, or minus another run's.

    Differences are paired by task and seed. Each combination of layout and teammate family has the same weight.

    Args:
        run: results of an agent.
        other: results of another agent; if given, its return in the last block is subtracted.
    """
    last = _played_blocks(run)[-1]
    base, block = (run, "1") if other is None else (other, last)
    return mean_interval(
        *(of.blocks[last][0] - base.returns[cell].blocks[block][0] for cell, of in run.returns.items())
    )


def conclusion(own: EvaluationRun, cleared: EvaluationRun) -> str:
    """Return text that says whether the model learns within its context, and how far the measurement can be trusted."""
    rise, memory = mean_gain(own), mean_gain(own, cleared)
    verdict = "rises by what it remembers" if rise.low > 0 and memory.low > 0 else "does not rise by what it remembers"
    return (
        f"Its return {verdict}: {rise.text(sign='+')} from the first episode to the last ones, {memory.text(sign='+')} "
        f"more there than with its memory cleared before each episode.\n"
        f"This is one training run, and the intervals leave out how much such runs differ. Validation tasks are for "
        f"choosing models, so this is no test result."
    )


def draw_adaptation(runs: Sequence[EvaluationRun], path: Path) -> None:
    """Draw each run's mean return in every episode; the model with its memory cleared has a dashed line."""
    figure, (axes,) = panel_grid(
        [f"{DEMO_LAYOUT}, validation teammates: one dish is wanted, and nothing shows which"],
        1,
        (6.4, 3.6),
        "episode with the same teammate",
    )
    for number, run in enumerate(runs):
        returns = np.mean([of_cell.mean(axis=0) for of_cell in run.cells.values()], axis=0)
        if run.agent in _AGENTS:
            label, style = f"{run.agent}: {_AGENTS[run.agent]}", {"color": f"C{number}", "alpha": 0.7}
        elif number:
            label, style = "the model, memory cleared before each episode", {"linestyle": "--", **_OWN_STYLE}
        else:
            label, style = "the model, with its memory", _OWN_STYLE
        axes.plot(np.arange(1, len(returns) + 1), returns, marker=".", label=label, **style)
    axes.set_ylabel("return of an episode", fontsize=8)
    axes.axhline(0, color="gray", linewidth=0.6)
    legend_below(figure)
    save_figure(figure, path)


def _draw_best_episode(dataset: Dataset, path: Path) -> None:
    """Draw the best episode of the history with the highest final return, the latest one if several are equal."""
    history = dataset[int(np.argmax(dataset.column("return_end")))]
    returns = history.returns()
    best = len(returns) - 1 - int(np.argmax(returns[::-1]))
    steps = slice(best * KEPT_STEPS, (best + 1) * KEPT_STEPS)
    save_episode(path, get_layout(history.entry.layout), history.state[steps], history.rewards[steps])
