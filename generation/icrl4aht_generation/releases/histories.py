"""Selection of the histories that a release keeps of each task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icrl4aht_data.benchmark.facts import LEAST_HEADROOM
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.info import LeftOutTask
from icrl4aht_data.format.schema import curve_ends
from icrl4aht_data.writing.card import teammate_name
from icrl4aht_generation.collection.curate import select_streams, stream_returns
from icrl4aht_generation.profiles import Profile, Work
from icrl4aht_generation.releases.measures import TeammateFacts


class TaskHistories(NamedTuple):
    """Recorded histories of a task, and those that the release keeps.

    Attributes:
        task: the task.
        source: how they were made.
        folders: artefact of each learner.
        returns: for each learner float64 (N, E), episode returns of its streams.
        streams: for each learner int (n,), numbers of the kept streams, best first.
        least_improvement: what a stream had to improve by to be kept; None for any.
    """

    task: Task
    source: str
    folders: list[Path]
    returns: list[np.ndarray]
    streams: list[np.ndarray]
    least_improvement: float | None

    @property
    def recorded(self) -> np.ndarray:
        """float64 (N, E), episode returns of all streams of all learners."""
        return np.concatenate(self.returns)

    @property
    def kept(self) -> np.ndarray:
        """float64 (n, E), episode returns of the kept streams."""
        return np.concatenate([own[streams] for own, streams in zip(self.returns, self.streams, strict=True)])

    def left_out(self, reason: str) -> LeftOutTask:
        """Return the note about a task that the release leaves out."""
        start, end = (round(float(ends.mean()), 3) for ends in curve_ends(self.recorded))
        learners = len(self.folders) if self.source == "ppo" else 0
        layout, name = self.task.layout.name, teammate_name(self.task)
        return LeftOutTask(
            self.task.task_id, layout, name, self.source, learners, len(self.recorded), start, end, reason
        )


def select_histories(
    artefacts: Path, units: Sequence[Work], profile: Profile, facts: TeammateFacts, *, headroom: bool
) -> TaskHistories | LeftOutTask:
    """Choose the histories of a task that a release keeps.

    A scripted history is always kept; of the streams of learners, the best are kept. On layouts with headroom,
    `profile.least_improvement` also drops the streams that improve by less, and the tasks whose teammate makes no
    difference to the ego; `profile.least_rise` drops the tasks whose kept histories rise by less.

    Args:
        artefacts: folder of the finished artefacts.
        units: the task's units of work.
        profile: the profile.
        facts: facts about the teammate.
        headroom: whether the ego matters with any teammate of the profile on this layout.
    """
    task, source = units[0].task, units[0].source
    folders = [artefacts / work.name for work in units]
    returns = [stream_returns(np.load(folder / "rewards.npy", mmap_mode="r")) for folder in folders]
    least = profile.least_improvement if headroom else None
    if source == "ppo":
        streams = select_streams(returns, profile.keep, least)
    else:
        streams = [np.arange(len(own)) for own in returns]
    found = TaskHistories(task, source, folders, returns, streams, least)
    if least is not None and not facts.matters:
        return found.left_out(
            f"the ego does not matter: returns of these egos differ by less than {LEAST_HEADROOM:g}: "
            f"{facts.references.describe()}"
        )
    if not len(found.kept):
        return found.left_out(f"the learners did not learn: no stream's end exceeds its start by {least or 0:g}")
    start, end = curve_ends(found.kept)
    if headroom and profile.least_rise is not None and end.mean() - start.mean() < profile.least_rise:
        return found.left_out(
            f"its histories rise by {end.mean() - start.mean():.1f} on average, expected {profile.least_rise:g}"
        )
    return found
