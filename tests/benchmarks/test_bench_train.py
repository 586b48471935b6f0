"""The benchmark of training on the smallest scale: it runs, its figures are consistent, both ways get the same data."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks import bench_train
from benchmarks.bench_train import main, published_batches
from generation.teammates.instances import published_tasks
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.writing.published import to_published

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def test_the_peer_gets_the_same_batches(lite, tmp_path):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    to_published(dataset, tmp_path / "published", states=False)
    sampler = dataset.ad(batch_size=8, length=100, seed=3)  # starts 0 to 20, among them 0
    assert any(0 in sampler.windows(i)[1] for i in range(5))
    for i, batch in zip(range(5), published_batches(tmp_path / "published", sampler), strict=False):
        for ours, theirs in zip(sampler.batch(i), batch, strict=True):
            assert np.asarray(ours).dtype == np.asarray(theirs).dtype
            np.testing.assert_array_equal(ours, theirs)


def test_all_parts(monkeypatch):
    tasks = [task for task in published_tasks("teammate") if task.layout.name == "demo_wide"][:1]
    monkeypatch.setattr(bench_train, "published_tasks", lambda track: tasks)
    small = ["--histories", "1", "--batch", "2", "--length", "6", "--steps", "1", "--acting-steps", "2"]
    tiny = ["--episodes", "1", "--tasks", "1", "--rounds", "1", "--layers", "1", "--width", "8"]
    result = CliRunner().invoke(main, [*small, *tiny], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    train, act, every = (json.loads(line) for line in result.output.splitlines())
    assert train["transitions_per_second"] == pytest.approx(12 * train["steps_per_second"], rel=0.01)
    assert train["ratio"] > 0
    assert act["ratio"] > 0
    assert (every["tasks"], every["episodes"]) == (2, 1)
    assert every["minutes"] > 0
