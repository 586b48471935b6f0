"""File for libhdf5 to write to that never fails: on a full disk libhdf5 may crash the process when it closes a file."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from icrl4aht_data.utils.files import add_filename


class _Sink(io.RawIOBase):
    """A new file that remembers the first error of the disk, and from then on drops what is written to it."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self.error: OSError | None = None

    def write(self, data: Any, /) -> int:
        view = memoryview(data).cast("B")
        done = 0
        try:
            while self.error is None and done < len(view):  # a write may be cut short by a full disk
                done += self._file.write(view[done:]) or 0
        except OSError as error:
            self.error = error
        return len(view)

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return self._file.truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0

    def readinto(self, buffer: Any, /) -> int | None:
        return self._file.readinto(buffer)

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        self._file.close()
        super().close()


class SafeWriter:
    """A new HDF5 file, see `new_hdf5`.

    Attributes:
        file: the open file.
    """

    def __init__(self, file: h5py.File, sink: _Sink) -> None:
        self.file, self._sink = file, sink

    def check(self) -> None:
        """Raise the error of the disk, if there was one; to be called after every large write."""
        if self._sink.error is not None:
            raise self._sink.error


@contextmanager
def new_hdf5(path: Path) -> Iterator[SafeWriter]:
    """Yield a new HDF5 file to write to.

    Raises:
        OSError: names the file, if the disk has no room for it.
    """
    with add_filename(path), _Sink(path) as sink:
        with h5py.File(sink, "w") as file:
            writer = SafeWriter(file, sink)
            yield writer
        writer.check()
