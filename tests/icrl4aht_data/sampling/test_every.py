"""Test windows of every n-th episode, which the sampler option `every` selects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.sampling.draws import Curriculum
from tests.helpers.batches import CACHES
from tests.helpers.two_sources import EPISODES, LENGTH

OPTIONS: dict[str, Any] = {"batch_size": 32, "length": 2 * LENGTH + 7, "seed": 2}


def next_step(step: int, every: int) -> int:
    """Return the step after `step` in a window that has only every n-th episode."""
    after = step + 1
    return after if after % LENGTH else after + (every - 1) * LENGTH


def previous_step(step: int, every: int) -> int:
    """Return the step before `step` in a window of every n-th episode, or -1 for the first step."""
    skipped = (every - 1) * LENGTH
    return step - 1 if step % LENGTH or step <= skipped else step - 1 - skipped


@pytest.mark.parametrize("cache", CACHES)
@pytest.mark.parametrize("every", [2, 3, EPISODES, EPISODES + 5])
def test_windows_contain_only_every_nth_episode(two_sources, cache, every):
    root, written = two_sources
    dataset = load_icrl4aht(root, split="train", cache=cache, obs="state", channels="canonical")
    sampler = dataset.ad(every=every, labels="oracle", teammate_actions=True, **OPTIONS)
    padded = 0
    for i in range(3):
        batch = sampler[i]
        assert batch.is_first is not None
        for row, (history, start) in enumerate(zip(*(values.tolist() for values in sampler.windows(i)), strict=True)):
            arrays, steps = written[history], [start]
            while len(steps) < OPTIONS["length"] and next_step(steps[-1], every) < EPISODES * LENGTH:
                steps.append(next_step(steps[-1], every))
            previous = [previous_step(start, every), *steps[:-1]]
            valid = len(steps)
            padded += valid < OPTIONS["length"]
            assert batch.attention_mask[row].tolist() == [True] * valid + [False] * (OPTIONS["length"] - valid)
            size = arrays["state"].shape[1]
            np.testing.assert_array_equal(batch.obs[row, :valid, :size], arrays["state"][steps])
            np.testing.assert_array_equal(batch.target_actions[row, :valid], arrays["oracle_actions"][steps])
            np.testing.assert_array_equal(batch.dones[row, :valid], arrays["dones"][steps])
            assert batch.is_first[row].nonzero()[0].tolist() == [0] * (start == 0)
            for name in ("actions", "rewards", "teammate_actions"):
                values = getattr(batch, f"prev_{name}")
                expected = np.where(np.array(previous) < 0, 0, arrays[name][previous])
                np.testing.assert_array_equal(values[row, :valid], expected)
                assert not values[row, valid:].any()
    assert bool(padded) == (every > 2)


def test_all_starts_of_windows_are_drawn(two_sources):
    """With `every` = 2, six episodes form two sequences of three; windows start at the first 14 steps of a sequence."""
    sampler = load_icrl4aht(two_sources[0], layout="demo_wide", split="train").ad(every=2, **OPTIONS)
    starts = np.concatenate([sampler.windows(i)[1] for i in range(40)])
    assert set(starts.tolist()) == {*range(14), *range(LENGTH, LENGTH + 14)}


def test_every_option_respects_episode_range_and_curriculum(two_sources):
    """Windows are drawn from the last four of six episodes; all windows of batch 0 start in episodes 2 and 3."""
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide", split="train")
    parts = dataset.ad(every=2, episodes=(-4, None), curriculum=Curriculum(9, (0, 0.5), (0.5, 1)), **OPTIONS)
    for i, first in ((0, 2), (9, 4), (50, 4)):
        assert set((parts.windows(i)[1] // LENGTH).tolist()) == {first, first + 1}
        assert (parts[i].attention_mask.sum(axis=1) == LENGTH).all()
