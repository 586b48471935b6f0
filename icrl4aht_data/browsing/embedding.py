"""Selection and compression of the histories and episodes that a page embeds."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.errors import ReleaseError
from icrl4aht_data.format.layouts_file import layout_title
from icrl4aht_data.format.schema import ACTION_FIELDS, FIELDS, Entry, episode_returns
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import faults
from icrl4aht_data.reading.history import History

NO_ACTION = 255
"""Placeholder action of an episode's last frame, which shows the state after the last step."""

_INDEX_FIELDS = ("history_id", "task_id", "layout", "source", "split", "track", "learner", "episodes", "expert_return")


class EmbeddedHistory(NamedTuple):
    """One history in the form that a page embeds.

    Attributes:
        facts: JSON object: properties to choose a history by; `returns` of all episodes; `shown`, the numbers of the
            episodes with frames, from 0; `frames` per episode, one more than its steps; `columns`, the names of the
            columns after those of the state record.
        records: uint8 (F, S), the state records of all frames.
        data: columns of F bytes each, compressed by zlib: those of the state record, then `columns`. Rewards are int8.
            The last frame of an episode has action `NO_ACTION` and reward 0.
    """

    facts: dict[str, Any]
    records: np.ndarray
    data: bytes


def spread_histories(dataset: Dataset, count: int) -> list[int]:
    """Return the ids of at most `count` histories, ascending, spread over layouts, kinds of teammates and sources.

    The generated layouts of a family count as one.
    """
    groups: dict[str, dict[str, dict[tuple[str, ...], list[int]]]] = {}
    names = ("layout", "source", "teammate_family", "teammate_kind")
    columns = (dataset.column(name).tolist() for name in names)
    for number, layout, source, *kind in zip(dataset.ids.tolist(), *columns, strict=True):
        of_source = groups.setdefault(layout_title(layout), {}).setdefault(source, {})
        of_source.setdefault(tuple(kind), []).append(number)
    layouts = (_alternating(_alternating(kinds.values()) for kinds in layout.values()) for layout in groups.values())
    return sorted(_alternating(layouts)[:count])


def _alternating(lists: Iterable[list[int]]) -> list[int]:
    """Return the first elements of all lists, then the second ones, and so on."""
    return [number for turn in zip_longest(*lists) for number in turn if number is not None]


def spread_episodes(episodes: int, most: int | None) -> np.ndarray:
    """Return the numbers of at most `most` evenly spaced episodes of a history, including the first and the last."""
    if most is None or most >= episodes:
        return np.arange(episodes)
    return np.unique(np.linspace(0, episodes - 1, max(2, most)).round().astype(int))


def embed_history(history: History, most: int | None = None) -> EmbeddedHistory:
    """Return a history for embedding, with frames of all its episodes or at most `most` of them.

    Raises:
        NotStoredError: if the release has no state records.
        ReleaseError: if the release cannot be read, or has impossible states or actions.
    """
    entry, rewards, dones = history.entry, history.read("rewards"), history.read("dones")
    ends = np.flatnonzero(dones) + 1
    _check(history, len(ends) == entry.episodes, f"{entry.episodes} episodes", f"{len(ends)} ends of episodes")
    starts, shown = np.concatenate([[0], ends[:-1]]), spread_episodes(len(ends), most)
    steps = np.concatenate(
        [np.arange(int(starts[e]), int(ends[e]) + 1) for e in shown]
    )  # no step follows the last frame of an episode
    last = np.cumsum(ends[shown] + 1 - starts[shown]) - 1
    steps[last] -= 1

    records = history.read("state")[steps]
    records[last] = history.read("episode_end_state")[shown]
    wrong = faults(get_layout(entry.layout), records)
    _check(history, not wrong, "possible states", "; ".join(wrong))
    values = {"rewards": rewards[steps].astype(np.int8).view(np.uint8)}
    values["rewards"][last] = 0
    for name in _embedded_actions(entry):
        values[name] = history.read(name)[steps].astype(np.uint8)
        _check(history, int(values[name].max()) < len(ACTIONS), f"{name} below {len(ACTIONS)}", values[name].max())
        values[name][last] = NO_ACTION
    # Column-major order compresses best, since columns change little over time.
    columns = np.vstack([records.T, *values.values()])
    facts = {
        **{name: getattr(entry, name) for name in _INDEX_FIELDS},
        "steps": entry.T,
        "returns": episode_returns(rewards, dones).tolist(),
        "shown": shown.tolist(),
        "frames": np.diff(last, prepend=-1).tolist(),
        "columns": list(values),
    }
    return EmbeddedHistory(facts, records, zlib.compress(np.ascontiguousarray(columns).tobytes(), 9))


def _check(history: History, fulfilled: bool, expected: str, found: object) -> None:
    if not fulfilled:
        raise ReleaseError(
            f"{history.entry.shard}: history {history.entry.history_id}: expected {expected}, found {found}; "
            f"`icrl4aht-data verify --deep` lists all problems"
        )


def _embedded_actions(entry: Entry) -> list[str]:
    """Return the action fields to show, without `oracle_actions` if they equal `expert_actions`."""
    names = [name for name in ACTION_FIELDS if entry.has(FIELDS[name])]
    twice = entry.source == "noise" and "expert_actions" in names
    return [name for name in names if not (twice and name == "oracle_actions")]
