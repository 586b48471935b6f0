"""The paper's experiments: sweeps, ablations, held-out learned teammates (Sec. 5.3 and 5.4, App. F).

An experiment is a list of entries; each entry is trained on each layout, or once on all of them, and evaluated on its
layouts' tasks:

    OUT/<method>-<entry>/<layout>/run          run folder, as of `train`; <layout> is "all" for a model of all layouts
    OUT/<method>-<entry>/<layout>/results      results, as of `evaluate`
    OUT/report/                                report of all entries, with report.html

Everything resumes: finished parts are kept, stopped ones continue, and folders of other settings are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from icrl4aht_baselines.agents.egos import Acting, find_agent
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol, limit_tasks
from icrl4aht_baselines.methods.options import PAPER_SIZES, SIZES, ModelOptions
from icrl4aht_baselines.methods.registry import get_method
from icrl4aht_baselines.report.page import REPORT_FILES, write_page_with_episodes, write_report
from icrl4aht_baselines.report.results import evaluate_agent, merge, read_run
from icrl4aht_baselines.training.histories import filter_histories, prepare
from icrl4aht_baselines.training.options import ALL_LAYOUTS, HistoryOptions, TrainOptions
from icrl4aht_baselines.training.trainer import TrainingTask
from icrl4aht_data.benchmark.facts import TESTED_ON, track_of
from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.dataset import Dataset, load_icrl4aht
from icrl4aht_data.errors import EmptySelectionError, LabelsMissingError, OptionError, unknown
from icrl4aht_data.format.schema import TASKS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.plotting import check_can_draw
from icrl4aht_data.utils.files import check_output

CONTEXTS = (250, 500, 1000, 2000, 5000, 10_000)
"""K of the paper's context sweeps (Sec. 5.3; App. F, "Extended Context Lengths")."""


@dataclass(frozen=True)
class ExperimentEntry:
    """One model of an experiment: the differences from the default settings.

    Attributes:
        name: of its folder, without the method.
        model: values of `ModelOptions`.
        train: values of `TrainOptions`.
        variant: of a sweep: the varied quantity and its value.
    """

    name: str
    model: dict[str, Any] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    variant: dict[str, Any] | None = None


class Experiment(NamedTuple):
    """Entries of an experiment, and the layouts that the paper runs them on.

    Attributes:
        title: for the report.
        entries: one per model.
        layouts: to train on.
        varies: options that the entries set and that can therefore not be set for all of them.
        held_out: whether to evaluate with learned teammates held out of training, on the training layouts.
        acting: way of acting of the trained models; see `agents.egos.ACTING`.
    """

    title: str
    entries: tuple[ExperimentEntry, ...]
    layouts: tuple[str, ...] = tuple(TESTED_ON)
    varies: tuple[str, ...] = ()
    held_out: bool = False
    acting: Acting = "cached"


_PLAIN = (ExperimentEntry("plain"),)
_TA, _NEXT_OBS = {"teammate_actions": True}, {"next_obs": True}

EXPERIMENTS = {
    "tracks": Experiment("Teammate and layout generalization", _PLAIN),
    "sweep context": Experiment(
        "Context length",
        tuple(ExperimentEntry(f"K{k}", train={"context": k}, variant={"K": k}) for k in CONTEXTS),
        ("test_wide", "demo_wide"),
        varies=("context",),
        acting="exact",  # K is what is compared, and a cached window has down to 4/5 K steps
    ),
    "sweep size": Experiment(
        "Model scale and training budget",
        tuple(
            ExperimentEntry(
                name, {"layers": size.layers, "width": size.width}, {"steps": size.steps}, variant={"size": name}
            )
            for name, size in SIZES.items()
            if name in PAPER_SIZES
        ),
        varies=("size", "layers", "width"),
    ),
    "ablate ta": Experiment(
        "Teammate actions and auxiliary losses",
        (
            ExperimentEntry("none"),
            ExperimentEntry("ta", _TA),
            ExperimentEntry("next_obs", _NEXT_OBS),
            ExperimentEntry("ta-next_obs", {**_TA, **_NEXT_OBS}),
        ),
        ("test_wide", "demo_wide", "cramped_up"),
        varies=("teammate_actions", "next_obs"),
    ),
    "heldout-rl": Experiment("Held-out learned teammates", _PLAIN, held_out=True),
}
"""Command -> experiment; settings and layouts are the paper's."""


