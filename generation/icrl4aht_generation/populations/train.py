"""Train populations of teammates, and save their checkpoints in a folder, the suite (paper, App. B.1).

    SUITE/<layout>/<algorithm>/m<member>/c<checkpoint>/policy.safetensors, policy.json
    SUITE/<layout>/<algorithm>/responses/m<member>/...      best responses, if the algorithm trains them
    SUITE/<layout>/<algorithm>/metrics.jsonl, timing.jsonl, population.json

`population.json` is written last and contains the hash of every file. During training, `resume.safetensors` holds the
state from which a stopped run resumes with identical results.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from icrl4aht_data.benchmark.facts import ALGORITHMS
from icrl4aht_data.errors import IndexFormatError, OptionError, check_choice
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.files import file_hash, hashes_match, json_hash, read_json, write_json
from icrl4aht_generation.env import Environment
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.checkpoint import (
    POLICY_CARD,
    POLICY_CHECKPOINTS,
    POLICY_WEIGHTS,
    checkpoint_updates,
    load_card,
    load_policy,
    save_policy,
)
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.population.brdiv import BRDiv
from icrl4aht_generation.learners.population.comedi import CoMeDi
from icrl4aht_generation.learners.population.fcp import FCP
from icrl4aht_generation.learners.population.lbrdiv import LBRDiv
from icrl4aht_generation.learners.population.population import Population, PopulationState
from icrl4aht_generation.learners.resume import (
    METRICS,
    TIMING,
    RunLog,
    SaveInterval,
    StateFile,
    differing_settings,
    last_line,
    run_lock,
    software_versions,
)
from icrl4aht_generation.policy import stacked
from icrl4aht_generation.populations.cross_play import EPISODES_PER_PAIR, cross_play_returns

POPULATION_SAVE_SECONDS = 60.0
"""Seconds between two saves; a killed run loses at most the work of this time."""

_SELECTIONS = 10  # number of times per new member that CoMeDi selects its partner among the earlier members
RESPONSES = "responses"
"""Folder name of a population's final best responses, if its algorithm trains best responses."""

POPULATION = "population.json"
"""File name of the record of a finished population."""

_RESUME = "resume.safetensors"


@dataclass(frozen=True)
class PopulationRun:
    """Settings of the training of one population on one layout.

    Attributes:
        layout: layout on which the policies train.
        algorithm: name of the algorithm, one of `ALGORITHMS`.
        members: number of policies for the suite. CoMeDi also trains a first policy by self-play, which is only a
            reference for the other policies and not a teammate.
        config: hyper-parameters of each policy.
        seed: seed of the training.

    Raises:
        OptionError: if the algorithm does not exist, or the sizes are invalid for the algorithm.
    """

    layout: Layout
    algorithm: str
    members: int
    config: PPOConfig
    seed: int

    def __post_init__(self) -> None:
        check_choice("algorithm", self.algorithm, ALGORITHMS)
        if self.config.updates < POLICY_CHECKPOINTS:
            raise OptionError(
                f"teammates.total_steps = {self.config.total_steps}: {self.config.updates} updates, expected at least "
                f"{POLICY_CHECKPOINTS}, one for each checkpoint"
            )
        try:
            for stage in self.stages:
                _ = stage.assignment
        except ValueError as error:
            raise OptionError(f"teammates, {self.algorithm} with {self.members} members: {error}") from error

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that the population depends on."""
        return {
            "layout": self.layout.name,
            "algorithm": self.algorithm,
            "members": self.members,
            "policies": self.members + (self.algorithm == "comedi"),
            "config": asdict(self.config),
            "seed": self.seed,
            "code_version": version("icrl4aht-data"),
        }

    @cached_property
    def stages(self) -> list[Population]:
        """Successive stages of training: for CoMeDi one for each policy, the first by self-play; otherwise only one."""
        env = Environment(self.layout)
        if self.algorithm == "comedi":
            first = Population(env, FCP(1), self.config, partners=2)
            return [first, *[Population(env, CoMeDi(), self.config)] * self.members]
        kinds = {"fcp": FCP, "brdiv": BRDiv, "lbrdiv": LBRDiv}
        return [Population(env, kinds[self.algorithm](self.members), self.config)]

    @property
    def has_best_responses(self) -> bool:
        """Whether the algorithm trains a best response to each member."""
        return self.algorithm in ("brdiv", "lbrdiv")

    @property
    def updates(self) -> int:
        """Number of updates of all stages."""
        return len(self.stages) * self.config.updates

    @property
    def steps(self) -> int:
        """Number of environment steps of all environments and stages."""
        return self.config.updates * sum(stage.steps_per_update for stage in self.stages)


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record of a finished population; an empty record if the file is missing or invalid."""
    try:
        record = read_json(folder / POPULATION)
    except IndexFormatError:
        return {}
    return record if isinstance(record, dict) else {}


