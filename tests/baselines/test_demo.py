"""The demo with a tiny model on few histories; the slow test runs it on the bundled release."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from icrl4aht_baselines import demo
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.evaluate.results import Result, write_result
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.report import gifs, results
from icrl4aht_baselines.report.statistics import MeanInterval
from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_generation.teammates.registry import sample_teammate
from rich.console import Console

from icrl4aht_data.benchmark.tasks import make_task
from tests.helpers.random_releases import random_release

TASKS = tuple(
    make_task("teammate", "validation", "demo_wide", sample_teammate(family, 0, "train", 1), seed)
    for seed, family in enumerate(("utility_greedy", "territory"))
)
SETTINGS = demo.DemoSettings(
    model=ModelOptions(layers=1, width=16, heads=2),
    training=TrainOptions(steps=2, batch_size=2, context=10),
    tasks=TASKS,
    reference=None,
    protocol=get_protocol("seeded", 2),
    seeds=range(4),
)
EARNED = {"stay": 0.0, "random": 2.0, "oracle": 50.0}


@pytest.fixture(scope="module")
def release(tmp_path_factory) -> Path:
    """Return a release of random play with both sources."""
    root = tmp_path_factory.mktemp("demo") / "release"
    random_release(root, layouts=("demo_wide",), streams=2, length=100, sources=("noise", "ppo"))
    return root


def evaluate_without_playing(agent, make, tasks, protocol, *, seeds, out, details, played):
    """Write results in which the model earns 10 more than `random` with H4 and equally much with H2."""
    settings = {"agent": agent, "seeds": list(seeds), "protocol": asdict(protocol), "code_version": "0"}
    settings |= {"details": details} if details else {}
    found = []
    for task in tasks:
        value = EARNED.get(agent, 12.0 if task.teammate_family == "H4" else 2.0)
        found.append(Result(task.task_id, settings, [[value, value] for _ in seeds]))
        write_result(out, found[-1])
    return found


def test_an_agent_leads_if_its_gain_over_both_is_significant():
    """Two tasks with two seeds deviate by up to 1 from the agent's mean."""

    def lead(**means: float) -> MeanInterval:
        spread = np.linspace(-1, 1, 4).reshape(2, 2)
        return demo.find_lead({agent: mean + spread * (agent == "AD") for agent, mean in means.items()}, "AD")

    found = lead(stay=0.0, random=2.0, AD=12.0)
    assert found.mean == pytest.approx(10.0) and 8.0 <= found.low < 10.0 < found.high <= 12.0
    assert lead(stay=0.0, random=12.0, AD=8.0).mean == pytest.approx(-4.0), "the better of both counts"
    assert lead(stay=0.0, random=2.0, AD=2.5).low < 0 < lead(stay=0.0, random=2.0, AD=2.5).mean


def run(out: Path, settings: demo.DemoSettings) -> tuple[str, Path]:
    """Run a demo; return its output and report."""
    text = StringIO()
    page = demo.run_demo(out, Console(file=text, width=300), settings)
    return text.getvalue(), page


def test_the_demo_runs_every_step(release, tmp_path, monkeypatch):
    """The model is trained; its evaluation is replaced by invented results."""
    monkeypatch.setattr(results, "evaluate", evaluate_without_playing)
    monkeypatch.setattr(gifs, "save_episodes", lambda *arguments, **named: ())
    text, page = run(tmp_path, replace(SETTINGS, root=release))
    for expected in ("1/6", "target_actions", "context_next_obs", "transitions replayed", "6/6", "done in", str(page)):
        assert expected in text, expected
    assert text.endswith("AD earns more than stay and random with 1 of 2 families: H4; no more with H2.\n")
    assert re.search(r"H4 +0\.0 +2\.0 +50\.0 +12\.0 +\+10\.0 \(\+10\.0 to \+10\.0\)", text)
    assert "† the agent was trained with other teammates of this family" in text
    assert (tmp_path / "learning_curves.png").read_bytes()[1:4] == b"PNG"
    assert (tmp_path / "episode.gif").read_bytes()[:6] == b"GIF89a"
    assert "<h3>Return in each cell, validation tasks</h3>" in page.read_text()
    config = json.loads((tmp_path / "ad" / "config.json").read_text())
    assert {cell["source"] for cell in config["trained_on"]} == {"noise"}


@pytest.mark.slow
def test_the_complete_demo(tmp_path):
    text, page = run(tmp_path, replace(SETTINGS, tasks=None, reference="ad-reference"))
    assert "transitions replayed" in text
    rows = {line.split()[0]: line.split() for line in text.splitlines() if re.match(r"H\d .*\(", line)}
    assert len(rows) >= 2, "families of the validation tasks"
    assert all(float(row[1]) == 0.0 and float(row[3]) > 20 for row in rows.values()), "stay and oracle"
    assert "data:image/gif" in page.read_text()
