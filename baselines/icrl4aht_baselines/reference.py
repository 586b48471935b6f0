"""Reference models: from a release that one command makes to models that are evaluated, step by step.

    OUT/noise/lite              release of noise histories, as `generation generate --profile noise` makes it
    OUT/rl2-TRACK               RL^2, trained by playing with the training teammates of that release
    OUT/student-TRACK           histories of RL^2 whose noise falls, source `student`
    OUT/rising-TRACK            such histories that begin at random, see `RL2_HISTORIES`
    OUT/NAME-TRACK              run folder of a model
    OUT/NAME-TRACK-first        its first training, before it was labelled on histories of its own
    OUT/NAME-TRACK-own          these histories, and OUT/NAME-TRACK-mixed with the others
    OUT/results/NAME-TRACK/...  results on validation tasks and on test tasks
    OUT/times.jsonl             wall seconds of each part that was made, and the number of cores

Everything resumes: finished parts are kept, stopped ones continue.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from icrl4aht_generation.learners.resume import Checkpoints
from icrl4aht_generation.profiles.noise_config import NoiseConfig

from icrl4aht_baselines.agents.bundled import MODEL_CARD, MODELS
from icrl4aht_baselines.agents.egos import AS_PUBLISHED, FORGETS, PlayMode, find_agent
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol
from icrl4aht_baselines.methods.options import RL2_SETTINGS, SIZES, ModelOptions
from icrl4aht_baselines.online.prepare import prepare_play
from icrl4aht_baselines.online.student import collect_release, release_teammates
from icrl4aht_baselines.plotting import SMOOTHING, plot_return_curves, shrink_picture
from icrl4aht_baselines.report.comparison import cells_with_headroom
from icrl4aht_baselines.report.model_card import model_card
from icrl4aht_baselines.report.results import merge, note_results, read_run
from icrl4aht_baselines.training.histories import prepare, start_from
from icrl4aht_baselines.training.options import HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import CHECKPOINTS, RUN_CURVES
from icrl4aht_baselines.training.trainer import format_loss, train
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import read_headroom
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
from icrl4aht_data.dataset import MINI, load_icrl4aht
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.progress import counted
from icrl4aht_data.utils.system import usable_cores
from icrl4aht_data.writing.combine import combine_releases

Data = Literal["tasks", "noise", "ppo", "both", "student", "rising"]
"""What a model learns from: playing, noise histories, those of PPO learners of the bundled release, both, or histories
of RL^2, see `RL2_HISTORIES`."""

PROFILE = "noise"
"""Profile of the release that everything starts from."""


@dataclass(frozen=True)
class Recipe:
    """How a reference model is made.

    Attributes:
        method: name of the method.
        data: see `Data`.
        model: values of `ModelOptions`.
        train: values of `TrainOptions`.
        histories: values of `HistoryOptions`.
        play: values of `PlayOptions`, in addition to those of the track, `TRACK_PLAY`.
        rounds: number of further trainings, each with histories that the model plays and RL^2 labels, in addition to
            all earlier ones. After one round, 2 of 10 histories with each teammate are own ones (`OWN_HISTORIES`); they
            are shorter, a ninth of all episodes.
        mode: way in which the model plays.
        protocols: protocol of the evaluation on test tasks -> number of seeds.
        forgets: whether to evaluate it on test tasks with its memory cleared at the start of each episode as well.
        meets_tests: whether a model that learns by playing plays with the test teammates on the test layouts with
            headroom, besides those of the noise histories there, instead of diverse ones on the training layouts. It
            is no result of the benchmark: it shows what such a model earns that has met the teammates of the test.
    """

    method: str
    data: Data
    model: dict[str, Any] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    histories: dict[str, Any] = field(default_factory=dict)
    play: dict[str, Any] = field(default_factory=dict)
    rounds: int = 0
    mode: PlayMode = AS_PUBLISHED
    protocols: Mapping[str, int] = field(default_factory=lambda: {"seeded": 3, "published": 1})
    forgets: bool = False
    meets_tests: bool = False


_TINY: dict[str, Any] = {**SIZES["tiny"].model, "teammate_actions": True, "reward_scale": 0.05, "dropout": 0.0}
_STEPS: dict[str, Any] = {"steps": 4000, "batch_size": 16, "context": 200, "learning_rate": 2e-3}
_DPT_STEPS: dict[str, Any] = {**_STEPS, "steps": 2000}
_QUERIES: dict[str, Any] = {"queries": _STEPS["context"] + 1}  # another one after every part of a context
_TEACHER: dict[str, Any] = {**RL2_SETTINGS["train"], "steps": 1600}

RL2_HISTORIES = {
    "student": NoiseConfig(8, 40, start=(0.2, 0.9), end=(0.0, 0.0), begin=(0.0, 0.0), finish=(0.2, 0.8)),
    "rising": NoiseConfig(8, 40, start=(0.8, 1.0), end=(0.0, 0.0), begin=(0.0, 0.0), finish=(0.4, 0.9)),
}
"""Kind of data -> noise of histories of RL^2 with each teammate. The end of every history is without noise. Those of
`rising` begin at random or nearly so, as learners begin, for a model that imitates how they improve."""

OWN_HISTORIES = NoiseConfig(2, 20, start=(0.0, 0.0))
"""Histories that a model plays itself."""

RECIPES = {
    "rl2": Recipe("rl2", "tasks", RL2_SETTINGS["model"], _TEACHER, mode=PlayMode(greedy=False)),
    "rl2-tests": Recipe(
        "rl2",
        "tasks",
        RL2_SETTINGS["model"],
        {**_TEACHER, "steps": 1000},
        mode=PlayMode(greedy=False),
        protocols={"seeded": 1},
        meets_tests=True,
    ),
    "ad-noise": Recipe("ad", "noise", _TINY, _STEPS, {"labels": "oracle"}),
    "dpt-noise": Recipe("dpt", "noise", _TINY, _DPT_STEPS, {"labels": "oracle", **_QUERIES}),
    "ad-ppo": Recipe("ad", "ppo", _TINY, _STEPS, {"labels": "oracle"}),
    "dpt-ppo": Recipe("dpt", "ppo", _TINY, _DPT_STEPS, {"labels": "oracle", **_QUERIES}),
    "ad-both": Recipe("ad", "both", _TINY, _STEPS, {"labels": "oracle"}),
    "dpt-both": Recipe("dpt", "both", _TINY, _DPT_STEPS, {"labels": "oracle", **_QUERIES}),
    "ad-learned": Recipe("ad", "both", _TINY, _STEPS, {"labels": "oracle", "teammate_family": ("rl",)}),
    "ad-student": Recipe("ad", "student", _TINY, _STEPS, {"labels": "expert"}, rounds=1),
    "dpt-student": Recipe(
        "dpt",
        "student",
        _TINY,
        _DPT_STEPS,
        {"labels": "expert", **_QUERIES},
        rounds=1,
        mode=PlayMode(greedy=False),
    ),
    "ad-rising": Recipe(
        "ad",
        "rising",
        _TINY,
        {**_STEPS, "steps": 3000, "batch_size": 4, "context": 1000},
        mode=PlayMode(greedy=False),
        forgets=True,
    ),
}
"""Reference models by name."""

TRACK_VIEWS: dict[str, dict[str, Any]] = {
    "teammate": {},
    "layout": {"mirror": True, "hide_recipe": ("asymm_both",)},
}
"""Track -> values of `HistoryOptions` for all of its models. Models of the layout track are tested on other layouts
than they are trained on, so they learn from mirrored games, too; asymm_right has no recipe indicator that the ego could
see, so that of asymm_both is hidden from them."""

TRACK_PLAY: dict[str, dict[str, Any]] = {
    "teammate": {},
    "layout": {"rearranged": 70, "four_recipes": True},
}
"""Track -> values of `PlayOptions` for its models that learn by playing."""

TIMES = "times.jsonl"
"""File name of the times of parts, see this module's docstring."""

