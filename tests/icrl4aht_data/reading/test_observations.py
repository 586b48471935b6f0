"""Test releases with observations instead of state records, converted from published files without state records."""

from __future__ import annotations

import shutil
from typing import Any

import h5py
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.tasks import write_tasks
from icrl4aht_data.errors import IndexFormatError, LabelsMissingError, NotStoredError, OptionError, PublishedFormatError
from icrl4aht_data.format.schema import HISTORIES, INFO, KINDS, TASKS
from icrl4aht_data.interop import hf_episodes
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import PUBLISHED_FIELDS, from_published, to_published
from icrl4aht_data.writing.release_folder import HISTORIES_INDEX
from tests.helpers.batches import CACHES
from tests.helpers.published_files import KEPT, SHARD
from tests.helpers.random_releases import make_tasks, one_history_release, random_release, write_long_index
from tests.helpers.tampered import change_file, read_lines, tamper


class TestConversion:
    def test_converted_arrays_and_index_equal_the_published_files(self, published_folder, converted_release):
        folder, written = published_folder
        dataset = load_icrl4aht(converted_release, obs="uint8")
        assert dataset.info.kind == "observations"
        lines = read_lines(folder / HISTORIES_INDEX)
        by_stream = {history.entry.env_idx: history for history in dataset}
        for line, arrays in zip(lines, written, strict=True):
            history = by_stream[line["env_idx"]]
            entry = history.entry.to_json()
            for name in {*PUBLISHED_FIELDS} - {"history_id", "h5_group", "layout"}:
                assert entry[name] == line[name]
            assert history.entry.layout == get_layout(line["layout"]).name
            assert history.entry.episodes == arrays["dones"].sum() == line["T"] // KEPT
            for name, array in arrays.items():
                np.testing.assert_array_equal(history.read(name), array, err_msg=name)
            assert len(history.returns()) == history.entry.episodes
            np.testing.assert_array_equal(history.obs[3:7, 2], arrays["obs"][3:7, 2])
        assert load_icrl4aht(converted_release)[0].obs[:5].dtype == np.float32
        statistics = dataset.info.statistics["demo_wide"]
        assert (statistics.history_length, statistics.teammates) == ((50, 130), None)

    def test_export_then_import_returns_the_same_release(self, converted_release, tmp_path):
        to_published(load_icrl4aht(converted_release), tmp_path / "files")
        assert not (tmp_path / "files" / "tasks.jsonl").exists()
        from_published(tmp_path / "files", tmp_path / "back", kept_steps=KEPT)
        for name in (HISTORIES, TASKS, INFO, SHARD):
            assert (tmp_path / "back" / name).read_bytes() == (converted_release / name).read_bytes(), name

    @pytest.mark.parametrize("kind", KINDS)
    def test_states_cannot_be_recovered_from_observations(self, published_folder, converted_release, tmp_path, kind):
        with pytest.raises(OptionError, match=rf"has observations only, but a {kind} release needs state records"):
            to_release(load_icrl4aht(converted_release), tmp_path / "out", kind)
        missing = r"group /0: missing state, episode_end_state: .* `--to observations`"
        with pytest.raises(PublishedFormatError, match=missing):
            from_published(published_folder[0], tmp_path / "out", kind, kept_steps=KEPT)

    def test_releases_with_states_can_be_converted_to_observations(self, lite, reconverted_release, tmp_path):
        """Convert a lite release, and published files with states, to releases of observations without states."""
        to_published(load_icrl4aht(lite[0]), tmp_path / "files")
        to_release(load_icrl4aht(lite[0]), tmp_path / "one", "observations")
        assert from_published(tmp_path / "files", tmp_path / "two", "observations", kept_steps=KEPT) == "observations"
        for root in (tmp_path / "one", tmp_path / "two"):
            assert (root / SHARD).read_bytes() == (reconverted_release / SHARD).read_bytes()
        assert from_published(tmp_path / "files", tmp_path / "three", kept_steps=KEPT) == "lite"
        # files with states in only some groups are refused
        with h5py.File(tmp_path / "files" / "histories.h5", "r+") as file:
            del file["/4/state"]
        with pytest.raises(PublishedFormatError, match="group /4: missing state"):
            from_published(tmp_path / "files", tmp_path / "out", kept_steps=KEPT)


def assign_values(name: str, where: Any, value: Any):
    def assign_value(file: Any, index: list[dict]) -> None:
        array = file[name][()].astype("f4")
        array[where] = value
        replace_dataset(name, array)(file, index)

    return assign_value


