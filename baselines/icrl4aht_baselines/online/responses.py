"""Best responses: egos with the benchmark's 5 x 5 view, each trained with a single teammate.

The mean return B of a best response estimates what an ego could earn with a teammate that it knows from the start. B is
a lower bound, because longer training or another learner may earn more. For comparison, jax-aht trains PPO egos for
10^7 steps with one teammate; ZSC-Eval trains for 10^7 steps and evaluates on 50 episodes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from icrl4aht_generation.jobs.job import OnUpdate
from icrl4aht_generation.learners.resume import METRICS
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.distances import act_on_records, common_states, group_behaviours
from icrl4aht_generation.teammates.registry import build_teammate
from icrl4aht_generation.teammates.spread import find_measured
from msgspec import structs, to_builtins

from icrl4aht_baselines.agents.bundled import bundled_models
from icrl4aht_baselines.agents.egos import PlayMode, trained_policy, with_channels
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import SUBMITTED_SEEDS, bundled_tasks
from icrl4aht_baselines.methods.options import RL2_SETTINGS, ModelOptions
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.online.rl2 import PlayTask, PlayTrainer
from icrl4aht_baselines.training.histories import read_trained
from icrl4aht_baselines.training.job import TrainingJob
from icrl4aht_baselines.training.options import PlayOptions, ResponseOptions
from icrl4aht_baselines.training.run_folder import read_config
from icrl4aht_baselines.training.trainer import TrainingData, TrainingTask
from icrl4aht_data.benchmark.best_responses import (
    BestResponse,
    BestResponseCard,
    TrainingRun,
    best_training_run,
    read_best_responses,
    write_best_responses,
)
from icrl4aht_data.benchmark.facts import KEPT_STEPS, LAYOUT_NAMES, LEAST_HEADROOM, PREFERENCE, TESTED_ON
from icrl4aht_data.benchmark.reference_returns import has_headroom, read_reference_returns
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import OptionError, unknown_name
from icrl4aht_data.utils.files import json_hash, parse_json, read_text, write_atomically
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import counted_noun, markdown_table

PROTOCOL = "seeded"
"""Protocol under which best responses are chosen and measured."""

CHOICE_SEEDS = (1000,)
"""Seeds of the episodes that the best training run is chosen by; `SUBMITTED_SEEDS` are those of reported episodes."""

RESPONSES_FILE = "best_responses.json"
"""Name of the file of best responses, in a folder of training runs and among the package's cards."""

ABOUT = (
    "Best responses are recurrent PPO agents with the benchmark's view. Each is trained with one teammate, with memory "
    "cleared before each episode, and imitates the oracle in the first half of the training. Some runs start from the "
    "parameters of a bundled model. Episodes of seed "
    f"{CHOICE_SEEDS[0]} decide between training runs. Returns are means over tasks and the seeds "
    f"{', '.join(map(str, SUBMITTED_SEEDS))}. For each of these seeds, the stored model that earns most with the other "
    "two is used instead if it earns more with them; in validation tasks, models are not compared. On the track "
    "`preference`, best responses are informed egos, which observe the task's number, and returns are means over "
    "training runs."
)

PLAY = PlayOptions(task_end=1.0)
"""Play options of a best response: each task is one episode, because the ego trains with a single teammate."""


def find_behaviours(tasks: Iterable[Task]) -> list[tuple[Task, ...]]:
    """Group tasks of the same split, layout, dish and family whose teammates behave the same.

    The tasks of a group share one best response. Teammates behave the same if their distance on the states of
    `teammates.distances` is below `SAME_BEHAVIOUR`. On layouts without test tasks, teammates are not compared.
    """

    def group_key(task: Task) -> tuple[Any, ...]:
        alone = task.task_id if task.layout.name not in LAYOUT_NAMES else ""
        return task.split, task.layout.name, task.recipes, task.teammate_kind, alone

    found = []
    for own in grouped(tasks, group_key).values():
        if len(own) == 1:
            found.append((own[0],))
            continue
        plain = replace(own[0], recipes=None).layout
        actions = act_on_records(plain, [build_teammate(plain, task.teammate) for task in own], common_states(plain)[0])
        alike = grouped(zip(group_behaviours(actions), own, strict=True), lambda numbered: numbered[0])
        found += [tuple(task for _, task in one) for one in alike.values()]
    return found


def tasks_with_headroom(tasks: Iterable[Task]) -> list[Task]:
    """Return the tasks in which the scripted oracle earns more than `stay`, according to stored measurements.

    Test tasks are kept if the oracle earns over 1 more, averaged over the layout and family, other tasks if the oracle
    earns at least `LEAST_HEADROOM` more with the teammate. Tasks without a measurement, such as those of the track
    `preference`, are kept.
    """
    cells = read_reference_returns(PROTOCOL)
    kept = []
    for task in tasks:
        if task.split == "test":
            cell = cells.get((task.layout.name, task.teammate_family))
            matters = cell is None or has_headroom(cell)
        else:
            draw = find_measured(task.layout.name, task.teammate) if task.layout.name in TESTED_ON else None
            matters = draw is None or draw.oracle - draw.stay >= LEAST_HEADROOM
        kept += [task] if matters else []
    return kept


