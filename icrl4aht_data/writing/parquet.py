"""Writing of Parquet files: the index, one row per history, and the episodes, one row per episode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import OptionError
from icrl4aht_data.reading.arrow_tables import episode_schema, episode_table, import_pyarrow, index_schema
from icrl4aht_data.utils.files import atomic_write, check_output, explain_full_disk
from icrl4aht_data.writing.release_folder import as_path

if TYPE_CHECKING:
    import pyarrow as pa

ROW_GROUP = 2000
"""Minimum number of episodes in a row group, which takes about 10 MB of memory."""

FILE_EPISODES = 500_000
"""Number of episodes after which a new file starts; such a file has about 100 MB."""


def to_parquet(dataset: Dataset, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write a selection's index as a Parquet file, one row per history; this needs pyarrow (extra `hf`).

    Args:
        dataset: a release, or a selection of its histories.
        path: path of the file to write, which ends in .parquet.
        overwrite: whether to replace a Parquet file at `path`.

    Raises:
        OptionError: if pyarrow is not installed, or if `path` has another suffix, is inside the release, or may not be
            written, see `utils.files.check_output`.
    """
    arrow, path = import_pyarrow(), as_path(path)
    import pyarrow.parquet as pq

    if path.suffix != ".parquet":
        raise OptionError(f"{path}: expected a name that ends in .parquet; give such a name")
    check_output(path, overwrite)
    if path.resolve().is_relative_to(dataset.root.resolve()):
        raise OptionError(f"{path} is inside the release {dataset.root}; give a path outside of it")
    schema = index_schema().with_metadata({"icrl4aht-data": "index"})
    rows = arrow.Table.from_pylist([entry.to_row() for entry in dataset.entries], schema)
    with explain_full_disk(path), atomic_write(path) as partial, partial.open("wb") as stream:
        pq.write_table(rows, stream)  # given a path, pyarrow would leave the file open after an error
    return path


def write_episodes(
    dataset: Dataset,
    folder: Path,
    *,
    file_episodes: int = FILE_EPISODES,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write Parquet files `<layout>/<split>-00000-of-00001.parquet` with one row per episode.

    Only one history and one row group are in memory at a time. All episodes of a history are in one file, in order. The
    columns are `arrow_tables.EPISODE_COLUMNS`; state records are padded to the longest record of the selection.

    Args:
        dataset: a release with state records, or a selection of its histories.
        folder: the folder in which to create one folder per layout.
        file_episodes: number of episodes after which a new file starts.
        advance: function called with the number of written histories and the number of all histories.

    Raises:
        OptionError: if pyarrow is not installed.
    """
    schema = episode_schema(dataset)
    done = 0
    for layout, split in dict.fromkeys((entry.layout, entry.split) for entry in dataset.entries):
        part = dataset.filter(layout=layout, split=split)
        before = np.cumsum(part.column("episodes")) - part.column("episodes")
        _, number = np.unique(before // file_episodes, return_inverse=True)
        files = int(number[-1]) + 1
        (folder / layout).mkdir(parents=True, exist_ok=True)
        for file in range(files):
            chosen = part.select(number == file)
            path = folder / layout / f"{split}-{file:05}-of-{files:05}.parquet"
            for written in _write_row_groups(chosen, path, schema):
                done += written
                advance(done, len(dataset))


def _write_row_groups(part: Dataset, path: Path, schema: pa.Schema) -> Iterator[int]:
    """Write one Parquet file of episodes; after each row group, yield the number of histories in the row group."""
    arrow = import_pyarrow()
    import pyarrow.parquet as pq

    group = (np.cumsum(part.column("episodes")) - 1) // ROW_GROUP
    with path.open("wb") as stream, pq.ParquetWriter(stream, schema, compression="zstd", compression_level=9) as file:
        for number in np.unique(group):
            members = part.select(group == number)
            file.write_table(arrow.concat_tables([episode_table(history, schema) for history in members]))
            yield len(members)
