"""Files of a remote of which parts are here: each chunk proved by its checksum, so that no record of them is needed.

A partial file has every part at its place, with holes between them. A chunk is here if what lies at its place has its
checksum: after a crash, beside another process, or on a disk that lost a sector, what is not whole is fetched again.
The same holds for reading windows, for downloads that go on, and for repairs.
"""

from __future__ import annotations

import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icrl4aht_data.errors import ChunkTableError, RemoteError
from icrl4aht_data.format.schema import CHUNK_DTYPE
from icrl4aht_data.remote.store import Store
from icrl4aht_data.utils.cache import cache_limit, data_folder
from icrl4aht_data.utils.files import add_filename
from icrl4aht_data.utils.hashes import file_hash

_GAP = 4096  # bytes between two chunks that cost less than another request
_PIECE = 2**20  # bytes asked for at once: what a cut can lose
_AT_ONCE = 16  # requests
_TRIES = 3  # for bytes that come, but wrong
_OVERFLOW = 64 * 2**20  # bytes kept in memory where the disk takes no more
_DISK_BLOCK = 4096  # bytes: what a disk gives to a sparse file at once
_CHECKED = 64 * 2**20  # bytes written between two looks at the folder's size


class Piece(NamedTuple):
    """Bytes asked for at once, and the chunks in them."""

    start: int
    stop: int
    chunks: np.ndarray  # CHUNK_DTYPE


class PartialFile:
    """One file of a remote.

    Args:
        store: where it is.
        name: what it is called there.
        path: what is here of it.
    """

    def __init__(self, store: Store, name: str, path: Path) -> None:
        self.store, self.name, self.path = store, name, path
        self._lock = threading.Lock()
        self._overflow: OrderedDict[int, bytes] = OrderedDict()

    def __getstate__(self) -> tuple[Store, str, Path]:
        return self.store, self.name, self.path

    def __setstate__(self, state: tuple[Store, str, Path]) -> None:
        self.__init__(*state)

    def get(self, offset: int, size: int, crc32: int) -> bytes | None:
        """A chunk, if it is here and whole."""
        with self._lock:
            data = self._overflow.get(offset)
        if data is None:
            try:
                with self.path.open("rb", buffering=0) as stream:
                    stream.seek(offset)
                    data = stream.read(size)
            except OSError:  # no such file, or a bad sector
                return None
        return data if len(data) == size and zlib.crc32(data) == crc32 else None

    def put(self, start: int, data: bytes) -> None:
        """Write bytes at their place.

        Raises:
            OSError: if the disk does not take them.
        """
        if not self.path.exists():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.touch()
        with add_filename(self.path), self.path.open("r+b") as stream:
            stream.seek(start)
            stream.write(data)

    def keep(self, piece: Piece, data: bytes) -> None:
        """The same for bytes that are only cached: in memory where the disk does not take them."""
        try:
            self.put(piece.start, data)
        except OSError:
            with self._lock:
                for offset, size, *_ in piece.chunks.tolist():
                    self._overflow[offset] = data[offset - piece.start :][:size]
                excess = sum(map(len, self._overflow.values())) - _OVERFLOW
                while excess > 0 and len(self._overflow) > 1:
                    excess -= len(self._overflow.popitem(last=False)[1])

    def chunk(self, offset: int, size: int, crc32: int) -> bytes:
        """A chunk, fetched if it is not here.

        Raises:
            RemoteError: if it cannot be had.
        """
        data = self.get(offset, size, crc32)
        if data is None:
            chunk = np.array([(offset, size, 0, crc32)], CHUNK_DTYPE)
            data = _fetch(self, Piece(offset, offset + size, chunk), self.keep)
        return data

    def missing(self, chunks: np.ndarray) -> np.ndarray:
        """Those of the chunks (CHUNK_DTYPE) that are not here, in the order of the file."""
        if not self.path.exists() and not self._overflow:
            return np.sort(chunks, order="offset")
        absent = [self.get(offset, size, crc) is None for offset, size, _, crc in chunks.tolist()]
        return np.sort(chunks[absent], order="offset")


