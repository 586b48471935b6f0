"""Self-contained HTML page that shows learning curves of histories and replays their episodes."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template

import numpy as np

from icrl4aht_data.browsing.drawings import hex_colour, layout_drawings
from icrl4aht_data.browsing.embedding import NO_ACTION, EmbeddedHistory, embed_history
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import NotStoredError, OptionError
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.cells import WINDOW
from icrl4aht_data.overcooked.drawing import AGENT_COLOURS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_data.utils.text import counted_histories

PAGE_START = b'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>ICRL4AHT histories</title>'
"""First bytes of a page, which identify a file that may be replaced."""

PAGE_HISTORIES = 30
"""Default number of histories on a page."""

PAGE_MEGABYTES = 5
"""Default maximum size of a page, in MB."""

_FILES = Path(__file__).parent


@dataclass(frozen=True)
class BrowserPage:
    """HTML page with histories.

    Attributes:
        html: the complete file, UTF-8.
        histories: number of histories on the page.
        episodes: number of episodes of these histories.
        shown_episodes: number of episodes that the page can replay.
    """

    html: bytes = field(repr=False)
    histories: int
    episodes: int
    shown_episodes: int


def check_drawable(dataset: Dataset) -> None:
    """Check that the episodes of a release can be drawn.

    Raises:
        NotStoredError: if the release has no state records.
    """
    if not dataset.has_states:
        raise NotStoredError(
            f"{dataset.origin}: a release of kind {dataset.info.kind} has no state records, so there is nothing to "
            f"draw; browse a full or lite release"
        )


def make_browser_page(
    dataset: Dataset,
    *,
    megabytes: float = PAGE_MEGABYTES,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> BrowserPage:
    """Return a page with all histories of a selection; see `spread_histories` for a smaller one.

    Embeds all episodes if the page stays below `megabytes`; else evenly spaced episodes of each history, including the
    first and the last. The page says which episodes can be watched.

    Args:
        dataset: the histories.
        megabytes: maximum size of the page, in millions of bytes.
        advance: called with the number of histories read and the total number to read.

    Raises:
        NotStoredError: if the release has no state records.
        OptionError: if the page would be too large even with two episodes per history.
        ReleaseError: if the release cannot be read.
    """
    check_drawable(dataset)
    most: int | None = None
    while True:
        embedded = []
        for number, history in enumerate(dataset):
            embedded.append(embed_history(history, most))
            advance(number + 1, len(dataset))
        html = _render(dataset, embedded)
        if len(html) < megabytes * 1e6:
            shown = sum(len(one.facts["shown"]) for one in embedded)
            return BrowserPage(html, len(embedded), sum(one.facts["episodes"] for one in embedded), shown)
        longest = max(len(one.facts["shown"]) for one in embedded)
        if longest <= 2:
            raise OptionError(
                f"the page has {len(html) / 1e6:.2f} MB with the first and last episodes of "
                f"{counted_histories(len(dataset))}, expected less than {megabytes:g} MB: take fewer histories, or "
                f"allow a larger page"
            )
        most = max(2, min(longest - 1, int(longest * 0.95 * megabytes * 1e6 / len(html))))


def save_browser_page(page: BrowserPage, path: Path) -> None:
    """Write a page atomically."""
    with atomic_write(path) as partial:
        partial.write_bytes(page.html)


def _render(dataset: Dataset, embedded: Sequence[EmbeddedHistory]) -> bytes:
    name, info = _release_name(dataset), dataset.info
    records: dict[str, list[np.ndarray]] = {}
    for one in embedded:
        records.setdefault(one.facts["layout"], []).append(one.records)
    index = {
        "release": {"name": name, "kind": info.kind, "version": info.data_version, "histories": info.histories},
        "actions": ACTIONS,
        "no_action": NO_ACTION,
        "window": WINDOW,
        "layouts": {one: layout_drawings(get_layout(one), np.concatenate(own)) for one, own in records.items()},
        "histories": [one.facts | {"teammate": _teammate(dataset, one.facts["history_id"])} for one in embedded],
    }
    packed = zlib.compress(json.dumps(index, separators=(",", ":")).encode(), 9)
    data = {"index": _base64(packed), "histories": [_base64(one.data) for one in embedded]}
    colours = {"ego": AGENT_COLOURS[EGO], "teammate": AGENT_COLOURS[TEAMMATE]}
    style = "".join(f"--{agent}: {hex_colour(colour)}; " for agent, colour in colours.items())
    text = Template(_source("page.html")).substitute(
        release=escape(name),
        style=f":root {{ {style}}}\n{_source('page.css')}",
        script="\n".join(map(_source, ("state.js", "curve.js", "page.js"))),
        data=json.dumps(data),  # base64 cannot contain a closing tag
    )
    return text.encode()


def _teammate(dataset: Dataset, history_id: int) -> str:
    """Return the family and kind of a history's teammate, with its number if the release has tasks."""
    entry = dataset.index.entry(history_id)
    name = f"{entry.teammate_family}/{entry.teammate_kind}"
    return f"{name} t{dataset.recover_teammate(history_id)['theta_id']}" if dataset.knows_tasks else name


def _release_name(dataset: Dataset) -> str:
    """Return the address of a remote release, or the name of a local folder without its path."""
    return str(dataset.origin) if dataset.origin.remote else dataset.root.resolve().name


def _source(name: str) -> str:
    return (_FILES / name).read_text(encoding="utf-8")


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
