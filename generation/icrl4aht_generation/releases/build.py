"""Generate a release: train the teammates of a profile, generate histories of its tasks, and pack the release."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

from rich.console import Console

from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.info import LeftOutTask
from icrl4aht_data.format.provenance import ReferenceEgos
from icrl4aht_data.format.schema import KINDS, Kind
from icrl4aht_data.overcooked.layouts import LAYOUTS, get_layout
from icrl4aht_data.plotting import check_can_draw
from icrl4aht_data.utils.files import check_folder_content, lock_file_path, process_lock
from icrl4aht_data.utils.progress import bar_updater, progress_bars
from icrl4aht_data.writing.card import card_facts, print_learning_curves, teammate_name
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.jobs.job import FAILED, FailedJobsError
from icrl4aht_generation.jobs.options import QueueOptions
from icrl4aht_generation.jobs.queue import run_jobs
from icrl4aht_generation.populations.build import build_suite
from icrl4aht_generation.populations.select import THRESHOLD, make_tasks
from icrl4aht_generation.profiles import Profile, WorkUnit
from icrl4aht_generation.releases.measures import learned_reference_returns, teammate_facts
from icrl4aht_generation.releases.package import check_release_folder, package_release

SUITE = "suite"
"""Name of the suite's folder in the output folder of `generate`."""


def build_releases(
    profile: Profile,
    out: Path,
    kinds: Sequence[Kind],
    console: Console,
    options: QueueOptions | None = None,
    suite: Path | None = None,
    seed: int = 0,
    tasks: Sequence[Task] | None = None,
    sources: Mapping[str, str] | None = None,
) -> list[Path]:
    """Train unfinished teammates, generate unfinished tasks, then write a release out/<kind> for each kind.

    Args:
        profile: settings for the release.
        out: output folder; histories are generated under out/artefacts.
        kinds: kinds of releases.
        console: where progress is printed.
        options: options of the queues of populations and tasks.
        suite: folder of the learned teammates: a suite, by default out/suite, or with `tasks` also the folder
            TEAMMATES of a release.
        seed: seed of the suite.
        tasks: tasks to generate instead of the profile's tasks; no teammates are trained then.
        sources: source of each given task by task id; by default the profile's source, if it has only one.

    Returns:
        The release folders.

    Raises:
        FailedJobsError: if a task failed; nothing is packed then.
        OptionError: if the source of a given task is not known, if `out` has files that this function does not write,
            if out/<kind> is not a release of this profile, or if matplotlib is not installed.
    """
    check_can_draw()  # fail before the long training if matplotlib is missing
    for kind in kinds:
        check_release_folder(out / kind, profile)
    options = options or QueueOptions()
    out, suite = out.resolve(), (suite or out / SUITE).resolve()  # absolute, as workers have other working directories
    names = {"artefacts", "packing", SUITE, FAILED, *KINDS, *(f".{kind}.old" for kind in KINDS)}
    check_folder_content(out, names | ({suite.name} if suite.parent == out else set()), "a rebuild")
    if tasks is None:
        units, headroom, left_out = train_teammates(profile, suite, seed, console, options)
    else:
        units, headroom, left_out = profile.units_of(tasks, sources or {}), {}, []
    played = dict.fromkeys([*profile.layouts, *(work.task.layout.name for work in units)])
    generated = tuple(get_layout(name) for name in played if name not in LAYOUTS)
    jobs = [CollectionJob(work, profile, out / "artefacts", suite, generated) for work in units]
    run_jobs(jobs, out, console, options)
    tasks = list({work.task.task_id: work.task for work in units}.values())
    artefacts, releases = out / "artefacts", [out / kind for kind in kinds]
    with process_lock(lock_file_path(out / "packing")):  # other processes may pack the same releases
        facts = teammate_facts(tasks, artefacts, suite, headroom)
        for kind, release in zip(kinds, releases, strict=True):
            with progress_bars(unit="tasks") as show:
                steps = (
                    bar_updater(show, f"{step} {kind}", len(tasks)) for step in ("choosing labellers for", "packing")
                )
                package_release(artefacts, release, units, profile, suite, kind, facts, left_out, *steps)
        for release in releases:
            print_learning_curves(card_facts(release), console)
    return releases


def train_teammates(
    profile: Profile, suite: Path, seed: int, console: Console, options: QueueOptions
) -> tuple[list[WorkUnit], dict[str, ReferenceEgos], list[LeftOutTask]]:
    """Train the learned teammates of a profile, then return the profile's units of work.

    Returns:
        The units, the returns of reference egos with learned teammates by task id, and the tasks that are left out
        because all reference egos earn about the same.

    Raises:
        FailedJobsError: if no task remains, because no teammate is good enough.
    """
    if not profile.algorithms:
        return profile.units(), {}, []
    selections = build_suite(profile, suite, profile.algorithms, seed, console, options)
    learned = make_tasks(suite, selections, "train")
    headroom = learned_reference_returns(learned, suite)
    of_teammate = {task.teammate_key: headroom[task.task_id] for task in learned}
    units, left_out = [], []
    for work in profile.units(learned):
        earned = of_teammate.get(work.task.teammate_key)
        if earned is None or earned.returns_differ:
            units.append(work)
        elif work.learner == 0:
            reason = f"no headroom: {earned.describe()}"
            console.print(f"{work.task.task_id}: left out, {reason}")
            task, name = work.task, teammate_name(work.task)
            left_out.append(LeftOutTask(task.task_id, task.layout.name, name, work.source, 0, 0, None, None, reason))
    if not units and left_out:
        raise FailedJobsError(
            f"{suite}: all reference egos earn about the same with each learned teammate: train other teammates, or "
            f"add sampled heuristics ([tasks.sampled]) to profile {profile.name}"
        )
    if not units:
        names = dict.fromkeys(chain(*profile.algorithms.values()))
        raise FailedJobsError(
            f"{suite}: no checkpoint of {', '.join(names)} exceeds the return of {THRESHOLD:g} that a "
            f"teammate needs: raise teammates.total_steps in profile {profile.name}"
        )
    return units, headroom, left_out
