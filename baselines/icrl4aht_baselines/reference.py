"""Make the reference models, from a release of noise histories to evaluated models and their cards.

    OUT/noise/lite              release of noise histories, as `icrl4aht-data generate --profile noise` makes it
    OUT/rl2-reference-TRACK     RL^2, trained by playing with the training teammates of that release
    OUT/agent-TRACK             histories of RL^2 with falling noise, source `agent`
    OUT/rising-TRACK            histories of RL^2 that begin with random actions, see `RL2_HISTORIES`
    OUT/NAME-TRACK              run folder of the model NAME
    OUT/NAME-TRACK-first        run folder of the first of two training runs of a model
    OUT/NAME-TRACK-own          histories that this first model plays, labelled by RL^2
    OUT/NAME-TRACK-mixed        the histories of the first training together with the model's histories
    OUT/results/NAME-TRACK/...  results on validation tasks and on test tasks

Finished parts are reused, and stopped parts resume.
"""

from __future__ import annotations

import subprocess
import sys
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
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.templates import fill_template
from icrl4aht_data.writing.combine import combine_releases

PROFILE = "noise"
"""Name of the profile that the release of noise histories is generated with."""

RL2_HISTORIES = {
    "agent": NoiseConfig(8, 40, start=(0.2, 0.9), end=(0.0, 0.0), begin=(0.0, 0.0), finish=(0.2, 0.8)),
    "rising": NoiseConfig(8, 40, start=(0.8, 1.0), end=(0.0, 0.0), begin=(0.0, 0.0), finish=(0.4, 0.9)),
}
"""Kind of data -> noise of the histories that RL^2 plays with each teammate. Every history ends without noise. Those of
the kind `rising` begin with mostly random actions, like a learner, for a model that imitates the improvement."""

OWN_HISTORIES = NoiseConfig(2, 20, start=(0.0, 0.0))
"""Noise and number of the histories that a model itself plays for its second training: 1 in 9 of all episodes."""

OWN_SHARE = 0.5
"""Learning rate of a model's second training relative to that of the first."""

EVALUATIONS = {
    "validation": ("validation", "seeded", 1),
    "diverse": ("diverse", "seeded", 1),
    "test-seeded": ("test", "seeded", 3),
    "test-published": ("test", "published", 1),
}
"""Name of a folder of results -> split of the tasks, protocol, and number of seeds."""

TRACK_VIEWS: dict[str, dict[str, Any]] = {
    "teammate": {},
    "layout": {"mirror": True, "hide_recipe": ("asymm_both",)},
}
"""Track -> values of `HistoryOptions` for all of its models. Models of the layout track are tested on new layouts, so
they are also trained on mirrored games. On the test layout asymm_right the ego cannot see a recipe indicator, so the
indicator of the training layout asymm_both is hidden."""

TRACK_PLAY: dict[str, dict[str, Any]] = {
    "teammate": {},
    "layout": {"rearranged": 70, "four_recipes": True},
}
"""Track -> values of `PlayOptions` for models that learn by playing."""


