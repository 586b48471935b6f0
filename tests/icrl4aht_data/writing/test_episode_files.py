"""Test episodes as Parquet files: `datasets` streams typed rows, and observations are rendered from rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow.parquet as pq
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import NotStoredError, OptionError, UnknownNameError
from icrl4aht_data.format.schema import ACTION_FIELDS
from icrl4aht_data.interop import hf_episodes, render_observations
from icrl4aht_data.publishing.build import build_release
from icrl4aht_data.reading.episodes import Episode
from icrl4aht_data.reading.history import History
from icrl4aht_data.writing import parquet
from icrl4aht_data.writing.parquet import write_episodes

STEPS, WIDTH = 20, 24
"""Steps of an episode of `two_sources`, and bytes of the longest state record of its layouts."""


@pytest.fixture(scope="module")
def built_release(two_sources, tmp_path_factory) -> Path:
    """Return the release `two_sources`, built for publication (read-only)."""
    return build_release(two_sources[0], tmp_path_factory.mktemp("built") / "release")


@pytest.fixture
def dataset(built_release) -> Dataset:
    return load_icrl4aht(built_release)


def stream_episodes(built_release: Path, split: str) -> Any:
    return datasets.load_dataset(str(built_release), "episodes", split=split, streaming=True)


def episodes_in_file_order(dataset: Dataset, split: str) -> list[tuple[History, Episode]]:
    """Return all episodes of a split, each with its history, sorted by layout name like the episode files."""
    layouts = sorted(layout.name for layout in dataset.filter(split=split).layouts)
    parts = [dataset.filter(split=split, layout=name) for name in layouts]
    return [(history, episode) for part in parts for history in part for episode in history.episodes]


@pytest.mark.parametrize("split", ["train", "validation"])
def test_streamed_rows_equal_the_episodes(built_release, dataset, split):
    for row, (history, episode) in zip(
        stream_episodes(built_release, split), episodes_in_file_order(dataset, split), strict=True
    ):
        entry = history.entry
        names = ("history_id", "task_id", "track", "split", "layout", "teammate_family", "teammate_kind", "source")
        assert [row[name] for name in (*names, "learner")] == [getattr(entry, name) for name in (*names, "learner")]
        assert (row["episode"], row["return"]) == (episode.number, episode.total_return)
        for name in ("rewards", *ACTION_FIELDS):
            np.testing.assert_array_equal(row[name], episode[name])
        for name in ("state", "episode_end_state"):
            records = np.array(row[name], np.uint8)
            size = episode[name].shape[-1]
            np.testing.assert_array_equal(records[..., :size], episode[name])
            assert records.shape[-1] == WIDTH and not records[..., size:].any()


@pytest.mark.parametrize("obs", ["float32", "uint8"])
@pytest.mark.parametrize("channels", ["own", "canonical"])
def test_rendered_observations_equal_those_of_the_histories(built_release, dataset, channels, obs):
    """Render one episode from a row of Python lists, and all episodes of a layout from a batch of arrays."""
    opened = dataset.filter(split="train").with_options(obs=obs, channels=channels)
    for layout in opened.layouts:
        expected = [episode.obs for history in opened.filter(layout=layout.name) for episode in history.episodes]
        rows = stream_episodes(built_release, "train").filter(lambda row, name=layout.name: row["layout"] == name)
        for seen, row in zip(expected, rows, strict=True):
            found = render_observations(row, channels=channels, obs=obs)
            assert found.dtype == obs
            np.testing.assert_array_equal(found, seen)
        (batch,) = rows.with_format("numpy").batch(1000)
        np.testing.assert_array_equal(render_observations(batch, channels=channels, obs=obs), expected)


def test_rows_of_several_layouts_need_canonical_channels(built_release, dataset):
    by_layout = {row["layout"]: row for row in stream_episodes(built_release, "train")}
    assert len(by_layout) > 1
    rows = list(by_layout.values())
    assert render_observations(rows, channels="canonical").shape == (len(rows), STEPS, 5, 5, 46)
    with pytest.raises(OptionError, match=r'expected one shape, found .*: give .* use channels="canonical"'):
        render_observations(rows)


def test_invalid_rows_raise_errors(built_release):
    row = next(iter(stream_episodes(built_release, "train")))
    wrong: list[tuple[type[Exception], str, Any, dict[str, Any]]] = [
        (UnknownNameError, "unknown channels", row, {"channels": "all"}),
        (OptionError, "found none: give at least one row", [], {}),
        (
            OptionError,
            r"state: expected .* S at least \d+, found \(1, 20, 3\)",
            row | {"state": np.zeros((20, 3))},
            {},
        ),
        (NotStoredError, "without a column 'state'.* use hf_windows", {"layout": "demo_wide"}, {}),
    ]
    for kind, message, rows, options in wrong:
        with pytest.raises(kind, match=message):
            render_observations(rows, **options)


def test_hf_episodes_have_the_same_rows_as_streamed_files(built_release, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path)
    rows: Any = hf_episodes(dataset.filter(split="validation"))
    streamed = stream_episodes(built_release, "validation")
    assert rows.features == streamed.features
    by_episode = {(row["history_id"], row["episode"]): row for row in streamed}
    assert len(by_episode) == len(rows)
    assert all(row == by_episode[row["history_id"], row["episode"]] for row in list(rows))


def test_histories_are_divided_among_files_and_row_groups(dataset, tmp_path, monkeypatch):
    """Files and row groups contain complete histories in order."""
    monkeypatch.setattr(parquet, "ROW_GROUP", 12)
    part, done = dataset.filter(split="train", layout="demo_wide"), []
    write_episodes(part, tmp_path, file_episodes=30, advance=lambda *numbers: done.append(numbers))
    paths = sorted(tmp_path.glob("demo_wide/*"))
    count = len(paths)
    assert count > 1
    assert [path.name for path in paths] == [f"train-{n:05}-of-{count:05}.parquet" for n in range(count)]
    found = [pq.read_table(path, columns=["history_id", "episode"]).to_pydict() for path in paths]
    expected = [(int(i), e) for i, n in zip(part.ids, part.column("episodes"), strict=True) for e in range(n)]
    assert [pair for table in found for pair in zip(*table.values(), strict=True)] == expected
    metadata = [pq.ParquetFile(path).metadata for path in paths]
    sizes = [group.row_group(n).num_rows for group in metadata for n in range(group.num_row_groups)]
    assert max(sizes) < 12 + max(part.column("episodes")) and len(sizes) > count
    assert done[-1] == (len(part), len(part))
