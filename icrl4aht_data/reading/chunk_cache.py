"""A cache of decoded chunks in memory."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from icrl4aht_data.utils.forks import ForkSafeLock

_CACHE_BYTES = 256 * 2**20


class ChunkCache:
    """Decoded chunks of all shards of a release; the least recently used are dropped beyond a size. Thread-safe.

    Args:
        size: limit in bytes. The newest chunk is kept even if it alone is larger.
    """

    def __init__(self, size: int = _CACHE_BYTES) -> None:
        self._size = size
        self.clear()

    def clear(self) -> None:
        """Drop all chunks."""
        self._chunks: OrderedDict[tuple[str, int], np.ndarray] = OrderedDict()
        self._bytes = 0
        self._lock = ForkSafeLock()

    def __getstate__(self) -> int:
        return self._size  # a pickled cache is empty: the receiver reads what it needs

    def __setstate__(self, size: int) -> None:
        self.__init__(size)

    def get(self, key: tuple[str, int]) -> np.ndarray | None:
        """The chunk with the key (shard, row of its chunk table), or None."""
        with self._lock:
            rows = self._chunks.get(key)
            if rows is not None:
                self._chunks.move_to_end(key)
            return rows

    def put(self, key: tuple[str, int], rows: np.ndarray) -> None:
        """Add a chunk."""
        with self._lock:
            if key not in self._chunks:
                self._chunks[key] = rows
                self._bytes += rows.nbytes
            while self._bytes > self._size and len(self._chunks) > 1:
                self._bytes -= self._chunks.popitem(last=False)[1].nbytes
