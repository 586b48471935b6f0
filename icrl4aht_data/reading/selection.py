"""TODO."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrl4aht_data.reading.history import Obs
from icrl4aht_data.reading.sources import CacheMode, HistorySource

Names = str | Sequence[str] | None


class ReadOptions(NamedTuple):
    """How a dataset gives its data; see `load_icrl4aht`."""

    obs: Obs
    cache: CacheMode
    threads: int


class Storage(NamedTuple):
    """Where a selection's rows come from: one source a layout, and each history's place."""

    sources: list[HistorySource]
    layout: np.ndarray  # intp (H,), which source
    place: np.ndarray  # intp (H,), position in it
