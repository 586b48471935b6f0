"""Content of meta/info.json: kind, versions, layouts, totals, shard sizes and statistics of a release."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import mul
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import (
    FormatTooNewError,
    FormatTooOldError,
    Icrl4ahtError,
    IndexFormatError,
    OptionError,
    RootNotFoundError,
)
from icrl4aht_data.format.provenance import ProvenanceByTask
from icrl4aht_data.format.schema import INFO, READABLE_VERSIONS, Entry, FiniteNumber, Kind, StreamCount, check_name
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import parse_json, read_text, resolve_inside
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.install_hints import PACKAGE
from icrl4aht_data.utils.text import counted_histories, counted_noun

_NUMBER = r"(0|[1-9]\d*)"
_PRERELEASE = r"(0|[1-9]\d*|\d*[A-Za-z-][0-9A-Za-z-]*)"
_SEMVER = re.compile(
    rf"{_NUMBER}\.{_NUMBER}\.{_NUMBER}(-{_PRERELEASE}(\.{_PRERELEASE})*)?(\+[0-9A-Za-z-]+(\.[0-9A-Za-z-]+)*)?", re.ASCII
)

_VERSION_LENGTH = 100  # maximum number of characters of a version

_Steps = Annotated[int, Meta(gt=0, lt=2**31)]
_Bytes = Annotated[int, Meta(ge=0, lt=2**62)]


class EpisodeLengths(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers of steps per episode.

    Args:
        max_steps: number of steps of an episode while the ego learns.
        kept_steps: number of steps at the start of each episode that the histories contain.
    """

    max_steps: _Steps
    kept_steps: _Steps


class LayoutSummary(msgspec.Struct, frozen=True):
    """Summary of the histories of a release on one layout.

    Args:
        environment_name: the layout's name in the paper's code.
        map: cells of the layout, one string per row.
        recipes: recipes of the layout, three ingredient ids each.
        obs_shape: shape (5, 5, C) of one observation.
        histories: number of histories on this layout.
        tasks: number of tasks on this layout.
        transitions: number of steps on this layout.
        mean_final_return: mean of `Entry.return_end` over the histories.
    """

    environment_name: str
    map: list[str]
    recipes: list[list[int]]
    obs_shape: tuple[int, int, int]
    histories: int
    tasks: int
    transitions: int
    mean_final_return: float


class LayoutStatistics(msgspec.Struct, frozen=True):
    """One column of the paper's table "Dataset statistics per layout".

    Args:
        original_transitions: number of steps of all recorded streams before filtering; None if unknown.
        filtered_transitions: number of steps of the histories in the release.
        history_length: numbers of steps of the shortest and of the longest history.
        teammates: number of different teammates; None if the tasks are unknown.
        steps_per_episode: number of steps of an episode that the histories contain.
        obs_shape: shape (5, 5, C) of one observation.
        actions: number of actions.
        mean_final_return: mean of `Entry.return_end` over the histories.
        disk_bytes: total size of the layout's shards in bytes.
        independent_teammates: number of different teammates, where several checkpoints of one policy count as one;
            None if the tasks are unknown.
    """

    original_transitions: int | None
    filtered_transitions: int
    history_length: tuple[int, int]
    teammates: int | None
    steps_per_episode: int
    obs_shape: tuple[int, int, int]
    actions: int
    mean_final_return: float
    disk_bytes: int
    independent_teammates: int | None


@dataclass(frozen=True)
class LeftOutTask:
    """A task that was planned or generated but has no histories in the release.

    Args:
        task_id: the task's id.
        layout: the layout's short name.
        teammate: name of the teammate, such as "H3/t12" or "fcp/m1".
        source: intended source of the task's histories, see `Entry.source`.
        learners: number of independent learners; 0 if none was trained.
        streams: number of recorded streams of all learners.
        return_start: mean return of the streams' first episodes, see `schema.curve_ends`; None if nothing was recorded.
        return_end: mean return of the streams' last episodes; None if nothing was recorded.
        reason: a sentence that says why the task was left out.
    """

    task_id: str
    layout: str
    teammate: str
    source: str
    learners: StreamCount
    streams: StreamCount
    return_start: FiniteNumber | None
    return_end: FiniteNumber | None
    reason: str


