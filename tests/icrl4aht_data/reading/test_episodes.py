"""Test episodes of histories, and splitting, sampling, sorting and filtering of selections."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icrl4aht_data import Dataset, load_icrl4aht
from icrl4aht_data.errors import (
    EmptySelectionError,
    NotStoredError,
    OptionError,
    PositionError,
    PositionTypeError,
    UnknownNameError,
)


@pytest.fixture(scope="module")
def dataset(lite) -> Dataset:
    return load_icrl4aht(lite[0], obs="uint8")


@pytest.fixture(scope="module")
def two_source_dataset(two_sources) -> Dataset:
    return load_icrl4aht(two_sources[0])


class TestEpisodes:
    @pytest.mark.parametrize("name", ["actions", "rewards", "dones", "teammate_actions", "expert_actions", "state"])
    def test_episode_arrays_equal_the_written_arrays(self, lite, dataset, name):
        written = np.split(lite[1][7][name], 6)
        for episode, expected in zip(dataset.history(7).episodes, written, strict=True):
            assert len(episode) == 20
            np.testing.assert_array_equal(getattr(episode, name), expected)
            np.testing.assert_array_equal(episode[name], expected)

    def test_episode_observations_equal_those_of_the_history(self, dataset):
        for history in (dataset[8], dataset.with_options(obs="state", channels="canonical")[8]):
            episode = history.episodes[2]
            np.testing.assert_array_equal(episode.obs, history.obs[40:60], strict=True)
            np.testing.assert_array_equal(episode.episode_end_state, history.episode_end_state[2], strict=True)

    def test_episodes_are_found_by_index_and_slice(self, dataset):
        history = dataset[0]
        episodes = history.episodes
        assert len(episodes) == history.entry.episodes == 6
        assert [(one.number, one.start, one.stop) for one in episodes[-2:]] == [(4, 80, 100), (5, 100, 120)]
        assert [one.number for one in episodes[::-2]] == [5, 3, 1]
        assert episodes[-1].number == episodes[1:][-1].number == 5
        np.testing.assert_array_equal(episodes.returns(), history.returns())
        np.testing.assert_array_equal(episodes[::-2].returns(), history.returns()[::-2])
        assert [one.total_return for one in episodes] == history.returns().tolist()
        for wrong in (6, -7):
            with pytest.raises(PositionError, match=r"position .* of Episodes\(6 of .*expected a number from -6 to 5"):
                episodes[wrong]
        assert issubclass(PositionError, IndexError) and issubclass(PositionTypeError, TypeError)
        with pytest.raises(PositionTypeError, match=r"position 'a' of Episodes.*: expected an integer or a slice"):
            episodes["a"]  # type: ignore[call-overload]
        with pytest.raises(PositionError, match="expected no position, because there are no items"):
            episodes[:0][0]
        with pytest.raises(PositionError, match="position 99 of the selection's histories: expected a number from -12"):
            dataset[99]

    def test_fields_are_read_by_name(self, dataset):
        history = dataset[0]
        np.testing.assert_array_equal(history["actions"], history.actions[:])
        np.testing.assert_array_equal(history["obs"][:3], history.obs[:3])
        for holder in (history, history.episodes[0]):
            with pytest.raises(UnknownNameError, match=r"unknown field 'action'; valid: .* mean 'actions'"):
                holder["action"]
            with pytest.raises(TypeError, match="not iterable"):
                iter(holder)  # type: ignore[call-overload]


class TestAnimations:
    def test_animate_returns_a_gif_of_an_episode(self, dataset, tmp_path):
        picture = dataset[6].animate(2, cell=16)
        picture.save(tmp_path / "episode.gif")
        content = (tmp_path / "episode.gif").read_bytes()
        assert content.startswith(b"GIF89a")
        assert "data:image/gif;base64," in picture._repr_html_()
        assert picture.figure is None
        assert "Episode(2 of 6 of history 6" in repr(picture)
        with pytest.raises(OptionError, match=r"x\.png: expected a name that ends in \.gif"):
            picture.save(tmp_path / "x.png")

    @pytest.mark.parametrize("episode", [6, -7, 1.0, True])
    def test_animate_refuses_invalid_episode_numbers(self, dataset, episode):
        with pytest.raises((OptionError, PositionError), match=r"expected an integer|expected a number from -6 to 5"):
            dataset[6].animate(episode)

    def test_animate_needs_state_records(self, converted_release):
        with pytest.raises(NotStoredError, match="this release has observations only"):
            load_icrl4aht(converted_release)[0].animate()


class TestSplit:
    @pytest.mark.parametrize("by", ["teammate", "history"])
    def test_split_parts_are_disjoint_and_independent_of_order(self, two_source_dataset, by):
        train, validation = two_source_dataset.split(0.25, seed=3, by=by)
        assert sorted([*train.ids, *validation.ids]) == sorted(two_source_dataset.ids)
        shuffled = two_source_dataset.select(np.random.default_rng(0).permutation(two_source_dataset.ids))
        assert set(shuffled.split(0.25, seed=3, by=by)[1].ids) == set(validation.ids)
        others = {tuple(two_source_dataset.split(0.25, seed=seed, by=by)[1].ids) for seed in range(5)}
        assert len(others) > 1

    def test_split_by_teammate_has_no_shared_teammates(self, two_source_dataset):
        train, validation = (set(part.column("task_id")) for part in two_source_dataset.split(0.3))
        assert train and validation and not train & validation

    def test_split_by_history_keeps_every_task_in_training(self, two_source_dataset):
        train, validation = two_source_dataset.split(0.9, by="history")
        assert (
            set(validation.column("task_id"))
            <= set(train.column("task_id"))
            == set(two_source_dataset.column("task_id"))
        )

    def test_invalid_splits_raise_errors(self, two_source_dataset):
        one = two_source_dataset.filter(task_id=str(two_source_dataset.column("task_id")[0]))
        with pytest.raises(OptionError, match=r'has one teammate, so none can be held out; use by="history"'):
            one.split()
        with pytest.raises(OptionError, match=r"every task of .* has one history"):
            one[:1].split(by="history")
        for share in (0, 1, 1.5, True, "a"):
            with pytest.raises(OptionError, match=rf"validation = {share!r}: expected "):
                two_source_dataset.split(share)
        with pytest.raises(UnknownNameError, match=r"unknown split by 'task'; valid: teammate, history"):
            two_source_dataset.split(by="task")  # type: ignore[arg-type]


class TestSampleEpisodes:
    def test_sampled_episodes_are_distinct_and_depend_on_the_seed(self, dataset):
        found, again, other = (
            [(one.entry.history_id, one.number) for one in dataset.sample_episodes(30, seed=seed)] for seed in (2, 2, 3)
        )
        assert len(set(found)) == 30
        assert found == sorted(found) == again != other
        assert len(dataset.sample_episodes(72)) == 12 * 6

    def test_episodes_are_sampled_with_equal_probability(self, dataset):
        part = dataset[:2]
        counts = np.zeros((2, 6))
        for seed in range(600):
            for one in part.sample_episodes(4, seed=seed):
                counts[one.entry.history_id, one.number] += 1
        assert counts.sum() == 2400
        assert np.abs(counts - 200).max() < 60  # 60 is about five standard deviations

    @pytest.mark.parametrize(
        ("n", "message"), [(73, "the selection has 72 episodes"), (0, "at least 1"), (1.5, "integer")]
    )
    def test_invalid_sample_sizes_raise_errors(self, dataset, n, message):
        with pytest.raises(OptionError, match=f"n = {n}: .*{message}"):
            dataset.sample_episodes(n)


class TestSort:
    def test_sort_orders_histories_by_numbers_and_names(self, two_source_dataset):
        ordered = two_source_dataset.sort("return_end")
        assert (np.diff(ordered.column("return_end")) >= 0).all()
        assert (np.diff(two_source_dataset.sort("return_end", reverse=True).column("return_end")) <= 0).all()
        by_both = two_source_dataset[::-1].sort("layout", "history_id")
        pairs = sorted(zip(two_source_dataset.column("layout"), two_source_dataset.ids.tolist(), strict=True))
        assert by_both.ids.tolist() == [row for _, row in pairs]
        assert len(by_both.sort("obs_shape")) == len(two_source_dataset)

    def test_sort_keeps_the_order_of_equal_histories(self, two_source_dataset):
        for reverse in (False, True):
            assert (
                two_source_dataset.sort("action_dim", reverse=reverse).ids.tolist() == two_source_dataset.ids.tolist()
            )

    def test_sort_puts_unknown_values_last(self, two_source_dataset):
        known = np.count_nonzero(two_source_dataset.column("expert_step") != -1)
        assert known < len(two_source_dataset)
        for reverse in (False, True):
            assert (two_source_dataset.sort("expert_step", reverse=reverse).column("expert_step")[known:] == -1).all()

    def test_sort_refuses_invalid_column_names(self, two_source_dataset):
        with pytest.raises(UnknownNameError, match="unknown column 'return'"):
            two_source_dataset.sort("return")
        wrong_names: list[Any] = [(), (["layout", "return_end"],), (lambda entry: entry.T,)]
        for wrong in wrong_names:
            with pytest.raises(OptionError, match=r'index fields, such as ds.sort\("layout", "return_end"\)'):
                two_source_dataset.sort(*wrong)


class TestFilterFunctions:
    def test_filter_function_selects_histories(self, two_source_dataset):
        found = two_source_dataset.filter(lambda entry: entry.env_idx > 0, source="noise", split="train")
        whole = two_source_dataset.filter(source="noise", split="train")
        assert found.ids.tolist() == whole.ids[whole.column("env_idx") > 0].tolist()
        assert 0 < len(found) < len(whole)

    def test_filter_refuses_empty_results_and_non_functions(self, two_source_dataset):
        with pytest.raises(EmptySelectionError, match="no history of this selection passes the function"):
            two_source_dataset.filter(lambda entry: False)
        with pytest.raises(OptionError, match=r"filter: expected a function .*found 'demo_wide'"):
            two_source_dataset.filter("demo_wide")

    def test_faulty_filter_functions_raise_errors(self, two_source_dataset):
        with pytest.raises(AttributeError, match=r"property .*of 'History' object has no setter"):
            two_source_dataset[0].actions = two_source_dataset[1].actions
        with pytest.raises(AttributeError, match="layuot"):
            two_source_dataset.filter(lambda entry: entry.layuot == "demo_wide")
        with pytest.raises(OptionError, match=r"expected the function to return True or False, found str"):
            two_source_dataset.filter(lambda entry: entry.layout)
