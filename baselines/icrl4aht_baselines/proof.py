"""Show what models learn from a release: train models on its histories alone, and play validation tasks.

    OUT/SOURCE-LEARNER-sSEED/run         run folder of a training job
    OUT/SOURCE-LEARNER-sSEED/results     results on the sets of validation tasks, with memory and without
    OUT/references/...                   results of egos to compare with
    OUT/proof.json                       summary of all results

Each training is a job of a queue. Finished jobs are reused, and stopped jobs resume.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.resume import TIMING

from icrl4aht_baselines.agents.egos import NamedEgo, find_agent
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol
from icrl4aht_baselines.methods.options import SIZES, ModelOptions
from icrl4aht_baselines.online.responses import tasks_with_headroom
from icrl4aht_baselines.report.results import evaluate_agent
from icrl4aht_baselines.training.histories import prepare
from icrl4aht_baselines.training.job import TrainingJob
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, TrainOptions
from icrl4aht_data.benchmark.facts import PREFERENCE
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.utils.files import json_hash, parse_json, read_json, read_text, write_json
from icrl4aht_data.writing.proof import RUN_KEY, histories_hash

TEAMMATE_TRACK = "teammate"

PROOF_PROTOCOL = get_protocol("seeded", 20)
"""Protocol of the evaluations, with 20 episodes, because the proof reports the episodes 1 and 6 to 20."""

_SEEDS = {PREFERENCE: range(4), TEAMMATE_TRACK: range(1)}
"""Track -> seeds of its tasks. On `preference` the first episode is reported separately, which needs several seeds."""

COMPARED_EGOS = {PREFERENCE: ("stay", "search"), TEAMMATE_TRACK: ("stay", "rl2-reference")}
"""Track -> names of the egos that models are compared with."""


class ProofLearner(NamedTuple):
    """A method and the actions that it learns.

    Attributes:
        method: name of the method.
        labels: "expert" for expert labels, or None for the actions in the histories.
    """

    method: str
    labels: Literal["expert"] | None


LEARNERS = {
    "ad": ProofLearner("ad", None),
    "ad-expert": ProofLearner("ad", "expert"),
    "dpt-expert": ProofLearner("dpt", "expert"),
}
"""Name on the command line and in folders -> learner."""

_MODEL = ModelOptions(**{**SIZES["tiny"].model, "teammate_actions": True, "reward_scale": 0.05, "dropout": 0.0})
# Within its first episodes, the script `search` finds out which dish is wanted, so models train on these episodes.
_FIRST_EPISODES = 5
_TRAINING: dict[str, Any] = {"learning_rate": 2e-3, "validate_every": 10**6, "save_every": 10**6, "log_every": 20}


def proof_tasks() -> dict[str, tuple[Task, ...]]:
    """Return name of a track -> its validation tasks; on the track `teammate`, only tasks with headroom."""
    played = [*bundled_tasks(TEAMMATE_TRACK, "validation"), *bundled_tasks(TEAMMATE_TRACK, "diverse")]
    return {
        PREFERENCE: tuple(bundled_tasks(PREFERENCE, "validation")),
        TEAMMATE_TRACK: tuple(tasks_with_headroom(played)),
    }


@dataclass(frozen=True)
class ProofOptions:
    """Settings that all training jobs of `research proof` share.

    Attributes:
        root: folder or address of a release; None for the bundled release.
        steps: number of training steps; with the defaults, a job takes about 30 minutes on a core.
        batch_size: number of windows or contexts in a batch.
        context: K, steps of a window or transitions of a context.
        tasks: name of a track -> its tasks; by default the validation tasks that `proof_tasks` returns.
    """

    root: str | None = None
    steps: int = 4000
    batch_size: int = 8
    context: int = 500
    tasks: dict[str, tuple[Task, ...]] = field(default_factory=proof_tasks)

    @property
    def steps_per_update(self) -> int:
        """Number of history steps in a batch."""
        return self.batch_size * self.context

    def training(self, seed: int) -> TrainOptions:
        """Return the settings of a training run, for the trainer."""
        return TrainOptions(self.steps, self.batch_size, self.context, seed=seed, **_TRAINING)


@dataclass(frozen=True)
class ProofJob(TrainingJob):
    """Job that trains a model on histories and evaluates it.

    Attributes:
        source: source of the histories, or "all".
        learner: a name in `LEARNERS`.
        seed, options, out: see `TrainingJob`.
    """

    source: str
    learner: str
    seed: int
    options: ProofOptions
    out: Path

    @property
    def name(self) -> str:
        """Name of the job's folder."""
        return f"{self.source}-{self.learner}-s{self.seed}"

    @property
    def label(self) -> str:
        """Name of the job that progress displays show: learner, source and seed."""
        return f"{self.learner}, {self.source} histories, seed {self.seed}"

    @property
    def first(self) -> int:
        """Number of episodes to train on at the start of each history; 0 for all episodes."""
        return _FIRST_EPISODES if self.source == "search" else 0  # other histories improve to the last episode

    @property
    def queries(self) -> int:
        """Number of queries of each context: DPT has one for every prefix, so that it learns as many labels as AD."""
        return self.options.context + 1 if LEARNERS[self.learner].method == "dpt" else 1

    @property
    def balance(self) -> bool:
        """Whether windows are drawn from each source equally often; four fifths of the histories are of `search`."""
        return self.source == "all" and LEARNERS[self.learner].method != "dpt"

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that the result depends on, as JSON."""
        return {
            "histories_sha256": _histories_hash(self.options.root, self.source),
            "first": self.first,
            "queries": self.queries,
            "balance": self.balance,
            "model": asdict(_MODEL),
            "train": asdict(self.training),
            "protocol": PROOF_PROTOCOL.settings,
            "tasks": {track: [task.task_id for task in own] for track, own in self.options.tasks.items()},
        }

    @property
    def settings_hash(self) -> str:
        """Hash of learner and settings without the seed, which is equal for the runs of a row of the card's table."""
        settings = self.settings
        del settings["train"]["seed"]
        return json_hash([LEARNERS[self.learner], settings])

    def finished_text(self) -> str:
        """Return text for progress displays: mean returns on the track `preference`."""
        returns = self.result()["returns"]
        return f"first episode {returns[PREFERENCE]['1']:.1f}, episodes 6 to 20 {returns[PREFERENCE]['6-20']:.1f}"

    def measure(self, on_update: OnUpdate) -> dict[str, Any]:
        """Train and evaluate the model. Return the `minutes` of training, and the `returns` from `evaluate_on_sets`."""
        learner, run = LEARNERS[self.learner], self.run_folder
        source = () if self.source == "all" else (self.source,)
        chosen: dict[str, Any] = {"source": source, "labels": learner.labels, "first": self.first}
        drawn: dict[str, Any] = {"queries": self.queries, "balance": self.balance}
        histories = HistoryOptions((ALL_LAYOUTS,), self.options.root, **drawn, **chosen)
        prepare(learner.method, _MODEL, self.training, histories).train(run, done=self.step_progress(on_update))
        return {
            "minutes": round(_training_seconds(run / TIMING) / 60, 1),
            "returns": evaluate_on_sets(find_agent(run, greedy=False), self.options, self.folder / "results"),
        }


