"""Batches whose rows are mirrored at random: the batch says how, and its actions are those of the mirrored view."""

from __future__ import annotations

import numpy as np
from icrl4aht_baselines.methods.view_change import mirrored_action
from icrl4aht_baselines.training.layout_numbers import number_layouts

from icrl4aht_data import load_icrl4aht


def test_mirrored_rows():
    dataset = load_icrl4aht(layout=["asymm_both", "demo_wide"], split="train", obs="state", channels="canonical")
    layouts = [*reversed(dataset.layouts)]
    sampler = dataset.ad(batch_size=64, length=40, seed=3, labels="expert", teammate_actions=True)
    plain, mirrored = (number_layouts(sampler, layouts, mirror).batch(5) for mirror in (False, True))
    mirroring, number = np.divmod(mirrored.layouts, len(layouts))
    np.testing.assert_array_equal(number, plain.layouts)
    assert set(mirroring) == {0, 1, 2, 3}
    np.testing.assert_array_equal(mirrored.obs, plain.obs)  # of the state: the view mirrors them
    np.testing.assert_array_equal(mirrored.target_actions, mirrored_action(plain.target_actions, mirroring))
    first = plain.is_first | ~plain.attention_mask
    np.testing.assert_array_equal(mirrored.prev_actions[first], 0)
    np.testing.assert_array_equal(
        mirrored.prev_teammate_actions[~first], mirrored_action(plain.prev_teammate_actions, mirroring)[~first]
    )
    again = number_layouts(sampler, layouts, True).batch(5)
    np.testing.assert_array_equal(again.layouts, mirrored.layouts)