RETURNS = "returns.png"
"""File name of the curves of a bundled model's returns, in the folder of a track."""

VALIDATION_KINDS = ("validation", "diverse")
"""Kinds of tasks that models are chosen by."""

OWN_SHARE = 0.5
"""Learning rate of a training on own histories, as a share of the first training's."""


class ReferenceOutcome(NamedTuple):
    """Outcome of one reference model on one track.

    Attributes:
        name: name of the recipe.
        track: the track.
        run: the model's run folder.
        results: kind of tasks -> folder of results.
    """

    name: str
    track: str
    run: Path
    results: dict[str, Path]


def write_bundled_card(
    name: str, outcomes: Sequence[ReferenceOutcome], folder: Path = MODELS, teacher: str | None = None
) -> Path:
    """Write the card of a bundled model: its results on test and validation tasks, and curves. Returns its path.

    Args:
        name: of the bundled model.
        outcomes: of its tracks, evaluated.
        folder: of the bundled models.
        teacher: the agent that it was made with, see `make_reference`.
    """
    (run,) = merge([read_run(found.results["test-seeded"]) for found in outcomes])
    path = folder / name / MODEL_CARD
    validation = merge([read_run(found.results[kind]) for found in outcomes for kind in VALIDATION_KINDS])
    taught = f" --teacher {teacher}" if teacher else ""
    command = f"icrl4aht-data research reference --name {outcomes[0].name}{taught} --bundle-as {name}"
    pictures = {}
    for found in outcomes:
        pictures |= _card_pictures(name, found, folder / name)
    path.write_text(model_card(run, name, command, validation, pictures), encoding="utf-8")
    return path


