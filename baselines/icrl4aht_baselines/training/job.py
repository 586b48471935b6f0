"""Jobs of a queue that train a model, measure it and store the result, see `icrl4aht_generation.jobs.job.Job`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.resume import TIMING, differing_settings, last_line, run_lock

from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_baselines.training.trainer import StepProgress
from icrl4aht_data.utils.files import read_json, write_json


class TrainingJob(ABC):
    """Base class of jobs that train a model and measure it.

    Attributes:
        seed: seed of the training run.
        options: settings of the run. The properties `training` and `steps_per_update` read `options.training(seed)`
            and `options.steps_per_update`; a subclass with other options overrides both properties.
        out: folder of all jobs.
        xla_threads: see `Job`.
    """

    seed: int
    options: Any
    out: Path
    xla_threads: int | None = 1

    @property
    def is_quick(self) -> bool:
        """See `Job.is_quick`."""
        return False

    @property
    @abstractmethod
    def name(self) -> str:
        """Unique name of the job in its queue, which is also the name of its folder."""

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All settings that the result depends on, as JSON."""

    @abstractmethod
    def measure(self, on_update: OnUpdate) -> dict[str, Any]:
        """Train the model, and return the measured values, as JSON."""

    @property
    def folder(self) -> Path:
        """Folder of the training run and of its result."""
        return self.out / self.name

    @property
    def run_folder(self) -> Path:
        """Folder of the training run."""
        return self.folder / "run"

    @property
    def result_file(self) -> Path:
        """Path of the file with the result of the finished job."""
        return self.folder / "result.json"

    @property
    def training(self) -> TrainOptions:
        """Settings of the training run, for the trainer."""
        return self.options.training(self.seed)

    @property
    def steps_per_update(self) -> int:
        """Number of environment or history steps in one training step."""
        return self.options.steps_per_update

    @property
    def updates(self) -> int:
        """Number of training steps."""
        return self.training.steps

    def is_finished(self) -> bool:
        """Return whether a result with the settings of this job is stored."""
        return self.result_file.is_file() and not differing_settings(self.result()["settings"], self.settings)

    def result(self) -> dict[str, Any]:
        """Return the content of result.json: `settings`, and the values that `measure` returned."""
        return read_json(self.result_file)

    def progress(self) -> tuple[int, float] | None:
        """Return the finished training steps and the speed in environment or history steps/s; None if unknown."""
        if timing := last_line(self.run_folder / TIMING):
            return timing["step"], timing["steps_per_second"] * self.steps_per_update
        return None

    def step_progress(self, on_update: OnUpdate) -> StepProgress:
        """Return a progress function for the trainer, which passes the progress on to `on_update`; see `Job.run`."""
        return lambda step, loss: on_update(step, (self.progress() or (0, 0.0))[1])

    def finished_text(self) -> str:
        """Return a note on the result for progress displays."""
        return "finished"

    def run(self, on_update: OnUpdate = lambda updates, speed: None, wait: bool = False) -> None:
        """Train the model, and write the values that `measure` returns to result.json."""
        with run_lock(self.folder, wait=wait):
            if self.is_finished():
                return
            content = {"settings": self.settings, **self.measure(on_update)}
            self.folder.mkdir(parents=True, exist_ok=True)  # a job that trains nothing has no folder yet
            write_json(self.result_file, content)
