"""A whole rebuild: every task of a profile collected, then packed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from filelock import FileLock
from rich.console import Console

from generation.build_suite import build_suite
from generation.options import Options
from generation.package import package
from generation.profiles import Profile, load_profile
from generation.progress import progress
from generation.run import CollectionError, collect_tasks
from generation.select import THRESHOLD, training_tasks
from icrl4aht_data.index import read_info
from icrl4aht_data.release import check_replaceable
from icrl4aht_data.schema import Kind
from icrl4aht_data.statistics import print_statistics
from icrl4aht_data.tasks import Task

SUITE = "suite"
"""Where a rebuild keeps its learned teammates, unless told another place."""


def build_releases(
    profile_name: str,
    out: Path,
    kinds: Sequence[Kind],
    console: Console,
    options: Options | None = None,
    suite: Path | None = None,
) -> list[Path]:
    """Train the teammates and collect the tasks that are unfinished, then write out/<kind> for each kind.

    Args:
        out: tasks are collected under out/artefacts.
        suite: the folder of the learned teammates; by default out/suite.

    Raises:
        CollectionError: if a task could not be collected; nothing is packed then.
    """
    profile = load_profile(profile_name)
    for kind in kinds:
        check_replaceable(out / kind)  # before the long work, not after it
    suite = suite or out / SUITE
    if profile.algorithms:
        build_suite(profile, suite, profile.layouts, profile.algorithms, 0, console)
    tasks = tasks_of(profile, suite)
    collect_tasks(tasks, profile, out, console, options or Options(), suite)
    with FileLock(out / ".packing.lock"):  # another collector on this folder packs the same, before or after
        releases = [_pack(out / "artefacts", out / kind, tasks, profile, suite, kind, console) for kind in kinds]
    for release in releases:
        print_statistics(read_info(release), console)
    return releases


def tasks_of(profile: Profile, suite: Path) -> list[Task]:
    """The training tasks of a profile: those with presets, then those with the suite's teammates.

    Raises:
        CollectionError: if there are none, because no teammate is good enough.
    """
    tasks = [*profile.heuristic_tasks(), *training_tasks(suite, profile.layouts, profile.algorithms)]
    if not tasks:
        raise CollectionError(
            f"{suite}: no checkpoint of {', '.join(profile.algorithms)} exceeds the return of {THRESHOLD:g} that a "
            f"teammate needs: raise teammates.total_steps in profile {profile.name}"
        )
    return tasks


def _pack(
    artefacts: Path,
    target: Path,
    tasks: list[Task],
    profile: Profile,
    suite: Path,
    kind: Kind,
    console: Console,
) -> Path:
    with progress(console) as bars:
        bar = bars.add_task(f"packing {kind}", total=len(tasks), note="")
        return package(artefacts, target, tasks, profile, suite, kind, lambda task: bars.advance(bar))
