"""Make the reference models, from a release of histories to evaluated models and their cards.

    OUT/PROFILE/lite                    release that `icrl4aht-data generate --profile PROFILE` makes
    OUT/bundled-PROFILE                 its histories together with those of the bundled release, of chosen sources
    OUT/NAME-TRACK-sSEED/run            run folder of the model NAME
    OUT/NAME-TRACK-sSEED/results/KIND   results on validation tasks and on test tasks, see `EVALUATIONS`; in subfolders
                                        `cleared` and `swapped` those of controls

Finished parts are reused, and stopped parts resume.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from icrl4aht_generation.jobs.job import OnUpdate
from msgspec import to_builtins

from icrl4aht_baselines.agents.bundled import EVERY_TRACK, MODEL_CARD, MODELS, format_track
from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.protocols import CONTROLS, bundled_tasks, get_protocol
from icrl4aht_baselines.evaluate.rollout import ProgramCache
from icrl4aht_baselines.methods.options import RL2_SETTINGS, SIZES, ModelOptions
from icrl4aht_baselines.online.prepare import prepare_play
from icrl4aht_baselines.report.page import instances_range, summary_lines
from icrl4aht_baselines.report.results import (
    EPISODE_BLOCKS,
    EvaluationRun,
    ResultSource,
    evaluate_agent,
    mean_over_cells,
    merge,
    read_run,
)
from icrl4aht_baselines.report.scores import cell_scales
from icrl4aht_baselines.training.histories import load_initial_params, prepare
from icrl4aht_baselines.training.job import TrainingJob
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import RUN_CURVES
from icrl4aht_baselines.training.seen import TRAINED_ON, describe_training, overlap_legend
from icrl4aht_data.benchmark.facts import ALL_TRACKS, KEPT_STEPS, PREFERENCE, TRACKS, layout_track
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import process_lock
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import fill_template, markdown_table
from icrl4aht_data.writing.combine import combine_releases

_PUBLISHED = tuple(TRACKS)

EVALUATIONS: dict[str, tuple[tuple[str, ...], str, str, int]] = {
    "validation": (ALL_TRACKS, "validation", "seeded", 1),
    "diverse": (_PUBLISHED, "diverse", "seeded", 1),
    "test-seeded": (_PUBLISHED, "test", "seeded", 3),
    "test-preference": ((PREFERENCE,), "test", "seeded", 3),
    "test-published": (_PUBLISHED, "test", "published", 1),
}
"""Name of a folder of results -> tracks and split of the tasks, protocol, and number of seeds. Tracks have separate
folders of test results, because `submit` takes complete tracks."""

_CONTROLLED = ("test-seeded", "test-preference")  # evaluations that also play the controls

TRACK_VIEWS: dict[str, dict[str, Any]] = {
    EVERY_TRACK: {},
    "teammate": {},
    "layout": {"mirror": True, "hide_recipe": ("asymm_both",)},
}
"""Track -> values of `HistoryOptions` for all of its models. Models of the layout track are tested on new layouts, so
they are also trained on mirrored games. On the test layout asymm_right the ego cannot see a recipe indicator, so the
indicator of the training layout asymm_both is hidden."""

TRACK_PLAY: dict[str, dict[str, Any]] = {
    EVERY_TRACK: {},
    "teammate": {},
    "layout": {"rearranged": 70, "four_recipes": True},
}
"""Track -> values of `PlayOptions` for models that learn by playing."""


@dataclass(frozen=True)
class ReferenceSettings:
    """Settings that a reference model is made with.

    Attributes:
        method: name of the method.
        plays: whether the model learns by playing, not from histories.
        model: values of `ModelOptions`.
        train: values of `TrainOptions`.
        histories: values of `HistoryOptions`.
        play: values of `PlayOptions`.
        profile: profile of the release with the training teammates, or with histories to learn from besides those of
            the bundled release; empty for the bundled release alone.
        start: name of a bundled model; training starts with its parameters for track `teammate`, or with random
            parameters if the name is empty.
        one_model: whether the same model plays all tracks, see `EVERY_TRACK`.
        role: purpose of the model in the package.
    """

    method: str
    plays: bool = False
    model: dict[str, Any] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    histories: dict[str, Any] = field(default_factory=dict)
    play: dict[str, Any] = field(default_factory=dict)
    profile: str = "noise"
    start: str = ""
    one_model: bool = False
    role: str = ""

    @property
    def tracks(self) -> tuple[str, ...]:
        """Names of the tracks that have a model of their own."""
        return (EVERY_TRACK,) if self.one_model else tuple(TRACKS)


_TINY: dict[str, Any] = {**SIZES["tiny"].model, "teammate_actions": True, "reward_scale": 0.05, "dropout": 0.0}
_HISTORIES_TRAIN: dict[str, Any] = {"batch_size": 8, "context": 500, "learning_rate": 2e-3}
_ADAPTING: dict[str, Any] = {"steps": 320, "batch_size": 384, "log_every": 5, "save_every": 20}

REFERENCE_SETTINGS = {
    "rl2-reference": ReferenceSettings(
        "rl2", True, RL2_SETTINGS["model"], {**RL2_SETTINGS["train"], "steps": 1600}, role="plays best"
    ),
    "rl2-adapting": ReferenceSettings(
        "rl2",
        True,
        RL2_SETTINGS["model"],
        {**RL2_SETTINGS["train"], **_ADAPTING},
        play={"episodes": 5, "task_end": 0.5, "imitation": 50.0, "imitation_end": 1.5, "minibatches": 64},
        profile="search",
        start="rl2-reference",
        one_model=True,
        role="adapts best",
    ),
    "ad-reference": ReferenceSettings(
        "ad",
        model=_TINY,
        train={**_HISTORIES_TRAIN, "steps": 8000},
        histories={"source": ("agent", "search"), "labels": "expert", "balance": True, "at_start": 0.5},
        profile="teach",
        one_model=True,
        role="AD on released histories",
    ),
    "dpt-reference": ReferenceSettings(
        "dpt",
        model=_TINY,
        train={**_HISTORIES_TRAIN, "steps": 4000},
        # With K + 1 queries, each prefix of a context of K transitions has its own query.
        histories={"source": ("agent",), "labels": "expert", "queries": _HISTORIES_TRAIN["context"] + 1},
        profile="",
        one_model=True,
        role="DPT on released histories",
    ),
}
"""Name of a reference model -> how it is made. The bundled models have the same names."""


@dataclass(frozen=True)
class ReferenceJob(TrainingJob):
    """Job that trains a reference model for a track, or for all tracks. Existing releases are reused.

    Attributes:
        model: name in `REFERENCE_SETTINGS`.
        track: name of the track, or `EVERY_TRACK`.
        seed: seed of the training run.
        out: folder of all jobs, with the content that the top of this module describes.
        xla_threads: see `Job`.
    """

    model: str
    track: str
    seed: int
    out: Path
    xla_threads: int | None = None

    @property
    def name(self) -> str:
        """Name of the job's folder."""
        return f"{self.model}-{self.track}-s{self.seed}"

    @property
    def label(self) -> str:
        """Name of the job for progress displays."""
        return f"{self.model}, {format_track(self.track)}, seed {self.seed}"

    @property
    def reference(self) -> ReferenceSettings:
        """Settings that the model is made with."""
        return REFERENCE_SETTINGS[self.model]

    @property
    def training(self) -> TrainOptions:
        """Settings of the training run, for the trainer."""
        return TrainOptions(**self.reference.train, seed=self.seed)

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps, or steps of histories, in a training step; approximate if the model plays."""
        played = PlayOptions(**self.reference.play).episodes * KEPT_STEPS
        return self.training.batch_size * (played if self.reference.plays else self.training.context)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that the result depends on, as JSON. The content of releases is not included."""
        views, play = TRACK_VIEWS[self.track], TRACK_PLAY[self.track]
        code = {"code_version": version("icrl4aht-data")}
        return to_builtins({"reference": self.reference, "views": views, "play": play, **code})

    def measure(self, on_update: OnUpdate) -> dict[str, Any]:
        """Make the training data and train the model. Return no measured values."""
        if self.reference.plays:
            self.train_by_playing(on_update)
        else:
            self.train_on_histories(on_update)
        return {}

    def generated_release(self, profile: str) -> Path:
        """Generate the release of a profile, unless it exists. Return the folder of the release."""
        folder = self.out / profile
        with process_lock(self.out / f".{profile}.generating.lock"):
            if not (folder / "lite").is_dir():
                command = ["-m", "icrl4aht_data", "generate", "--profile", profile, "--out", str(folder)]
                failed = subprocess.run([sys.executable, *command], check=False).returncode
                if failed:
                    raise OptionError(
                        f"{folder}: `python {' '.join(command)}` failed with exit code {failed}, see its output"
                    )
        return folder / "lite"

    def released_histories(self) -> Path | None:
        """Return the folder of a release with the histories to learn from; None for the bundled release.

        The folder is made if it is missing: from the profile's release, and the bundled histories of other sources.
        """
        profile, source = self.reference.profile, self.reference.histories["source"]
        if not profile:
            return None
        others, bundled = load_icrl4aht(self.generated_release(profile), source=source), load_icrl4aht()
        folder, wanted = self.out / f"bundled-{profile}", bundled.info.data_version
        with process_lock(self.out / f".{folder.name}.combining.lock"):
            if not folder.is_dir():
                own = bundled.filter(source=[name for name in source if name not in others.index.values("source")])
                combine_releases(folder, [own, others], wanted)
        if (found := load_icrl4aht(folder).info.data_version) != wanted:
            raise OptionError(
                f"{folder}: made from data version {found}, but the bundled release has {wanted}; remove {folder} and "
                f"{self.out / profile}, or choose another --out"
            )
        return folder

    def diverse_tasks(self) -> list[Task]:
        """Return the bundled training tasks of the track with diverse teammates; none for `EVERY_TRACK`."""
        return [] if self.track == EVERY_TRACK else read_tasks(manifest_path(self.track, "train", "diverse"))

    def train_by_playing(self, on_update: OnUpdate) -> None:
        """Train RL^2 by playing with the teammates of a release and of `diverse_tasks`."""
        reference, root = self.reference, str(self.generated_release(self.reference.profile))
        layouts = (ALL_LAYOUTS,) if reference.one_model else TRACKS[self.track]["train"]
        choice = HistoryOptions(layouts, root, **TRACK_VIEWS[self.track])
        model, play = ModelOptions(**reference.model), PlayOptions(**TRACK_PLAY[self.track], **reference.play)
        job = prepare_play(reference.method, model, self.training, play, choice, self.diverse_tasks())
        params = (
            load_initial_params(MODELS / reference.start / "teammate", job.method, job.about)
            if reference.start
            else None
        )
        job.train(self.run_folder, params=params, done=self.step_progress(on_update))

    def train_on_histories(self, on_update: OnUpdate) -> None:
        """Train a model on the histories of `released_histories`, of all layouts."""
        root = self.released_histories()
        histories = HistoryOptions((ALL_LAYOUTS,), str(root) if root else None, **self.reference.histories)
        job = prepare(self.reference.method, ModelOptions(**self.reference.model), self.training, histories)
        job.train(self.run_folder, done=self.step_progress(on_update))

    def evaluation_tasks(self, kind: str) -> list[Task]:
        """Return the tasks of an evaluation that the model plays as a bundled model.

        A model of one track also plays the tasks of the track `preference` on layouts of its own track.

        Args:
            kind: a name in `EVALUATIONS`.
        """
        tracks, split, _, _ = EVALUATIONS[kind]
        tasks = [task for track in tracks for task in bundled_tasks(track, split)]
        return [task for task in tasks if self.track in (EVERY_TRACK, layout_track(task.layout.name))]

    def results(self, kind: str) -> Path:
        """Return the folder of the job's results; `kind` is a name in `EVALUATIONS`."""
        return self.folder / "results" / kind

    def evaluate(self, show: Callable[..., None]) -> None:
        """Evaluate the trained model, with the function `show` for progress; on test tasks also with controls."""
        agent = find_agent(self.run_folder, greedy=False)._replace(name=self.model)
        programs = ProgramCache()
        for kind, (_, _, protocol, seeds) in EVALUATIONS.items():
            tasks = self.evaluation_tasks(kind)
            for control in (None, *CONTROLS) if kind in _CONTROLLED else (None,):
                out, what = self.results(kind) / (control or ""), " ".join(filter(None, (self.name, kind, control)))
                shown: Any = {"seeds": range(seeds), "show": show, "what": what, "programs": programs}
                evaluate_agent(agent, tasks, get_protocol(protocol), out, control=control, **shown)