@dataclass(frozen=True)
class PopulationJob:
    """Training of a population as a job of a queue, see `jobs.job.Job`.

    Attributes:
        population: settings of the population.
        suite: folder of the suite.
        xla_threads: number of CPU threads of XLA; None for all cores.
    """

    population: PopulationRun
    suite: Path
    xla_threads: int | None = None
    is_quick: bool = False

    @property
    def name(self) -> str:
        """Name of the job: layout and algorithm, which is also the population's folder in the suite."""
        return f"{self.population.layout.name}/{self.population.algorithm}"

    @property
    def label(self) -> str:
        """Text that names the algorithm and the layout."""
        return f"{self.population.algorithm} on {self.population.layout.name}"

    @property
    def updates(self) -> int:
        """Number of updates of all stages."""
        return self.population.updates

    @property
    def folder(self) -> Path:
        """Folder of the population."""
        return self.suite / self.name

    def is_finished(self) -> bool:
        """Return whether the folder contains the population of these settings with unchanged files."""
        record = read_record(self.folder)
        try:
            same = record["settings_hash"] == json_hash(self.population.settings)
            return same and hashes_match(self.folder, record["files"])
        except (OSError, KeyError, TypeError):
            return False

    def progress(self) -> tuple[int, float] | None:
        """Return finished updates and steps per second from the timing file; None before the first update."""
        timing = last_line(self.folder / TIMING)
        if timing is None:
            return None
        return timing["stage"] * self.population.config.updates + timing["update"] + 1, timing["steps_per_second"]

    def run(
        self,
        on_update: OnUpdate = lambda updates, speed: None,
        wait: bool = False,
        save_seconds: float = POPULATION_SAVE_SECONDS,
    ) -> None:
        """Train the population, or resume a stopped run with the same settings; do nothing if it is finished.

        Args:
            on_update: called after each update with the number of updates and steps per second.
            wait: whether to wait while another process trains the population.
            save_seconds: minimum time between two saves.

        Raises:
            BusyError: if another process trains the population and `wait` is false.
            OptionError: if the folder contains a run with other settings.
        """
        with run_lock(self.folder, wait=wait):
            self.folder.mkdir(exist_ok=True)
            if not self.is_finished():
                _PopulationTraining(self.population, self.folder, on_update, save_seconds).train()

    def finished_text(self) -> str:
        """Return a message on the finished population: steps, speed and the last self-play return."""
        metrics, progress = last_line(self.folder / METRICS) or {}, self.progress()
        speed = f" at {progress[1]:,.0f} steps/s (all environments)" if progress else ""
        return (
            f"{metrics.get('step', 0):,} steps a member{speed}, last self-play return "
            f"{metrics.get('self_play', 0.0):.1f} (400 steps)"
        )


