"""`make demo`: train a model on bundled histories, and show whether it learns within its context."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from icrl4aht_baselines.agents.egos import NamedEgo, find_agent
from icrl4aht_baselines.evaluate.protocols import Protocol, bundled_tasks, get_protocol
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.plotting import panel_grid
from icrl4aht_baselines.report.page import write_page
from icrl4aht_baselines.report.results import EPISODE_BLOCKS, EvaluationRun, evaluate_agent
from icrl4aht_baselines.report.scores import block_returns_text
from icrl4aht_baselines.report.statistics import mean_interval
from icrl4aht_baselines.training.histories import prepare
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import RUN_CURVES
from icrl4aht_baselines.training.trainer import show_steps
from icrl4aht_data.benchmark.facts import KEPT_STEPS, PREFERENCE
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import MINI, load_icrl4aht
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.plotting import add_legend_below, check_can_draw, save_figure
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.progress import progress_bars

DEMO_LAYOUT = "rooms-0-46"
_SOURCE = "search"
_EPISODES = 5  # episodes of a window; within them, the script `search` finds out which dish is wanted

_MODEL = ModelOptions(
    width=128, recurrent_layers=1, dropout=0.0, encoder="mlp", teammate_actions=True, reward_scale=0.05
)
_TRAINING = TrainOptions(
    900, batch_size=32, context=_EPISODES * KEPT_STEPS, learning_rate=2e-3, validate_every=500, validation_batches=1
)
_PROTOCOL = get_protocol("seeded", 10)

_AGENTS = {"stay": "never moves", "search": "the script that it imitates", "oracle": "a script that sees the dish"}
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


def run_demo(out: Path, settings: DemoSettings | None = None) -> Path:
    """Run the demo: load, sample and verify a release; train a model; evaluate it with and without memory; draw.

    Args:
        out: output folder; the same call with this folder resumes a stopped demo.
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
    picture, page = out / "adaptation.png", out / "report.html"
    for path in (picture, page):
        check_output(path, overwrite=(out / "run").is_dir())  # a stopped demo is resumed
    out.mkdir(parents=True, exist_ok=True)

    def print_stage(number: int, text: str) -> None:
        click.echo(f"{click.style(f'{number}/6', bold=True)} ({time.perf_counter() - started:.0f} s) {text}")

    print_stage(1, f'ds = load_icrl4aht(split="train", layout="{DEMO_LAYOUT}", source="{_SOURCE}")')
    dataset = load_icrl4aht(settings.root, split="train", layout=DEMO_LAYOUT, source=_SOURCE)
    click.echo(repr(dataset))

    print_stage(2, 'ds.ad(batch_size=8, length=500, labels="expert")[0]')
    click.echo(dataset.ad(batch_size=8, length=500, labels="expert")[0].describe())

    print_stage(3, "verifying every byte and every step")
    verified = verify_release(settings.root, level="deep")
    if not verified.ok:
        raise ReleaseError(f"{settings.root}: {verified.findings[0].file}: {verified.findings[0].problem}")
    click.echo(
        f"no problem in {verified.files} files, {verified.chunks} chunks, {verified.transitions:,} transitions replayed"
    )

    training = settings.training
    print_stage(4, f"training Hybrid-AD on windows of {training.context:,} steps: {training.steps} steps")
    run = out / "run"
    histories = HistoryOptions((DEMO_LAYOUT,), str(settings.root), source=(_SOURCE,), labels="expert", first=_EPISODES)
    job = prepare("hybrid_ad", settings.model, training, histories)
    with progress_bars(unit="steps") as show:
        job.train(run, done=show_steps(show, "Hybrid-AD", training.steps))
    click.echo(f"losses on training and held-out histories: {run / RUN_CURVES}")

    every = bundled_tasks(PREFERENCE, "validation")  # tasks with new teammates, but dishes of the training tasks
    tasks = settings.tasks or [task for task in every if task.layout.name == DEMO_LAYOUT]
    print_stage(5, f"evaluating it and {', '.join(_AGENTS)} on {len(tasks)} validation tasks")
    agent = find_agent(run, greedy=False)

    def evaluate_into(one: NamedEgo, folder: str, **control: Any) -> EvaluationRun:
        rules, where = settings.protocol, out / "results" / folder
        return evaluate_agent(one, tasks, rules, where, seeds=settings.seeds, **control)

    own, cleared = evaluate_into(agent, agent.name), evaluate_into(agent, "cleared", control="cleared")
    runs = [own, cleared, *(evaluate_into(find_agent(name), name) for name in _AGENTS)]
    for run in runs:
        click.echo(f"{run.agent}, mean return in episodes {block_returns_text([*run.returns.values()])}")

    print_stage(6, "drawing")
    draw_adaptation(runs, picture)
    write_page(runs, page)
    click.echo(f"return by episode: {picture}\nreport: {page}")
    click.echo(f"done in {time.perf_counter() - started:.0f} s\n\n{conclusion(own, cleared)}")
    return page


def conclusion(own: EvaluationRun, cleared: EvaluationRun) -> str:
    """Return text that says whether the model learns within its context, and how far the measurement can be trusted."""
    last = next(block for block in reversed(EPISODE_BLOCKS) if all(block in of.blocks for of in own.returns.values()))
    ends = {cell: of.blocks[last][0] for cell, of in own.returns.items()}
    # Differences are paired by task and seed. Each combination of layout and teammate family has the same weight.
    rise = mean_interval(*(end - own.returns[cell].blocks["1"][0] for cell, end in ends.items()))
    memory = mean_interval(*(end - cleared.returns[cell].blocks[last][0] for cell, end in ends.items()))
    verdict = "rises because of memory" if rise.low > 0 and memory.low > 0 else "does not rise because of memory"
    return (
        f"Its return {verdict}: {rise.text(sign='+')} from the first episode to the last ones, and there "
        f"{memory.text(sign='+')} above the return with memory cleared before each episode.\n"
        f"This is one training run, and the intervals leave out how much such runs differ. Validation tasks are for "
        f"choosing models, so this is no test result."
    )


def draw_adaptation(runs: Sequence[EvaluationRun], path: Path) -> None:
    """Draw each run's mean return in every episode; a dashed line shows the model with its memory cleared."""
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
    add_legend_below(figure)
    save_figure(figure, path)
