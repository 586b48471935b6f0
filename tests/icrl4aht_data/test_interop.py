"""Test loaders of PyTorch, Grain and Hugging Face that take batches from samplers."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional
from torch.utils.data import DataLoader

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.interop import IGNORED, hf_episodes, hf_index, hf_windows, torch_loader
from tests.helpers.batches import assert_equal_batches
from tests.helpers.commands import run_python


@pytest.fixture
def sampler(lite):
    return load_icrl4aht(lite[0], layout="demo_wide", obs="uint8").ad(batch_size=4, length=25, seed=6)


class TestLoaderPasses:
    """Regression: each pass over a loader repeated the batches of the first pass."""

    def test_each_pass_over_a_torch_loader_returns_new_batches(self, sampler):
        loader, n = torch_loader(sampler), len(sampler)
        for number in range(3):
            assert len(loader) == n
            batches = list(loader)
            assert len(batches) == n
            for i, batch in enumerate(batches, start=number * n):
                np.testing.assert_array_equal(batch.obs, sampler[i].obs)

    def test_resumed_torch_loader_ends_its_passes_at_the_same_batches(self, sampler):
        resumed, n = torch_loader(sampler, start=len(sampler) + 3), len(sampler)
        assert len(resumed) == n - 3
        first, second = list(resumed), list(resumed)
        assert (len(first), len(second)) == (n - 3, n)
        np.testing.assert_array_equal(first[0].obs, sampler[n + 3].obs)
        np.testing.assert_array_equal(second[0].obs, sampler[2 * n].obs)

    def test_loader_starts_the_next_pass_after_an_unfinished_pass(self, sampler):
        loader = torch_loader(sampler, start=2, stop=5)
        found = [next(iter(loader)).obs for _ in range(3)]
        for i, obs in zip((2, 5, 8), found, strict=True):
            np.testing.assert_array_equal(obs, sampler[i].obs)


class TestGrain:
    def test_grain_keeps_the_order_for_any_number_of_threads(self, sampler):
        import grain

        source = grain.MapDataset.source(sampler)
        for threads in (0, 1, 4):
            options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=8 * (threads > 0))
            found = list(source.to_iter_dataset(options))
            assert len(found) == len(sampler)
            for i, batch in enumerate(found):
                assert_equal_batches(batch, sampler[i])


ONE_CORE = "ignore:This DataLoader will create:UserWarning"
"""PyTorch warns of more workers than cores."""

TORCH = """
import json
import sys
import numpy as np
import torch
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.interop import torch_loader

if __name__ == "__main__":
    for cache, kind, workers, context in json.loads(sys.argv[2]):
        dataset = load_icrl4aht(sys.argv[1], layout="demo_wide", obs="float32", cache=cache, threads=2)
        options = {"batch_size": 4, "seed": 6}
        sampler = dataset.ad(length=25, **options) if kind == "ad" else dataset.dpt(context=25, **options)
        sampler[0]  # a forked worker inherits what has been used: threads, locks, open files
        loader = torch_loader(sampler, start=1, stop=6, workers=workers, context=context)
        for epoch in range(2 if context == "fork" else 1):  # workers persist
            for i, batch in enumerate(loader, start=1 + 5 * epoch):
                assert type(batch) is type(sampler[i])
                for name, array in sampler[i]._asdict().items():
                    if array is not None:
                        found = getattr(batch, name)
                        assert isinstance(found, torch.Tensor)
                        np.testing.assert_array_equal(found.numpy(), array)
            assert i == 5 * epoch + 5
        print(cache, kind, workers, context)
