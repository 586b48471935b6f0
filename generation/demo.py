"""`make demo`: the whole way on the smallest profile, with pictures at the end."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from generation.build import build_releases
from generation.plan import task_learner
from generation.profiles import load_profile
from generation.speed import learner_speed
from icrl4aht_data.benchmark import KEPT_STEPS
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.figures import plot_learning_curves
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.verify import verify_release

_STEPS = 6


def run_demo(out: Path, profile_name: str, console: Console) -> None:
    """Generate, verify, load, sample, draw, measure; says what it does and where things are."""
    started = time.perf_counter()

    def say(number: int, text: str) -> None:
        console.print(f"[bold]{number}/{_STEPS}[/bold] ({time.perf_counter() - started:.0f} s) {text}")

    say(1, f"generating profile {profile_name}: an ego learns from scratch, its histories are recorded")
    root = build_releases(profile_name, out, ("lite",), console)[0]

    say(2, "verifying every byte and every step")
    report = verify_release(root, deep=True)
    if not report.ok:
        raise ReleaseError(f"{root}: {report.findings[0].file}: {report.findings[0].problem}")
    console.print(f"whole: {report.files} files, {report.chunks} chunks, {report.transitions:,} transitions replayed")

    layout = load_profile(profile_name).layouts[-1]
    say(3, f'ds = load_icrl4aht("{root}", split="train", layout="{layout}")')
    dataset = load_icrl4aht(root, split="train", layout=layout)
    console.print(repr(dataset), highlight=False)

    say(4, "ds.ad(batch_size=8, length=500)[0], then ds.dpt(batch_size=8, context=500)[0]")
    console.print(dataset.ad(batch_size=8, length=500)[0].describe(), highlight=False)
    console.print()
    console.print(dataset.dpt(batch_size=8, context=500)[0].describe(), highlight=False)

    say(5, "drawing")
    curves, episode = out / "learning_curves.png", out / "episode.gif"
    plot_learning_curves(load_icrl4aht(root), curves)
    _draw_best_episode(dataset, episode)
    console.print(f"learning curves: {curves}\nan episode: {episode}", highlight=False)

    say(6, "measuring the learner")
    profile = load_profile(profile_name)
    console.print(json.dumps(learner_speed(task_learner(profile, profile.ego))), highlight=False)
    console.print(f"[bold]done[/bold] in {time.perf_counter() - started:.0f} s; the release is {root}")


def _draw_best_episode(dataset: Dataset, path: Path) -> None:
    """The episode with the highest return of the first (best) history, latest among equals."""
    history = dataset[0]
    returns = history.returns()
    best = len(returns) - 1 - int(np.argmax(returns[::-1]))
    steps = slice(best * KEPT_STEPS, (best + 1) * KEPT_STEPS)
    save_episode(path, get_layout(history.entry.layout), history.state[steps], history.rewards[steps])
