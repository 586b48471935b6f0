"""Make the reference models step by step, from a release of noise histories to evaluated models and their cards.

    OUT/noise/lite              release of noise histories, as `icrl4aht-data generate --profile noise` makes it
    OUT/rl2-reference-TRACK     RL^2, trained by playing with the training teammates of that release
    OUT/agent-TRACK             histories of RL^2 with falling noise, source `agent`
    OUT/rising-TRACK            such histories that begin at random, see `RL2_HISTORIES`
    OUT/NAME-TRACK              run folder of a model
    OUT/NAME-TRACK-first        its first training, before it was labelled on histories of its own
    OUT/NAME-TRACK-own          these histories, and OUT/NAME-TRACK-mixed with the others
    OUT/results/NAME-TRACK/...  results on validation tasks and on test tasks

Everything resumes: finished parts are kept, stopped ones continue.
"""

from __future__ import annotations

import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from icrl4aht_generation.profiles.noise_config import NoiseConfig

from icrl4aht_baselines.agents.bundled import MODEL_CARD, MODELS
from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol
from icrl4aht_baselines.methods.options import RL2_SETTINGS, SIZES, ModelOptions
from icrl4aht_baselines.online.agent_histories import collect_release, release_teammates
from icrl4aht_baselines.online.prepare import prepare_play
from icrl4aht_baselines.report.page import instances_range, markdown_sections
from icrl4aht_baselines.report.results import EvaluationRun, ResultSource, evaluate_agent, merge, read_run
from icrl4aht_baselines.training.histories import prepare, start_from
from icrl4aht_baselines.training.options import HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import RUN_CURVES
from icrl4aht_baselines.training.seen import TRAINED_ON, describe_training, overlap_legend
from icrl4aht_baselines.training.trainer import show_steps
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.templates import fill_template
from icrl4aht_data.writing.combine import combine_releases

PROFILE = "noise"
"""Profile of the release that everything starts from."""

RL2_HISTORIES = {
    "agent": NoiseConfig(8, 40, start=(0.2, 0.9), end=(0.0, 0.0), begin=(0.0, 0.0), finish=(0.2, 0.8)),
    "rising": NoiseConfig(8, 40, start=(0.8, 1.0), end=(0.0, 0.0), begin=(0.0, 0.0), finish=(0.4, 0.9)),
}
"""Kind of data -> noise of histories of RL^2 with each teammate. The end of every history is without noise. Those of
`rising` begin at random or nearly so, as learners begin, for a model that imitates how they improve."""

OWN_HISTORIES = NoiseConfig(2, 20, start=(0.0, 0.0))
"""Histories that a model plays itself: 2 of 10 with each teammate. They are shorter, a ninth of all episodes."""

OWN_SHARE = 0.5
"""Learning rate of a training on own histories, as a share of the first training's."""

EVALUATIONS = {
    "validation": ("validation", "seeded", 1),
    "diverse": ("diverse", "seeded", 1),
    "test-seeded": ("test", "seeded", 3),
    "test-published": ("test", "published", 1),
}
"""Folder of results -> split of the tasks, protocol, and number of seeds."""

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


@dataclass(frozen=True)
class Recipe:
    """How a reference model is made.

    Attributes:
        method: name of the method.
        data: kind of the histories that it learns from, one of `RL2_HISTORIES`; empty for learning by playing.
        model: values of `ModelOptions`.
        train: values of `TrainOptions`.
        histories: values of `HistoryOptions`.
        own_round: whether a second training follows, with histories that the model plays and RL^2 labels, in addition
            to the first ones.
        greedy: whether it plays its most probable actions or draws them.
        role: what the package bundles it for.
    """

    method: str
    data: str = ""
    model: dict[str, Any] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    histories: dict[str, Any] = field(default_factory=dict)
    own_round: bool = False
    greedy: bool = False
    role: str = ""


_TINY: dict[str, Any] = {**SIZES["tiny"].model, "teammate_actions": True, "reward_scale": 0.05, "dropout": 0.0}
_STEPS: dict[str, Any] = {"steps": 4000, "batch_size": 16, "context": 200, "learning_rate": 2e-3}
# DPT has another query after every part of a context.
_QUERIES: dict[str, Any] = {"labels": "expert", "queries": _STEPS["context"] + 1}
_LONG: dict[str, Any] = {**_STEPS, "steps": 3000, "batch_size": 4, "context": 1000}