@dataclass(frozen=True)
class EgoJob(TrainingJob):
    """Job that trains an ego by playing and measures its returns.

    Attributes:
        tasks: the tasks that the ego plays.
        seed, options, out: see `TrainingJob`.
    """

    tasks: tuple[Task, ...]
    seed: int
    options: ResponseOptions
    out: Path

    @property
    def name_suffix(self) -> str:
        """End of the job's name: width, steps and seed, so jobs that differ in these can share an output folder."""
        return f"w{self.options.width}-{self.options.played_steps}-s{self.seed}"

    @property
    def model(self) -> ModelOptions:
        """Architecture of the ego: the bundled rl2 models' architecture, with the width from the options."""
        return ModelOptions(**{**RL2_SETTINGS["model"], "width": self.options.width})

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that the result depends on, as JSON."""
        options = asdict(self.options)
        del options["width"]  # the width is part of `model`
        return {
            "seed": self.seed,
            "options": options,
            "model": asdict(self.model),
            "play": asdict(PLAY),
            "code_version": version("icrl4aht-data"),
        }

    def train(self, played: Sequence[PlayTask], on_update: OnUpdate, params: Any = None) -> tuple[PlayTrainer, Any]:
        """Train an ego on tasks, or resume a stopped run. Return the trainer and the parameters.

        Args:
            played: tasks that every training step plays; if their `partner` is set, the ego observes this number.
            on_update: function for progress, see `run`.
            params: initial parameters; by default random ones that depend on the seed.
        """
        layouts = list(dict.fromkeys(task.layout for task in self.tasks))
        told = 0 if played[0].partner is None else len(self.tasks)
        world = overcooked_world(layouts, self.model.encoder, canonical=True, partners=told)
        method = get_method("rl2")(self.model, world)
        trainer = PlayTrainer(method, self.training, PLAY, played)
        task = TrainingTask(method, TrainingData(None, {}), self.training, self.settings, trainer)
        state = task.train(self.run_folder, params=params, done=self.step_progress(on_update))
        return trainer, state.params


@dataclass(frozen=True)
class ResponseJob(EgoJob):
    """Job that trains and evaluates one best response, on a group of tasks from `find_behaviours`.

    The best response is trained with the teammate of the group's first task.
    """

    @property
    def name(self) -> str:
        """Name of the job's folder: id of the first task, initial model if any, width, steps and seed."""
        start = f"-{self.options.init}" if self.options.init else ""
        return f"{self.tasks[0].task_id}{start}-{self.name_suffix}"

    @property
    def label(self) -> str:
        """Name of the job that progress displays show: layout, teammate and seed."""
        task, others = self.tasks[0], len(self.tasks) - 1
        alike = f" and {others} alike" if others else ""
        return f"{task.layout.name} {task.teammate_family}/t{task.teammate['theta_id']}{alike}, seed {self.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that the result depends on, as JSON."""
        seeds = {"choice_seeds": list(CHOICE_SEEDS), "report_seeds": list(SUBMITTED_SEEDS), "protocol": PROTOCOL}
        return {"tasks": [task.task_id for task in self.tasks], **super().settings, **seeds}

    def finished_text(self) -> str:
        """Return a note on the result for progress displays: the return in each play mode."""
        modes = self.result()["modes"]
        return "return " + ", ".join(f"{mode} {found['return']:.1f}" for mode, found in modes.items())

    def measure(self, on_update: OnUpdate) -> dict[str, Any]:
        """Train the ego, and measure its returns in episodes with other seeds than in training.

        "choice" is the mean return over the tasks in episodes with `CHOICE_SEEDS`, "return" in episodes with
        `SUBMITTED_SEEDS`. Each is measured with its most probable actions ("greedy") and with sampled ones ("sampled").
        "slope" is the training return in the last quarter of the steps minus that in the third quarter.
        """
        task, params = self.tasks[0], None
        if run := initial_run(task.layout.name, self.options):
            params = read_trained(run).params
        mate = build_teammate(task.layout, task.teammate)
        played = PlayTask(task.layout, task.teammate_kind, mate, False, task.layout.name)
        trainer, params = self.train([played] * self.options.tasks, on_update, params)
        modes = {}
        for mode, greedy in (("greedy", True), ("sampled", False)):
            policy = with_channels(
                trained_policy(trainer.method, params, KEPT_STEPS, PlayMode(greedy=greedy)), "canonical"
            )
            modes[mode] = self._mean_returns(policy)
        lines = map(parse_json, read_text(self.run_folder / METRICS).splitlines())
        returns = [value for line in lines for name, value in line.items() if name.startswith("return ")]
        last, before = returns[len(returns) * 3 // 4 :], returns[len(returns) // 2 : len(returns) * 3 // 4]
        slope = float(np.mean(last) - np.mean(before)) if len(before) else 0.0
        return {"modes": modes, "slope": round(slope, 3)}

    def _mean_returns(self, policy: Policy) -> dict[str, float]:
        """Return the mean returns in episodes with `CHOICE_SEEDS` ("choice") and with `SUBMITTED_SEEDS` ("return")."""
        # The memory is cleared before each episode, as it was in training.
        results = evaluate(
            "best response",
            lambda layout: policy,
            self.tasks,
            PROTOCOL,
            seeds=(*CHOICE_SEEDS, *SUBMITTED_SEEDS),  # together, because each number of seeds is compiled separately
            control="cleared",
            played=lambda count: None,
        )
        returns = np.array([result.returns for result in results])  # shape (tasks, seeds, episodes)
        choice, report = np.split(returns, [len(CHOICE_SEEDS)], axis=1)
        return {"choice": round(float(choice.mean()), 3), "return": round(float(report.mean()), 3)}


def trained_response(job: ResponseJob) -> TrainingRun:
    """Return the result of a finished job, for the play mode with the higher return in episodes with `CHOICE_SEEDS`."""
    result = job.result()
    acting, earned = max(result["modes"].items(), key=lambda mode: mode[1]["choice"])
    return TrainingRun(
        seed=job.seed,
        steps=job.options.played_steps,
        width=job.options.width,
        mean_return=earned["return"],
        choice=earned["choice"],
        acting=acting,
        slope=result["slope"],
        init=job.options.init or "",
    )


def choose_best_response(tasks: Sequence[Task], trainings: Iterable[TrainingRun]) -> BestResponse:
    """Return the best response to tasks whose teammates behave the same, from several training runs.

    The run with the highest mean return in episodes with the seeds `CHOICE_SEEDS` is chosen. The result's field `best`
    is the mean return of this run in other episodes, with the seeds `SUBMITTED_SEEDS`. For informed egos, which have no
    returns in separate episodes, it is the mean over the runs with the most steps. Of several runs with the same seed,
    tasks, initial model, steps and width, only the last is used.
    """
    task, seeds = tasks[0], {(one.tasks, one.init, one.steps, one.width, one.seed): one for one in trainings}
    best, ego = _trained_ego(seeds.values())
    return BestResponse(
        layout=task.layout.name,
        family=task.teammate_family,
        split=task.split,
        tasks=tuple(one.task_id for one in tasks),
        seeds=tuple(seeds.values()),
        best=best,
        agent=ego,
    )


def _trained_ego(trainings: Collection[TrainingRun]) -> tuple[float, str]:
    """Return the mean return of a best response's trained ego, and the ego's name."""
    run = best_training_run(trainings)
    if run.choice is None:
        longest = [one.mean_return for one in trainings if (one.steps, one.width) == (run.steps, run.width)]
        return float(np.mean(longest)), f"informed ego, {counted_noun(len(longest), 'run')}"
    return run.mean_return, f"best response, seed {run.seed}" + (f" from {run.init}" if run.init else "")


def initial_run(layout: str, options: ResponseOptions) -> Path | None:
    """Return the run folder of the bundled model that a training run on a layout starts from; None without a model.

    Args:
        layout: short name of the layout.
        options: settings of the training run.

    Raises:
        UnknownNameError: if `options.init` is not the name of a bundled model.
        OptionError: if the model has another width.
    """
    if not options.init:
        return None
    models = bundled_models()
    if options.init not in models:
        raise unknown_name("bundled model", options.init, models)
    model = models[options.init]
    run = model.runs[model.run_key(layout)]
    width = read_config(run)["model"]["width"]
    if width != options.width:
        raise OptionError(
            f"width = {options.width}: {options.init} has width {width}; choose --width {width}, or --init oracle"
        )
    return run


def include_models(found: BestResponse, models: Mapping[str, Mapping[str, np.ndarray]]) -> BestResponse:
    """Choose between the trained ego of a best response and stored models.

    The return of a model that is chosen by the reported episodes would be too high. Therefore an ego is chosen for each
    seed of `SUBMITTED_SEEDS` separately: the model with the highest mean return with the other seeds, or the trained
    ego if its mean return over all seeds is as high. (Its returns by seed are not stored; its return with
    `CHOICE_SEEDS` is the highest of several runs, and thus too high for a comparison.) Field `best` of the result is
    the mean return of the chosen egos. Field `agent` is the ego that would be chosen by all seeds.

    Args:
        found: best response; its training runs are used, and its fields `best` and `agent` are replaced.
        models: model -> task id -> mean return with each of `SUBMITTED_SEEDS`, float64 (3,); models without results in
            all tasks of `found` are ignored.
    """
    trained, ego = _trained_ego(found.seeds)
    found = structs.replace(found, best=trained, agent=ego)
    names = [name for name, returns in models.items() if returns.keys() >= {*found.tasks}]
    if not names:
        return found
    earned = np.array([np.mean([models[name][task] for task in found.tasks], axis=0) for name in names])
    others = (earned.sum(axis=1, keepdims=True) - earned) / (len(SUBMITTED_SEEDS) - 1)  # shape (models, seeds)
    of_models = np.take_along_axis(earned, others.argmax(axis=0)[None], axis=0)[0]
    best = np.where(others.max(axis=0) > trained, of_models, trained)
    means = earned.mean(axis=1)
    agent = names[int(means.argmax())] if means.max() > trained else ego
    return structs.replace(found, best=float(best.mean()), agent=agent)


def write_responses(
    jobs: Sequence[ResponseJob], folder: Path, models: Mapping[str, Mapping[str, np.ndarray]] = MappingProxyType({})
) -> Path:
    """Add the best responses of finished jobs to the file `RESPONSES_FILE` in a folder. Return the file's path.

    A new entry includes the file's earlier training runs on the same tasks.

    Args:
        jobs: training jobs; unfinished jobs are skipped.
        folder: folder of the file.
        models: model -> task id -> mean returns, see `include_models`.
    """
    known = {one.tasks: one for one in stored_responses(folder)}
    found = []
    for ids, own in grouped(
        [job for job in jobs if job.is_finished()], lambda job: tuple(task.task_id for task in job.tasks)
    ).items():
        before = known[ids].seeds if ids in known else ()
        found.append(choose_best_response(own[0].tasks, [*before, *map(trained_response, own)]))
    return add_responses(found, folder, models)


def stored_responses(folder: Path) -> tuple[BestResponse, ...]:
    """Return the best responses in a folder's file `RESPONSES_FILE`; none if the file does not exist."""
    path = folder / RESPONSES_FILE
    return read_best_responses(path).behaviours if path.is_file() else ()


def add_responses(found: Sequence[BestResponse], folder: Path, models: Mapping[str, Mapping[str, np.ndarray]]) -> Path:
    """Add best responses to the file `RESPONSES_FILE` in a folder. Return the file's path.

    Earlier entries that share tasks with the new ones are removed, and a new entry takes the place of one with the same
    tasks. For all entries, `include_models` chooses between trained egos and stored models. The version in the file is
    a hash of all entries. A Markdown file of the same name gets a table of all entries.
    """
    path, new = folder / RESPONSES_FILE, {one.tasks: one for one in found}
    played = {task for tasks in new for task in tasks}
    stored = [one for one in stored_responses(folder) if one.tasks in new or played.isdisjoint(one.tasks)]
    kept = [new.pop(one.tasks, one) for one in stored]
    behaviours = tuple(include_models(one, models) for one in (*kept, *new.values()))
    card = BestResponseCard(json_hash(to_builtins(behaviours)), PROTOCOL, ABOUT, behaviours)
    write_best_responses(path, card)
    write_atomically(path.with_suffix(".md"), f"# Best responses\n\n{responses_table(folder)}\n")
    return path


def responses_table(folder: Path) -> str:
    """Return a Markdown table of a folder's best responses.

    On the track `preference`, column "teammates" also has the ingredient ids of the wanted dish. Column "B" is the best
    return. Column "rise" is the `slope` of the best training run; a `slope` well above 0 shows that the training was
    too short.
    """
    body = []
    dishes = {task.task_id: task.recipes for task in bundled_tasks(PREFERENCE, "test")}
    for one in read_best_responses(folder / RESPONSES_FILE).behaviours:
        returns, best = [seed.mean_return for seed in one.seeds], best_training_run(one.seeds)
        mates = f"{one.family} {', '.join(task.rsplit('_', 3)[1] for task in one.tasks)}"
        mates += "".join(f", dish {'-'.join(map(str, dish))}" for dish in dishes.get(one.tasks[0]) or ())
        spread = f"{min(returns):.1f} to {max(returns):.1f}" if len(returns) > 1 else ""
        training = [
            str(len(returns)),
            f"{best.steps:,}",
            str(best.width),
            "" if best.slope is None else f"{best.slope:+.1f}",
        ]
        body.append([one.layout, one.split, mates, f"{one.best:.1f}", one.agent, spread, *training])
    header = ["layout", "split", "teammates", "B", "ego", "range of runs", "runs", "steps", "width", "rise"]
    return markdown_table(header, body)
