"""The benchmark of training on the smallest scale: it runs, its figures are consistent, both ways get the same data."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from icrl4aht_baselines.methods.options import SIZES, ModelSize
from icrl4aht_generation.teammates.instances import published_tasks

from benchmarks import bench_train
from benchmarks.bench_train import main, published_batches
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.writing.published import to_published


def test_the_peer_gets_the_same_batches(lite, tmp_path):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    to_published(dataset, tmp_path / "published", states=False)
    sampler = dataset.ad(batch_size=8, length=100, seed=3)  # starts 0 to 20, among them 0
    assert any(0 in sampler.windows(i)[1] for i in range(5))
    for i, batch in zip(range(5), published_batches(tmp_path / "published", sampler), strict=False):
        for ours, theirs in zip(sampler.batch(i), batch, strict=True):
            assert np.asarray(ours).dtype == np.asarray(theirs).dtype
            np.testing.assert_array_equal(ours, theirs)


SMALLEST = (
    "--size tiny --encoder mlp --histories 1 --batch 2 --length 6 --steps 1 --acting-steps 2 --episodes 1 --tasks 1"
)


@pytest.fixture(autouse=True)
def one_layer(monkeypatch) -> None:
    monkeypatch.setitem(SIZES, "tiny", ModelSize(1, 8, 5, heads=2, context=6, encoder="mlp"))


def run_part(part: str) -> list[dict[str, Any]]:
    """The lines of one part on the smallest scale."""
    result = CliRunner().invoke(main, [*SMALLEST.split(), "--part", part], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in result.output.splitlines()]


@pytest.mark.slow
def test_training():
    lines = run_part("train")
    assert [(line["size"], line["way"]) for line in lines] == [("tiny", "published"), ("tiny", "mlp")]
    for line in lines:
        assert line["transitions_per_second"] == pytest.approx(12 * line["steps_per_second"], rel=0.01)
    assert lines[0]["ratio_to_published"] == 1
    assert lines[1]["ratio_to_published"] > 0


@pytest.mark.slow
def test_acting():
    assert run_part("act")[0]["ratio"] > 0


@pytest.mark.slow
def test_all_tasks(monkeypatch):
    tasks = [task for task in published_tasks("teammate") if task.layout.name == "demo_wide"][:1]
    monkeypatch.setattr(bench_train, "published_tasks", lambda track: tasks)
    (line,) = run_part("all")
    assert (line["tasks"], line["episodes"]) == (2, 1)
    assert line["minutes"] > 0
