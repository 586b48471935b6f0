"""Test that reading a damaged release raises package errors, never errors of other libraries."""

from __future__ import annotations

import json

import numpy as np
import pytest

from icrl4aht_data import errors, load_icrl4aht
from icrl4aht_data.errors import (
    ChunkTableError,
    FormatTooNewError,
    FormatTooOldError,
    Icrl4ahtError,
    IndexFormatError,
    ShardMismatchError,
    ShardMissingError,
    ShardTruncatedError,
)
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import HISTORIES
from tests.helpers.random_releases import SHARD
from tests.helpers.tampered import tamper


def load_damaged(root, **options):
    """Update the manifest of a damaged release, then open the release."""
    write_manifest(root)
    return load_icrl4aht(root, **options)


def read_all(root):
    """Read every field of every history on coord_simple, the layout with damaged files."""
    for history in load_damaged(root, layout="coord_simple"):
        for name in ("state", "actions", "rewards", "dones", "teammate_actions", "expert_actions", "episode_end_state"):
            history.read(name)


@pytest.mark.parametrize(
    ("version", "error", "what_to_do"),
    [
        (6, FormatTooNewError, "pip install -U icrl4aht-data"),
        (3, FormatTooOldError, "fetch a newer version of the release"),
    ],
)
def test_unsupported_format_versions_raise_errors(release_copy, version, error, what_to_do):
    (release_copy / "meta" / "info.json").write_text(json.dumps({"format_version": version, "renamed": 1}))
    with pytest.raises(error, match=rf"info\.json: format version {version}, this package reads 4, 5.*{what_to_do}"):
        load_damaged(release_copy)


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"format_version": "x"}', '{"format_version": 4}', "\x00", "[" * 9999],
)
def test_malformed_info_raises_index_format_error(release_copy, content):
    (release_copy / "meta" / "info.json").write_text(content)
    with pytest.raises(IndexFormatError, match=r"info\.json: malformed"):
        load_damaged(release_copy)


def set_fields(**changes):
    return lambda line: json.dumps(json.loads(line) | changes)


def remove_field(name):
    return lambda line: json.dumps({k: v for k, v in json.loads(line).items() if k != name})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda line: line[:40], "Input data was truncated"),
        (remove_field("layout"), "missing required field `layout`"),
        (set_fields(colour="red"), "unknown field `colour`"),
        (set_fields(T="many"), r"Expected `int`, got `str` - at `\$\.T`"),
        (set_fields(T=-5), r"Expected `int` >= 1 - at `\$\.T`"),
        (set_fields(history_id=0), "expected history_id 2, since ids count up from 0, found 0"),
        (set_fields(layout="cave"), "unknown layout of the train split of track teammate 'cave'"),
        (set_fields(obs_shape=[5, 5, 41]), r"expected obs_shape \[5, 5, 40\] for .*, found \[5, 5, 41\]"),
        (set_fields(shard="../../etc/passwd"), "expected data/teammate/coord_simple/train-NNNNN"),
    ],
)
def test_error_names_the_malformed_index_line(release_copy, change, message):
    path = release_copy / "meta" / "histories.jsonl"
    lines = path.read_text().splitlines()
    lines[2] = change(lines[2])
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(IndexFormatError, match=rf"histories\.jsonl, line 3: .*({message})"):
        load_damaged(release_copy)


def test_missing_index_line_raises_error(release_copy):
    path = release_copy / "meta" / "histories.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(IndexFormatError, match=r"11 lines, but .* counts 12 histories"):
        load_damaged(release_copy)


def test_missing_shard_raises_error_with_its_name(release_copy):
    (release_copy / SHARD).unlink()
    assert len(load_damaged(release_copy)) == 12, "opening reads the index only"
    with pytest.raises(ShardMissingError, match=r"train-00000-of-00001\.h5: the index names this shard"):
        read_all(release_copy)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated_shard_raises_error(release_copy, share):
    path = release_copy / SHARD
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(ShardTruncatedError, match=r"truncated: has \d+ bytes, but chunk \d+ of \w+ in history \d+"):
        read_all(release_copy)


def test_index_that_disagrees_with_a_shard_raises_error(release_copy):
    right = (release_copy / HISTORIES).read_text()
    for change in ({"T": 100, "episodes": 5}, {"has_expert_actions": False}):
        tamper(release_copy, HISTORIES, lambda lines, change=change: lines[0].update(change))
        with pytest.raises(ShardMismatchError, match=r"the index (says|implies)"):
            read_all(release_copy)
        (release_copy / HISTORIES).write_text(right)


def test_damaged_chunk_table_raises_error(release_copy):
    path = release_copy / chunk_table_name(SHARD)
    table = np.load(path)
    np.save(path, table[1:])
    with pytest.raises(ShardMismatchError):
        read_all(release_copy)
    np.save(path, np.zeros(3))
    with pytest.raises(ChunkTableError, match="expected rows of"):
        read_all(release_copy)
    path.write_bytes(b"junk")
    with pytest.raises(ChunkTableError, match="not a chunk table"):
        read_all(release_copy)
    path.unlink()
    with pytest.raises(ChunkTableError, match="missing; fetch the release again"):
        read_all(release_copy)


def test_error_classes_are_package_errors_or_warnings():
    classes = [c for c in vars(errors).values() if isinstance(c, type) and c.__module__ == errors.__name__]
    assert len(classes) > 10
    assert all(issubclass(c, (Icrl4ahtError, Warning)) for c in classes)
