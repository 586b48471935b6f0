"""Pack artefacts into a release folder: labelled histories of each task, and a figure of the learning curves."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS, LEAST_HEADROOM, SCRIPTED_SOURCES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.checkpoints import checkpoint_files, expert_files
from icrl4aht_data.format.info import LeftOutTask
from icrl4aht_data.format.layouts_file import layout_title
from icrl4aht_data.format.provenance import ExpertLabels, Provenance, ReferenceEgos, TeammateSuite
from icrl4aht_data.format.schema import Kind, curve_ends, episode_ends
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.plotting import SourceCurves, add_curve, plot_source_curves, save_figure
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.writing.card import CURVES_FIGURE, teammate_name
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_data.writing.release_folder import atomic_folder, check_target
from icrl4aht_generation.collection.curate import (
    filter_report,
    greedy_labels,
    oracle_labels,
    select_streams,
    stream_returns,
)
from icrl4aht_generation.collection.task import TEAMMATE_NOISE
from icrl4aht_generation.collection.task_folder import HISTORY_ARRAYS, METADATA
from icrl4aht_generation.learners.checkpoint import load_policy
from icrl4aht_generation.populations.select import THRESHOLD
from icrl4aht_generation.populations.train import population_threads
from icrl4aht_generation.profiles import Profile, WorkUnit
from icrl4aht_generation.releases.labeller import choose_labeller
from icrl4aht_generation.releases.measures import (
    TeammateFacts,
    few_spread_teammates,
    recorded_provenance,
    release_provenance,
    unusable_families,
)


class TaskHistories(NamedTuple):
    """Recorded histories of a task, and the selection that the release contains.

    Attributes:
        task: task of the histories.
        source: how the histories were made.
        folders: artefact folder of each learner.
        returns: for each learner float64 (N, E), episode returns of its streams.
        streams: for each learner int (n,), numbers of the selected streams, best first.
        least_improvement: minimum improvement of a selected stream; None for no minimum.
    """

    task: Task
    source: str
    folders: list[Path]
    returns: list[np.ndarray]
    streams: list[np.ndarray]
    least_improvement: float | None

    @property
    def recorded_returns(self) -> np.ndarray:
        """Episode returns of all streams of all learners, float64 of shape (N, E)."""
        return np.concatenate(self.returns)

    @property
    def kept_returns(self) -> np.ndarray:
        """Episode returns of the selected streams, float64 of shape (n, E)."""
        return np.concatenate([own[streams] for own, streams in zip(self.returns, self.streams, strict=True)])

    def left_out(self, reason: str) -> LeftOutTask:
        """Return a record of the task for the release's list of left-out tasks."""
        start, end = (round(float(ends.mean()), 3) for ends in curve_ends(self.recorded_returns))
        learners = len(self.folders) if self.source == "ppo" else 0
        layout, name = self.task.layout.name, teammate_name(self.task)
        return LeftOutTask(
            self.task.task_id, layout, name, self.source, learners, len(self.recorded_returns), start, end, reason
        )


def select_histories(
    artefacts: Path, units: Sequence[WorkUnit], profile: Profile, facts: TeammateFacts, *, headroom: bool
) -> TaskHistories | LeftOutTask:
    """Select the histories of a task for a release.

    All scripted histories and the best streams of learners are selected. Two minimums of the profile apply only to
    layouts with headroom. `least_improvement` removes streams with a smaller improvement, and tasks in which the
    returns of the reference egos hardly differ. `least_rise` removes tasks with a smaller mean improvement.

    Args:
        artefacts: folder of the finished artefacts.
        units: the task's units of work.
        profile: profile of the release.
        facts: facts about the teammate.
        headroom: whether the reference egos' returns differ for at least one of the profile's teammates on this layout.
    """
    task, source = units[0].task, units[0].source
    folders = [artefacts / work.name for work in units]
    returns = [stream_returns(np.load(folder / "rewards.npy", mmap_mode="r")) for folder in folders]
    least = profile.least_improvement if headroom else None
    if source == "ppo":
        streams = select_streams(returns, profile.keep, least)
    else:
        streams = [np.arange(len(own)) for own in returns]
    found = TaskHistories(task, source, folders, returns, streams, least)
    if least is not None and not facts.references.returns_differ:
        return found.left_out(
            f"no headroom: returns of these egos differ by less than {LEAST_HEADROOM:g}: {facts.references.describe()}"
        )
    if not len(found.kept_returns):
        return found.left_out(f"the learners did not learn: no stream's return rises by {least or 0:g}")
    start, end = curve_ends(found.kept_returns)
    if headroom and profile.least_rise is not None and end.mean() - start.mean() < profile.least_rise:
        return found.left_out(
            f"its histories rise by {end.mean() - start.mean():.1f} on average, expected {profile.least_rise:g}"
        )
    return found


