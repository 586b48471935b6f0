"""Test the demo with a tiny model on few histories, and with the bundled release."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from icrl4aht_baselines import demo
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, controlled_name, get_protocol
from icrl4aht_baselines.evaluate.results import Result, write_result
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.report import results
from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_generation.teammates.registry import sample_teammate

from icrl4aht_data.benchmark.tasks import make_task, write_tasks
from icrl4aht_data.checking.verify import verify_release
from tests.helpers.random_releases import random_release

TASKS = tuple(
    make_task("teammate", "validation", "demo_wide", sample_teammate(family, 0, "train", 1), seed)
    for seed, family in enumerate(("utility_greedy", "territory"))
)
SETTINGS = demo.DemoSettings(
    model=ModelOptions(recurrent_layers=1, width=16, heads=2),
    training=TrainOptions(steps=2, batch_size=2, context=10),
    tasks=TASKS,
    protocol=get_protocol("seeded", 6),
    seeds=range(4),
)
EARNED = {"stay": (0.0, 0.0), "search": (-20.0, 40.0), "oracle": (40.0, 40.0)}
"""Returns of each agent: in the first episode, and in each other episode."""


@pytest.fixture(scope="module")
def release(tmp_path_factory) -> Path:
    """Return a release of random play whose histories name `search` and `ppo` as their sources."""
    root = tmp_path_factory.mktemp("demo") / "release"
    random_release(root, layouts=("demo_wide",), streams=2, length=100, sources=("search", "ppo"))
    return root


def fake_evaluate(last: float, last_cleared: float):
    """Return a replacement for `evaluate` with fixed returns, to which the seed is added after the first episode.

    The agents in `EARNED` have the returns stated there. Others have 0 in the first episode, then `last`, or
    `last_cleared` in runs with a control.
    """

    def evaluate(agent, make, tasks, protocol, *, seeds, out, details, played, control=None):
        name = agent if control is None else controlled_name(agent, control)
        settings = {"agent": name, "seeds": list(seeds), "protocol": asdict(protocol), "code_version": "0"}
        settings |= {"details": details} if details else {}
        first, others = EARNED.get(agent, (0.0, last if control is None else last_cleared))
        found = []
        for task in tasks:
            returns = [[first, *[others + seed] * (protocol.episodes - 1)] for seed in seeds]
            found.append(Result(task.task_id, settings, returns))
            write_result(out, found[-1])
        return found

    return evaluate


@pytest.mark.parametrize(
    ("last", "last_cleared", "verdict"),
    [(20.0, 0.0, "rises"), (20.0, 20.0, "does not rise"), (-10.0, -30.0, "does not rise")],
)
def test_conclusion_says_whether_memory_raises_the_return(last, last_cleared, verdict, tmp_path):
    evaluate = fake_evaluate(last, last_cleared)
    for control in (None, "cleared"):
        out = tmp_path / str(control)
        evaluate(
            "AD", None, TASKS, SETTINGS.protocol, seeds=range(4), out=out, details={}, played=None, control=control
        )
        write_tasks(out / "tasks.jsonl", TASKS)
    said = demo.conclusion(results.read_run(tmp_path / "None"), results.read_run(tmp_path / "cleared"))
    assert said.startswith(f"Its return {verdict} because of memory: {last + 1.5:+.1f}")


@pytest.mark.slow
def test_demo_prints_every_step_and_writes_all_files(release, tmp_path, monkeypatch, capsys):
    """The model is trained, but the results of its evaluation are invented."""
    monkeypatch.setattr(results, "evaluate", fake_evaluate(20.0, 0.0))
    monkeypatch.setattr(demo, "DEMO_LAYOUT", "demo_wide")
    page = demo.run_demo(tmp_path, replace(SETTINGS, root=release))
    said = capsys.readouterr().out
    for expected in ("1/6", "target_actions", "transitions replayed", "6/6", "done in", str(page)):
        assert expected in said, expected
    assert "Its return rises because of memory: +21.5" in said
    assert "search, mean return in episodes 1: -20.0, 2-5: 41.5, 6-20: 41.5\n" in said
    assert (tmp_path / "adaptation.png").read_bytes()[1:4] == b"PNG"
    assert "validation tasks</h3>" in page.read_text()
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert {cell["source"] for cell in config["trained_on"]} == {"search"}


@pytest.mark.slow
def test_complete_demo_on_the_bundled_release_shows_plausible_returns(tmp_path, monkeypatch, capsys):
    """Run the demo with quick verification, half of the tasks and one seed, which are enough for rough bounds."""
    monkeypatch.setattr(demo, "verify_release", lambda root, level: verify_release(root, level="quick"))
    few = [task for task in bundled_tasks("preference", "validation") if task.layout.name == demo.DEMO_LAYOUT][::2]
    monkeypatch.setattr(demo, "bundled_tasks", lambda track, split: few)
    short = TrainOptions(steps=2, batch_size=2, context=100)
    settings = replace(SETTINGS, tasks=None, training=short, seeds=range(1))
    demo.run_demo(tmp_path, settings)
    rows = re.findall(
        r"(\w+), mean return in episodes 1: ([-.\d]+), 2-5: [-.\d]+, 6-20: ([-.\d]+)", capsys.readouterr().out
    )
    found = {agent: (float(first), float(last)) for agent, first, last in rows}
    assert found["stay"][0] < 20 < found["oracle"][0]
    assert found["search"][0] < 10 < found["search"][1]
