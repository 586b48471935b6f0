"""Jobs that generate the histories of tasks, to be run by a queue."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from icrl4aht_data.overcooked.layouts import Layout, add_layouts
from icrl4aht_generation.collection.scripted import play_histories
from icrl4aht_generation.collection.scripted_rollout import scripted_batches
from icrl4aht_generation.collection.task import TASK_SAVE_SECONDS, train_and_record
from icrl4aht_generation.collection.task_folder import is_task_finished, last_timing, partial_folder, publish_artefact
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.resume import run_lock
from icrl4aht_generation.profiles import Profile, WorkUnit

_GENERATORS = {"ppo": train_and_record, "noise": play_histories, "search": play_histories}
"""Source -> function that generates an artefact in its partial folder; only that of `ppo` resumes there."""


@dataclass(frozen=True)
class CollectionJob:
    """Job that generates the artefact of one unit of work, see `WorkUnit`.

    Attributes:
        work: unit of work: a task with a source and a learner.
        profile: profile that the unit belongs to.
        artefacts: folder of all artefacts.
        suite: folder of the learned teammates; None if no task has a learned teammate.
        layouts: all generated layouts of the rebuild, since every worker compiles for the largest of these layouts.
    """

    work: WorkUnit
    profile: Profile
    artefacts: Path
    suite: Path | None = None
    layouts: tuple[Layout, ...] = ()

    @property
    def name(self) -> str:
        """Name of the job's artefact."""
        return self.work.name

    @property
    def label(self) -> str:
        """Text that names the job's layout, teammate, source and learner."""
        learner = f", learner {self.work.learner}" if self.work.learner else ""
        source = "" if self.work.source == "ppo" else f", {self.work.source}"
        return f"{self.work.task.layout.name} with {self.work.task.teammate_kind}{source}{learner}"

    @property
    def folder(self) -> Path:
        """Folder of the job's artefact."""
        return self.artefacts / self.work.name

    @property
    def updates(self) -> int:
        """Number of updates of the ego, or of batches of episodes that a script plays."""
        layout, source = self.work.task.layout.name, self.work.source
        if source == "ppo":
            return self.profile.ego_config(layout).updates
        return len(scripted_batches(source, self.profile.scripted_config(layout, source)))

    @property
    def xla_threads(self) -> int | None:
        """Number of XLA threads that the profile sets; None for all cores."""
        return self.profile.xla_threads

    @property
    def is_quick(self) -> bool:
        """Whether the job takes only seconds, because a script plays and nothing is trained."""
        return self.work.source != "ppo"

    def is_finished(self) -> bool:
        """Return whether the artefact is complete and unchanged."""
        return is_task_finished(self.folder, self.work, self.profile)

    def progress(self) -> tuple[int, float] | None:
        """Return the number of finished updates and the steps per second; None before the first update."""
        timing = last_timing(self.folder)
        return (int(timing["update"]) + 1, timing["steps_per_second"]) if timing else None

    def run(
        self,
        on_update: OnUpdate = lambda updates, speed: None,
        wait: bool = False,
        save_seconds: float = TASK_SAVE_SECONDS,
    ) -> None:
        """Generate the artefact, or resume from its last save; do nothing if the artefact is finished.

        Args:
            on_update: called after each update, or after each batch of episodes that a script plays.
            wait: whether to wait while another process works on the artefact.
            save_seconds: minimum time between two saves.

        Raises:
            BusyError: if another process works on the artefact and `wait` is false.
            DiskFullError: if the disk is full.
        """
        add_layouts(self.layouts)
        with run_lock(self.folder, wait=wait):
            if self.is_finished():
                return
            partial = partial_folder(self.folder)
            # If a run was killed just before the rename, its partial folder is already complete.
            if not is_task_finished(partial, self.work, self.profile):
                _GENERATORS[self.work.source](self.work, self.profile, partial, on_update, self.suite, save_seconds)
            publish_artefact(partial, self.folder)

    def finished_text(self) -> str:
        """Return a message which says that the artefact is finished, and the speed if known."""
        progress = self.progress()
        return f"finished at {progress[1]:,.0f} steps/s" if progress else "finished"