@dataclass(frozen=True)
class ExperimentPlan:
    """Settings of an experiment's run; the defaults are the paper's.

    Attributes:
        methods: to train; "ad" and "dpt" by default.
        layouts: to train on, one model each; by default those of the experiment that the release has. `ALL_LAYOUTS`
            alone for one model of all layouts that the release has, which is tested on the layouts of all of them.
        root: folder or address of a release; None for the bundled mini release.
        suite: folder of learned teammates; required for "heldout-rl".
        size: name of the models' size; "sweep size" varies it.
        batch_size: rows of a batch, where an entry has no value; the paper's by default.
        train: values of `TrainOptions` for all entries, such as steps.
        model: values of `ModelOptions` for all entries.
        histories: values of `HistoryOptions` for all entries: channels, and filters such as teammate_family.
        values: names of the entries to run; all by default.
        split: which tasks to evaluate on, see `EVALUATION_SPLITS`: "test" by default; others are on the training
            layouts.
        families: teammate families to evaluate with; all by default.
        tasks: tasks of each teammate kind and layout, at most.
        episodes: of a task; the protocol's by default.
        seeds: number of times that every task is played.
        protocol: name of the evaluation protocol.
        acting: see `agents.egos.ACTING`; the experiment's by default.
        gifs: whether the page shows an episode per family.
    """

    methods: tuple[str, ...] = ()
    layouts: tuple[str, ...] = ()
    root: str | None = None
    suite: Path | None = None
    size: str = "small"
    batch_size: int = TrainOptions.batch_size
    train: dict[str, Any] = field(default_factory=dict)
    model: dict[str, Any] = field(default_factory=dict)
    histories: dict[str, Any] = field(default_factory=dict)
    values: tuple[str, ...] = ()
    split: str | None = None
    families: tuple[str, ...] = ()
    tasks: int | None = None
    episodes: int | None = None
    seeds: int = 1
    protocol: str = "seeded"
    acting: Acting | None = None
    gifs: bool = True


class ExperimentOutcome(NamedTuple):
    """Outcome of an experiment.

    Attributes:
        report: paths of the files written.
        notes: facts for the reader, such as layouts that were left out.
    """

    report: list[Path]
    notes: list[str]


ExperimentProgress = Callable[[str, int, int], None]
"""Called with (description, units done, units)."""


def run_experiment(
    name: str, plan: ExperimentPlan, out: Path, progress: ExperimentProgress = lambda what, done, total: None
) -> ExperimentOutcome:
    """Train, evaluate and report all entries of an experiment, or resume it.

    Args:
        name: one of `EXPERIMENTS`.
        plan: how.
        out: folder, see this module's docstring.
        progress: called now and then.

    Raises:
        UnknownNameError: for an unknown experiment, method, entry, layout or split.
        EmptySelectionError: if the release has histories of none of the layouts, or no task is left.
        LabelsMissingError: for DPT on histories without expert actions.
        OptionError: if a context is longer than a history, the plan sets what the experiment varies, or a folder holds
            a run of other settings; for "heldout-rl", if the suite has no held-out teammates, or one of them is in
            training; if matplotlib is not installed.
        TrainingStopped: after SIGTERM or SIGINT during a training, which is saved.
    """
    check_can_draw()  # before the long work, not after it
    if name not in EXPERIMENTS:
        raise unknown("experiment", name, EXPERIMENTS)
    experiment = EXPERIMENTS[name]
    entries = _chosen_entries(name, plan)
    layouts, notes = _training_layouts(experiment, plan)
    tasks = {layout: _test_tasks(experiment, plan, layout) for layout in layouts}
    models = list(product(plan.methods or ("ad", "dpt"), entries, layouts))
    chosen = [_prepare_entry(*model, plan).about["histories"] for model in models]  # impossible ones fail early
    if any(histories["channels"] == "canonical" for histories in chosen):
        notes = [*notes, f"models take canonical channels, {chosen[0]['obs_shape'][-1]} on every layout"]
    check_output(out / "report", overwrite=True, names=[*REPORT_FILES, "report.html"])  # of a stopped run
    results = []
    for method, entry, layout in models:
        folder = out / f"{method}-{entry.name}" / layout
        _train_entry(_prepare_entry(method, entry, layout, plan), f"{entry.name} on {layout}", folder, progress)
        _evaluate_entry(experiment, entry, tasks[layout], plan, folder, progress)
        results.append(folder / "results")
    runs = merge([read_run(folder) for folder in results])
    notes = [f"{experiment.title} (`{name}`)", *notes]
    report = write_report(runs, out / "report")
    page = out / "report" / "report.html"
    options: dict[str, Any] = {"episodes": plan.gifs, "notes": notes, "suite": plan.suite, "progress": progress}
    report.append(write_page_with_episodes(runs, page, **options))
    return ExperimentOutcome(report, notes)


