"""Batches whose rows are changed at random: the batch says how, and its actions are those of the changed view."""

from __future__ import annotations

from math import factorial

import numpy as np
from icrl4aht_baselines.methods.view_change import MIRRORINGS, mirrored_action
from icrl4aht_baselines.training.layout_numbers import number_layouts

from icrl4aht_data import load_icrl4aht


def test_changed_rows():
    dataset = load_icrl4aht(layout=["asymm_both", "demo_wide"], split="train", obs="state", channels="canonical")
    layouts = [*reversed(dataset.layouts)]
    sampler = dataset.ad(batch_size=64, length=40, seed=3, labels="expert", teammate_actions=True)
    plain = number_layouts(sampler, layouts).batch(5)
    for mirror, rename in ((True, False), (False, True), (True, True)):
        changed = number_layouts(sampler, layouts, mirror, rename).batch(5)
        number, change = changed.layouts % len(layouts), changed.layouts // len(layouts)
        mirroring, naming = change % MIRRORINGS, change // MIRRORINGS
        np.testing.assert_array_equal(number, plain.layouts)
        np.testing.assert_array_equal(changed.obs, plain.obs)  # of the state: the view changes them
        assert set(mirroring) == ({0, 1, 2, 3} if mirror else {0})
        for row, layout in enumerate(
            [layouts[one] for one in number]
        ):  # namings of the ingredients that the layout has
            assert naming[row] < (factorial(layout.ingredient_types) if rename else 1)
        assert not rename or len(set(naming)) > 6  # demo_wide has four ingredients
        np.testing.assert_array_equal(changed.target_actions, mirrored_action(plain.target_actions, mirroring))
        was_first = plain.is_first | ~plain.attention_mask
        np.testing.assert_array_equal(changed.prev_actions[was_first], 0)
        np.testing.assert_array_equal(
            changed.prev_teammate_actions[~was_first],
            mirrored_action(plain.prev_teammate_actions, mirroring)[~was_first],
        )
        again = number_layouts(sampler, layouts, mirror, rename).batch(5)
        np.testing.assert_array_equal(again.layouts, changed.layouts)