class _PopulationTraining:
    """Training of a population in its folder, while the caller holds the folder's lock."""

    def __init__(self, run: PopulationRun, folder: Path, on_update: OnUpdate, save_seconds: float) -> None:
        self.run, self.folder, self.on_update = run, folder, on_update
        self.saved = StateFile(folder / _RESUME, run.settings | software_versions())
        self.interval = SaveInterval(run.updates, seconds=save_seconds)

    def train(self) -> None:
        if (self.folder / POPULATION).exists():
            found = read_record(self.folder).get("settings") or self.run.settings
            other = {name: was for name, (was, _) in differing_settings(found, self.run.settings).items()}
            difference = f"with other settings: {other}" if other else "with changed files"
            raise OptionError(
                f"{self.folder}: contains a finished population {difference}; remove it, or give another --suite"
            )
        done, state = self._resume()
        updates = self.run.config.updates
        with closing(RunLog(self.folder, lambda line: line["stage"] * updates + line["update"] < done)) as log:
            for stage in range(max(0, done - 1) // updates, len(self.run.stages)):
                self._train_stage(stage, state, log)
                state = None
        self._finish()

    def _resume(self) -> tuple[int, PopulationState | None]:
        """Return the number of finished updates of all stages, and the state to resume from; None at the start."""
        done = self.saved.progress
        if done is None:  # remove the checkpoints of a run that was killed before its first save
            for folder in (*self.folder.glob("m[0-9]*"), self.folder / RESPONSES):
                shutil.rmtree(folder, ignore_errors=True)
            return 0, None
        stage = (done - 1) // self.run.config.updates
        return done, self.saved.load(jax.eval_shape(self.run.stages[stage].init, self._stage_key(stage)))

    def _stage_key(self, stage: int):
        return jax.random.fold_in(jax.random.key(self.run.seed), stage)

    def _train_stage(self, stage: int, resumed: PopulationState | None, log: RunLog) -> None:
        population, updates = self.run.stages[stage], self.run.config.updates
        state: PopulationState = resumed or jax.jit(population.init)(self._stage_key(stage))
        moments = checkpoint_updates(self.run.config)
        started, first = time.perf_counter(), int(state.update)
        for number in range(first, updates):
            if self.run.algorithm == "comedi" and stage and number % max(1, updates // _SELECTIONS) == 0:
                state = state._replace(params=self._with_best_partner(state.params, stage, number))
            state, metrics = population.compiled_update(state)
            seconds = time.perf_counter() - started
            line = self._metrics_line(stage, number, metrics)
            speed = round((number + 1 - first) * population.steps_per_update / seconds, 1)
            log.write(line, timing={"stage": stage, "update": number, "steps_per_second": speed})
            done = stage * updates + number + 1
            self.on_update(done, speed)
            # Checkpoints are written before the state, so a resumed run has all earlier checkpoints.
            if number + 1 in moments:
                self._save_checkpoints(stage, moments.index(number + 1), number + 1, state.params)
            if self.interval.due(done):
                log.sync()
                self.saved.save(state, done)

    def _metrics_line(self, stage: int, number: int, metrics: dict[str, Any]) -> dict[str, float]:
        """Return a line of the metrics log, without mean returns if no episode ended."""
        values = {name: float(value) for name, value in metrics.items()}
        if not values["episodes"]:
            del values["self_play"], values["cross_play"]
        elif self.run.stages[stage].assignment.self_play.all():
            del values["cross_play"]
        return {
            "stage": stage,
            "update": number,
            "step": (number + 1) * self.run.config.steps_per_update,
            **values,
        }

    def _with_best_partner(self, params: Any, stage: int, number: int) -> Any:
        """Return the parameters; the frozen policy becomes the earlier member that earns most with the new member.

        Source: paper, App. B.1, "Partner Selection".
        """
        network, layout = self.run.stages[stage].network, self.run.layout
        last = POLICY_CHECKPOINTS - 1
        former = stacked([load_policy(self.folder / f"m{m}" / f"c{last}")[1] for m in range(stage)])
        new = jax.tree.map(lambda leaf: leaf[:1], params)
        # Add the returns with the two policies in either order, because layouts are not symmetric.
        returns = cross_play_returns(layout, network, new, former, seed=number)[0]
        returns = returns + cross_play_returns(layout, network, former, new, seed=number)[:, 0]
        nearest = int(np.argmax(returns))
        return jax.tree.map(lambda leaf, old: leaf.at[1].set(old[nearest]), params, former)

    def _save_checkpoints(self, stage: int, checkpoint: int, update: int, params: Any) -> None:
        run, population = self.run, self.run.stages[stage]
        count = 1 if run.algorithm == "comedi" else run.members
        members = jax.tree.map(lambda leaf: leaf[:count], params)
        partners = jax.tree.map(lambda leaf: leaf[count : 2 * count], params) if run.has_best_responses else members
        returns, as_teammate = (
            cross_play_returns(run.layout, population.network, partners, members, greedy=greedy, paired=True)
            for greedy in (False, True)
        )
        for k in range(count):
            card = {
                "algorithm": run.algorithm,
                "layout": run.layout.name,
                "member": stage + k,
                "checkpoint": checkpoint,
                "step": update * run.config.steps_per_update,
                "seed": run.seed,
                "code_version": version("icrl4aht-data"),
                "agents": [1] if run.has_best_responses else [0, 1],
                "return": float(returns[k]),
                "teammate_return": float(as_teammate[k]),
                "return_of": f"{EPISODES_PER_PAIR} episodes of 400 steps with its best response or itself, both "
                "drawing their actions; as a teammate it acts greedily, as agent 1",
            }
            own = jax.tree.map(lambda leaf, k=k: leaf[k], members)
            save_policy(self.folder / f"m{stage + k}" / f"c{checkpoint}", population.network, own, card)
            # Save best responses only at the end; they show the return that is possible with a teammate.
            if run.has_best_responses and checkpoint == POLICY_CHECKPOINTS - 1:
                response = jax.tree.map(lambda leaf, k=k: leaf[k], partners)
                path = self.folder / RESPONSES / f"m{k}"
                save_policy(path, population.network, response, card | {"role": "best response", "agents": [0]})

    def _finish(self) -> None:
        # The record is written last and lists every file: a folder without a record is unfinished.
        files = {
            str(path.relative_to(self.folder)): file_hash(path)
            for name in (POLICY_WEIGHTS, POLICY_CARD)
            for path in sorted(self.folder.rglob(name))
        }
        content = {
            "settings_hash": json_hash(self.run.settings),
            "settings": self.run.settings,
            "software": software_versions(),
            "files": files,
        }
        write_json(self.folder / POPULATION, content)
        (self.folder / _RESUME).unlink(missing_ok=True)


@dataclass(frozen=True)
class SuiteCheckpoint:
    """A checkpoint of a learned teammate in a suite.

    Attributes:
        path: path relative to the suite's folder.
        card: description of the checkpoint, see `load_card`.
    """

    path: str
    card: dict[str, Any]


def is_trained(suite: Path, layout: str, algorithm: str) -> bool:
    """Return whether a suite has a finished population for a layout and an algorithm."""
    return (suite / layout / algorithm / POPULATION).is_file()


def population_threads(suite: Path, layout: str, algorithm: str) -> int | None:
    """Return the number of XLA threads that trained a population; None if the suite does not record the number."""
    return (read_record(suite / layout / algorithm).get("software") or {}).get("xla_threads")


def suite_checkpoints(suite: Path, layout: str, algorithm: str) -> Iterator[SuiteCheckpoint]:
    """Yield the checkpoints of a population's members, in the order of members and checkpoints.

    CoMeDi's first policy is excluded, because it was trained only by self-play.

    Raises:
        OptionError: if the population is not finished.
    """
    folder = suite / layout / algorithm
    if not is_trained(suite, layout, algorithm):
        raise OptionError(f"{folder}: no finished population; run `icrl4aht-data teammates --layout {layout}`")
    found = [path.parent for path in folder.glob(f"m*/c*/{POLICY_WEIGHTS}")]
    for path in sorted(found, key=lambda path: (int(path.parent.name[1:]), int(path.name[1:]))):
        point = SuiteCheckpoint(str(path.relative_to(suite)), load_card(path))
        if algorithm != "comedi" or point.card["member"] > 0:
            yield point


def cross_play_matrix(suite: Path, layout: Layout, algorithm: str, greedy: bool = False) -> np.ndarray:
    """Return the mean returns of all pairs of a population's final policies, float64 of shape (K, K).

    Args:
        suite: the suite's folder.
        layout: layout of the population.
        algorithm: the population's algorithm.
        greedy: whether teammates take their most probable actions.

    Returns:
        Matrix with a row for each ego (the best responses, if the algorithm trains them) and a column for each member
        as the teammate; the diagonal is self-play.

    Raises:
        OptionError: if the population is not finished.
    """
    final = f"c{POLICY_CHECKPOINTS - 1}"
    last = [point for point in suite_checkpoints(suite, layout.name, algorithm) if point.path.endswith(final)]
    loaded = [load_policy(suite / point.path) for point in last]
    members = stacked([params for _, params, _ in loaded])
    folder = suite / layout.name / algorithm / RESPONSES
    egos = members
    if folder.is_dir():
        egos = stacked([load_policy(folder / f"m{point.card['member']}")[1] for point in last])
    return cross_play_returns(layout, loaded[0][0], egos, members, greedy=greedy)