def _card_pictures(name: str, found: ReferenceOutcome, folder: Path) -> dict[str, str]:
    """Draw the returns of a bundled model on a track. Returns the pictures of the track: path in the folder -> text."""
    run, headroom = read_run(found.results["test-seeded"]), read_headroom("seeded")
    cells = [cell for cell in cells_with_headroom("seeded") if cell in run.cells]
    returns, training = f"{found.track}/{RETURNS}", f"{found.track}/{RUN_CURVES}"
    plot_return_curves([(name, run.cells)], cells, folder / returns, headroom)
    shrink_picture(folder / returns, folder / returns)
    pictures = {
        returns: f"Return in each episode of the test tasks of track {found.track}, protocol seeded: running mean over "
        f"{SMOOTHING} episodes of the mean over a cell's instances and seeds, range over the instances (band), single "
        f"episodes (thin)"
    }
    if (folder / training).is_file():
        pictures[training] = f"Training of the model of track {found.track}"
    return pictures


def describe_times(out: Path) -> str:
    """Returns a sentence on the total time of the parts in a folder; empty if none was timed."""
    path = out / TIMES
    lines = [parse_json(line) for line in read_text(path).splitlines()] if path.exists() else []
    hours = sum(line["seconds"] for line in lines) / 3600
    cores = " or ".join(map(str, sorted({line["cores"] for line in lines})))
    return f"everything in {out} took {hours:.2f} hours on {cores} cores; see {path}" if lines else ""


Show = Callable[..., None]
"""Called with (description, units done, units, note)."""


def make_reference(
    name: str,
    track: str,
    out: Path,
    show: Show,
    evaluates: bool = True,
    teacher: str | None = None,
    finished: Path | None = None,
) -> ReferenceOutcome:
    """Make a reference model of a track, with everything that it needs, or resume it.

    Args:
        name: one of `RECIPES`.
        track: the track.
        out: folder, see this module's docstring.
        show: called now and then, for progress.
        evaluates: whether to evaluate it as well.
        teacher: agent whose histories are recorded and who labels them, such as the bundled `rl2-reference`; without
            it, RL^2 is trained first. Releases and runs that are there are used as they are, whoever taught them.
        finished: run folder of the model, such as that of a bundled one, which is then only evaluated.

    Raises:
        UnknownNameError: for an unknown recipe or track.
        OptionError: if a run folder holds a run of other settings. Releases that are there are used as they are.
        TrainingStopped: after SIGTERM or SIGINT during a training, which is saved.
    """
    if name not in RECIPES:
        raise unknown("reference model", name, RECIPES)
    if track not in TRACKS:
        raise unknown("track", track, TRACKS)
    made = _Making(out, track, show, teacher)
    recipe = RECIPES[name]
    if teacher is not None:
        check_taught(name)
    run = finished or (made.play(name) if recipe.data == "tasks" else made.train(name, recipe))
    return ReferenceOutcome(name, track, run, made.evaluate(name, run, recipe) if evaluates else {})


