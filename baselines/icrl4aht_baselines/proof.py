"""What a release teaches: models trained on its histories alone, and what they earn on validation tasks.

    OUT/SOURCE-LEARNER-sSEED/run         run folder, as of `train`
    OUT/SOURCE-LEARNER-sSEED/results     results on the validation tasks of a set, with memory and without
    OUT/references/...                   results of egos to compare with
    OUT/proof.json                       all of it, which the card of the release shows

Every training is one job of a queue; finished ones are kept, stopped ones continue.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.resume import TIMING, last_line, run_lock

from icrl4aht_baselines.agents.egos import NamedEgo, find_agent
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol
from icrl4aht_baselines.methods.options import SIZES, ModelOptions
from icrl4aht_baselines.online.responses import with_headroom
from icrl4aht_baselines.report.results import evaluate_agent
from icrl4aht_baselines.training.histories import prepare
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, TrainOptions
from icrl4aht_data.benchmark.facts import PREFERENCE
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.format.schema import HISTORIES
from icrl4aht_data.utils.files import atomic_write, file_hash, parse_json, read_text, write_json

TEAMMATE_TRACK = "teammate"

PROOF_PROTOCOL = get_protocol("seeded", 20)
"""Protocol of the evaluations: as many episodes as the longest block that the proof reports."""

_SEEDS = {PREFERENCE: range(4), TEAMMATE_TRACK: range(1)}
"""Set of tasks -> seeds of each. A rise compares with one episode of each task and seed, so one seed would be few."""

COMPARED_EGOS = {PREFERENCE: ("stay", "search"), TEAMMATE_TRACK: ("stay", "rl2-reference")}
"""Set of tasks -> the egos that models are compared with."""


class ProofLearner(NamedTuple):
    """A method and what it learns.

    Attributes:
        method: name of the method.
        labels: None for the histories' own actions, or "expert".
        title: text for tables.
    """

    method: str
    labels: Literal["expert"] | None
    title: str


LEARNERS = {
    "ad": ProofLearner("ad", None, "AD, own actions"),
    "ad-expert": ProofLearner("ad", "expert", "AD, expert labels"),
    "dpt-expert": ProofLearner("dpt", "expert", "DPT, expert labels"),
}
"""Name of a folder -> what is trained."""

_MODEL = ModelOptions(**{**SIZES["tiny"].model, "teammate_actions": True, "reward_scale": 0.05, "dropout": 0.0})
# Histories of `search` find out everything in the first episodes: windows begin where these begin, as a test does.
_FIRST_EPISODES = {"search": 5}
_TRAINING: dict[str, Any] = {"learning_rate": 2e-3, "validate_every": 10**6, "save_every": 10**6, "log_every": 20}


@dataclass(frozen=True)
class ProofOptions:
    """Settings of all trainings.

    Attributes:
        root: folder or address of a release; None for the bundled one.
        steps, batch_size, context: see `TrainOptions`. With the defaults a training takes about 35 minutes on a core.
        tasks: set of tasks -> its tasks; by default the validation tasks of a track in which the ego matters.
    """

    root: str | None = None
    steps: int = 4000
    batch_size: int = 16
    context: int = 500
    tasks: dict[str, tuple[Task, ...]] | None = None

    @property
    def task_sets(self) -> dict[str, tuple[Task, ...]]:
        """The tasks of each set."""
        if self.tasks is not None:
            return self.tasks
        played = [*bundled_tasks(TEAMMATE_TRACK, "validation"), *bundled_tasks(TEAMMATE_TRACK, "diverse")]
        return {
            PREFERENCE: tuple(bundled_tasks(PREFERENCE, "validation")),
            TEAMMATE_TRACK: tuple(with_headroom(played)),
        }


@dataclass(frozen=True)
class ProofJob:
    """One training and its evaluation, a job of a queue, see `icrl4aht_generation.jobs.job.Job`.

    Attributes:
        source: source of the histories, or "all".
        learner: one of `LEARNERS`.
        seed: seed of the training.
        options: settings of all trainings.
        out: folder of all of them.
        xla_threads: threads of XLA on a CPU.
    """

    source: str
    learner: str
    seed: int
    options: ProofOptions
    out: Path
    xla_threads: int | None = 1
    is_quick: bool = False

    @property
    def name(self) -> str:
        """Name of the folder."""
        return f"{self.source}-{self.learner}-s{self.seed}"

    @property
    def label(self) -> str:
        """Method, labels, source and seed."""
        return f"{LEARNERS[self.learner].title}, {self.source} histories, seed {self.seed}"

    @property
    def folder(self) -> Path:
        """Folder of the run and its results."""
        return self.out / self.name

    @property
    def updates(self) -> int:
        """Training steps."""
        return self.options.steps

    @property
    def training(self) -> TrainOptions:
        """Settings of the training."""
        own = self.options
        return TrainOptions(own.steps, own.batch_size, own.context, seed=self.seed, **_TRAINING)

    @property
    def result_file(self) -> Path:
        """File of the finished job: a `ProofTraining`, and the settings."""
        return self.folder / "result.json"

    def is_finished(self) -> bool:
        """Return whether the result of these settings is there."""
        return self.result_file.is_file() and self.result()["settings"] == self.settings

    @property
    def settings(self) -> dict[str, Any]:
        """What the result depends on, beside the release."""
        tasks = {name: [task.task_id for task in own] for name, own in self.options.task_sets.items()}
        return {"train": asdict(self.training), "root": self.options.root, "tasks": tasks}

    def result(self) -> dict[str, Any]:
        """Return the content of result.json: `settings`, `minutes` of training, and `returns`, see `play`."""
        return parse_json(read_text(self.result_file))

    def progress(self) -> tuple[int, float] | None:
        """Return training steps done, and steps of histories per second."""
        timing = last_line(self.folder / "run" / TIMING)
        if not timing:
            return None
        return timing["step"], timing["steps_per_second"] * self.options.batch_size * self.options.context

    def finished_text(self) -> str:
        """Return the text on the finished job."""
        returns = self.result()["returns"]
        return f"first episode {returns[PREFERENCE]['1']:.1f}, episodes 6 to 20 {returns[PREFERENCE]['6-20']:.1f}"

    def run(self, on_update: OnUpdate = lambda updates, speed: None, wait: bool = False) -> None:
        """Train, evaluate with memory and without, and write the result."""
        with run_lock(self.folder, wait=wait):
            if self.is_finished():
                return
            learner, run = LEARNERS[self.learner], self.folder / "run"
            source = () if self.source == "all" else (self.source,)
            release, first = self.options.root, _FIRST_EPISODES.get(self.source, 0)
            histories = HistoryOptions((ALL_LAYOUTS,), release, source=source, labels=learner.labels, first=first)
            job = prepare(learner.method, _MODEL, self.training, histories)
            job.train(run, done=lambda step, loss: on_update(step, (self.progress() or (0, 0.0))[1]))
            content = {
                "settings": self.settings,
                "minutes": round(_training_seconds(run / TIMING) / 60, 1),
                "returns": play(find_agent(run, greedy=False), self.options, self.folder / "results"),
            }
            with atomic_write(self.result_file) as partial:
                write_json(partial, content)


def _training_seconds(timing: Path) -> float:
    """Return the seconds of a training, those of several processes that resumed it together."""
    lines = [parse_json(line) for line in read_text(timing).splitlines()]
    steps = np.diff([0, *(line["step"] for line in lines)])
    return float(np.sum(steps / [line["steps_per_second"] for line in lines]))


def play(agent: NamedEgo, options: ProofOptions, out: Path, controls: bool = True) -> dict[str, dict[str, float]]:
    """Evaluate an agent on each set of tasks.

    Args:
        agent: the agent.
        options: with the tasks.
        out: folder of the results.
        controls: whether to play with the memory cleared before each episode as well.

    Returns:
        Name of the set, with " cleared" for the second -> block of episodes -> mean return of the tasks.
    """
    found = {}
    for control in (None, "cleared")[: 1 + controls]:
        for name, tasks in options.task_sets.items():
            folder = out / f"{name}{' cleared' if control else ''}"
            shared: Any = {"seeds": _SEEDS[name], "control": control, "show": lambda *shown: None}
            run = evaluate_agent(agent, tasks, PROOF_PROTOCOL, folder, **shared)
            means = run.table.groupby("block")["return"].mean()
            found[folder.name] = {str(block): round(float(mean), 3) for block, mean in means.items()}
    return found


def write_proof(jobs: Sequence[ProofJob], references: dict[str, dict[str, dict[str, float]]], path: Path) -> Path:
    """Write what finished trainings earn, one entry for each source and learner with a value for each training.

    Args:
        jobs: the trainings.
        references: ego -> what `play` returned.
        path: the file; replaced.
    """
    entries: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for job in jobs:
        if job.is_finished():
            entries[job.source, job.learner].append(job.result() | {"seed": job.seed})
    stay, expert = (references[name][TEAMMATE_TRACK]["all"] for name in COMPARED_EGOS[TEAMMATE_TRACK])
    models = [
        {
            "histories": source,
            "learner": LEARNERS[learner].title,
            "seeds": [one["seed"] for one in own],
            "minutes": [one["minutes"] for one in own],
            **{
                key: [one["returns"][name][block] for one in own]
                for key, name, block in (
                    ("first", PREFERENCE, "1"),
                    ("late", PREFERENCE, "6-20"),
                    ("first_cleared", f"{PREFERENCE} cleared", "1"),
                    ("late_cleared", f"{PREFERENCE} cleared", "6-20"),
                )
            },
            "share": [round((one["returns"][TEAMMATE_TRACK]["all"] - stay) / (expert - stay), 3) for one in own],
        }
        for (source, learner), own in entries.items()
    ]
    options, dataset = jobs[0].options, load_icrl4aht(jobs[0].options.root)
    content = {
        "histories_sha256": file_hash(dataset.root / HISTORIES),
        "data_version": dataset.info.data_version,
        "training": {"steps": options.steps, "batch_size": options.batch_size, "context": options.context},
        "tasks": {name: len(tasks) for name, tasks in options.task_sets.items()},
        "references": {name: references[name][PREFERENCE] for name in COMPARED_EGOS[PREFERENCE]},
        "models": models,
    }
    with atomic_write(path) as partial:
        write_json(partial, content)
    return path


def run_references(options: ProofOptions, out: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Evaluate the egos of `COMPARED_EGOS`, or read what they earned. Return ego -> what `play` returns."""
    names = dict.fromkeys(name for of_set in COMPARED_EGOS.values() for name in of_set)
    return {name: play(find_agent(name), options, out / "references" / name, controls=False) for name in names}