def write_bundled_card(name: str, jobs: Sequence[ReferenceJob], folder: Path = MODELS) -> Path:
    """Write the card of a bundled model, with its training and its results. Return the path of the card.

    Args:
        name: name of the bundled model.
        jobs: finished and evaluated jobs of the model, one for each track, or one for all tracks.
        folder: folder of the bundled models.
    """
    (run,) = merge([read_run(job.results(kind)) for job in jobs for kind in _CONTROLLED])
    validation = merge([read_run(job.results(kind)) for job in jobs for kind in ("validation", "diverse")])
    trained = [source for source in run.sources if source.trained]
    models = grouped(trained, lambda source: (source.trained or {})["run_hash"])  # the table has a row for each model
    configs: list[dict[str, Any]] = [(sources[0].trained or {})["config"] for sources in models.values()]
    config = configs[0]
    seeds = ", ".join(dict.fromkeys(str(config["train"]["seed"]) for config in configs))
    overlaps = {overlap for one in (run, *validation) for overlap in one.overlaps(one.cells)}
    limits = [
        f"The results are of one run, of seed {seeds}. They do not show the variation between runs.",
        "Its input at each step must be what the evaluator passes, see `docs/protocol.md` in the repository.",
        *overlap_legend(overlaps),
    ]
    command = f"icrl4aht-data research reference --name {jobs[0].model} --bundle-as {name}"
    properties = [
        f"| method | {config['method']} |",
        f"| created with | icrl4aht-data {config['package_version']} |",
        f"| made by | `{command}` |",
    ]
    drawn = [job.track for job in jobs if (folder / name / job.track / RUN_CURVES).is_file()]
    shown = [f"Training of the model of {format_track(track)}:\n\n![curves]({track}/{RUN_CURVES})" for track in drawn]
    text = fill_template(
        "baseline.md",
        title=name,
        method=config["method"],
        training=" ".join(dict.fromkeys(map(training_sentence, configs))),
        properties="\n".join(properties),
        models="\n".join(_model_row(run, sources) for sources in models.values()),
        protocol=run.protocol,
        summaries="\n".join(f"* {line}" for line in summary_lines([run, *validation])),
        results=_layout_table(run),
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


def _layout_table(run: EvaluationRun) -> str:
    """Return the card's table of results: mean returns over the result cells of each kind of tasks and layout."""
    scales, body = cell_scales(run.protocol), []
    blocks = [name for name in EPISODE_BLOCKS if all(name in of.blocks for of in run.returns.values())]
    columns = ["tasks", "layout", *blocks, "`stay`", "best response"]
    for (kind, layout), cells in grouped(run.returns, lambda cell: (cell.kind, cell.layout)).items():
        known = [scales[cell] for cell in cells if cell in scales]
        means = [mean_over_cells(run.returns[cell].blocks[name] for cell in cells) for name in blocks]
        if len(known) == len(cells):
            means += [float(np.mean(ends)) for ends in zip(*((of.stay, of.best) for of in known), strict=True)]
        body.append([kind, layout, *(f"{mean:z.1f}" for mean in means), *["–"] * (len(columns) - 2 - len(means))])
    return markdown_table(columns, body, right=len(columns) - 2)


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
