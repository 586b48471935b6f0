"""Test canonical channels in batches and histories, for all kinds of releases, caches and loaders."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.channels import CANONICAL_CHANNELS, channel_names
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import record_size
from tests.helpers.batches import CACHES, assert_equal_batches

LAYOUTS = ["coord_simple", "demo_wide"]
"""The layouts of `lite`, `full` and `reconverted_release`: 40 and 45 channels."""
RELEASES = ["lite", "full", "reconverted_release"]


@pytest.fixture(params=RELEASES)
def root(request):
    """Return a release with state records, with state records and observations, or with observations only."""
    made = request.getfixturevalue(request.param)
    return made if request.param == "reconverted_release" else made[0]


def load_canonical(root, **options) -> Any:
    return load_icrl4aht(root, layout=LAYOUTS, channels="canonical", **{"obs": "uint8", "threads": 2} | options)


def test_canonical_histories_have_stored_channels_and_zeros_elsewhere(root):
    dataset = load_canonical(root)
    own = dataset.with_options(channels="own")
    for number in (0, len(dataset) - 1):
        one, two = dataset[number], own[number]
        names = channel_names(get_layout(two.entry.layout))
        assert (one.obs.shape, one.obs.dtype) == ((120, 5, 5, 46), np.uint8)
        assert one.obs[:].any()
        for place, name in enumerate(CANONICAL_CHANNELS):
            expected = two.obs[..., names.index(name)] if name in names else np.zeros((120, 5, 5))
            np.testing.assert_array_equal(one.obs[..., place], expected, err_msg=name)
        np.testing.assert_array_equal(one.obs[7:9], one.obs[:][7:9])
        assert one.entry.obs_shape == two.obs.shape[1:], "the index has the shape of the own channels"
        np.testing.assert_array_equal(one.read("obs", 3, 5), two.obs[3:5], err_msg="fields are read as stored")
    shown = load_canonical(root, obs="float32")[0].obs
    assert (shown.shape[1:], shown.dtype, shown[3:5].dtype) == ((5, 5, 46), np.float32, np.float32)


def ad_and_dpt_samplers(dataset):
    return [
        dataset.ad(batch_size=8, length=50, seed=3),
        dataset.ad(batch_size=6, length=130, seed=3),  # windows longer than the histories of 120 steps
        dataset.dpt(batch_size=8, context=17, seed=3),
        dataset.dpt(batch_size=8, context=17, seed=3, order="random"),
    ]


def render_canonical(records, layouts):
    """Return canonical observations of state records of shape (B, ..., S); `records[i]` is on `LAYOUTS[layouts[i]]`."""
    views = []
    for row, number in zip(records, layouts, strict=True):
        layout = get_layout(LAYOUTS[number])
        views.append(observe(layout, row[..., : record_size(layout)], 0, canonical=True))
    return np.stack(views)


@pytest.mark.parametrize("cache", CACHES)
def test_batches_equal_rendered_state_records(lite, cache):
    rows = set()
    states = load_canonical(lite[0], obs="state", cache="ram")
    assert [layout.name for layout in states.layouts] == LAYOUTS
    for obs in ("uint8", "float32"):
        dataset = load_canonical(lite[0], obs=obs, cache=cache)
        for sampler, records in zip(ad_and_dpt_samplers(dataset), ad_and_dpt_samplers(states), strict=True):
            batch, stored = sampler[2], records[2]
            assert {name: (str(a.dtype), a.shape) for name, a in batch._asdict().items() if a is not None} == (
                sampler.specs
            )
            assert stored.layouts is not None
            rows |= set(stored.layouts.tolist())
            for name in (name for name in batch._fields if name.endswith("obs")):
                shown = getattr(batch, name)
                assert shown.dtype == obs
                expected = render_canonical(getattr(stored, name), stored.layouts)
                if name == "obs":
                    expected[~stored.attention_mask] = 0
                np.testing.assert_array_equal(shown, expected)
            assert_equal_batches(
                batch._replace(layouts=stored.layouts, **{n: None for n in batch._fields if n.endswith("obs")}),
                stored._replace(**{n: None for n in batch._fields if n.endswith("obs")}),
            )
    assert rows == {0, 1}, "both layouts in the batches"


@pytest.mark.parametrize("cache", CACHES)
@pytest.mark.parametrize("obs", ["uint8", "float32"])
def test_stored_observations_are_mapped_to_canonical_channels(lite, reconverted_release, cache, obs):
    original, stored = load_canonical(lite[0], obs=obs), load_canonical(reconverted_release, obs=obs, cache=cache)
    assert not stored.has_states
    for length in (1, 40, 130):
        options = {"batch_size": 8, "length": length, "seed": 5}
        assert_equal_batches(original.ad(**options)[3], stored.ad(**options)[3])
    one = stored.filter(layout="demo_wide")
    own = one.with_options(channels="own")
    for order in ("contiguous", "random"):
        batch, plain = (dataset.dpt(batch_size=5, context=9, order=order)[1] for dataset in (one, own))
        places = [CANONICAL_CHANNELS.index(name) for name in channel_names(get_layout("demo_wide"))]
        for name in ("query_obs", "context_obs", "context_next_obs"):
            assert getattr(batch, name).sum() == getattr(plain, name).sum() > 0
            np.testing.assert_array_equal(getattr(batch, name)[..., places], getattr(plain, name))
    mixed = stored.dpt(batch_size=32, context=9)[0]
    assert mixed.context_obs.shape == (32, 9, 5, 5, 46)
    assert {"delivery"}.isdisjoint(np.array(CANONICAL_CHANNELS)[mixed.context_obs.any(axis=(0, 1, 2, 3))])


def test_selections_keep_the_channels_option(root):
    dataset = load_canonical(root)
    assert (dataset.channels, dataset.obs_shape) == ("canonical", (5, 5, 46))
    assert "obs uint8 with canonical channels;" in repr(dataset)
    for part in (dataset.filter(layout="demo_wide"), dataset[:2], pickle.loads(pickle.dumps(dataset))):
        assert (part.channels, part.obs_shape) == ("canonical", (5, 5, 46))
    own = dataset.with_options(channels="own")
    assert own.channels == load_icrl4aht(root).channels == "own"
    assert "canonical" not in repr(own)
    assert own.filter(layout="demo_wide").obs_shape == (5, 5, 45)
    message = (
        r"has layouts coord_simple, demo_wide, and their observations have different shapes \(\(5, 5, 40\), "
        r'\(5, 5, 45\)\): choose channels="canonical", .* or one layout: layout=\'coord_simple\''
    )
    for make in (lambda: own.obs_shape, lambda: own.ad(batch_size=2, length=5), lambda: ad_and_dpt_samplers(own)):
        with pytest.raises(OptionError, match=message):
            make()
    with pytest.raises(UnknownNameError, match=r"unknown channels 'canonic'; valid: own, canonical\..*'canonical'"):
        load_icrl4aht(root, channels="canonic")  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="unknown channels 46"):
        own.with_options(channels=46)  # type: ignore[arg-type]