def fetch_chunks(wanted: Iterable[tuple[PartialFile, np.ndarray]]) -> None:
    """Make sure that chunks of several files are here: what is missing comes in few requests, many at once.

    Args:
        wanted: files, and chunks of each (CHUNK_DTYPE).

    Raises:
        RemoteError: if bytes cannot be had, or come wrong again and again.
    """
    pieces = [(file, piece) for file, chunks in wanted for piece in _pieces(file.missing(chunks))]
    if not pieces:
        return
    _at_once([lambda file=file, piece=piece: _fetch(file, piece, file.keep) for file, piece in pieces])
    disk = sum(piece.stop // _DISK_BLOCK - piece.start // _DISK_BLOCK + 1 for _, piece in pieces) * _DISK_BLOCK
    _bound({file.path for file, _ in pieces}, disk)


def _pieces(chunks: np.ndarray, gap: int = _GAP) -> list[Piece]:
    """Few ranges with all the chunks (sorted by offset), and at most `gap` bytes between them; none much longer than
    `_PIECE`."""
    starts = chunks["offset"].astype(np.int64)
    stops = starts + chunks["size"]
    pieces, first = [], 0
    for row in range(1, len(chunks) + 1):
        if row == len(chunks) or starts[row] - stops[row - 1] > gap or stops[row] - starts[first] > _PIECE:
            pieces.append(Piece(int(starts[first]), int(stops[first:row].max()), chunks[first:row]))
            first = row
    return pieces


def _fetch(file: PartialFile, piece: Piece, write: Callable[[Piece, bytes], None]) -> bytes:
    """Ask for a piece until every chunk in it is right, and write it."""
    wrong = 0, 0, 0
    for _ in range(_TRIES):
        data = file.store.read(file.name, piece.start, piece.stop)
        for offset, size, _, crc in piece.chunks.tolist():
            if zlib.crc32(data[offset - piece.start : offset - piece.start + size]) != crc:
                wrong = offset, offset + size, crc
                break
        else:
            write(piece, data)
            return data
    raise RemoteError(
        f"{file.store.url}/{file.name}: bytes {wrong[0]}..{wrong[1]}: expected crc32 {wrong[2]:08x}, got others "
        f"{_TRIES} times: the remote's file is damaged or not of this version; tell its publisher"
    )


def whole_file(
    file: PartialFile,
    size: int,
    digest: str,
    table: np.ndarray | None,
    advance: Callable[[int], None],
    keep: bool = False,
) -> None:
    """Make `file.path` the whole file: what is missing or wrong of it is fetched.

    Args:
        size: the file's.
        digest: SHA-256 that it must have.
        table: its chunk table, if it is a shard; without one what is here is taken for the first bytes.
        advance: called with the bytes that have arrived, those that were here included.
        keep: leave what there is if it does not become the file.

    Raises:
        RemoteError: if what has come is not that file.
        ChunkTableError: if the chunk table does not cover the file.
        OSError: if the disk does not take it.
    """
    found = ""
    for _ in range(1 if keep else _TRIES):
        if table is None:
            _in_order(file, size, advance)
        else:
            _by_chunks(file, size, np.sort(table, order="offset"), advance)
        found = file_hash(file.path)
        if found == digest:
            return
        advance(-size)
        if not keep:
            file.path.unlink()
    raise RemoteError(
        f"{file.store.url}/{file.name}: expected sha256 {digest}, found {found} in {size} bytes: the remote's file is "
        f"damaged or not of this version; tell its publisher"
    )


def _in_order(file: PartialFile, size: int, advance: Callable[[int], None]) -> None:
    have = file.path.stat().st_size if file.path.exists() else 0
    if have > size:
        file.path.unlink()
        have = 0
    file.put(have, b"")
    advance(have)
    for start in range(have, size, _PIECE):
        stop = min(start + _PIECE, size)
        file.put(start, file.store.read(file.name, start, stop))
        advance(stop - start)


def _by_chunks(file: PartialFile, size: int, table: np.ndarray, advance: Callable[[int], None]) -> None:
    stops = (table["offset"] + table["size"]).tolist()
    if [0, *stops] != [*table["offset"].tolist(), size]:
        raise ChunkTableError(f"{file.store.url}/{file.name}: its chunk table does not cover its {size} bytes")
    missing = file.missing(table)
    advance(size - int(missing["size"].sum()))
    file.put(0, b"")

    def copy(piece: Piece) -> None:
        _fetch(file, piece, lambda piece, data: file.put(piece.start, data))
        advance(int(piece.chunks["size"].sum()))

    _at_once([lambda piece=piece: copy(piece) for piece in _pieces(missing, gap=0)])
    with add_filename(file.path), file.path.open("r+b") as stream:
        stream.truncate(size)


def _at_once(work: Sequence[Callable[[], object]]) -> None:
    """Call all of them on a few threads; the first error, after all have ended."""
    if len(work) < 2:
        for one in work:
            one()
        return
    with ThreadPoolExecutor(min(_AT_ONCE, len(work))) as pool:
        futures = [pool.submit(one) for one in work]
    for future in futures:
        future.result()


_unlooked = 0


def _bound(used: set[Path], written: int) -> None:
    """Keep what is here of all partial files below the cache's limit: the least recently written ones go first."""
    global _unlooked
    _unlooked += written
    limit = cache_limit()
    if _unlooked < min(_CHECKED, limit // 4):
        return
    _unlooked = 0
    kept = []
    for path in data_folder().glob("*/*.partial/**/*"):
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        if path.is_file() and not path.name.startswith("."):
            kept.append((path in used, status.st_mtime_ns, path, getattr(status, "st_blocks", 0) * 512))
    excess = sum(size for *_, size in kept) - limit
    for _, _, path, size in sorted(kept):
        if excess <= 0:
            return
        path.unlink(missing_ok=True)
        excess -= size
