"""A cache of decoded chunks in memory."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict

import numpy as np

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
        self._bytes, self._process, self._lock = 0, os.getpid(), threading.Lock()

    def __getstate__(self) -> int:
        return self._size  # a pickled cache is empty: the receiver reads what it needs

    def __setstate__(self, size: int) -> None:
        self.__init__(size)

    def get(self, key: tuple[str, int]) -> np.ndarray | None:
        """Return the chunk with the key (shard, row of its chunk table), or None."""
        if self._process != os.getpid():  # a fork, where the lock may be held by a thread that does not exist
            self.clear()
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