def package_release(
    artefacts: Path,
    target: Path,
    units: Sequence[WorkUnit],
    profile: Profile,
    suite: Path,
    kind: Kind,
    facts: Mapping[str, TeammateFacts],
    left_out: Sequence[LeftOutTask] = (),
    chosen: Callable[[int], None] = lambda count: None,
    written: Callable[[int], None] = lambda count: None,
) -> Path:
    """Write a release of tasks with the checkpoints of their learned teammates; see `write_release`.

    `select_histories` selects the histories. The checkpoint that `choose_labeller` returns labels the histories of
    learners; a script labels its own histories.

    Args:
        artefacts: folder of the finished artefacts.
        target: the release folder; an existing release of this profile is replaced atomically.
        units: units of work, grouped by task in the release's order.
        profile: profile of the units.
        suite: folder of the learned teammates.
        kind: kind of the release.
        facts: facts about each task's teammate by task id, see `teammate_facts`.
        left_out: tasks that were not generated, for the list in meta/info.json.
        chosen: called with 1 after the histories of a task are chosen.
        written: called with 1 after a task is written.

    Raises:
        OptionError: if `target` is not a release of this profile, see `check_release_folder`, or no history is left.
    """
    check_release_folder(target, profile)
    tasks = grouped(units, lambda work: work.task.task_id)
    headroom = {work.task.layout.name for work in units if facts[work.task.task_id].references.returns_differ}
    recorded, new, omitted, curves = recorded_provenance(suite), [], list(left_out), SourceCurves()
    for task_id, members in tasks.items():
        task = members[0].task
        found = select_histories(artefacts, members, profile, facts[task_id], headroom=task.layout.name in headroom)
        if isinstance(found, LeftOutTask):
            omitted.append(found)
            written(1)
        else:
            new.append(_new_task(found, profile, suite, facts[task_id], recorded))
            for returns in found.kept_returns:
                add_curve(curves, found.source, layout_title(task.layout.name), task.split, returns)
        chosen(1)
    if not new:
        reasons = "; ".join(one.reason for one in omitted) or "the profile has no task"
        raise OptionError(f"{target}: no task has histories to keep: {reasons}")
    if profile.sampled is not None:
        omitted += unusable_families(profile.layouts)
    if profile.spread is not None:
        omitted += few_spread_teammates(profile.spread.per_layout)
    with TemporaryDirectory() as folder:
        files = {CURVES_FIGURE: Path(folder) / "curves.png"}
        save_figure(plot_source_curves(curves), files[CURVES_FIGURE], dpi=80)
        return write_release(
            target,
            kind,
            new,
            data_version=profile.data_version,
            left_out=omitted,
            files=files,
            overwrite=True,
            done=lambda task: written(1),
        )


def check_release_folder(target: Path, profile: Profile) -> None:
    """Check that `target` does not exist, or is an unchanged release that was generated with this profile.

    Raises:
        OptionError: if `target` exists and is not an unchanged release of this profile.
    """
    if not check_target(target, overwrite=True):
        return
    profiles = {of_task.profile for of_task in release_provenance(target).values()}
    if profiles != {profile.name}:
        made = ", ".join(sorted(map(str, profiles - {None}))) or "no known profile"
        raise OptionError(
            f"{target}: this release was generated with {made}, not with profile {profile.name}, and is not replaced; "
            f"move it away, or give another --out"
        )


def bundle_release(release: Path) -> Path:
    """Replace the bundled release of the package by a copy of a given release."""
    with atomic_folder(MINI, overwrite=True, sources=[release]) as copy:
        shutil.copytree(release, copy, dirs_exist_ok=True)
    return MINI


def recorded_sources(release: Path) -> dict[str, str]:
    """Return the source of each task id from a release's provenance; empty if the folder is not a release."""
    return {task_id: made.source or "ppo" for task_id, made in release_provenance(release).items()}


