"""Test expert and oracle labels in all caches and loaders, and errors for missing labels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import LabelsMissingError, WeakLabelsWarning
from icrl4aht_data.format.schema import HISTORIES, PROVENANCE
from icrl4aht_data.interop import hf_episodes
from icrl4aht_data.reading.history import LABELS
from icrl4aht_data.writing.convert import to_release
from tests.helpers.batches import CACHES, assert_equal_batches
from tests.helpers.two_sources import two_source_release

OPTIONS: dict[str, Any] = {"batch_size": 16, "context": 9, "seed": 4}


def expected_targets(written, sampler, i: int) -> np.ndarray:
    """Return the expert or oracle actions at the query steps of batch i."""
    query, steps, *_ = sampler._draw(i)
    ids = sampler.dataset.ids[query].tolist()
    return np.array([written[k][f"{sampler.labels}_actions"][t] for k, (t,) in zip(ids, steps, strict=True)])


@pytest.mark.parametrize("order", ["contiguous", "random"])
@pytest.mark.parametrize("labels", LABELS)
@pytest.mark.parametrize("cache", CACHES)
def test_targets_equal_the_labels_of_the_query_steps(two_sources, cache, labels, order):
    """Use two layouts, because caches store each layout in separate arrays."""
    root, written = two_sources
    dataset = load_icrl4aht(root, cache=cache, channels="canonical", obs="uint8")
    sampler = dataset.dpt(labels=labels, order=order, **OPTIONS)
    for i in range(3):
        np.testing.assert_array_equal(sampler[i].query_target, expected_targets(written, sampler, i))


@pytest.mark.parametrize("labels", LABELS)
@pytest.mark.parametrize("cache", CACHES)
def test_labels_option_changes_only_the_targets(two_sources, cache, labels):
    root, written = two_sources
    dataset = load_icrl4aht(root, cache=cache, channels="canonical", obs="uint8")
    options: dict[str, Any] = {"batch_size": 16, "length": 50, "seed": 4, "episodes": (-2, None)}
    plain, labelled = dataset.ad(**options), dataset.ad(labels=labels, **options)
    taken, batch = plain[1], labelled[1]
    assert_equal_batches(taken, batch._replace(target_actions=taken.target_actions))
    ids, starts = labelled.windows(1)
    assert not batch.attention_mask.all()
    for row, (history, start) in enumerate(zip(ids.tolist(), starts.tolist(), strict=True)):
        valid = int(batch.attention_mask[row].sum())
        expected = written[history][f"{labels}_actions"][start : start + valid]
        np.testing.assert_array_equal(batch.target_actions[row, :valid], expected)
    assert not batch.target_actions[~batch.attention_mask].any()
    assert (batch.target_actions != taken.target_actions).any()


@pytest.fixture(scope="module")
def release_without_noise_oracle(tmp_path_factory):
    """Return the release `two_sources` with noise histories stored without oracle actions (read-only)."""
    root = tmp_path_factory.mktemp("releases") / "smaller"
    two_source_release(root, oracle=("ppo",))
    return root


class TestNoiseWithoutOracleActions:
    """The expert of a noise history is the oracle, so oracle actions need not be stored."""

    @pytest.mark.parametrize("cache", CACHES)
    @pytest.mark.parametrize("filters", [{}, {"source": "noise"}])
    def test_batches_equal_those_with_stored_oracle_actions(
        self, two_sources, release_without_noise_oracle, cache, filters
    ):
        options: dict[str, Any] = {"layout": "demo_wide", "cache": cache} | filters
        one, other = (load_icrl4aht(root, **options) for root in (two_sources[0], release_without_noise_oracle))
        assert_equal_batches(one.dpt(labels="oracle", **OPTIONS)[0], other.dpt(labels="oracle", **OPTIONS)[0])

    def test_oracle_labels_are_counted_and_read_from_expert_actions(self, two_sources, release_without_noise_oracle):
        dataset = load_icrl4aht(release_without_noise_oracle, source="noise")
        assert not dataset.column("has_oracle_actions").any()
        assert dataset.counts("labels") == {"expert": 24, "oracle": 24}
        assert dataset.has_labels("oracle").all()
        history, actions = dataset[0], two_sources[1][int(dataset.ids[0])]["oracle_actions"]
        np.testing.assert_array_equal(history.oracle_actions, actions)
        np.testing.assert_array_equal(history.read("oracle_actions", 5, 9), actions[5:9])
        rows: Any = hf_episodes(dataset[:1])
        np.testing.assert_array_equal(np.concatenate([row["oracle_actions"] for row in rows]), actions)

    def test_verification_and_conversion_accept_missing_oracle_actions(self, release_without_noise_oracle, tmp_path):
        to_release(load_icrl4aht(release_without_noise_oracle), tmp_path / "full", "full")
        assert verify_release(tmp_path / "full", level="deep").ok
        to_release(load_icrl4aht(tmp_path / "full"), tmp_path / "lite", "lite")
        for name in (HISTORIES, PROVENANCE):
            assert (tmp_path / "lite" / name).read_bytes() == (release_without_noise_oracle / name).read_bytes()


class TestMissingLabels:
    def test_labels_missing_in_all_histories_raise_error(self, lite):
        dataset = load_icrl4aht(lite[0], layout="demo_wide")
        with pytest.raises(
            LabelsMissingError,
            match=r": labels = oracle: 6 of 6 histories have no oracle actions, in 2 tasks \(first: history 6 of "
            r"task teammate_\S*\); 6 have expert actions, 0 have oracle actions: use labels that all histories "
            r"have, or ",
        ):
            dataset.dpt(labels="oracle", **OPTIONS)
        with pytest.raises(LabelsMissingError, match=r"history 6 .* has no oracle actions"):
            _ = dataset[0].oracle_actions

    def test_labels_missing_in_some_histories_raise_error(self, two_sources, monkeypatch):
        dataset = load_icrl4aht(two_sources[0], layout="demo_wide")
        column = type(dataset).column

        def column_with_oracle_only_for_noise(self, name):
            return column(self, "source") == "noise" if name == "has_oracle_actions" else column(self, name)

        monkeypatch.setattr(type(dataset), "column", column_with_oracle_only_for_noise)
        with pytest.raises(LabelsMissingError, match=r"8 of 20 .*, 12 have oracle actions: .*has_labels\('oracle'"):
            dataset.dpt(labels="oracle", **OPTIONS)


def test_weak_oracle_labels_cause_a_warning(two_sources, monkeypatch):
    """The oracle's return is 5 in each task, and every history is given a final return of 11."""
    dataset = load_icrl4aht(two_sources[0], layout="demo_wide", source="ppo")
    column = type(dataset).column

    def column_with_high_returns(self, name):
        return np.full(len(self), 11.0) if name == "return_end" else column(self, name)

    monkeypatch.setattr(type(dataset), "column", column_with_high_returns)
    with pytest.warns(WeakLabelsWarning, match=r"of 2 of 2 tasks come from the oracle, .*labels 5\.0, histories 11"):
        dataset.dpt(labels="oracle", **OPTIONS)
    with pytest.warns(WeakLabelsWarning, match="of 2 of 2 tasks come from the oracle"):
        dataset.ad(labels="oracle", batch_size=2, length=9)