RECIPES = {
    "rl2-reference": Recipe(
        "rl2", "", RL2_SETTINGS["model"], {**RL2_SETTINGS["train"], "steps": 1600}, role="plays best"
    ),
    "ad-reference": Recipe(
        "ad", "agent", _TINY, _STEPS, {"labels": "expert"}, own_round=True, greedy=True, role="best of AD"
    ),
    "dpt-reference": Recipe(
        "dpt", "agent", _TINY, {**_STEPS, "steps": 2000}, _QUERIES, own_round=True, role="best of DPT"
    ),
    "ad-rising": Recipe("ad", "rising", _TINY, _LONG, role="gains most by its memory"),
}
"""Reference models by name; the bundled ones have the same names."""


class ReferenceOutcome(NamedTuple):
    """Outcome of one reference model on one track.

    Attributes:
        name: name of the recipe.
        track: the track.
        run: the model's run folder.
        results: name in `EVALUATIONS` -> folder of results.
    """

    name: str
    track: str
    run: Path
    results: dict[str, Path]


def make_reference(
    name: str,
    track: str,
    out: Path,
    show: Callable[..., None],
    evaluates: bool = True,
    teacher: str | None = None,
) -> ReferenceOutcome:
    """Make a reference model of a track, with everything that it needs, or resume it.

    Args:
        name: one of `RECIPES`.
        track: the track.
        out: folder, see this module's docstring.
        show: called with (description, units done, units, note), for progress.
        evaluates: whether to evaluate it as well.
        teacher: agent whose histories are recorded and who labels them, such as the bundled `rl2-reference`; without
            it, RL^2 is trained first. Existing releases and runs are kept, even if they were made with another teacher.

    Raises:
        OptionError: if a run folder holds a run of other settings. Existing releases are not checked.
        TrainingStopped: after SIGTERM or SIGINT during a training, which is saved.
    """
    steps, recipe = _Steps(out, track, show, teacher), RECIPES[name]
    run = out / f"{name}-{track}"
    if not recipe.data:
        run = steps.play()
    else:
        histories, first = steps.teacher_histories(recipe.data), None
        if recipe.own_round:
            first = run.with_name(f"{run.name}-first")
            steps.train(recipe, histories, first)
            histories = steps.add_own_histories(histories, first, run)
        steps.train(recipe, histories, run, before=first)
    return ReferenceOutcome(name, track, run, steps.evaluate(name, run, recipe) if evaluates else {})


def check_taught(name: str) -> None:
    """Check that a reference model learns from histories of a teacher.

    Raises:
        OptionError: if it does not.
    """
    if not RECIPES[name].data:
        taught = ", ".join(each for each, recipe in RECIPES.items() if recipe.data)
        raise OptionError(f"{name} learns from no histories of a teacher; leave it out, or choose one of {taught}")


