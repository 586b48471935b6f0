"""Self-contained HTML page that shows learning curves of histories and replays their episodes."""

from __future__ import annotations

import json
import zlib
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_data.browsing.drawings import hex_colour, layout_drawings
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import NotStoredError, OptionError, ReleaseError
from icrl4aht_data.fetch import Remote
from icrl4aht_data.format.layouts_file import layout_title
from icrl4aht_data.format.schema import ACTION_FIELDS, FIELDS
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.cells import WINDOW
from icrl4aht_data.overcooked.drawing import AGENT_COLOURS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import faults
from icrl4aht_data.reading.history import History
from icrl4aht_data.utils.files import PAGE_START, write_atomically
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import counted_histories

BROWSER_PAGE_START = PAGE_START + b"histories</title>"
"""First bytes of a page; an output file that starts with them may be replaced."""

PAGE_HISTORIES = 30
"""Default number of histories on a page."""

PAGE_MEGABYTES = 5
"""Default maximum size of a page, in MB."""

_FILES = Path(__file__).parent

NO_ACTION = 255
"""Placeholder action of an episode's last frame, which shows the state after the last step."""

_INDEX_FIELDS = (
    *("history_id", "task_id", "layout", "source", "split", "learner", "episodes", "expert_return"),
    *("return_start", "return_end"),
)


class EmbeddedHistory(NamedTuple):
    """One learning history in the form that an HTML page embeds.

    Attributes:
        facts: JSON object with index fields of the history; `returns`, the return of every episode; `shown`, the
            numbers (from 0) of the episodes that can be replayed; `frames`, the number of frames of each shown episode,
            one more than its steps; `columns`, the names of the columns of `data` after the state record.
        records: uint8 (F, S), the state records of all frames.
        data: columns of F bytes each, compressed by zlib: the bytes of the state record, then `columns`. Rewards are
            int8. The last frame of an episode has action `NO_ACTION` and reward 0.
    """

    facts: dict[str, Any]
    records: np.ndarray
    data: bytes


def varied_history_ids(dataset: Dataset, count: int) -> list[int]:
    """Return at most `count` history ids, ascending, spread over layouts, sources and teammate kinds.

    Layouts take turns. In its turn, a layout gives a history of the source, and of this source's teammate kind, of
    which the fewest histories were chosen before. The generated layouts of a family count as one layout.
    """
    groups: dict[str, dict[tuple[str, ...], list[int]]] = {}
    names = ("layout", "source", "teammate_family", "teammate_kind")
    columns = (dataset.column(name).tolist() for name in names)
    for number, layout, *kind in zip(dataset.ids.tolist(), *columns, strict=True):
        groups.setdefault(layout_title(layout), {}).setdefault(tuple(kind), []).append(number)
    chosen: list[int] = []
    sources, kinds = Counter[str](), Counter[tuple[str, ...]]()
    while groups and len(chosen) < count:
        for layout, remaining in list(groups.items())[: count - len(chosen)]:
            kind = min(remaining, key=lambda one: (sources[one[0]], kinds[one[1:]]))
            chosen.append(remaining[kind].pop(0))
            sources[kind[0]] += 1
            kinds[kind[1:]] += 1
            if not remaining[kind]:
                del remaining[kind]
            if not remaining:
                del groups[layout]
    return sorted(chosen)


def evenly_spaced_episodes(episodes: int, most: int | None) -> np.ndarray:
    """Return the numbers of at most `most` evenly spaced episodes of a history, including the first and the last."""
    if most is None or most >= episodes:
        return np.arange(episodes)
    return np.unique(np.linspace(0, episodes - 1, max(2, most)).round().astype(int))


def embed_history(history: History, most: int | None = None) -> EmbeddedHistory:
    """Return a history in the form that a page embeds, with frames of at most `most` episodes (None: all).

    Raises:
        NotStoredError: if the release has no state records.
        ReleaseError: if the release cannot be read, or has impossible states or actions.
    """
    entry, rewards, ends = history.entry, history.read("rewards"), history.episode_ends
    _require(history, len(ends) == entry.episodes, f"{entry.episodes} episodes", f"{len(ends)} ends of episodes")
    starts, shown = np.concatenate([[0], ends[:-1]]), evenly_spaced_episodes(len(ends), most)
    # An episode with n steps has n + 1 frames: the last frame shows the state after the last step.
    steps = np.concatenate([np.arange(int(starts[e]), int(ends[e]) + 1) for e in shown])
    last = np.cumsum(ends[shown] + 1 - starts[shown]) - 1
    steps[last] -= 1

    records = history.read("state")[steps]
    records[last] = history.read("episode_end_state")[shown]
    wrong = faults(get_layout(entry.layout), records)
    _require(history, not wrong, "possible states", "; ".join(wrong))
    values = {"rewards": rewards[steps].astype(np.int8).view(np.uint8)}
    values["rewards"][last] = 0
    for name in (name for name in ACTION_FIELDS if entry.has(FIELDS[name])):
        if name == "oracle_actions" and entry.source == "noise" and "expert_actions" in values:
            continue  # in histories with action noise, the expert actions are the oracle actions
        values[name] = history.read(name)[steps].astype(np.uint8)
        _require(history, int(values[name].max()) < len(ACTIONS), f"{name} below {len(ACTIONS)}", values[name].max())
        values[name][last] = NO_ACTION
    # Column-major order compresses best, since columns change little over time.
    columns = np.vstack([records.T, *values.values()])
    facts = {
        **{name: getattr(entry, name) for name in _INDEX_FIELDS},
        "steps": entry.T,
        "returns": history.returns().tolist(),
        "shown": shown.tolist(),
        "frames": np.diff(last, prepend=-1).tolist(),
        "columns": list(values),
    }
    return EmbeddedHistory(facts, records, zlib.compress(np.ascontiguousarray(columns).tobytes(), 9))