def delete_dataset(name: str):
    return lambda file, index: file.pop(name)


def replace_dataset(name: str, content: Any):
    return lambda file, index: (file.pop(name), file.create_dataset(name, data=content))


def edit_index_line(number: int, **fields: Any):
    return lambda file, index: index[number].update(fields)


class TestFaultyFiles:
    @pytest.mark.parametrize(
        ("tamper", "message"),
        [
            (
                assign_values("/1/obs", (7, 1, 2, 3), 0.5),
                r"group /1: obs\[7, 1, 2, 3\]: expected an integer 0\.\.255, .* 0\.5",
            ),
            (assign_values("/0/obs", (0, 0, 0, 0), 256), r"group /0: obs\[0, 0, 0, 0\]: expected .* found 256"),
            (assign_values("/3/obs", (0, 0, 0, 0), np.nan), r"group /3: obs.* found nan"),
            (assign_values("/0/actions", 9, 6), r"group /0: actions\[9\]: expected an integer 0\.\.5, found 6"),
            (assign_values("/1/expert_actions", 2, 1.5), r"group /1: expert_actions\[2\]"),
            (
                assign_values("/2/rewards", 5, 0.25),
                r"group /2: rewards\[5\]: expected an integer -128\.\.127, found 0\.25",
            ),
            (assign_values("/2/dones", 5, 2), r"group /2: dones\[5\]: expected an integer 0\.\.1, found 2"),
            (
                assign_values("/2/dones", 5, 1),
                r"group /2: dones: expected an episode end every 20 steps, found 4 .*\[5, 19, 39\].*--kept",
            ),
            (delete_dataset("/1/obs"), r"histories\.h5, group /1: missing obs: complete the file"),
            (delete_dataset("/1/expert_actions"), r"group /1: missing expert_actions: complete the file"),
            (delete_dataset("/3"), r"group /3 is missing, but the index has a line"),
            (
                replace_dataset("/0/actions", np.zeros(9, "i4")),
                r"group /0: actions: .*expected numbers of shape \(120,\), found int32 of shape \(9,\)",
            ),
            (
                replace_dataset("/0/actions", np.array([b"x"] * 120)),
                r"group /0: actions: .*expected numbers or small arrays of numbers, found \|S1",
            ),
            # demo_simple has as many channels as coord_simple, so only deep verification finds the wrong layout name.
            (edit_index_line(2, layout="demo_simple"), None),
            (
                edit_index_line(2, split="test", layout="demo_wide"),
                r"group /2: .*expected numbers of shape \(60, 5, 5, 45\)",
            ),
            (
                edit_index_line(1, teammate_kind="other"),
                r"index\.jsonl: history 1: expected track, .* as in task 'task_a', found .*'other'",
            ),
            (edit_index_line(1, T="many"), r"index\.jsonl, line 2: Expected `int`, got `str` - at `\$\.T`"),
            (edit_index_line(3, layout="nowhere"), r"index\.jsonl, line 4: unknown layout"),
        ],
    )
    def test_faults_of_published_files_are_found(self, published_folder, tmp_path, tamper, message):
        files = shutil.copytree(published_folder[0], tmp_path / "files")
        with h5py.File(files / "histories.h5", "r+") as file:
            change_file(files / HISTORIES_INDEX, lambda lines: tamper(file, lines))
        if message is None:
            from_published(files, tmp_path / "out", kept_steps=KEPT)
            assert verify_release(tmp_path / "out").ok
            (finding,) = verify_release(tmp_path / "out", level="deep").findings
            assert "obs: 60 steps do not show demo_simple from any cell" in finding.problem
            return
        with pytest.raises(PublishedFormatError, match=message):
            from_published(files, tmp_path / "out", kept_steps=KEPT)
        assert not (tmp_path / "out").exists()

    def test_files_with_an_unexpected_episode_length_are_refused(self, published_folder, tmp_path):
        message = "group /0: dones: expected an episode end every 100 steps, found 6"
        with pytest.raises(PublishedFormatError, match=message):
            from_published(published_folder[0], tmp_path / "out")
        with pytest.raises(OptionError, match="kept_steps = 0"):
            from_published(published_folder[0], tmp_path / "out", kept_steps=0)

    def test_releases_with_states_need_complete_episodes(self, tmp_path):
        def keep_50_steps(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {name: array[: 2 if name == "episode_end_state" else 50] for name, array in arrays.items()}

        with pytest.raises(OptionError, match="expected histories with episodes of 20 steps"):
            one_history_release(tmp_path / "r", keep_50_steps)


class TestTasks:
    def test_release_without_tasks_has_only_names_of_teammates(self, converted_release):
        dataset = load_icrl4aht(converted_release)
        assert (converted_release / TASKS).read_text() == ""
        assert {entry.seed for entry in dataset.entries} == {-1}
        message = r"tasks\.jsonl is empty: .* family rl and kind some_variant .* with tasks\.jsonl"
        with pytest.raises(NotStoredError, match=message):
            dataset.recover_teammate(0)
        assert dataset.environment_parameters(0)["layout"] == "demo_wide"
        assert len(load_icrl4aht(converted_release, teammate_family="H2", task_id="task_c")) == 1

    def test_tasks_of_published_files_restore_teammates(self, lite, reconverted_release):
        one, two = load_icrl4aht(lite[0]), load_icrl4aht(reconverted_release)
        assert (reconverted_release / TASKS).read_text() == (lite[0] / TASKS).read_text()
        assert two.recover_teammate(8) == one.recover_teammate(8)
        assert [entry.seed for entry in two.entries] == [entry.seed for entry in one.entries]

    def test_incomplete_task_files_are_refused(self, published_folder, tmp_path):
        source = shutil.copytree(published_folder[0], tmp_path / "source")
        write_tasks(source / "tasks.jsonl", make_tasks(["demo_wide"]))
        message = r"tasks\.jsonl: 3 tasks of the index are missing, such as 'task_a'"
        with pytest.raises(PublishedFormatError, match=message):
            from_published(source, tmp_path / "out", kept_steps=KEPT)


class TestMissingStates:
    def test_reading_missing_states_raises_errors(self, converted_release):
        message = r'obs = "state": .* has observations only, no state records; use float32'
        with pytest.raises(OptionError, match=message):
            load_icrl4aht(converted_release, obs="state")
        dataset = load_icrl4aht(converted_release)
        for name in ("state", "episode_end_state"):
            with pytest.raises(NotStoredError, match=rf"no {name}: this release has observations only"):
                getattr(dataset[0], name)
            with pytest.raises(NotStoredError, match="full or lite release"):
                dataset[0].read(name)
        with pytest.raises(NotStoredError, match="use hf_windows"):
            hf_episodes(dataset)

    def test_reading_missing_teammate_actions_raises_errors(self, converted_release):
        dataset = load_icrl4aht(converted_release, task_id="task_c")
        with pytest.raises(LabelsMissingError, match=r"no teammate actions: .* has_teammate_actions = false"):
            dataset[0].teammate_actions  # noqa: B018
        with pytest.raises(LabelsMissingError, match="some histories have no teammate actions"):
            dataset.ad(batch_size=1, length=5, teammate_actions=True)
        for cache in CACHES:
            mixed = load_icrl4aht(converted_release, layout="demo_wide", cache=cache)
            assert mixed.ad(batch_size=9, length=5)[0].prev_teammate_actions is None

    def test_has_teammate_actions_column_is_read_from_a_large_index(self, tmp_path):
        write_long_index(tmp_path / "r")
        has = [number % 3 > 0 for number in range(3000)]
        change = {number: {"has_teammate_actions": value} for number, value in enumerate(has)}
        tamper(tmp_path / "r", HISTORIES, lambda lines: [lines[number].update(change[number]) for number in change])
        message = r"histories\.jsonl, line 1: expected has_teammate_actions true in a lite"
        with pytest.raises(IndexFormatError, match=message):
            load_icrl4aht(tmp_path / "r")
        tamper(tmp_path / "r", INFO, lambda info: info.update(kind="observations"))
        assert load_icrl4aht(tmp_path / "r").column("has_teammate_actions").tolist() == has


class TestBatches:
    @pytest.mark.parametrize("cache", CACHES)
    @pytest.mark.parametrize("order", ["contiguous", "random"])
    @pytest.mark.parametrize("options", [{}, {"episodes": (1, 3)}, {"episodes": (-1, None)}])
    def test_contexts_exclude_the_last_steps_of_episodes(
        self, converted_release, published_folder, cache, order, options
    ):
        """Contexts contain all steps except the last step of each episode, even if the episode is unfinished."""
        arrays = published_folder[1][1]  # a history of 130 steps, which are six and a half episodes
        dataset = load_icrl4aht(converted_release, obs="uint8", cache=cache).select([1])
        sampler = dataset.dpt(batch_size=40, context=15, order=order, seed=2, teammate_actions=True, **options)
        low, high = {(1, 3): (20, 60), (-1, None): (100, 130)}.get(options.get("episodes"), (0, 130))
        met = set()
        for i in range(6):
            batch, (_, queries, _, steps) = sampler[i], sampler._draw(i)
            query = queries[:, 0]
            met |= set(steps.ravel().tolist())
            assert (np.diff(steps) == np.where((steps[:, :-1] + 2) % KEPT, 1, 2)).all() or order == "random"
            np.testing.assert_array_equal(batch.query_obs, arrays["obs"][query])
            np.testing.assert_array_equal(batch.query_target, arrays["expert_actions"][query])
            np.testing.assert_array_equal(batch.context_next_obs, arrays["obs"][steps + 1])
            for name in ("obs", "actions", "rewards", "teammate_actions"):
                np.testing.assert_array_equal(getattr(batch, f"context_{name}"), arrays[name][steps])
        assert met == {t for t in range(low, high) if t % KEPT != KEPT - 1 and t != 129}

    def test_queries_are_drawn_from_every_step(self, converted_release):
        sampler = load_icrl4aht(converted_release).select([0]).dpt(batch_size=2000, context=1)
        assert set(sampler._draw(0)[1].ravel().tolist()) == set(range(120))

    def test_invalid_contexts_raise_errors(self, converted_release, tmp_path):
        # the histories have 114 and 123 transitions
        dataset = load_icrl4aht(converted_release, task_id="task_a", obs="uint8")
        assert dataset.dpt(batch_size=2, context=114)[0].context_obs.shape == (2, 114, 5, 5, 45)
        with pytest.raises(OptionError, match="context = 115: the shortest history has 114 transitions"):
            dataset.dpt(batch_size=2, context=115)
        random_release(tmp_path / "r", layouts=("cramped_up",), episodes=9, length=1)
        to_release(load_icrl4aht(tmp_path / "r"), tmp_path / "o", "observations")
        for order in ("contiguous", "random"):
            with pytest.raises(OptionError, match="the shortest history has 0 transitions"):
                load_icrl4aht(tmp_path / "o").dpt(batch_size=2, context=1, order=order)
        with pytest.raises(LabelsMissingError, match="labels = expert: 1 of 1 histories have no expert actions"):
            load_icrl4aht(converted_release, task_id="task_b").dpt(batch_size=2, context=5)

    def test_position_saved_by_a_sampler_with_other_excluded_steps_is_refused(self, lite, reconverted_release):
        roots = lite[0], reconverted_release
        one, two = (load_icrl4aht(root, layout="demo_wide").dpt(batch_size=2, context=5) for root in roots)
        with one.batches() as batches, pytest.raises(OptionError, match="excluded"):
            two.batches().load_state_dict(batches.state_dict())


def test_combine_accepts_releases_of_observations(converted_release, published_folder, reconverted_release, tmp_path):
    other = shutil.copytree(published_folder[0], tmp_path / "files")
    index = other / HISTORIES_INDEX
    index.write_text(index.read_text().replace('": "task_', '": "more_'))
    from_published(other, tmp_path / "more", kept_steps=KEPT)
    combine_releases(tmp_path / "out", [converted_release, tmp_path / "more"])
    report = verify_release(tmp_path / "out", level="deep")  # the second release is a copy with other names of tasks
    assert len(report.findings) == 4
    assert all("has the content of history" in finding.problem for finding in report.findings)
    combined = load_icrl4aht(tmp_path / "out", obs="uint8")
    assert len(combined) == 8
    assert not combined.has_tasks
    olds = [history for root in (converted_release, tmp_path / "more") for history in load_icrl4aht(root)]
    before = {(old.entry.task_id, old.entry.env_idx): old for old in olds}
    for history in combined:
        old = before[history.entry.task_id, history.entry.env_idx]
        np.testing.assert_array_equal(history.obs[:], old.obs[:])
        np.testing.assert_array_equal(history.actions[:], old.actions[:])
    with pytest.raises(OptionError, match=r"3 of 7 tasks, such as 'task_a', have only names: give complete"):
        combine_releases(tmp_path / "mixed", [reconverted_release, converted_release])
