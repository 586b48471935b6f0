"""Partially downloaded files, validated chunk by chunk.

A partial file is sparse: every part that has arrived is at its final offset, with holes between the parts. No record of
the parts is kept. A chunk counts as downloaded if the bytes at its offset have its checksum, so that after a crash,
next to another process, or on a disk that lost a sector, exactly what is missing or damaged is fetched again. Reading
windows, resumed downloads and repairs all rely on this.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import numpy as np

from icrl4aht_data.errors import ChunkTableError, RemoteError
from icrl4aht_data.format.chunks import check_chunk
from icrl4aht_data.format.schema import CHUNK_DTYPE
from icrl4aht_data.remote.store import Store
from icrl4aht_data.utils.files import add_filename, in_new_folder
from icrl4aht_data.utils.forks import ForkSafeLock
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.system import cache_limit, data_folder

T = TypeVar("T")
R = TypeVar("R")

_GAP = 4096  # bytes between two chunks that cost less than another request
_REQUEST_BYTES = 2**20  # longest range of one request: what a cut connection can lose
_PARALLEL_REQUESTS = 16
_ATTEMPTS = 3  # for bytes that arrive with a wrong checksum
_OVERFLOW = 64 * 2**20  # bytes of chunks kept in memory if the disk is full
_DISK_BLOCK = 4096  # bytes that a file system allocates at once for a sparse file
_CHECKED = 64 * 2**20  # bytes written between two checks of the folder's size


class ByteRange(NamedTuple):
    """One request: contiguous bytes of a file, and the chunks within them.

    Args:
        start: first byte.
        stop: end, exclusive.
        chunks: CHUNK_DTYPE (n,), by offset; n = 0 for a file without a chunk table.
    """

    start: int
    stop: int
    chunks: np.ndarray


class PartialFile:
    """The downloaded part of one remote file. Can be shared between threads and pickled.

    Args:
        store: the remote.
        name: the file's path in it.
        path: local file for the parts; it need not exist.
    """

    def __init__(self, store: Store, name: str, path: Path) -> None:
        self.store, self.name, self.path = store, name, path
        self._lock = ForkSafeLock()
        self._overflow: OrderedDict[int, bytes] = OrderedDict()

    def __reduce__(self) -> tuple:
        return type(self), (self.store, self.name, self.path)

    def get(self, row: np.void) -> bytes | None:
        """The bytes of a chunk, a row of the chunk table, or None if it is not downloaded or damaged."""
        offset, size = row.item()[:2]
        with self._lock:
            data = self._overflow.get(offset)
        if data is None:
            try:
                with self.path.open("rb", buffering=0) as stream:
                    stream.seek(offset)
                    data = stream.read(size)
            except OSError:  # no such file, or a bad sector
                return None
        try:
            check_chunk(data, row)
        except ValueError:
            return None
        return data

    def put(self, start: int, data: bytes) -> None:
        """Write bytes at their offset.

        Raises:
            OSError: if the disk is full or not writable; names the file.
        """
        with add_filename(self.path), self.open_to_write() as stream:
            stream.seek(start)
            stream.write(data)

    def open_to_write(self) -> BinaryIO:
        """The file, created with its folder if necessary, open for writing at any position; a link is not followed.

        Raises:
            OSError: if the disk is full or not writable, or the path is a link.
        """
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
        return in_new_folder(self.path, lambda: os.fdopen(os.open(self.path, flags, 0o666), "r+b"))

    def cache(self, fetched: ByteRange, data: bytes) -> None:
        """Write bytes that can be fetched again at any time; keep their chunks in memory if the disk is full."""
        try:
            self.put(fetched.start, data)
        except OSError:
            with self._lock:
                for offset, size, *_ in fetched.chunks.tolist():
                    self._overflow[offset] = data[offset - fetched.start :][:size]
                excess = sum(map(len, self._overflow.values())) - _OVERFLOW
                while excess > 0 and len(self._overflow) > 1:
                    excess -= len(self._overflow.popitem(last=False)[1])

    def chunk(self, row: np.void) -> bytes:
        """The bytes of a chunk, a row of the chunk table, fetched if necessary.

        Raises:
            RemoteError: if it cannot be fetched, or arrives with a wrong checksum.
        """
        data = self.get(row)
        if data is None:
            offset, size = row.item()[:2]
            wanted = ByteRange(offset, offset + size, np.array([row]))
            data = _fetch(self, wanted)
            self.cache(wanted, data)
        return data

    def missing_chunks(self, chunks: np.ndarray) -> np.ndarray:
        """The chunks (CHUNK_DTYPE) that are not downloaded or damaged, by offset."""
        if self.path.exists() or self._overflow:
            chunks = chunks[[self.get(row) is None for row in chunks]]
        return np.sort(chunks, order="offset")


def fetch_chunks(wanted: Iterable[tuple[PartialFile, np.ndarray]]) -> None:
    """Download the missing chunks of several files, with few requests, many at once.

    Chunks at most 4 KiB apart share a request. Chunks that are already downloaded cost no request. If the parts exceed
    the cache's size limit, the least recently written files are removed.

    Args:
        wanted: pairs of a file and the chunks needed of it: rows of its chunk table (CHUNK_DTYPE (n,)), in any order.
            A file may occur in several pairs, a chunk in one of them only.

    Raises:
        RemoteError: if bytes cannot be fetched, or arrive with a wrong checksum three times.
    """
    requests = [(file, span) for file, chunks in wanted for span in _ranges(file.missing_chunks(chunks))]
    map_parallel(lambda request: request[0].cache(request[1], _fetch(*request)), requests)
    if requests:
        blocks = sum(span.stop // _DISK_BLOCK - span.start // _DISK_BLOCK + 1 for _, span in requests)
        _limit_disk_use({file.path for file, _ in requests}, blocks * _DISK_BLOCK)


def complete_file(
    file: PartialFile,
    size: int,
    digest: str,
    chunks: np.ndarray | None,
    advance: Callable[[int], None],
    in_place: bool = False,
) -> None:
    """Make `file.path` the complete file: fetch what is missing or damaged, then check the file's hash.

    Args:
        file: what has been downloaded so far.
        size: bytes of the complete file.
        digest: SHA-256 that it must have, hexadecimal.
        chunks: its chunk table (CHUNK_DTYPE (n,)), if it is a shard. Without one the bytes downloaded so far are
            taken for the beginning of the file.
        advance: called with the number of valid bytes since the last call, those downloaded before included.
        in_place: `file.path` is a damaged file of a release, not to be removed if it cannot be repaired.

    Raises:
        RemoteError: if the remote's file is not the one that the manifest lists.
        ChunkTableError: if the chunk table does not cover the file.
        OSError: if the disk is full or not writable.
    """
    found = ""
    for _ in range(1 if in_place else _ATTEMPTS):
        _fetch_missing(file, size, chunks, advance)
        found = file_hash(file.path)
        if found == digest:
            return
        advance(-size)
        if not in_place:
            file.path.unlink()
    raise RemoteError(
        f"{file.store.url}/{file.name}: expected sha256 {digest}, found {found} in {size} bytes: the remote's file is "
        f"damaged or not of this version; report it to its publisher"
    )


def _fetch_missing(file: PartialFile, size: int, chunks: np.ndarray | None, advance: Callable[[int], None]) -> None:
    if chunks is None:
        present = file.path.stat().st_size if file.path.exists() else 0
        if present > size:
            file.path.unlink()
            present = 0
        starts = range(present, size, _REQUEST_BYTES)
        spans = [ByteRange(start, min(start + _REQUEST_BYTES, size), np.empty(0, CHUNK_DTYPE)) for start in starts]
    else:
        chunks = np.sort(chunks, order="offset")
        stops = (chunks["offset"] + chunks["size"]).tolist()
        if [0, *stops] != [*chunks["offset"].tolist(), size]:
            raise ChunkTableError(f"{file.store.url}/{file.name}: its chunk table does not cover its {size} bytes")
        missing = file.missing_chunks(chunks)
        present = size - int(missing["size"].sum())
        spans = _ranges(missing, gap=0)
    advance(present)
    file.put(0, b"")  # creates an empty file

    def fetch(span: ByteRange) -> None:
        file.put(span.start, _fetch(file, span))
        advance(span.stop - span.start)

    # Without checksums the file must grow from its beginning, or a hole would pass for data after a cut.
    map_parallel(fetch, spans, threads=1 if chunks is None else _PARALLEL_REQUESTS)
    with add_filename(file.path), file.open_to_write() as stream:
        stream.truncate(size)


def _ranges(chunks: np.ndarray, gap: int = _GAP) -> list[ByteRange]:
    """Few ranges that contain all chunks (sorted by offset), with at most `gap` unneeded bytes between two chunks.

    A range is at most `_REQUEST_BYTES` long, unless a single chunk is longer.
    """
    starts = chunks["offset"].astype(np.int64)
    stops = starts + chunks["size"]
    ranges, first = [], 0
    for row in range(1, len(chunks) + 1):
        if row == len(chunks) or starts[row] - stops[row - 1] > gap or stops[row] - starts[first] > _REQUEST_BYTES:
            ranges.append(ByteRange(int(starts[first]), int(stops[first:row].max()), chunks[first:row]))
            first = row
    return ranges


def _fetch(file: PartialFile, wanted: ByteRange) -> bytes:
    """The bytes of a range, requested until the checksum of every chunk in it is right."""
    damaged = ""
    for _ in range(_ATTEMPTS):
        data = file.store.read(file.name, wanted.start, wanted.stop)
        for row in wanted.chunks:
            offset, size = row.item()[:2]
            try:
                check_chunk(data[offset - wanted.start : offset - wanted.start + size], row)
            except ValueError as error:
                damaged = f"bytes {offset}..{offset + size}: {error}"
                break
        else:
            return data
    raise RemoteError(
        f"{file.store.url}/{file.name}: {damaged}, {_ATTEMPTS} times: the remote's file is damaged or not of this "
        f"version; report it to its publisher"
    )


def map_parallel(work: Callable[[T], R], items: Sequence[T], threads: int = _PARALLEL_REQUESTS) -> list[R]:
    """Results of `work` for every item, called on a few threads; raises the first error after all calls have ended."""
    if threads == 1 or len(items) < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(min(threads, len(items))) as pool:
        futures = [pool.submit(work, item) for item in items]
    return [future.result() for future in futures]


_written_since_check = 0


def _limit_disk_use(in_use: set[Path], written: int) -> None:
    """Remove the least recently written partial files if all of them together exceed the cache's size limit.

    Args:
        in_use: files to remove last.
        written: bytes written since the last call.
    """
    global _written_since_check
    _written_since_check += written
    limit = cache_limit()
    if _written_since_check < min(_CHECKED, limit // 4):
        return
    _written_since_check = 0
    kept = []
    for path in data_folder().glob("*/*.partial/**/*"):
        try:
            status = path.stat()
        except FileNotFoundError:  # removed by another process
            continue
        if path.is_file() and not path.name.startswith("."):
            kept.append((path in in_use, status.st_mtime_ns, path, getattr(status, "st_blocks", 0) * 512))
    excess = sum(size for *_, size in kept) - limit
    for _, _, path, size in sorted(kept):
        if excess <= 0:
            return
        path.unlink(missing_ok=True)
        excess -= size