def _chosen_entries(name: str, plan: ExperimentPlan) -> list[ExperimentEntry]:
    experiment = EXPERIMENTS[name]
    for method in plan.methods:
        get_method(method)
    entries = {entry.name: entry for entry in experiment.entries}
    for value in plan.values:
        if value not in entries:
            raise unknown(f"setting of {name}", value, entries)
    if plan.size not in SIZES:
        raise unknown("size", plan.size, SIZES)
    given = plan.train | plan.model | ({"size": plan.size} if plan.size != ExperimentPlan.size else {})
    for option in given.keys() & experiment.varies:
        first = next(iter(entries))
        raise OptionError(f"{option} = {given[option]}: `{name}` sets it; choose by --only, such as {first}")
    return [entry for entry in entries.values() if not plan.values or entry.name in plan.values]


def _histories(plan: ExperimentPlan) -> tuple[Dataset, dict[str, tuple[str, ...]]]:
    """Return the training histories that pass the plan's filters, and the filters."""
    filters = HistoryOptions((), **plan.histories).filters
    return filter_histories(load_icrl4aht(plan.root, split="train"), filters), filters


def _training_layouts(experiment: Experiment, plan: ExperimentPlan) -> tuple[list[str], list[str]]:
    """Return the layouts to train on, or `ALL_LAYOUTS` for one model of all, and a note on those left out."""
    dataset, filters = _histories(plan)
    if ALL_LAYOUTS in plan.layouts:
        return list(HistoryOptions(plan.layouts).layouts), []
    available = [layout.name for layout in dataset.layouts]
    wanted = [get_layout(name).name for name in plan.layouts]
    for name in wanted:
        if name not in TESTED_ON:
            raise unknown("training layout", name, TESTED_ON)
    missing = [name for name in wanted or experiment.layouts if name not in available]
    names = [name for name in wanted or experiment.layouts if name in available]
    kind = "training histories" + "".join(f" of {name} {' and '.join(values)}" for name, values in filters.items())
    if not names or (wanted and missing):
        raise EmptySelectionError(
            f"{plan.root or 'the bundled mini release'}: no {kind} on {', '.join(missing)}; it has "
            f"{', '.join(sorted(available))}: choose among them, or give a --root that has the others"
        )
    return names, [f"left out, the release has no {kind} of them: {', '.join(missing)}"] if missing else []


def _test_tasks(experiment: Experiment, plan: ExperimentPlan, layout: str) -> list[Task]:
    """Return the tasks that a model trained on a layout, or on `ALL_LAYOUTS`, is evaluated on."""
    if layout == ALL_LAYOUTS:
        dataset, _ = _histories(plan)
        names = [name for name in TESTED_ON if name in {layout.name for layout in dataset.layouts}]
        if not names:
            raise EmptySelectionError(f"{dataset!r}: none of its layouts is a training layout of the benchmark")
        return [task for name in names for task in _test_tasks(experiment, plan, name)]
    if experiment.held_out and plan.split:
        raise OptionError(
            f"split = {plan.split}: this experiment has tasks of its own, those of the suite's held-out teammates; "
            f"leave --split out"
        )
    split = plan.split or "test"
    played_on = TESTED_ON.get(layout, layout) if split == "test" else layout
    if experiment.held_out:
        tasks = held_out_tasks(plan.suite, layout, plan.root)
    else:
        tasks = [task for task in bundled_tasks(track_of(played_on), split) if task.layout.name == played_on]
    if not tasks:
        raise EmptySelectionError(f"no {split} tasks on {played_on}: choose another --layout, or --split test")
    available = dict.fromkeys(task.teammate_family for task in tasks)
    for family in plan.families:
        if family not in available:
            raise unknown("teammate family of these tasks", family, available)
    chosen = [task for task in tasks if not plan.families or task.teammate_family in plan.families]
    return limit_tasks(chosen, plan.tasks)