def check_taught(name: str) -> None:
    """Check that a reference model learns from histories of a teacher.

    Raises:
        OptionError: if it does not.
    """
    if RECIPES[name].data not in RL2_HISTORIES:
        taught = ", ".join(each for each, other in RECIPES.items() if other.data in RL2_HISTORIES)
        raise OptionError(f"{name} learns from no histories of a teacher; leave it out, or choose one of {taught}")


def _is_trained(folder: Path, options: TrainOptions) -> bool:
    """Returns whether the training in a run folder has reached its last step."""
    return Checkpoints(folder / CHECKPOINTS).latest == options.steps


@dataclass(frozen=True)
class _Making:
    """The steps towards the reference models of a track."""

    out: Path
    track: str
    show: Show
    teacher: str | None = None

    @contextmanager
    def timed(self, part: str, was_done: bool = False) -> Iterator[None]:
        """Add the wall time of a part to the file of times; nothing for a part that was done before."""
        start = time.perf_counter()
        try:
            yield
        finally:  # a part that was stopped has a line for each time that it ran
            if not was_done:
                self.out.mkdir(parents=True, exist_ok=True)
                line = {"part": part, "seconds": round(time.perf_counter() - start, 1), "cores": usable_cores()}
                with (self.out / TIMES).open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")

    @property
    def layouts(self) -> tuple[str, ...]:
        return TRACKS[self.track]["train"]

    def diverse(self) -> list[Task]:
        """Returns the training tasks with diverse teammates."""
        return read_tasks(manifest_path(self.track, "train", "diverse"))

    def noise_release(self) -> Path:
        """Returns the release of noise histories, which is made if it is missing."""
        folder = self.out / "noise"
        if not (folder / "lite").is_dir():
            command = ["-m", "icrl4aht_data", "generate", "--profile", PROFILE, "--out", str(folder)]
            with self.timed(folder.name):
                failed = subprocess.run([sys.executable, *command], check=False).returncode
            if failed:
                raise OptionError(f"{folder}: `python {' '.join(command)}` failed; its messages are above")
        return folder / "lite"

    def play(self, name: str = "rl2") -> Path:
        """Returns the run folder of RL^2."""
        recipe, folder = RECIPES[name], self.out / f"{name}-{self.track}"
        options = TrainOptions(**recipe.train)
        layouts, tasks, play = self.layouts, self.diverse(), PlayOptions(**TRACK_PLAY[self.track], **recipe.play)
        if recipe.meets_tests:
            tasks, play = self._tasks("test"), PlayOptions()
            layouts = tuple(dict.fromkeys(task.layout.name for task in tasks))
        choice = HistoryOptions(layouts, str(self.noise_release()), **TRACK_VIEWS[self.track])
        done = self._progress(folder.name, options.steps)
        with self.timed(folder.name, was_done=_is_trained(folder, options)):
            job = prepare_play(recipe.method, ModelOptions(**recipe.model), options, play, choice, tasks)
            train(job.method, job.data, options, folder, job.about, trainer=job.trainer, done=done)
        return folder

    def rl2(self) -> str:
        """Returns the name or run folder of the RL^2 that teaches; it is trained if there is none."""
        return self.teacher or str(self.play())

    def histories(self, kind: str) -> Path:
        """Returns the release with histories of RL^2 of a kind, one of `RL2_HISTORIES`."""
        folder = self.out / f"{kind}-{self.track}"
        if not folder.is_dir():
            agent = find_agent(self.rl2(), greedy=False)
            dataset = load_icrl4aht(self.noise_release(), layout=list(self.layouts))
            teammates = release_teammates(dataset, tasks=self.diverse())
            with self.timed(folder.name):
                collect_release(agent, teammates, RL2_HISTORIES[kind], folder, progress=self.show)
        return folder

    def root(self, recipe: Recipe) -> Path:
        """Returns the release that a model is first trained on."""
        if recipe.data in RL2_HISTORIES:
            return self.histories(recipe.data)
        return MINI if recipe.data in ("ppo", "both") else self.noise_release()

    def train(self, name: str, recipe: Recipe) -> Path:
        """Returns the run folder of a model that learns from histories, and then perhaps from its own."""
        folder, root = self.out / f"{name}-{self.track}", self.root(recipe)
        first = folder if not recipe.rounds else folder.with_name(f"{folder.name}-first")
        self._train_once(recipe, root, first, TrainOptions(**recipe.train))
        data = root
        for number in range(1, recipe.rounds + 1):
            end = "" if number == recipe.rounds else f"-{number}"
            target = folder.with_name(folder.name + end)
            data = self._train_on_own(recipe, data, first, target, number)
            first = target
        return folder

    def _train_on_own(self, recipe: Recipe, data: Path, before: Path, target: Path, number: int) -> Path:
        """Train a model further, on the release `data` and histories that it plays itself and RL^2 labels.

        Returns:
            The release of all these histories.
        """
        own, mixed = (target.with_name(f"{target.name}-{kind}") for kind in ("own", "mixed"))
        if not mixed.is_dir():
            dataset = load_icrl4aht(self.noise_release(), layout=list(self.layouts))
            labeller = find_agent(self.rl2())
            teammates = release_teammates(dataset, number, self.diverse())
            agent = find_agent(before, greedy=False)
            if not own.is_dir():
                with self.timed(own.name):
                    collect_release(agent, teammates, OWN_HISTORIES, own, labeller=labeller, progress=self.show)
            combine_releases(mixed, [data, own])
        options = TrainOptions(**recipe.train)
        rate = OWN_SHARE * options.learning_rate
        self._train_once(recipe, mixed, target, replace(options, learning_rate=rate), before)
        return mixed

    def _train_once(
        self, recipe: Recipe, root: Path, folder: Path, options: TrainOptions, before: Path | None = None
    ) -> None:
        sources = (recipe.data,) if recipe.data in ("noise", "ppo") else ()
        views = TRACK_VIEWS[self.track]
        histories = HistoryOptions(
            self.layouts, str(root), source=sources, channels="canonical", **recipe.histories, **views
        )
        done = self._progress(folder.name, options.steps)
        with self.timed(folder.name, was_done=_is_trained(folder, options)):
            job = prepare(recipe.method, ModelOptions(**recipe.model), options, histories)
            params = None if before is None else start_from(before, job.method, job.about)
            train(job.method, job.data, job.options, folder, job.about, params=params, done=done)

    def evaluate(self, name: str, run: Path, recipe: Recipe) -> dict[str, Path]:
        """Returns the folders of a model's results, by the kind of tasks."""
        found = {}
        kinds = [(kind, "seeded", 1, False) for kind in VALIDATION_KINDS]
        kinds += [(f"test-{protocol}", protocol, seeds, False) for protocol, seeds in recipe.protocols.items()]
        kinds += [("test-seeded-forgets", "seeded", 1, True)] if recipe.forgets else []
        for kind, protocol, seeds, forgets in kinds:
            tasks, folder = self._tasks(kind), self.out / "results" / f"{name}-{self.track}" / kind
            agent = find_agent(run, **recipe.mode._replace(forget=forgets)._asdict())
            played = get_protocol(protocol)
            was_done = len(list((folder / "tasks").glob("*.json"))) >= len(tasks)
            with self.timed(f"results/{name}-{self.track}/{kind}", was_done=was_done):
                evaluate(
                    name + FORGETS * forgets,
                    agent.make,
                    tasks,
                    played,
                    seeds=range(seeds),
                    out=folder,
                    details=agent.details,
                    played=counted(self.show, f"{name}-{self.track}, {kind}", len(tasks) * seeds * played.episodes),
                )
            note_results(folder, run, () if kind.startswith("test") else tasks)
            found[kind] = folder
        return found

    def _tasks(self, kind: str) -> list[Task]:
        if kind in VALIDATION_KINDS:
            return bundled_tasks(self.track, kind)
        headroom = {layout for layout, _ in cells_with_headroom("seeded")}
        return [task for task in bundled_tasks(self.track, "test") if task.layout.name in headroom]

    def _progress(self, what: str, steps: int) -> Callable[[int, float | None], None]:
        return lambda step, loss: self.show(what, step, steps, format_loss(loss))
