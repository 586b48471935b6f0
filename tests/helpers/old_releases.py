"""Releases of format versions 2 and 3, made from those of the current version."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from icrl4aht_data.format.chunks import chunk_table_path, read_table
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import CHUNK_DTYPES, FORMAT_VERSION, HISTORIES, INFO
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.writing.shard_writer import metadata_lines

NEW_FIELDS: dict[int, tuple[str, ...]] = {
    2: ("source", "expert_return", "expert_return_sampled", "expert_step", "learner", "has_oracle_actions"),
    3: ("learner", "has_oracle_actions"),
}
"""Format version -> fields of an index line that it does not have."""


def as_version(root: Path, version: int) -> Path:
    """Rewrite a release folder, whose histories have no oracle actions, in format version 2 or 3.

    The bytes are those that the package wrote when the version was current: chunk tables of that version, an index
    without `NEW_FIELDS`, and the version in meta/info.json and in every shard.
    """
    for shard in read_info(root).shards:
        with h5py.File(root / shard, "r+") as file:
            file.attrs.modify("format_version", version)
        table = np.array(read_table(chunk_table_path(root, shard)))
        chunks = table[table["rows"] > 0]
        table = np.concatenate([chunks, metadata_lines((root / shard).read_bytes(), chunks)])
        old = np.zeros(len(table), CHUNK_DTYPES[version])
        for name in old.dtype.names or ():
            old[name] = table[name]
        np.save(chunk_table_path(root, shard), old, allow_pickle=False)
    lines = [json.loads(line) for line in (root / HISTORIES).read_text().splitlines()]
    assert not any(line["has_oracle_actions"] for line in lines)
    kept = [{name: value for name, value in line.items() if name not in NEW_FIELDS[version]} for line in lines]
    (root / HISTORIES).write_text("".join(json.dumps(line) + "\n" for line in kept))
    info = json.loads((root / INFO).read_text())
    assert info["format_version"] == FORMAT_VERSION
    write_json(root / INFO, info | {"format_version": version})
    write_manifest(root)
    return root