def held_out_tasks(suite: Path | None, layout: str, root: str | None = None) -> list[Task]:
    """Return the tasks of a suite's held-out manifest on a training layout (paper, App. F, "Held-Out RL Teammates").

    Args:
        suite: folder that `icrl4aht-data teammates` made.
        layout: short name.
        root: the release that models are trained on, which must not have these teammates.

    Raises:
        OptionError: if the suite has no held-out teammates there, or one of them is in the release.
    """
    if suite is None:
        raise OptionError(
            "held-out teammates: expected a suite, found none; give --suite, a folder that `icrl4aht-data teammates` "
            "made"
        )
    path = suite / "manifests" / f"{track_of(layout)}_heldout.jsonl"
    if not path.is_file():
        raise OptionError(
            f"{path}: missing: the suite has no held-out teammates for track {track_of(layout)}; train more with "
            f"`icrl4aht-data teammates --suite {suite}` under a profile with [teammates] heldout of 1 or more"
        )
    tasks = [task for task in read_tasks(path) if task.layout.name == layout]
    if not tasks:
        raise OptionError(
            f"{path}: no held-out teammate on {layout}; train that layout's populations with `icrl4aht-data "
            f"teammates --suite {suite} --layout {layout}`, or choose another --layout"
        )
    release = load_icrl4aht(root, layout=layout).root
    trained_with = {
        task.teammate["theta"]["sha256"]: task.task_id
        for task in read_tasks(release / TASKS)
        if task.teammate["kind"] == "rl" and task.split == "train"
    }
    for task in tasks:
        digest = task.teammate["theta"]["sha256"]
        if digest in trained_with:
            raise OptionError(
                f"{path}: {task.task_id} has the teammate of {trained_with[digest]} in {release}, which models are "
                f"trained on; expected teammates that are not in training: give the suite that the release was made "
                f"from"
            )
    return tasks


def _prepare_entry(method: str, entry: ExperimentEntry, layout: str, plan: ExperimentPlan) -> TrainingTask:
    size = SIZES[plan.size]
    options = TrainOptions(**{**size.train, "batch_size": plan.batch_size, **entry.train, **plan.train})
    model = ModelOptions(**{**size.model, **entry.model, **plan.model})
    histories = HistoryOptions((layout,), plan.root, **plan.histories)
    try:
        return prepare(method, model, options, histories)
    except (EmptySelectionError, LabelsMissingError, OptionError) as error:
        hint = "or leave it out, by --method, --only and --layout"
        error.args = (f"{method} {entry.name} on {layout}: {error}; {hint}",)
        raise


def _train_entry(job: TrainingTask, name: str, folder: Path, progress: ExperimentProgress) -> None:
    def done(step: int, loss: float | None) -> None:
        progress(f"{job.method.label} {name}: training steps", step, job.options.steps)

    done(0, None)
    job.train(folder / "run", done=done)
    done(job.options.steps, None)


def _evaluate_entry(
    experiment: Experiment,
    entry: ExperimentEntry,
    tasks: Sequence[Task],
    plan: ExperimentPlan,
    folder: Path,
    progress: ExperimentProgress,
) -> None:
    agent = find_agent(folder / "run", acting=plan.acting or experiment.acting)
    if entry.variant:
        agent = agent._replace(details={**(agent.details or {}), "variant": entry.variant})
    names = list(dict.fromkeys(task.layout.name for task in tasks))
    what = f"{agent.name} {entry.name} on {names[0] if len(names) == 1 else f'{len(names)} layouts'}: episodes"
    protocol, shown = get_protocol(plan.protocol, plan.episodes), {"show": progress, "what": what}
    evaluate_agent(agent, tasks, protocol, folder / "results", seeds=range(plan.seeds), suite=plan.suite, **shown)