@dataclass(frozen=True)
class _Steps:
    """The steps towards the reference models of a track; each of them is skipped if it was done before."""

    out: Path
    track: str
    show: Callable[..., None]
    teacher: str | None = None

    def noise_release(self) -> Path:
        """Generate the release of noise histories. Return its folder."""
        folder = self.out / "noise"
        if not (folder / "lite").is_dir():
            command = ["-m", "icrl4aht_data", "generate", "--profile", PROFILE, "--out", str(folder)]
            failed = subprocess.run([sys.executable, *command], check=False).returncode
            if failed:
                raise OptionError(f"{folder}: `python {' '.join(command)}` failed; its messages are above")
        return folder / "lite"

    def teammates(self, number: int = 0) -> Any:
        """Return the teammates of the noise histories on the track's layouts, and diverse ones, see `collect_release`.

        Args:
            number: number of the collection, in the tasks' seeds.
        """
        noise = load_icrl4aht(self.noise_release(), layout=list(TRACKS[self.track]["train"]))
        return release_teammates(noise, number, self.diverse_tasks())

    def diverse_tasks(self) -> list[Task]:
        """Return the training tasks with diverse teammates."""
        return read_tasks(manifest_path(self.track, "train", "diverse"))

    def play(self) -> Path:
        """Train RL^2 by playing with the teammates of the noise histories and diverse ones. Return its run folder."""
        recipe, folder = RECIPES["rl2-reference"], self.out / f"rl2-reference-{self.track}"
        options = TrainOptions(**recipe.train)
        root = str(self.noise_release())
        choice = HistoryOptions(TRACKS[self.track]["train"], root, **TRACK_VIEWS[self.track])
        model, play = ModelOptions(**recipe.model), PlayOptions(**TRACK_PLAY[self.track])
        job = prepare_play(recipe.method, model, options, play, choice, self.diverse_tasks())
        job.train(folder, done=show_steps(self.show, folder.name, options.steps))
        return folder

    def teacher_histories(self, kind: str) -> Path:
        """Record histories of the teacher with noise as in `RL2_HISTORIES[kind]`. Return the path of the release."""
        folder = self.out / f"{kind}-{self.track}"
        if not folder.is_dir():
            agent = find_agent(self.teacher or self.play(), greedy=False)
            collect_release(agent, self.teammates(), RL2_HISTORIES[kind], folder, progress=self.show)
        return folder

    def train(self, recipe: Recipe, root: Path, folder: Path, before: Path | None = None) -> None:
        """Train a model on a release, after a first training from `before` at a lower learning rate."""
        options = TrainOptions(**recipe.train)
        if before:
            options = replace(options, learning_rate=OWN_SHARE * options.learning_rate)
        views = {**recipe.histories, **TRACK_VIEWS[self.track]}
        histories = HistoryOptions(TRACKS[self.track]["train"], str(root), channels="canonical", **views)
        job = prepare(recipe.method, ModelOptions(**recipe.model), options, histories)
        params = start_from(before, job.method, job.about) if before else None
        job.train(folder, params=params, done=show_steps(self.show, folder.name, options.steps))

    def add_own_histories(self, histories: Path, first: Path, run: Path) -> Path:
        """Record histories of a model that the teacher labels. Return the release of these and the given ones."""
        own, mixed = (run.with_name(f"{run.name}-{kind}") for kind in ("own", "mixed"))
        if not mixed.is_dir():
            if not own.is_dir():
                labeller = find_agent(self.teacher or self.play())
                teammates, agent = self.teammates(number=1), find_agent(first, greedy=False)
                collect_release(agent, teammates, OWN_HISTORIES, own, labeller=labeller, progress=self.show)
            combine_releases(mixed, [histories, own])
        return mixed

    def evaluate(self, name: str, run: Path, recipe: Recipe) -> dict[str, Path]:
        """Return the folders of a model's results, by their names in `EVALUATIONS`."""
        model, agent = f"{name}-{self.track}", find_agent(run, greedy=recipe.greedy)._replace(name=name)
        found = {kind: self.out / "results" / model / kind for kind in EVALUATIONS}
        for kind, (split, protocol, seeds) in EVALUATIONS.items():
            tasks, shown = bundled_tasks(self.track, split), {"show": self.show, "what": f"{model}, {kind}"}
            evaluate_agent(agent, tasks, get_protocol(protocol), found[kind], seeds=range(seeds), **shown)
        return found


def write_bundled_card(
    name: str, outcomes: Sequence[ReferenceOutcome], folder: Path = MODELS, teacher: str | None = None
) -> Path:
    """Write the card of a bundled model: its results on test and validation tasks, and its training. Return its path.

    Args:
        name: of the bundled model.
        outcomes: of its tracks, evaluated.
        folder: of the bundled models.
        teacher: the agent that it was made with, see `make_reference`.
    """
    (run,) = merge([read_run(found.results["test-seeded"]) for found in outcomes])
    validation = merge([read_run(found.results[kind]) for found in outcomes for kind in ("validation", "diverse")])
    taught = f" --teacher {teacher}" if teacher else ""
    command = f"icrl4aht-data research reference --name {outcomes[0].name}{taught} --bundle-as {name}"
    drawn = [found.track for found in outcomes if (folder / name / found.track / RUN_CURVES).is_file()]
    card = folder / name / MODEL_CARD
    card.write_text(model_card(run, name, command, validation, drawn), encoding="utf-8")
    return card