@cache
def _histories_hash(root: str | None, source: str) -> str:
    dataset = load_icrl4aht(root)
    dataset.origin.fetch([chunk_table_name(shard) for shard in dataset.index.values("shard")])
    return histories_hash(dataset.index, source)


def _training_seconds(timing: Path) -> float:
    """Return the duration of a training run in seconds, from its timing log, including steps before interruptions."""
    lines = [parse_json(line) for line in read_text(timing).splitlines()]
    steps = np.diff([0, *(line["step"] for line in lines)])
    return float(np.sum(steps / [line["steps_per_second"] for line in lines]))


def evaluate_on_sets(agent: NamedEgo, options: ProofOptions, out: Path) -> dict[str, dict[str, float]]:
    """Evaluate an agent on the validation tasks of each track.

    On the track `preference` it also plays with its memory cleared before each episode.

    Args:
        agent: agent to evaluate.
        options: settings with the tasks of each track.
        out: folder of the results.

    Returns:
        Name of the track, followed by " cleared" for cleared memory -> block of episodes -> mean return.
    """
    found = {}
    for track, tasks in options.tasks.items():
        for control in (None, "cleared") if track == PREFERENCE else (None,):
            folder = out / f"{track}{' cleared' if control else ''}"
            hidden: Any = {"show": lambda *shown: None}
            found[folder.name] = _mean_returns(agent, track, tasks, folder, control=control, **hidden)
    return found


