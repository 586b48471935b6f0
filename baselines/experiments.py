"""The paper's experiments as commands: sweeps, ablations, held-out learned teammates (Sec. 5.3 and 5.4, App. F).

An experiment is a table of entries; each entry is trained on each layout and evaluated on that layout's tasks:

    OUT/<entry>/<layout>/run          what `train` makes
    OUT/<entry>/<layout>/results      what `evaluate` makes
    OUT/report/                       the report of them all, report.html among it

Everything is resumable: what is finished is not done again, what was stopped goes on, and a folder of other settings is
refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from baselines.agents.egos import Acting, find_agent
from baselines.evaluate.evaluator import evaluate
from baselines.evaluate.protocols import get_protocol
from baselines.methods.method import SIZES, ModelOptions
from baselines.methods.registry import get_method
from baselines.report.page import write_page_with_films
from baselines.report.provenance import note_results
from baselines.report.results import merge, read_run
from baselines.report.write import write_report
from baselines.training.histories import HistoryOptions, TrainingTask, prepare
from baselines.training.trainer import TrainOptions, train
from icrl4aht_data.benchmark.facts import TRACKS, track_of
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
from icrl4aht_data.commands.options import counted
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.errors import EmptySelectionError, LabelsMissingError, OptionError, unknown
from icrl4aht_data.format.schema import TASKS
from icrl4aht_data.overcooked.layouts import get_layout

CONTEXTS = (250, 500, 1000, 2000, 5000, 10_000)
"""K of the paper's context sweeps (Sec. 5.3; App. F, "Extended Context Lengths")."""

TESTED_ON = {layout: layout for layout in TRACKS["teammate"]["train"]} | dict(
    zip(TRACKS["layout"]["train"], TRACKS["layout"]["test"], strict=True)
)
"""Training layout -> the layout that its models are tested on (paper, Sec. 5.1 and 5.2)."""


@dataclass(frozen=True)
class ExperimentEntry:
    """One model of an experiment: what differs from the defaults of `train`."""

    name: str  # of its folder, without the method
    model: dict[str, Any] = field(default_factory=dict)  # of `ModelOptions`
    train: dict[str, Any] = field(default_factory=dict)  # of `TrainOptions`
    variant: dict[str, Any] | None = None  # of a sweep: what is varied and its value here


class Experiment(NamedTuple):
    """A table of entries, and where the paper runs them."""

    title: str
    entries: tuple[ExperimentEntry, ...]
    layouts: tuple[str, ...]  # training layouts
    held_out: bool = False  # whether against learned teammates held out of training, on the training layouts


def _size(name: str) -> ExperimentEntry:
    layers, width, steps = SIZES[name]
    return ExperimentEntry(name, {"layers": layers, "width": width}, {"steps": steps}, {"size": name})


EXPERIMENTS = {
    "tracks": Experiment("Teammate and layout generalization", (ExperimentEntry("plain"),), tuple(TESTED_ON)),
    "sweep context": Experiment(
        "Context length",
        tuple(ExperimentEntry(f"K{k}", train={"context": k}, variant={"K": k}) for k in CONTEXTS),
        ("test_wide", "demo_wide"),
    ),
    "sweep size": Experiment("Model scale and training budget", tuple(map(_size, SIZES)), tuple(TESTED_ON)),
    "ablate ta": Experiment(
        "Teammate actions and auxiliary losses",
        (
            ExperimentEntry("none"),
            ExperimentEntry("ta", {"teammate_actions": True}),
            ExperimentEntry("next_obs", {"next_obs": True}),
            ExperimentEntry("ta-next_obs", {"teammate_actions": True, "next_obs": True}),
        ),
        ("test_wide", "demo_wide", "cramped_up"),
    ),
    "heldout-rl": Experiment(
        "Held-out learned teammates", (ExperimentEntry("plain"),), tuple(TESTED_ON), held_out=True
    ),
}
"""Command -> experiment; settings and layouts are the paper's."""


