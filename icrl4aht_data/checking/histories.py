"""Checks of the arrays of histories: checksums, ranges, episodes, values of the index, and the rules of the game."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from icrl4aht_data.checking.report import Report
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.format.info import ReleaseInfo
from icrl4aht_data.format.schema import (
    ACTION_FIELDS,
    FIELDS,
    KINDS,
    curve_ends,
    episode_ends,
    episode_returns,
    record_field,
    stream_score,
)
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.rules import step
from icrl4aht_data.overcooked.state import columns, faults, start
from icrl4aht_data.reading.history import History
from icrl4aht_data.reading.shard import Shard
from icrl4aht_data.utils.system import free_memory
from icrl4aht_data.writing.published_views import empty_views

_COPIES = 4  # memory of checking a history, in multiples of the size of its arrays


def check_chunks(shard: Shard, report: Report) -> set[int]:
    """Decode every chunk of a shard, and return the ids of histories with a damaged chunk."""
    damaged = set()
    for row, history_id, field in shard.chunks():
        try:
            shard.decode(row, history_id, field)
        except Icrl4ahtError as error:
            report.add(shard.name, str(error))
            damaged.add(history_id)
        report.chunks += 1
    return damaged


def check_history(
    history: History, layout: Layout, info: ReleaseInfo, contents: dict[tuple[str, bytes], int], report: Report
) -> None:
    """Check one history whose chunks are valid.

    Args:
        history: the history.
        layout: its layout, with the recipes of its task.
        info: the release's info.
        contents: (task id, hash of the ego's observations and actions) -> history id, of the histories checked so far;
            receives this one.
        report: receives the problems.
    """
    entry = history.entry
    try:
        step_bytes = sum(field.element(layout, info.kind).itemsize for field in entry.stored_fields(info.kind))
        if (size := _COPIES * entry.T * step_bytes) > free_memory():
            raise OptionError(f"takes {size / 1e9:.3g} GB of memory, more than is free")
        for fault in _history_faults(history, layout, info.environment.kept_steps, deep=report.level == "deep"):
            report.add(entry.shard, f"history {entry.history_id}: {fault}")
        arrays = (history.read(name) for name in (record_field(info.kind).name, "actions"))
        digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).digest()
        other = contents.setdefault((entry.task_id, digest), entry.history_id)
        if other != entry.history_id:
            report.add(entry.shard, f"history {entry.history_id}: has the content of history {other}")
        report.transitions += entry.T
    except (Icrl4ahtError, MemoryError) as error:
        report.add(entry.shard, f"history {entry.history_id}: could not be checked: {error!r}")


def _history_faults(history: History, layout: Layout, kept_steps: int, deep: bool) -> Iterator[str]:
    entry = history.entry
    dones, rewards, has_states = history.read("dones"), history.read("rewards"), history.kind in KINDS
    # Only a release of observations may end a history within an episode.
    counted = entry.episodes == entry.T // kept_steps and not (has_states and entry.T % kept_steps)
    if not counted or not np.array_equal(dones, episode_ends(entry.T, kept_steps)):
        yield f"dones: expected {entry.episodes} episodes of {kept_steps} steps, found {dones.sum()} in {entry.T} steps"
        return
    for name in (name for name in ACTION_FIELDS if entry.has(FIELDS[name])):
        values = history.read(name)
        if values.min() < 0 or values.max() >= len(ACTIONS):
            yield f"{name}: expected 0..{len(ACTIONS) - 1}, found {values.min()}..{values.max()}"
    if entry.source == "noise" and entry.has_expert_actions and entry.has_oracle_actions:
        wrong = np.flatnonzero(history.read("expert_actions") != history.read("oracle_actions"))
        if len(wrong):
            yield f"expert_actions: {len(wrong)} differ from the script's, oracle_actions, first step {wrong[0]}"
    if (rewards != np.rint(rewards)).any() or np.abs(rewards).max() > np.iinfo(FIELDS["rewards"].compact).max:
        yield f"rewards: expected integers that fit into a byte, found {rewards.min()}..{rewards.max()}"
    possible = True
    for name in ("state", "episode_end_state") if has_states else ():
        for fault in faults(layout, history.read(name)):
            possible = False
            yield f"{name} has {fault}"
    returns = episode_returns(rewards, dones)[None]
    first, last = curve_ends(returns)
    derived = {"return_start": first[0], "return_end": last[0], "return_mean": returns.mean()}
    derived["score"] = stream_score(returns)[0]
    for name, value in derived.items():
        if not np.isclose(value, getattr(entry, name), rtol=0, atol=1e-9):
            yield f"{name}: the index says {getattr(entry, name)}, the rewards give {value}"
    if deep and not has_states:
        yield from observation_faults(layout, history)
    elif deep and possible:  # the rules accept only possible states
        yield from replay_faults(layout, history, dones, rewards)


def observation_faults(layout: Layout, history: History) -> Iterator[str]:
    """Yield a problem if an observation does not match the layout's fixed cells; needs no state records."""
    fixed = fixed_channels(layout)
    views = {view.tobytes() for view in empty_views(layout)[..., fixed]}
    wrong = [t for t, seen in enumerate(history.read("obs")[..., fixed]) if seen.tobytes() not in views]
    if wrong:
        yield f"obs: {len(wrong)} steps do not show {layout.name} from any cell of the ego's, first step {wrong[0]}"


def replay_faults(layout: Layout, history: History, dones: np.ndarray, rewards: np.ndarray) -> Iterator[str]:
    """Replay every step of a history with state records, and yield contradictions to the rules.

    Args:
        layout: the history's layout.
        history: the history, with possible states only.
        dones: bool (T,), last steps of episodes.
        rewards: (T,), the recorded rewards.
    """
    states, ends = history.read("state"), history.read("episode_end_state")
    if history.kind == "full":
        wrong = np.flatnonzero((history.read("obs") != observe(layout, states, EGO)).any(axis=(1, 2, 3)))
        if len(wrong):
            yield f"obs: {len(wrong)} steps differ from what their state shows, first step {wrong[0]}"
    following = np.concatenate([states[1:], states[:1]])
    following[dones] = ends
    recipe = columns(layout).recipe
    actions = np.stack([history.read("actions"), history.read("teammate_actions")], axis=-1)
    # New recipes are random, so the replay takes the recorded ones.
    played = step(layout, states, np.clip(actions, 0, len(ACTIONS) - 1), following[:, recipe])
    wrong = np.flatnonzero((played.state != following).any(axis=-1))
    if len(wrong):
        yield f"replay: {len(wrong)} steps do not lead to the recorded next state, first step {wrong[0]}"
    wrong = np.flatnonzero(played.reward != rewards)
    if len(wrong):
        t = int(wrong[0])
        yield f"replay: {len(wrong)} rewards differ, first at step {t}: rules {played.reward[t]}, found {rewards[t]}"
    if not np.isin([*states[:, recipe], *ends[:, recipe]], layout.recipe_items).all():
        yield "a recipe is not one of the layout's"
    starts = states[np.concatenate([[0], np.flatnonzero(dones)[:-1] + 1])]
    positions = starts[:, columns(layout).positions]
    fresh = start(layout, positions, starts[:, columns(layout).facings], starts[:, recipe])
    differs = (fresh != starts).any(axis=-1)
    for agent in (0, 1):
        differs |= ~np.isin(positions[:, agent], layout.rooms[agent])
    if differs.any():
        yield f"{differs.sum()} episodes do not start as the environment starts, first episode {differs.argmax()}"