def _require(history: History, fulfilled: bool, expected: str, found: object) -> None:
    if not fulfilled:
        raise ReleaseError(
            f"{history.entry.shard}: history {history.entry.history_id}: expected {expected}, found {found}; "
            f"`icrl4aht-data verify --deep` lists all problems"
        )


@dataclass(frozen=True)
class BrowserPage:
    """An HTML page that shows learning histories.

    Attributes:
        html: content of the HTML file, in UTF-8.
        histories: number of histories on the page.
        episodes: number of episodes of the histories on the page.
        shown_episodes: number of episodes that the page can replay.
    """

    html: bytes = field(repr=False)
    histories: int
    episodes: int
    shown_episodes: int


def make_browser_page(
    dataset: Dataset,
    *,
    megabytes: float = PAGE_MEGABYTES,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> BrowserPage:
    """Return an HTML page with all histories of a selection; use `varied_history_ids` to choose fewer histories.

    The page embeds all episodes if it stays below `megabytes`, otherwise evenly spaced episodes of each history,
    including the first and the last. The page says which episodes can be watched.

    Args:
        dataset: the selection of histories to show.
        megabytes: maximum size of the page, in millions of bytes.
        advance: called with the number of histories read and the total number to read.

    Raises:
        NotStoredError: if the release has no state records.
        OptionError: if the page would be too large even with two episodes per history.
        ReleaseError: if the release cannot be read.
    """
    if not dataset.has_states:
        raise NotStoredError(
            f"{dataset.origin}: a release of kind {dataset.info.kind} has no state records, so there is nothing to "
            f"draw; browse a full or lite release"
        )
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
    """Write an HTML page to a file atomically."""
    write_atomically(path, page.html)


def _render(dataset: Dataset, embedded: Sequence[EmbeddedHistory]) -> bytes:
    info, origin = dataset.info, dataset.origin
    name = str(origin) if isinstance(origin, Remote) else dataset.root.resolve().name  # omits a folder's parents
    by_layout = grouped(embedded, lambda one: one.facts["layout"])
    index = {
        "release": {"name": name, "kind": info.kind, "version": info.data_version, "histories": info.histories},
        "actions": ACTIONS,
        "no_action": NO_ACTION,
        "window": WINDOW,
        "layouts": {
            layout: layout_drawings(get_layout(layout), np.concatenate([one.records for one in own]))
            for layout, own in by_layout.items()
        },
        "histories": [one.facts | {"teammate": _teammate_label(dataset, one.facts["history_id"])} for one in embedded],
    }
    packed = zlib.compress(json.dumps(index, separators=(",", ":")).encode(), 9)
    data = {"index": b64encode(packed).decode(), "histories": [b64encode(one.data).decode() for one in embedded]}
    text = Template(page_source("page.html")).substitute(
        release=escape(name),
        style=page_style(),
        script="\n".join(map(page_source, ("state.js", "curve.js", "page.js"))),
        data=json.dumps(data),  # safe in a <script> element: base64 cannot contain a closing tag
    )
    return text.encode()


def _teammate_label(dataset: Dataset, history_id: int) -> str:
    """Return the family and kind of a history's teammate as text, with the teammate's number if tasks are known."""
    entry = dataset.index.entry(history_id)
    name = f"{entry.teammate_family}/{entry.teammate_kind}"
    return f"{name} t{dataset.recover_teammate(history_id)['theta_id']}" if dataset.has_tasks else name


def page_style() -> str:
    """Return the CSS style sheet of a page, with the colours of the agents as variables."""
    colours = {"ego": AGENT_COLOURS[EGO], "teammate": AGENT_COLOURS[TEAMMATE]}
    style = "".join(f"--{agent}: {hex_colour(colour)}; " for agent, colour in colours.items())
    return f":root {{ {style}}}\n{page_source('page.css')}"


def page_source(name: str) -> str:
    """Return the text of a source file of the page, such as `state.js`."""
    return (_FILES / name).read_text(encoding="utf-8")
