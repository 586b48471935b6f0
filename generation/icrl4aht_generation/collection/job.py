"""The tasks of a rebuild as jobs of a queue."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from icrl4aht_data.overcooked.layouts import Layout, add_layouts
from icrl4aht_generation.collection.scripted import play_histories
from icrl4aht_generation.collection.scripted_rollout import scripted_pieces
from icrl4aht_generation.collection.task import TASK_SAVE_SECONDS, learn_histories
from icrl4aht_generation.collection.task_folder import is_task_finished, last_timing, partial_folder, publish_artefact
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.resume import run_lock
from icrl4aht_generation.profiles import Profile, Work

_MAKERS = {"ppo": learn_histories, "noise": play_histories, "search": play_histories}
"""Source -> function that makes an artefact in its partial folder, or resumes it there."""


@dataclass(frozen=True)
class CollectionJob:
    """The job that makes the artefact of one unit of work.

    Attributes:
        work: the unit.
        profile: its profile.
        artefacts: folder of all artefacts.
        suite: folder of the learned teammates, if the tasks have any.
        layouts: the profile's generated layouts. A worker has to know them all, so that programs are compiled for the
            largest of them.
    """

    work: Work
    profile: Profile
    artefacts: Path
    suite: Path | None = None
    layouts: tuple[Layout, ...] = ()

    @property
    def name(self) -> str:
        """Name of the artefact."""
        return self.work.name

    @property
    def label(self) -> str:
        """Layout, teammate, source and learner."""
        learner = f", learner {self.work.learner}" if self.work.learner else ""
        source = "" if self.work.source == "ppo" else f", {self.work.source}"
        return f"{self.work.task.layout.name} with {self.work.task.teammate_kind}{source}{learner}"

    @property
    def folder(self) -> Path:
        """Folder of the artefact."""
        return self.artefacts / self.work.name

    @property
    def updates(self) -> int:
        """Updates of the ego, or pieces that a script plays."""
        layout, source = self.work.task.layout.name, self.work.source
        if source == "ppo":
            return self.profile.ego_on(layout).updates
        return len(scripted_pieces(source, self.profile.scripted_on(layout, source)))

    @property
    def xla_threads(self) -> int | None:
        """Threads of the profile."""
        return self.profile.xla_threads

    @property
    def is_quick(self) -> bool:
        """Whether a script plays."""
        return self.work.source != "ppo"

    def is_finished(self) -> bool:
        """Return whether the artefact is complete and unchanged."""
        return is_task_finished(self.folder, self.work, self.profile)

    def progress(self) -> tuple[int, float] | None:
        """Return what the artefact's timing states, see `jobs.job.Job`."""
        timing = last_timing(self.folder)
        return (int(timing["update"]) + 1, timing["steps_per_second"]) if timing else None

    def run(
        self,
        on_update: OnUpdate = lambda updates, speed: None,
        wait: bool = False,
        save_seconds: float = TASK_SAVE_SECONDS,
    ) -> None:
        """Make the artefact, resuming from its last save, unless it is finished.

        Args:
            on_update: called after each update, or each piece that a script plays.
            wait: whether to wait for another process that works on it.
            save_seconds: least time between two saves.

        Raises:
            BusyError: if another process works on it.
            DiskFullError: if the disk has no room.
        """
        add_layouts(self.layouts)
        with run_lock(self.folder, wait=wait):
            if self.is_finished():
                return
            partial = partial_folder(self.folder)
            # A run that was killed just before the renaming has left a finished one.
            if not is_task_finished(partial, self.work, self.profile):
                _MAKERS[self.work.source](self.work, self.profile, partial, on_update, self.suite, save_seconds)
            publish_artefact(partial, self.folder)

    def finished_text(self) -> str:
        """Return the text on the finished artefact."""
        progress = self.progress()
        return f"finished at {progress[1]:,.0f} steps/s" if progress else "finished"