@dataclass(frozen=True, repr=False)
class ReleaseInfo:
    """Content of meta/info.json.

    Args:
        format_version: version of the file format, one of `schema.READABLE_VERSIONS`.
        data_version: version of the data, in the form of SemVer.
        kind: which arrays the shards store, see `schema.Kind`.
        actions: names of the actions, by action id.
        environment: numbers of steps per episode.
        histories: number of histories.
        transitions: total number of steps.
        layouts: summaries by layout name, in order of first appearance in the index.
        shards: sizes of the shards in bytes, by path in the release.
        statistics: statistics as in the paper, by layout name; empty in older releases.
        left_out: tasks without histories in the release, for example because the learner did not improve.
    """

    format_version: int
    data_version: str
    kind: Kind
    actions: list[str]
    environment: EpisodeLengths
    histories: int
    transitions: int
    layouts: dict[str, LayoutSummary]
    shards: dict[str, _Bytes]
    statistics: dict[str, LayoutStatistics] = field(default_factory=dict)
    left_out: list[LeftOutTask] = field(default_factory=list)

    def __repr__(self) -> str:
        return (
            f"ReleaseInfo({self.kind} release {self.data_version} of format {self.format_version}: "
            f"{counted_histories(self.histories)} and {counted_noun(self.transitions, 'transition')} on "
            f"{', '.join(self.layouts)}; {counted_noun(len(self.shards), 'shard')}, "
            f"{counted_noun(len(self.left_out), 'task')} left out)"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the content of info.json as a JSON object, without empty `shards`, `statistics` and `left_out`."""
        content = json.loads(msgspec.json.encode(self))
        return {name: value for name, value in content.items() if value not in ({}, [])}

    @classmethod
    def from_json(cls, content: Any) -> ReleaseInfo:
        """Parse the JSON object of an info.json.

        Raises:
            IndexFormatError: if a value is wrong or missing; the caller adds the file's path to the message.
        """
        try:
            info = msgspec.convert(content, cls)
            check_version(info.data_version)  # a bad version would end up in tags and folder names
            for task in info.left_out:
                for text in (task.task_id, task.layout, task.teammate, task.source, task.reason):
                    check_name(text)
        except (msgspec.ValidationError, Icrl4ahtError) as error:
            raise IndexFormatError(str(error)) from error
        return info


def read_info(root: Path) -> ReleaseInfo:
    """Read meta/info.json of a release.

    Raises:
        RootNotFoundError: if the folder is not a release.
        FormatTooNewError, FormatTooOldError: if the release has another format version.
        IndexFormatError: if the file is malformed.
    """
    path = resolve_inside(root, INFO)
    if not path.is_file():
        raise RootNotFoundError(
            f"{root}: no release here, expected the file {INFO}; give the folder of a release, fetch one with "
            f"`icrl4aht-data download`, or give no folder for the bundled release"
        )
    try:
        content = parse_json(read_text(path))
        version = content.get("format_version") if isinstance(content, dict) else None
        if not isinstance(version, int):
            raise IndexFormatError("expected an object with an integer format_version")
        if version in READABLE_VERSIONS:
            return ReleaseInfo.from_json(content)
    except IndexFormatError as error:
        raise IndexFormatError(f"{path}: malformed: {error}") from error
    found = f"{path}: format version {version}, this package reads {', '.join(map(str, READABLE_VERSIONS))}"
    if version > max(READABLE_VERSIONS):
        raise FormatTooNewError(f"{found}: update the package with `pip install -U {PACKAGE}`")
    raise FormatTooOldError(f"{found}: fetch a newer version of the release")


def check_version(version: str) -> None:
    """Check that a data version is valid SemVer.

    Raises:
        OptionError: if the version is not valid, or longer than 100 characters.
    """
    if not isinstance(version, str) or len(version) > _VERSION_LENGTH or not _SEMVER.fullmatch(version):
        raise OptionError(f"data version {version!r:.100}: expected a SemVer version such as 1.0.0 or 1.0.0-rc.1")


def make_info(kind: Kind, data_version: str, kept_steps: int, entries: list[Entry], format_version: int) -> ReleaseInfo:
    """Return the `ReleaseInfo` of a release with the given entries, without shard sizes and statistics."""
    layouts = {}
    for name, members in grouped(entries, lambda entry: entry.layout).items():
        layout = get_layout(name)
        layouts[name] = LayoutSummary(
            environment_name=layout.alias,
            map=list(layout.rows),
            recipes=[list(recipe) for recipe in layout.recipes],
            obs_shape=layout.obs_shape,
            histories=len(members),
            tasks=len({entry.task_id for entry in members}),
            transitions=sum(entry.T for entry in members),
            mean_final_return=round(float(np.mean([entry.return_end for entry in members])), 3),
        )
    return ReleaseInfo(
        format_version=format_version,
        data_version=data_version,
        kind=kind,
        actions=list(ACTIONS),
        environment=EpisodeLengths(EPISODE_STEPS, kept_steps),
        histories=len(entries),
        transitions=sum(entry.T for entry in entries),
        layouts=layouts,
        shards={},
    )


def layout_statistics(
    described: ReleaseInfo, entries: Sequence[Entry], tasks: Sequence[Task], provenance: ProvenanceByTask
) -> dict[str, LayoutStatistics]:
    """Return the statistics of every layout, in order of first appearance.

    Args:
        described: result of `make_info` for the entries, with the sizes of the shards.
        entries: entries of the release's index.
        tasks: the release's tasks.
        provenance: how the histories of each task were made, by task id.
    """
    statistics = {}
    for layout, members in grouped(entries, lambda entry: entry.layout).items():
        summary = described.layouts[layout]
        lengths = {entry.task_id: entry.T for entry in members}
        recorded = [provenance.of(task_id).streams_recorded for task_id in lengths]
        streams = [number for number in recorded if number is not None]
        original = sum(map(mul, streams, lengths.values())) if len(streams) == len(recorded) else None
        own = [task for task in tasks if task.task_id in lengths]
        teammates = {json.dumps(task.teammate, sort_keys=True) for task in own}
        statistics[layout] = LayoutStatistics(
            original_transitions=original,
            filtered_transitions=summary.transitions,
            history_length=(min(entry.T for entry in members), max(entry.T for entry in members)),
            teammates=len(teammates) or None,
            steps_per_episode=described.environment.kept_steps,
            obs_shape=summary.obs_shape,
            actions=len(ACTIONS),
            mean_final_return=summary.mean_final_return,
            independent_teammates=len(set(map(_policy_key, own))) or None,
            disk_bytes=sum(described.shards[shard] for shard in {entry.shard for entry in members}),
        )
    return statistics


def _policy_key(task: Task) -> str:
    """Return a key of a task's teammate that is equal for all checkpoints of one policy."""
    checkpoint = task.teammate.get("theta", {}).get("checkpoint")
    if task.teammate_family != "rl" or checkpoint is None:
        return json.dumps(task.teammate, sort_keys=True)
    return f"{checkpoint.rpartition('/')[0]} {task.teammate.get('base_seed')}"