@dataclass(frozen=True)
class ExperimentPlan:
    """How an experiment is run; the defaults are the paper's."""

    methods: tuple[str, ...] = ("ad", "dpt")
    layouts: tuple[str, ...] = ()  # to train on; those of the experiment that the release has
    root: str | None = None  # a release, its folder or address; the bundled mini release by default
    suite: Path | None = None  # learned teammates; for "heldout-rl"
    train: dict[str, Any] = field(default_factory=dict)  # of `TrainOptions` for all entries: steps, batch_size, ..
    model: dict[str, Any] = field(default_factory=dict)  # of `ModelOptions` for all entries
    values: tuple[str, ...] = ()  # only the entries of these names
    families: tuple[str, ...] = ()  # only these teammate families
    tasks: int | None = None  # at most so many of each kind of teammate and layout
    episodes: int | None = None  # of a task, instead of 100
    seeds: int = 1  # how often every task is played
    protocol: str = "seeded"
    acting: Acting = "cached"
    films: bool = True  # whether the page shows an episode per family
    tensorboard: bool = False  # whether training is also logged for TensorBoard


class Done(NamedTuple):
    """What an experiment leaves."""

    report: list[Path]
    notes: list[str]  # what was left out


Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is, and of how much."""


def run_experiment(
    name: str, plan: ExperimentPlan, out: Path, progress: Progress = lambda what, done, of: None
) -> Done:
    """Train, evaluate and report all entries of an experiment, or go on with them.

    Args:
        name: one of `EXPERIMENTS`.
        plan: how.
        out: the folder, see this module's docstring.
        progress: called now and then.

    Raises:
        UnknownNameError: for an experiment, method, entry or layout that does not exist.
        EmptySelectionError: if the release has histories of none of the layouts, or no task is left.
        LabelsMissingError: for DPT on histories without expert actions.
        OptionError: if a context is longer than a history, or a folder holds a run of other settings; for
            "heldout-rl", if the suite has no held-out teammates, or one of them was trained with.
    """
    if name not in EXPERIMENTS:
        raise unknown("experiment", name, EXPERIMENTS)
    experiment = EXPERIMENTS[name]
    for method in plan.methods:
        get_method(method)
    for value in plan.values:
        if value not in {entry.name for entry in experiment.entries}:
            raise unknown(f"setting of {name}", value, [entry.name for entry in experiment.entries])
    entries = [entry for entry in experiment.entries if not plan.values or entry.name in plan.values]
    layouts, notes = _layouts(experiment, plan)
    tasks = {layout: _tasks(experiment, plan, layout) for layout in layouts}
    models = list(product(plan.methods, entries, layouts))
    for model in models:
        _prepared(*model, plan)  # what cannot be trained on fails before any work
    results = []
    for method, entry, layout in models:
        folder = out / f"{method}-{entry.name}" / layout
        _train(method, entry, layout, plan, folder / "run", progress)
        _evaluate(entry, tasks[layout], plan, folder, progress, own_tasks=experiment.held_out)
        results.append(folder / "results")
    runs = merge([read_run(folder) for folder in results])
    notes = [f"{experiment.title} (`{name}`)", *notes]
    report = write_report(runs, out / "report")
    page = out / "report" / "report.html"
    report.append(write_page_with_films(runs, page, films=plan.films, notes=notes, suite=plan.suite))
    return Done(report, notes)


def _layouts(experiment: Experiment, plan: ExperimentPlan) -> tuple[list[str], list[str]]:
    """The layouts to train on, and what to say of those left out."""
    there = {layout.name for layout in load_icrl4aht(plan.root, split="train").layouts}
    if plan.layouts:
        names = [get_layout(name).name for name in plan.layouts]
        for name in names:
            if name not in TESTED_ON:
                raise unknown("training layout", name, TESTED_ON)
        missing = [name for name in names if name not in there]
        if missing:
            raise EmptySelectionError(
                f"{plan.root or 'the bundled mini release'}: no training histories on {', '.join(missing)}; it has "
                f"{', '.join(sorted(there))}: choose among them, or give a --root that has the others"
            )
        return names, []
    names = [name for name in experiment.layouts if name in there]
    if not names:
        raise EmptySelectionError(
            f"{plan.root or 'the bundled mini release'}: no training histories on {', '.join(experiment.layouts)}, "
            f"where the paper runs this; it has {', '.join(sorted(there))}: give --layout, or another --root"
        )
    left = [name for name in experiment.layouts if name not in there]
    return names, [f"left out, the release has no training histories of them: {', '.join(left)}"] if left else []


def _tasks(experiment: Experiment, plan: ExperimentPlan, layout: str) -> list[Task]:
    """What a model trained on a layout is tested on."""
    if experiment.held_out:
        tasks = held_out_tasks(plan.suite, layout, plan.root)
    else:
        on = TESTED_ON[layout]
        tasks = [task for task in read_tasks(manifest_path(track_of(on), "test")) if task.layout.name == on]
    there = dict.fromkeys(task.teammate_family for task in tasks)
    for family in plan.families:
        if family not in there:
            raise unknown("teammate family of these tasks", family, there)
    tasks = [task for task in tasks if not plan.families or task.teammate_family in plan.families]
    if plan.tasks is None:
        return tasks
    if plan.tasks < 1:
        raise OptionError(f"tasks = {plan.tasks}: expected at least 1 of each family and layout")
    kinds = dict.fromkeys(task.teammate_kind for task in tasks)
    return [task for kind in kinds for task in [t for t in tasks if t.teammate_kind == kind][: plan.tasks]]


def held_out_tasks(suite: Path | None, layout: str, root: str | None = None) -> list[Task]:
    """The tasks of a suite's held-out manifest on a training layout (paper, App. F, "Held-Out RL Teammates").

    Args:
        suite: a folder that `python -m generation teammates` has made.
        layout: short name.
        root: the release that models are trained on, whose teammates these must not be.

    Raises:
        OptionError: if the suite has no held-out teammates there, or one of them is in the release.
    """
    if suite is None:
        raise OptionError("held-out teammates: expected a suite, found none; give --suite, a folder that `python -m "
                          "generation teammates` has made")  # fmt: skip
    path = suite / "manifests" / f"{track_of(layout)}_heldout.jsonl"
    if not path.is_file():
        raise OptionError(
            f"{path}: missing: the suite has no held-out teammates for track {track_of(layout)}; train more with "
            f"`python -m generation teammates --suite {suite}` under a profile with [teammates] heldout of 1 or more"
        )
    tasks = [task for task in read_tasks(path) if task.layout.name == layout]
    if not tasks:
        raise OptionError(
            f"{path}: no held-out teammate on {layout}; train that layout's populations with `python -m generation "
            f"teammates --suite {suite} --layout {layout}`, or choose another --layout"
        )
    release = load_icrl4aht(root, layout=layout).root
    met = {
        task.teammate["theta"]["sha256"]: task.task_id
        for task in read_tasks(release / TASKS)
        if task.teammate["kind"] == "rl" and task.split == "train"
    }
    for task in tasks:
        digest = task.teammate["theta"]["sha256"]
        if digest in met:
            raise OptionError(
                f"{path}: {task.task_id} has the teammate of {met[digest]} in {release}, which models are trained on; "
                f"expected teammates that are not in training: give the suite that the release was made of"
            )
    return tasks


def _prepared(method: str, entry: ExperimentEntry, layout: str, plan: ExperimentPlan) -> TrainingTask:
    options = TrainOptions(**{**entry.train, **plan.train})
    model = ModelOptions(**{**entry.model, **plan.model})
    try:
        return prepare(method, model, options, HistoryOptions((layout,), plan.root))
    except (LabelsMissingError, OptionError) as error:
        told = f"{method} {entry.name} on {layout}: {error}; or leave it out, by --method, --only and --layout"
        raise type(error)(told) from error


def _train(
    method: str, entry: ExperimentEntry, layout: str, plan: ExperimentPlan, folder: Path, progress: Progress
) -> None:
    job = _prepared(method, entry, layout, plan)
    options = job.options
    what = f"{job.method.label} {entry.name} on {layout}: training"
    progress(what, 0, options.steps)
    train(
        job.method,
        job.data,
        options,
        folder,
        job.about,
        tensorboard=plan.tensorboard,
        done=lambda step, loss: progress(what, step, options.steps),
    )
    progress(what, options.steps, options.steps)


def _evaluate(
    entry: ExperimentEntry,
    tasks: Sequence[Task],
    plan: ExperimentPlan,
    folder: Path,
    progress: Progress,
    *,
    own_tasks: bool,
) -> None:
    agent = find_agent(str(folder / "run"), plan.acting)
    protocol = get_protocol(plan.protocol)
    if plan.episodes is not None:
        protocol = replace(protocol, episodes=plan.episodes)
    details = dict(agent.details or {}) | ({"variant": entry.variant} if entry.variant else {})
    what = f"{agent.name} {entry.name} on {tasks[0].layout.name}: evaluation"
    evaluate(
        agent.name,
        agent.make,
        tasks,
        protocol,
        seeds=range(plan.seeds),
        suite=plan.suite,
        out=folder / "results",
        details=details,
        done=counted(progress, what, len(tasks)),
    )
    note_results(folder / "results", folder / "run", tasks if own_tasks else ())
