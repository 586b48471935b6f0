"""Writes one HDF5 shard, chunk by chunk, with its chunk table."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.chunks import BETWEEN, DEFLATE_LEVEL, chunk_locations, chunk_table_path, encode_chunk
from icrl4aht_data.format.schema import CHUNK_DTYPE, FORMAT_VERSION, Entry, Field, Kind
from icrl4aht_data.overcooked.layouts import Layout, get_layout

if TYPE_CHECKING:
    import h5py

_Arrays = Mapping[str, np.ndarray]

_BLOCK = 2000  # steps: a chunk of scalars, two of records


def write_shard(root: Path, shard: str, kind: Kind, entries: Sequence[Entry], histories: Iterable[_Arrays]) -> None:
    """Write a shard and its chunk table into a folder that no reader has seen yet.

    Args:
        root: the release folder.
        shard: path below it, as in every entry.
        kind: of the release.
        entries: the histories' index entries; `h5_group` and `h5_row` say where each one goes.
        histories: for each entry, field name -> array in the field's dtype.

    Raises:
        OptionError: if a value does not survive the stored dtype, or an array has not the entry's length.
    """
    import h5py

    path, table_path = root / shard, chunk_table_path(root, shard)
    path.parent.mkdir(parents=True, exist_ok=True)
    table_path.parent.mkdir(parents=True, exist_ok=True)
    layout = get_layout(entries[0].layout)
    checksums: list[int] = []
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["layout"] = layout.name
        for group in dict.fromkeys(entry.h5_group for entry in entries):
            _create_datasets(file, layout, kind, [entry for entry in entries if entry.h5_group == group])
        for entry, arrays in zip(entries, histories, strict=True):
            checksums += _write_history(file[entry.h5_group], layout, kind, entry, arrays)
    with h5py.File(path, "r") as file:
        table = np.zeros(len(checksums), CHUNK_DTYPE)
        table["crc32"] = checksums
        places = [place for entry in entries for place in chunk_locations(file, kind, entry)]
        table["offset"], table["size"], table["rows"] = np.array(places, np.uint64).T
    np.save(table_path, np.concatenate([table, _between(path, table)]), allow_pickle=False)


def _between(path: Path, chunks: np.ndarray) -> np.ndarray:
    """Lines for what lies between a shard's chunks."""
    ordered = np.sort(chunks, order="offset")
    starts = [*ordered["offset"].tolist(), path.stat().st_size]
    stops = [0, *(ordered["offset"] + ordered["size"]).tolist()]
    lines = []
    with path.open("rb") as stream:
        for stop, start in zip(stops, starts, strict=True):
            for low in range(stop, start, BETWEEN):
                stream.seek(low)
                data = stream.read(min(BETWEEN, start - low))
                lines.append((low, len(data), 0, zlib.crc32(data)))
    return np.array(lines, CHUNK_DTYPE)


def _create_datasets(file: h5py.File, layout: Layout, kind: Kind, entries: Sequence[Entry]) -> None:
    """The empty datasets of a group: (T,) for one history, (histories, T) for stacked ones."""
    first = entries[0]
    group = file.create_group(first.h5_group)
    for field in first.stored_fields(kind):
        rows = first.rows(field)
        chunk = min(field.chunk, rows)
        stacked = first.h5_row is not None
        element = field.element(layout, kind)
        group.create_dataset(
            field.name,
            shape=(len(entries), rows) if stacked else (rows,),
            chunks=(1, chunk) if stacked else (chunk,),
            dtype=element,
            shuffle=element.itemsize > 1,
            compression="gzip",
            compression_opts=DEFLATE_LEVEL,
        )


def _write_history(group: Any, layout: Layout, kind: Kind, entry: Entry, arrays: _Arrays) -> list[int]:
    """Write every chunk of a history, by time; their checksums, in table order."""
    encoded = list(_encoded(layout, kind, entry, arrays))
    for field, start, data in sorted(encoded, key=lambda part: in_time(*part[:2])):
        place = (start,) if entry.h5_row is None else (entry.h5_row, start)
        group[field.name].id.write_direct_chunk(place, data)
    return [zlib.crc32(data) for _, _, data in encoded]


def in_time(field: Field, start: int) -> tuple[int, ...]:
    """Sorts the chunks of a history as they stand in the file: what a window needs in one range of bytes.

    That is by block of `_BLOCK` steps, and in a block the first records, what every window needs of scalars, the other
    records, labels, observations.
    """
    if field.axis == "E":
        return (1,)
    order = ("actions", "rewards", "dones", "state", "teammate_actions", "expert_actions", "obs")
    leads = field.name == "state" and start % _BLOCK == 0
    return (0, start // _BLOCK, -1 if leads else order.index(field.name), start)


def stored_bytes(kind: Kind, entry: Entry, arrays: _Arrays) -> int:
    """What the chunks of a history take in a shard."""
    return sum(len(data) for _, _, data in _encoded(get_layout(entry.layout), kind, entry, arrays))


def _encoded(layout: Layout, kind: Kind, entry: Entry, arrays: _Arrays) -> Iterator[tuple[Field, int, bytes]]:
    """Every chunk of a history as (field, first row, bytes), in table order."""
    for field in entry.stored_fields(kind):
        element = field.element(layout, kind)
        stored = _as_stored(field, element, arrays[field.name], entry)
        step = min(field.chunk, len(stored))
        for start in range(0, len(stored), step):
            yield field, start, encode_chunk(stored[start : start + step], step, element.itemsize)


def _as_stored(field: Field, element: np.dtype, array: np.ndarray, entry: Entry) -> np.ndarray:
    if len(array) != entry.rows(field):
        raise OptionError(
            f"history {entry.history_id}: field {field.name} has {len(array)} rows, expected {entry.rows(field)}"
        )
    stored = np.ascontiguousarray(array, element.base)
    if not np.array_equal(stored, array):
        raise OptionError(f"history {entry.history_id}: field {field.name} has values that {element.base} cannot hold")
    return stored
