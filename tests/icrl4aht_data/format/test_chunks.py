"""Test that all readers compare chunks with the chunk table, and refuse damaged or forged chunks."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import ShardCorruptError
from icrl4aht_data.format.chunks import check_chunk, chunk_hash, chunk_table_name, decode_chunk, encode_chunk
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import CHUNK_DTYPE
from tests.helpers.batches import CACHES
from tests.helpers.random_releases import SHARD


@pytest.mark.parametrize("tail", [b"\0", bytes(100), zlib.compress(b"again")], ids=["a byte", "zeros", "a stream"])
def test_bytes_after_the_deflate_stream_are_refused(tail):
    data = encode_chunk(np.arange(12, dtype=np.uint8).reshape(4, 3), 4, 3)
    assert decode_chunk(data, 12, 3) == bytes(range(12))
    with pytest.raises(ValueError, match=f"expected no bytes after the deflate stream, found {len(tail)}"):
        decode_chunk(data + tail, 12, 3)


def test_check_chunk_compares_size_crc32_and_hash():
    data, row = bytes(range(100)), np.zeros(1, CHUNK_DTYPE)[0]
    row["size"], row["rows"], row["crc32"] = len(data), 1, zlib.crc32(data)
    row["hash"] = np.frombuffer(chunk_hash(data), np.uint8)
    check_chunk(data, row)
    flipped = b"\1" + data[1:]
    with pytest.raises(ValueError, match="expected 100 bytes, found 99"):
        check_chunk(data[:99], row)
    with pytest.raises(ValueError, match=f"expected crc32 {zlib.crc32(data):08x}, found {zlib.crc32(flipped):08x}"):
        check_chunk(flipped, row)
    row["crc32"] = zlib.crc32(flipped)
    expected = f"expected blake2b {chunk_hash(data).hex()}, found {chunk_hash(flipped).hex()}"
    with pytest.raises(ValueError, match=expected):
        check_chunk(flipped, row)


@pytest.mark.parametrize("cache", CACHES)
def test_changed_chunk_with_matching_crc32_is_refused(release_copy, tmp_path, monkeypatch, cache):
    """Change a chunk, its CRC-32 and the manifest; only the stored BLAKE2b hash reveals the change."""
    # a new cache has no arrays of the undamaged release
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path / "cache"))
    path, data = release_copy / chunk_table_name(SHARD), bytearray((release_copy / SHARD).read_bytes())
    table = np.load(path)
    start, end = int(table["offset"][0]), int(table["offset"][0] + table["size"][0])
    data[start + 5] ^= 1
    table["crc32"][0] = zlib.crc32(data[start:end])
    (release_copy / SHARD).write_bytes(data)
    np.save(path, table)
    write_manifest(release_copy)
    with pytest.raises(ShardCorruptError, match=r"chunk 0 of state in history 0 .* expected blake2b"):
        load_icrl4aht(release_copy, layout="coord_simple", cache=cache).ad(batch_size=64, length=9)[0]
    problems = [finding.problem for finding in verify_release(release_copy).findings]
    assert any("chunk 0 of state in history 0" in problem and "blake2b" in problem for problem in problems), problems
