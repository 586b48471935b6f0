"""A whole rebuild: every task of a profile collected, then packed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from generation.collect import is_finished, run_task
from generation.package import package
from generation.profiles import Profile, load_profile
from generation.progress import progress
from icrl4aht_data.release import check_replaceable
from icrl4aht_data.schema import Kind
from icrl4aht_data.tasks import Task


def build_releases(profile_name: str, out: Path, kinds: Sequence[Kind], console: Console) -> list[Path]:
    """Collect what is unfinished under out/artefacts, then write out/<kind> for each kind."""
    profile = load_profile(profile_name)
    tasks = profile.tasks()
    artefacts = out / "artefacts"
    for kind in kinds:
        check_replaceable(out / kind)  # before the long work, not after it
    for number, task in enumerate(tasks, start=1):
        folder = artefacts / task.task_id
        label = f"task {number}/{len(tasks)} {task.layout.name} with {task.teammate_kind}"
        if is_finished(folder, task, profile):
            console.print(f"{label}: finished before")
            continue
        _collect(task, profile, folder, label, console)
    return [_pack(artefacts, out / kind, tasks, profile, kind, console) for kind in kinds]


def _collect(task: Task, profile: Profile, folder: Path, label: str, console: Console) -> None:
    total = profile.ego.updates
    last: dict[str, float] = {}
    with progress(console) as bars:
        bar = bars.add_task(label, total=total, note="compiling")

        def report(update: int, metrics: dict[str, float]) -> None:
            last.update(metrics)
            note = f"{metrics['steps_per_second']:,.0f} steps/s, return {last.get('return', 0.0):.1f}"
            bars.update(bar, completed=update + 1, note=note)

        run_task(task, profile, folder, report)
    console.print(
        f"{label}: {last['step']:,} steps at {last['steps_per_second']:,.0f} steps/s, "
        f"last return {last.get('return', 0.0):.1f} (400 steps)"
    )


def _pack(artefacts: Path, target: Path, tasks: list[Task], profile: Profile, kind: Kind, console: Console) -> Path:
    with progress(console) as bars:
        bar = bars.add_task(f"packing {kind}", total=len(tasks), note="")
        return package(artefacts, target, tasks, profile, kind, lambda task: bars.advance(bar))
