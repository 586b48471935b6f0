"""Two readers of the published format, with which our loader is compared."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.writing.published import HISTORIES_H5

_READ = ("obs", "actions", "rewards", "dones")

ReadWindows = Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]]
"""(histories int (B,), starts int (B,)) -> field -> windows (B, L, ...)."""


def published_reader(folder: Path, length: int) -> ReadWindows:
    """Return a reader as in the published code: one slice for overlapping windows, cut and stacked."""
    file = h5py.File(folder / HISTORIES_H5, "r", rdcc_nbytes=512 * 2**20)

    def read(ids: np.ndarray, starts: np.ndarray) -> dict[str, np.ndarray]:
        windows: dict[str, list] = {name: [None] * len(ids) for name in _READ}
        for history in np.unique(ids):
            rows = np.flatnonzero(ids == history)
            rows = rows[np.argsort(starts[rows])]
            begin = starts[rows].tolist()
            k = 0
            while k < len(rows):
                last = k
                while last + 1 < len(rows) and begin[last + 1] <= begin[last] + length:
                    last += 1
                for name in windows:
                    dataset: Any = file[f"/{history}/{name}"]
                    block = dataset[begin[k] : begin[last] + length]
                    for j in range(k, last + 1):
                        windows[name][rows[j]] = block[begin[j] - begin[k] : begin[j] - begin[k] + length]
                k = last + 1
        return {name: np.stack(parts) for name, parts in windows.items()}

    return read


def fair_reader(folder: Path, length: int, batch: int) -> ReadWindows:
    """Return a reader into one batch buffer, for files whose chunks have the windows' length."""
    file = h5py.File(folder / HISTORIES_H5, "r")
    first: Any = {name: file[f"/0/{name}"] for name in _READ}
    out = {name: np.ones((batch, length, *data.shape[1:]), data.dtype) for name, data in first.items()}

    def read(ids: np.ndarray, starts: np.ndarray) -> dict[str, np.ndarray]:
        for row, (history, start) in enumerate(zip(ids.tolist(), starts.tolist(), strict=True)):
            for name, array in out.items():
                dataset: Any = file[f"/{history}/{name}"]
                dataset.read_direct(array, np.s_[start : start + length], np.s_[row])
        return out

    return read
