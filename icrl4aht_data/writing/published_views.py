"""Padding of the published code's observations, which have fewer than 5 rows on maps with fewer than 5 rows.

On such a map, a published observation has only as many rows as the map: 4 x 5 cells on the cramped layouts. The missing
row is two cells below the agent. The padding is 0 outside the map. Inside the map the padding shows the fixed cells
(walls, pots, piles), but 0 for items, which were not recorded.
"""

from __future__ import annotations

import numpy as np

from icrl4aht_data.errors import PublishedFormatError
from icrl4aht_data.overcooked.actions import EGO
from icrl4aht_data.overcooked.cells import WINDOW
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.state import columns, record_size

PADDING = (
    "views of {rows} x 5 cells, as the published code makes them on this map, were padded to 5 x 5: the row two cells "
    "below the ego shows the map's fixed cells, and 0 outside of the map; items, pots' contents and timers in it were "
    "not recorded and are 0"
)
"""Note about padded observations for meta/provenance.json."""


def has_missing_rows(layout: Layout, obs_shape: tuple[int, ...]) -> bool:
    """Return whether `obs_shape` has only the rows of the layout's map, and the map has fewer than 5 rows."""
    return layout.height < WINDOW and tuple(obs_shape) == (layout.height, *layout.obs_shape[1:])


def views_without_items(layout: Layout) -> np.ndarray:
    """Return the view from each cell that the ego can reach, without any items, uint8 of shape (cells, 5, 5, C)."""
    records = np.zeros((len(layout.rooms[EGO]), record_size(layout)), np.uint8)
    records[:, columns(layout).positions] = layout.rooms[EGO][:, None]
    return np.asarray(observe(layout, records, EGO))


def complete_views(layout: Layout, short: np.ndarray) -> np.ndarray:
    """Pad observations that have fewer than five rows to five rows.

    Args:
        layout: the layout.
        short: observations with the H rows of the map, uint8 of shape (T, H, 5, C); the ego is in the third row.

    Returns:
        Padded observations, uint8 of shape (T, 5, 5, C).

    Raises:
        PublishedFormatError: if an observation does not match the layout from any cell that the ego can reach; the
            caller adds the file and the group to the message.
    """
    rows, fixed, known = short.shape[1], fixed_channels(layout), views_without_items(layout)
    cells = {view[:rows, :, fixed].tobytes(): cell for cell, view in enumerate(known)}
    at = np.array([cells.get(view.tobytes(), -1) for view in np.ascontiguousarray(short[..., fixed])], np.int64)
    if (at < 0).any():
        raise PublishedFormatError(
            f"the observation of step {int(np.argmin(at))} does not match {layout.name} from any cell that the ego can "
            f"reach"
        )
    full = np.zeros((len(short), *layout.obs_shape), np.uint8)
    full[:, :rows] = short
    full[:, rows:, :, fixed] = known[at][:, rows:, :, fixed]
    return full