"""

COMBINATIONS = [
    (cache, kind, workers, context)
    for cache, kind in (("mmap", "ad"), ("mmap", "dpt"), ("stream", "ad"))
    for workers, context in ((0, "spawn"), (2, "fork"), (1, "spawn"))
]


@pytest.mark.slow
def test_pytorch_workers_return_the_batches_of_the_sampler(lite, tmp_path):
    """Run in a separate process, because a process that has run JAX must not fork."""
    script = tmp_path / "loader.py"
    script.write_text(TORCH)
    printed = run_python("-W", "error", "-W", ONE_CORE, script, lite[0], json.dumps(COMBINATIONS))
    assert len(printed.splitlines()) == len(COMBINATIONS)


class TestHuggingFace:
    def test_hf_index_has_one_row_per_history(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide")
        assert hf_index(dataset).to_list() == [entry.to_row() for entry in dataset.entries]

    def test_hf_episodes_have_none_for_missing_oracle_actions(self, lite, tmp_path, monkeypatch):
        """Check a few columns; `test_episode_files.py` compares all columns with the histories."""
        monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path)
        row = hf_episodes(load_icrl4aht(lite[0], layout="demo_wide"))[8]
        assert (row["history_id"], row["episode"], row["layout"]) == (7, 2, "demo_wide")
        assert row["oracle_actions"] is None

    def test_hf_windows_equal_the_batches_and_can_be_resumed(self, sampler):
        windows = hf_windows(sampler, stop=3)
        rows = list(windows)
        assert len(rows) == 12
        for number, row in enumerate(rows):
            for name, array in row.items():
                np.testing.assert_array_equal(array, getattr(sampler[number // 4], name)[number % 4])
        iterator = iter(windows)
        for _ in range(5):
            next(iterator)
        again = hf_windows(sampler, stop=3)
        again.load_state_dict(windows.state_dict())
        np.testing.assert_array_equal(next(iter(again))["obs"], rows[5]["obs"])


def torch_batch(sampler):
    return next(iter(torch_loader(sampler, stop=1)))


def hugging_face_batch(sampler):
    rows = list(hf_windows(sampler, stop=1).with_format("torch"))
    return SimpleNamespace(**{name: torch.stack([row[name] for row in rows]) for name in rows[0]})


@pytest.mark.parametrize("take", [torch_batch, hugging_face_batch])
class TestLosses:
    """Regression: PyTorch's losses refused int32 targets, and padded targets were the action `up`."""

    def test_cross_entropy_accepts_targets_and_ignores_padding(self, lite, take):
        sampler = load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=3, length=150, teammate_actions=True)
        batch = take(sampler)
        for name in ("prev_actions", "target_actions", "prev_teammate_actions"):
            assert getattr(batch, name).dtype == torch.int64, name
        logits = torch.randn(3, 150, 6, generator=torch.Generator().manual_seed(0))
        loss = functional.cross_entropy(logits.transpose(1, 2), batch.target_actions)
        mask, targets = sampler[0].attention_mask, sampler[0].target_actions
        assert not mask.all()
        np.testing.assert_allclose(loss, -logits.log_softmax(-1).numpy()[mask, targets[mask]].mean(), rtol=1e-5)
        np.testing.assert_array_equal(batch.target_actions == IGNORED, ~mask)

    def test_cross_entropy_accepts_dpt_query_targets(self, lite, take):
        batch = take(load_icrl4aht(lite[0], layout="demo_wide").dpt(batch_size=3, context=7))
        assert batch.query_target.dtype == batch.context_actions.dtype == torch.int64
        assert functional.cross_entropy(torch.zeros(3, 6), batch.query_target) > 0


def test_cross_entropy_accepts_targets_of_a_torch_data_loader(lite):
    ds = load_icrl4aht(lite[0], layout="demo_wide")
    samplers: list[Any] = [ds.ad(batch_size=3, length=9), ds.dpt(batch_size=3, context=7)]
    batch, queries = (next(iter(DataLoader(one, batch_size=None))) for one in samplers)
    assert (batch.target_actions.dtype, batch.prev_actions.dtype) == (torch.int64, torch.int32)
    assert functional.cross_entropy(torch.zeros(3, 6, 9), batch.target_actions) > 0
    assert functional.cross_entropy(torch.zeros(3, 6), queries.query_target) > 0