@dataclass(frozen=True)
class Recipe:
    """Settings that a reference model is made with.

    Attributes:
        method: name of the method.
        data: kind of the training histories, one of `RL2_HISTORIES`; empty for learning by playing.
        model: values of `ModelOptions`.
        train: values of `TrainOptions`.
        histories: values of `HistoryOptions`.
        own_round: whether a second training run follows, on the first histories and on histories that the model itself
            plays and RL^2 labels.
        greedy: whether the model takes its most probable actions or samples its actions.
        role: purpose of the model in the package.
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
# With K + 1 queries, each prefix of a context of K transitions has its own query.
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
"""Name of a reference model -> how it is made. The bundled models have the same names."""


class ReferenceOutcome(NamedTuple):
    """Outcome of one reference model on one track.

    Attributes:
        name: name in `RECIPES`.
        track: name of the track.
        run: run folder of the model.
        results: name in `EVALUATIONS` -> folder of results.
    """

    name: str
    track: str
    run: Path
    results: dict[str, Path]


def check_learns_from_teacher(name: str) -> None:
    """Check that a reference model learns from histories of a teacher, as the choice of a teacher requires.

    Raises:
        OptionError: if the model learns by playing.
    """
    if not RECIPES[name].data:
        taught = ", ".join(each for each, recipe in RECIPES.items() if recipe.data)
        raise OptionError(
            f"{name} does not learn from a teacher's histories; leave out --teacher, or choose another --name: {taught}"
        )


@dataclass(frozen=True)
class ReferenceMaker:
    """Maker of the reference models of a track. Models and releases that exist already are reused.

    Attributes:
        track: name of the track.
        out: output folder; its content is described at the top of this module.
        show: function for progress, called with (description, units done, total units, note).
        teacher: name or run folder of the agent that plays and labels the histories, such as `rl2-reference`; if None,
            RL^2 is trained first. Existing releases and runs are reused, even if made with another teacher.
    """

    track: str
    out: Path
    show: Callable[..., None]
    teacher: str | None = None

    def make(self, name: str, evaluates: bool = True) -> ReferenceOutcome:
        """Make a reference model with everything that it needs, or resume a stopped call.

        Args:
            name: a name in `RECIPES`.
            evaluates: whether the model is also evaluated.

        Raises:
            OptionError: if a run folder holds a run with other settings. Existing releases are not checked.
            TrainingStopped: after SIGTERM or SIGINT during training; the state of the training is saved.
        """
        recipe, run = RECIPES[name], self.out / f"{name}-{self.track}"
        if not recipe.data:
            self.train_by_playing()
        else:
            histories, first = self.teacher_histories(recipe.data), None
            if recipe.own_round:
                first = run.with_name(f"{run.name}-first")
                self.train(recipe, histories, first)
                histories = self.add_own_histories(histories, first, run)
            self.train(recipe, histories, run, before=first)
        return ReferenceOutcome(name, self.track, run, self.evaluate(name, run, recipe) if evaluates else {})

    def noise_release(self) -> Path:
        """Generate the release of noise histories. Return the folder of the release."""
        folder = self.out / "noise"
        if not (folder / "lite").is_dir():
            command = ["-m", "icrl4aht_data", "generate", "--profile", PROFILE, "--out", str(folder)]
            failed = subprocess.run([sys.executable, *command], check=False).returncode
            if failed:
                raise OptionError(f"{folder}: `python {' '.join(command)}` failed; its messages are above")
        return folder / "lite"

    def teammates(self, number: int = 0) -> Any:
        """Return the teammates of the noise histories on the track's layouts, and those of `diverse_tasks`.

        Args:
            number: number of the collection, which determines the seeds of the tasks, see `release_teammates`.
        """
        noise = load_icrl4aht(self.noise_release(), layout=list(TRACKS[self.track]["train"]))
        return release_teammates(noise, number, self.diverse_tasks())

    def diverse_tasks(self) -> list[Task]:
        """Return the bundled training tasks of the track with diverse teammates."""
        return read_tasks(manifest_path(self.track, "train", "diverse"))

    def train_by_playing(self) -> Path:
        """Train RL^2 by playing with teammates of the noise histories and diverse teammates. Return the run folder."""
        recipe, folder = RECIPES["rl2-reference"], self.out / f"rl2-reference-{self.track}"
        options = TrainOptions(**recipe.train)
        root = str(self.noise_release())
        choice = HistoryOptions(TRACKS[self.track]["train"], root, **TRACK_VIEWS[self.track])
        model, play = ModelOptions(**recipe.model), PlayOptions(**TRACK_PLAY[self.track])
        job = prepare_play(recipe.method, model, options, play, choice, self.diverse_tasks())
        job.train(folder, done=show_steps(self.show, folder.name, options.steps))
        return folder

    def teacher_histories(self, kind: str) -> Path:
        """Record histories of the teacher, with noise as in `RL2_HISTORIES[kind]`. Return the folder of the release."""
        folder = self.out / f"{kind}-{self.track}"
        if not folder.is_dir():
            agent = find_agent(self.teacher or self.train_by_playing(), greedy=False)
            collect_release(agent, self.teammates(), RL2_HISTORIES[kind], folder, progress=self.show)
        return folder

    def train(self, recipe: Recipe, root: Path, folder: Path, before: Path | None = None) -> None:
        """Train a model on a release; with `before`, start from that run's parameters, at a lower learning rate."""
        options = TrainOptions(**recipe.train)
        if before:
            options = replace(options, learning_rate=OWN_SHARE * options.learning_rate)
        views = {**recipe.histories, **TRACK_VIEWS[self.track]}
        histories = HistoryOptions(TRACKS[self.track]["train"], str(root), channels="canonical", **views)
        job = prepare(recipe.method, ModelOptions(**recipe.model), options, histories)
        params = start_from(before, job.method, job.about) if before else None
        job.train(folder, params=params, done=show_steps(self.show, folder.name, options.steps))

    def add_own_histories(self, histories: Path, first: Path, run: Path) -> Path:
        """Record histories of a model, labelled by the teacher. Return a release that adds them to `histories`."""
        own, mixed = (run.with_name(f"{run.name}-{kind}") for kind in ("own", "mixed"))
        if not mixed.is_dir():
            if not own.is_dir():
                labeller = find_agent(self.teacher or self.train_by_playing())
                teammates, agent = self.teammates(number=1), find_agent(first, greedy=False)
                collect_release(agent, teammates, OWN_HISTORIES, own, labeller=labeller, progress=self.show)
            combine_releases(mixed, [histories, own])
        return mixed

    def evaluate(self, name: str, run: Path, recipe: Recipe) -> dict[str, Path]:
        """Evaluate a model. Return the folder of results for each name in `EVALUATIONS`."""
        model, agent = f"{name}-{self.track}", find_agent(run, greedy=recipe.greedy)._replace(name=name)
        found = {kind: self.out / "results" / model / kind for kind in EVALUATIONS}
        for kind, (split, protocol, seeds) in EVALUATIONS.items():
            tasks, shown = bundled_tasks(self.track, split), {"show": self.show, "what": f"{model}, {kind}"}
            evaluate_agent(agent, tasks, get_protocol(protocol), found[kind], seeds=range(seeds), **shown)
        return found


