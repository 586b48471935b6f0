"""Stored bytes against the chunk table: damaged and forged chunks are refused by every reader."""

from __future__ import annotations

import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import ShardCorruptError
from icrl4aht_data.format import chunks
from icrl4aht_data.format.chunks import check_chunk, chunk_hash, chunk_table_name, decode_chunk, encode_chunk
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import CHUNK_DTYPE
from icrl4aht_data.reading.shard import Shards
from icrl4aht_data.reading.sources import CacheMode
from tests.helpers.forged_chunks import forge_crc32, with_other_actions, with_trailing_bytes
from tests.helpers.random_releases import SHARD, random_release

MODES: tuple[CacheMode, ...] = ("ram", "mmap", "stream")
STEPS = 400


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    """Return a release of one history with uncompressed deflate chunks (read-only)."""
    root = tmp_path_factory.mktemp("stored") / "release"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "DEFLATE_LEVEL", 0)
        random_release(root, layouts=("coord_simple",), teammates=1, streams=1, episodes=STEPS // 20)
    return root


def row_of(data: bytes) -> np.void:
    row = np.zeros(1, CHUNK_DTYPE)[0]
    row["size"], row["rows"], row["crc32"] = len(data), 1, zlib.crc32(data)
    row["hash"] = np.frombuffer(chunk_hash(data), np.uint8)
    return row


def actions_row(root: Path) -> tuple[np.void, int]:
    """Return the row of the chunk with history 0's actions, and its number."""
    dataset = load_icrl4aht(root)
    shard = Shards(dataset.origin, dataset.index).open(SHARD)
    (number,) = (row for row, history_id, field in shard.chunks() if (history_id, field.name) == (0, "actions"))
    return shard.table[number], number


def forge(root: Path, target: Path, form: str) -> np.ndarray:
    """Copy a release with forged actions of history 0, of equal size and CRC-32; return them."""
    shutil.copytree(root, target)
    row, _ = actions_row(root)
    with (target / SHARD).open("r+b") as stream:
        stream.seek(int(row["offset"]))
        data = stream.read(int(row["size"]))
        forged = with_other_actions(data) if form == "other actions" else with_trailing_bytes(data, bytes(STEPS))
        assert forged != data
        assert zlib.crc32(forged) == row["crc32"]
        stream.seek(int(row["offset"]))
        stream.write(forged)
    return np.frombuffer(zlib.decompressobj().decompress(forged), np.int8)


def read_window(root: Path, mode: CacheMode) -> np.ndarray:
    """Return the actions of history 0, as a sampler reads them."""
    dataset = load_icrl4aht(root, obs="state", cache=mode)
    return dataset.ad(batch_size=1, length=STEPS, seed=0)[0].target_actions


@pytest.mark.parametrize("tail", [b"\0", bytes(100), zlib.compress(b"again")], ids=["a byte", "zeros", "a stream"])
def test_bytes_behind_the_deflate_stream_are_refused(tail):
    data = encode_chunk(np.arange(12, dtype=np.uint8).reshape(4, 3), 4, 3)
    assert decode_chunk(data, 12, 3) == bytes(range(12))
    with pytest.raises(ValueError, match=f"{len(tail)} bytes after the end of the deflate stream"):
        decode_chunk(data + tail, 12, 3)


def test_a_chunk_is_compared_with_its_row():
    data = bytes(range(100))
    check_chunk(data, row_of(data))
    flipped, crc32 = b"\1" + data[1:], zlib.crc32(data)
    with pytest.raises(ValueError, match="expected 100 bytes, found 99"):
        check_chunk(data[:99], row_of(data))
    with pytest.raises(ValueError, match=f"expected crc32 {crc32:08x}, found {zlib.crc32(flipped):08x}"):
        check_chunk(flipped, row_of(data))
    forged = forge_crc32(flipped, [{96 + bit // 8: 1 << bit % 8} for bit in range(32)], crc32)
    assert forged is not None
    with pytest.raises(
        ValueError, match=f"expected blake2b {chunk_hash(data).hex()}, found {chunk_hash(forged).hex()}"
    ):
        check_chunk(forged, row_of(data))


def test_every_row_has_the_hash_of_its_bytes(lite):
    root, _ = lite
    for shard in load_icrl4aht(root).info.shards:
        table, data = np.load(root / chunk_table_name(shard)), (root / shard).read_bytes()
        assert table.dtype == CHUNK_DTYPE
        assert not table["rows"][-1], "the bytes between the chunks come last"
        for row in table:
            check_chunk(data[row["offset"] : row["offset"] + row["size"]], row)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("form", ["other actions", "trailing bytes"])
def test_a_forged_chunk_is_refused(stored, tmp_path, monkeypatch, mode, form):
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    forged = forge(stored, tmp_path / "forged", form)
    with pytest.raises(ShardCorruptError, match=r"chunk 0 of actions in history 0 .* expected blake2b"):
        read_window(tmp_path / "forged", mode)
    np.testing.assert_array_equal(read_window(stored, mode)[0], load_icrl4aht(stored)[0].actions[:])
    assert not np.array_equal(forged, load_icrl4aht(stored)[0].actions[:])


def test_verify_finds_a_forged_chunk(stored, tmp_path):
    forge(stored, tmp_path / "forged", "other actions")
    write_manifest(tmp_path / "forged")  # only the chunk table reveals the change
    problems = [finding.problem for finding in verify_release(tmp_path / "forged").findings]
    assert any("chunk 0 of actions in history 0" in problem and "blake2b" in problem for problem in problems), problems


def test_a_forged_release_with_its_own_hashes_does_not_share_a_cache(stored, tmp_path, monkeypatch):
    """The cache must tell apart two releases whose CRC-32 checksums agree."""
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    forged = forge(stored, tmp_path / "forged", "other actions")
    path, (row, number) = tmp_path / "forged" / chunk_table_name(SHARD), actions_row(stored)
    table, data = np.load(path), (tmp_path / "forged" / SHARD).read_bytes()
    start = int(row["offset"])
    table["hash"][number] = np.frombuffer(chunk_hash(data[start : start + int(row["size"])]), np.uint8)
    np.save(path, table)
    write_manifest(tmp_path / "forged")
    np.testing.assert_array_equal(read_window(tmp_path / "forged", "mmap")[0], forged)
    np.testing.assert_array_equal(read_window(stored, "mmap")[0], load_icrl4aht(stored)[0].actions[:])