def model_card(
    run: EvaluationRun,
    title: str,
    command: str,
    validation: Sequence[EvaluationRun] = (),
    drawn: Sequence[str] = (),
) -> str:
    """Return README.md of a bundled model, which has a model for each track.

    Args:
        run: results of all of its models on test tasks. The card's table of models has a row for each.
        title: name of the bundled model.
        command: command that makes it.
        validation: further results, on validation tasks under the same protocol, which get tables, too.
        drawn: tracks for which the folder has a figure of the model's training.
    """
    models: dict[str, list[ResultSource]] = defaultdict(list)
    for source in run.sources:
        if source.trained:
            models[source.trained["run_hash"]].append(source)
    configs: list[dict[str, Any]] = [(sources[0].trained or {})["config"] for sources in models.values()]
    config = configs[0]
    seeds = ", ".join(dict.fromkeys(str(config["train"]["seed"]) for config in configs))
    overlaps = {name for one in (run, *validation) for name in one.overlaps(one.cells)}
    limits = [
        f"Each model is one run, of seed {seeds}: the variation between seeds is not known.",
        "Its input at each step must be what the evaluator passes, see `docs/protocol.md` in the repository.",
        *overlap_legend(overlaps),
    ]
    properties = [
        f"| method | {config['method']} |",
        f"| created with | icrl4aht-data {config['package_version']} |",
        f"| made by | `{command}` |",
    ]
    sections = [section for one in (run, *validation) for section in markdown_sections([one], one.protocol)]
    shown = [f"Training of the model of track {track}:\n\n![curves]({track}/{RUN_CURVES})" for track in drawn]
    return fill_template(
        "baseline.md",
        title=title,
        method=config["method"],
        training=" ".join(dict.fromkeys(map(training_sentence, configs))),
        properties="\n".join(properties),
        models="\n".join(_model_row(run, sources) for sources in models.values()),
        protocol=run.protocol,
        results="\n\n".join(f"#{section}" for section in sections),
        curves="\n\n".join(["## Curves", *shown, ""]) if shown else "",
        limits="\n".join(f"* {limit}" for limit in limits),
    )


def training_sentence(config: Mapping[str, Any]) -> str:
    """Return a sentence on what a model was trained on.

    Args:
        config: config.json of its run.
    """
    if "groups" in config["histories"]:
        sentence, play = "It was trained by playing with teammates, not on learning histories.", config.get("play", {})
        if not play.get("imitation"):
            return sentence
        part = f"In the first {play['imitation_end']:.0%} of its steps it also imitated the scripted oracle"
        return f"{sentence} {part}, which sees the full state."
    cells = config.get(TRAINED_ON, ())
    sources = sorted({cell["source"] for cell in cells if cell.get("source")})
    labels = sorted({cell["labels"] for cell in cells if cell.get("labels")})
    named = f" of source {' and '.join(f'`{source}`' for source in sources)}" if sources else ""
    targets = f", with {' and '.join(f'`{label}`' for label in labels)} labels" if labels else ""
    return f"It was trained on learning histories{named}{targets}."


def _model_row(run: EvaluationRun, sources: Sequence[ResultSource]) -> str:
    """Return a row of the table of models: training data and seed of one model, and its evaluation."""
    trained: dict[str, Any] = sources[0].trained or {}
    histories = trained["config"]["histories"]
    instances = instances_range(len(run.cells[cell]) for source in sources for cell in source.tasks)
    values = [
        ", ".join(dict.fromkeys(layout for source in sources for layout in source.layouts)),
        f"`{Path(histories['root']).name}`, data version {histories['data_version']}, manifest with SHA-256 "
        f"`{trained['manifest_sha256']}`",
        describe_training(sources[0].seen),
        str(trained["config"]["train"]["seed"]),
        f"{sources[0].conditions}, {instances} in a cell",
    ]
    return f"| {' | '.join(values)} |"
