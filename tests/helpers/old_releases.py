"""Releases of format version 2, made from those of the current version."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from icrl4aht_data.format.chunks import chunk_table_path, read_table
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import CHUNK_DTYPES, HISTORIES, INFO
from icrl4aht_data.writing.shard_writer import metadata_lines

NEW_FIELDS = ("source", "expert_return", "expert_return_sampled", "expert_step")
"""The fields of an index line that version 2 does not have."""


def as_version_2(root: Path) -> Path:
    """Rewrite a release folder in format version 2.

    The bytes are those that the package wrote when version 2 was current: chunk tables without hashes, an index without
    `NEW_FIELDS`, and 2 as `format_version` in meta/info.json and in every shard.
    """
    for shard in read_info(root).shards:
        with h5py.File(root / shard, "r+") as file:
            file.attrs.modify("format_version", 2)
        table = np.array(read_table(chunk_table_path(root, shard)))
        chunks = table[table["rows"] > 0]
        table = np.concatenate([chunks, metadata_lines((root / shard).read_bytes(), chunks)])
        old = np.zeros(len(table), CHUNK_DTYPES[2])
        for name in old.dtype.names or ():
            old[name] = table[name]
        np.save(chunk_table_path(root, shard), old, allow_pickle=False)
    lines = [json.loads(line) for line in (root / HISTORIES).read_text().splitlines()]
    kept = [{name: value for name, value in line.items() if name not in NEW_FIELDS} for line in lines]
    (root / HISTORIES).write_text("".join(json.dumps(line) + "\n" for line in kept))
    info = (root / INFO).read_text()
    (root / INFO).write_text(info.replace('"format_version": 3', '"format_version": 2'))
    write_manifest(root)
    return root
