"""A cache of decoded chunks in memory."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict

import numpy as np

_CACHE_BYTES = 256 * 2**20


class ChunkCache:
    """Cache of a release's decoded chunks of limited size; drops the least recently used. Thread-safe.

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
        return self._size  # a pickled cache is empty: the receiving process fills its own

    def __setstate__(self, size: int) -> None:
        self.__init__(size)

    def get(self, key: tuple[str, int]) -> np.ndarray | None:
        """Return the chunk with the key (shard, row of its chunk table), or None."""
        if self._process != os.getpid():  # after a fork, a thread that no longer exists may hold the lock
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