def _mean_returns(agent: NamedEgo, track: str, tasks: Sequence[Task], folder: Path, **options: Any) -> dict[str, float]:
    """Return block of episodes -> mean return of an agent on the validation tasks of a track.

    Args:
        agent: agent to evaluate.
        track: name of the track.
        tasks: tasks of the track.
        folder: folder of the results.
        options: further arguments for `evaluate_agent`.
    """
    run = evaluate_agent(agent, tasks, PROOF_PROTOCOL, folder, seeds=_SEEDS[track], **options)
    means = run.table.groupby("block")["return"].mean()
    return {str(block): round(float(mean), 3) for block, mean in means.items()}


def write_proof(jobs: Sequence[ProofJob], references: dict[str, dict[str, dict[str, float]]], path: Path) -> Path:
    """Write the returns of finished jobs, with an entry for each training run.

    Args:
        jobs: training jobs; unfinished jobs are skipped.
        references: returns from `run_references`.
        path: path of the file. An earlier file keeps the entries of other training runs, if these runs had the same
            settings and learned from the same histories.
    """
    stay, reference = (references[TEAMMATE_TRACK][name]["all"] for name in COMPARED_EGOS[TEAMMATE_TRACK])
    options, runs = jobs[0].options, []
    for job in (job for job in jobs if job.is_finished()):
        learner, result = LEARNERS[job.learner], job.result()
        returns = result["returns"]
        entry: dict[str, Any] = {
            "histories": job.source,
            "method": learner.method.upper(),
            "labels": learner.labels or "own",
            "seed": job.seed,
            "histories_sha256": job.settings["histories_sha256"],
            "settings_sha256": job.settings_hash,
            "minutes": result["minutes"],
        }
        share = (returns[TEAMMATE_TRACK]["all"] - stay) / (reference - stay)
        runs.append(
            entry
            | {
                "first": returns[PREFERENCE]["1"],
                "late": returns[PREFERENCE]["6-20"],
                "late_cleared": returns[f"{PREFERENCE} cleared"]["6-20"],
                "share": round(share, 3),
            }
        )
    content: dict[str, Any] = {
        "data_version": load_icrl4aht(options.root).info.data_version,
        "training": {"steps": options.steps, "batch_size": options.batch_size, "context": options.context},
        "tasks": {name: len(tasks) for name, tasks in options.tasks.items()},
        "references": references[PREFERENCE],
    }
    earlier = read_json(path)["runs"] if path.is_file() else []
    runs = [*(one for one in earlier if one.get("settings_sha256") == _expected_hash(one, jobs[0])), *runs]
    runs = [*{tuple(one[name] for name in RUN_KEY): one for one in runs}.values()]
    runs.sort(key=lambda one: [one[name] for name in RUN_KEY])
    write_json(path, content | {"runs": runs})
    return path


def _expected_hash(entry: Mapping[str, Any], job: ProofJob) -> str | None:
    """Return the hash of settings of an entry's run with a job's options; None if its learner no longer exists."""
    wanted = ProofLearner(entry["method"].lower(), None if entry["labels"] == "own" else entry["labels"])
    names = [name for name, one in LEARNERS.items() if one == wanted]
    return replace(job, source=entry["histories"], learner=names[0]).settings_hash if names else None


def run_references(options: ProofOptions, out: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Return track -> name of an ego in `COMPARED_EGOS` -> block of episodes -> mean return.

    Stored results are reused.
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    for track, names in COMPARED_EGOS.items():
        for name in names:
            folder = out / "references" / name / track
            found.setdefault(track, {})[name] = _mean_returns(find_agent(name), track, options.tasks[track], folder)
    return found