def _population_record(
    task: Task, profile: Profile, suite: Path, recorded: Mapping[str, Provenance]
) -> TeammateSuite | None:
    """Return the record of a learned teammate's populations, from the profile or from the teammate's release."""
    if task.task_id in recorded:
        return recorded[task.task_id].suite
    return TeammateSuite(
        algorithms={layout: list(names) for layout, names in profile.algorithms.items()},
        members=profile.teammates.members,
        train=profile.teammates.train,
        total_steps=profile.teammates.ppo.total_steps,
        threshold=THRESHOLD,
        xla_threads=population_threads(suite, task.layout.name, task.teammate_kind),
    )


def _new_task(
    found: TaskHistories, profile: Profile, suite: Path, facts: TeammateFacts, recorded: Mapping[str, Provenance]
) -> NewTask:
    """Return a task labelled with the actions of a learner's checkpoint, or with the script's choices before noise."""
    task, metadata = found.task, json.loads((found.folders[0] / METADATA).read_text(encoding="utf-8"))
    files, labeller = checkpoint_files(suite, task), None
    if found.source in SCRIPTED_SOURCES:
        expert, own = _script_label_record(found.source, facts.references), {"noise": metadata["noise"]}
    else:
        labeller, expert = choose_labeller(found.folders, task, suite)
        files |= expert_files(labeller, str(expert.policy_sha256)) if profile.policies else {}
        own = {"ego": metadata["ego"], "ego_hash": metadata["ego_hash"], "learners": len(found.folders)}
        own["filter"] = filter_report(found.recorded_returns, found.kept_returns, found.least_improvement)
    made = Provenance(
        profile=profile.name,
        profile_hash=profile.hash,
        **{name: metadata[name] for name in ("code_version", "jax_version", "platform", "xla_threads")},
        seed=task.seed,
        source=found.source,
        references=facts.references,
        nearest_test=facts.nearest,
        teammate={"slot": TEAMMATE, "noise": TEAMMATE_NOISE},
        streams_recorded=len(found.recorded_returns),
        streams_kept=len(found.kept_returns),
        suite=_population_record(task, profile, suite, recorded) if task.teammate_family == "rl" else None,
        expert=expert,
        **own,
    )
    # Store the oracle's actions if they are the labels, or if the oracle earns at least the histories' final return.
    with_oracle = profile.oracle_actions and made.is_oracle_useful(float(curve_ends(found.kept_returns)[1].mean()))

    def load() -> Iterator[NewHistory]:
        label = _label_function(found, labeller)
        for learner, stream, arrays in _recorded_histories(found):
            labels = {"expert_actions": label(stream, arrays["state"])}
            if with_oracle and found.source == "noise":
                labels["oracle_actions"] = labels["expert_actions"]
            elif with_oracle:
                labels["oracle_actions"] = oracle_labels(task.layout, arrays["state"], arrays["actions"])
            yield NewHistory(stream, arrays | labels, learner)

    return NewTask(task, made, len(found.kept_returns), load, files)


def _script_label_record(source: str, references: ReferenceEgos) -> ExpertLabels:
    """Return the provenance record for labels that are actions of a scripted policy."""
    if source == "noise":
        action = "scripted oracle, which sees the full state"
        return ExpertLabels(None, action, return_greedy=references.oracle, episodes=references.episodes, view="state")
    return ExpertLabels(None, "scripted searcher, which sees the full state but not which dish is wanted", view="state")


def _label_function(found: TaskHistories, labeller: Path | None) -> Callable[[int, np.ndarray], np.ndarray]:
    """Return a function from a stream's number and states, uint8 (T, S), to expert actions, int8 (T,)."""
    if labeller is None:
        script = np.load(found.folders[0] / "script_actions.npy", mmap_mode="r")
        return lambda stream, states: script[stream]
    network, params, _ = load_policy(labeller)
    return lambda stream, states: greedy_labels(found.task.layout, network, params, states)


def _recorded_histories(found: TaskHistories) -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
    """Yield the learner's number, the stream's number and the memory-mapped arrays of each selected history."""
    for learner, (folder, streams) in enumerate(zip(found.folders, found.streams, strict=True)):
        arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in HISTORY_ARRAYS}
        dones = episode_ends(arrays["actions"].shape[1], KEPT_STEPS)
        for stream in streams.tolist():
            yield learner, stream, {name: array[stream] for name, array in arrays.items()} | {"dones": dones}