def write_bundled_card(
    name: str, outcomes: Sequence[ReferenceOutcome], folder: Path = MODELS, teacher: str | None = None
) -> Path:
    """Write the card of a bundled model, with its training and its results. Return the path of the card.

    Args:
        name: name of the bundled model.
        outcomes: evaluated outcomes of the model's tracks.
        folder: folder of the bundled models.
        teacher: agent that played the training histories, see `ReferenceMaker`.
    """
    (run,) = merge([read_run(found.results["test-seeded"]) for found in outcomes])
    validation = merge([read_run(found.results[kind]) for found in outcomes for kind in ("validation", "diverse")])
    trained = [source for source in run.sources if source.trained]
    models = grouped(trained, lambda source: (source.trained or {})["run_hash"])  # the table has a row for each model
    configs: list[dict[str, Any]] = [(sources[0].trained or {})["config"] for sources in models.values()]
    config = configs[0]
    seeds = ", ".join(dict.fromkeys(str(config["train"]["seed"]) for config in configs))
    overlaps = {overlap for one in (run, *validation) for overlap in one.overlaps(one.cells)}
    limits = [
        f"Each model is one run, of seed {seeds}: the variation between seeds is not known.",
        "Its input at each step must be what the evaluator passes, see `docs/protocol.md` in the repository.",
        *overlap_legend(overlaps),
    ]
    taught = f" --teacher {teacher}" if teacher else ""
    command = f"icrl4aht-data research reference --name {outcomes[0].name}{taught} --bundle-as {name}"
    properties = [
        f"| method | {config['method']} |",
        f"| created with | icrl4aht-data {config['package_version']} |",
        f"| made by | `{command}` |",
    ]
    sections = [section for one in (run, *validation) for section in markdown_sections([one], one.protocol)]
    drawn = [found.track for found in outcomes if (folder / name / found.track / RUN_CURVES).is_file()]
    shown = [f"Training of the model of track {track}:\n\n![curves]({track}/{RUN_CURVES})" for track in drawn]
    text = fill_template(
        "baseline.md",
        title=name,
        method=config["method"],
        training=" ".join(dict.fromkeys(map(training_sentence, configs))),
        properties="\n".join(properties),
        models="\n".join(_model_row(run, sources) for sources in models.values()),
        protocol=run.protocol,
        results="\n\n".join(f"#{section}" for section in sections),
        curves="\n\n".join(["## Curves", *shown, ""]) if shown else "",
        limits="\n".join(f"* {limit}" for limit in limits),
    )
    card = folder / name / MODEL_CARD
    card.write_text(text, encoding="utf-8")
    return card


def training_sentence(config: Mapping[str, Any]) -> str:
    """Return a sentence on what a model was trained on.

    Args:
        config: content of config.json in the model's run folder.
    """
    if "groups" in config["histories"]:
        sentence, play = "It was trained by playing with teammates, not on learning histories.", config.get("play", {})
        if not play.get("imitation"):
            return sentence
        part = f"In the first {min(1, play['imitation_end']):.0%} of its steps it also imitated"
        if config["histories"].get("searched"):
            part = f"{part} the script `search` in tasks with a hidden dish, and elsewhere"
        return f"{sentence} {part} the scripted oracle, which sees the full state."
    cells = config.get(TRAINED_ON, ())
    sources = sorted({cell["source"] for cell in cells if cell.get("source")})
    labels = sorted({cell["labels"] for cell in cells if cell.get("labels")})
    named = f" of source {' and '.join(f'`{source}`' for source in sources)}" if sources else ""
    targets = f", with {' and '.join(f'`{label}`' for label in labels)} labels" if labels else ""
    return f"It was trained on learning histories{named}{targets}."


def _model_row(run: EvaluationRun, sources: Sequence[ResultSource]) -> str:
    """Return a row of the card's table of models: layouts, training data, seed and evaluation of one model."""
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
