"""A whole rebuild: every task of a profile collected, then packed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from filelock import FileLock
from rich.console import Console

from generation.options import Options
from generation.package import package
from generation.profiles import Profile, load_profile
from generation.progress import progress
from generation.run import collect_tasks
from icrl4aht_data.index import read_info
from icrl4aht_data.release import check_replaceable
from icrl4aht_data.schema import Kind
from icrl4aht_data.statistics import print_statistics
from icrl4aht_data.tasks import Task


def build_releases(
    profile_name: str, out: Path, kinds: Sequence[Kind], console: Console, options: Options | None = None
) -> list[Path]:
    """Collect what is unfinished under out/artefacts, then write out/<kind> for each kind.

    Raises:
        CollectionError: if a task could not be collected; nothing is packed then.
    """
    profile = load_profile(profile_name)
    tasks = profile.tasks()
    for kind in kinds:
        check_replaceable(out / kind)  # before the long work, not after it
    collect_tasks(tasks, profile, out, console, options or Options())
    with FileLock(out / ".packing.lock"):  # another collector on this folder packs the same, before or after
        releases = [_pack(out / "artefacts", out / kind, tasks, profile, kind, console) for kind in kinds]
    for release in releases:
        print_statistics(read_info(release), console)
    return releases


def _pack(artefacts: Path, target: Path, tasks: list[Task], profile: Profile, kind: Kind, console: Console) -> Path:
    with progress(console) as bars:
        bar = bars.add_task(f"packing {kind}", total=len(tasks), note="")
        return package(artefacts, target, tasks, profile, kind, lambda task: bars.advance(bar))
