"""Measure speed, memory and file sizes of the collection of histories: `make bench-collect`.

One JSON line for each part:

    noise:  recorded transitions/s of noise histories, including writing and hashing, and the seconds to compile
    speed:  recorded transitions/s of a complete collection (PPO, recording, writing), and the share of time for
            recording and writing
    memory: peak resident memory of a collection with the paper's 1024 environments, and of its learner without
            recording, each measured in a separate process
    bytes:  bytes per transition of the bundled histories, including all files: `lite` and `full` releases compared
            with the paper's format (App. D.1: float32 observations, gzip-6, one group per history)
"""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import jax
import numpy as np
from icrl4aht_generation.collection.job import CollectionJob
from icrl4aht_generation.collection.task import make_learner
from icrl4aht_generation.collection.task_folder import last_timing
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.profiles import Profile, WorkUnit, load_profile
from icrl4aht_generation.profiles.noise_config import NoiseConfig
from icrl4aht_generation.teammates.registry import heuristic_teammate

from benchmarks.harness import elapsed, folder_size, peak_memory, print_line
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS, layout_track
from icrl4aht_data.benchmark.tasks import make_task, read_tasks
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.format.schema import KINDS, TASKS
from icrl4aht_data.writing.published import to_published
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

_NOISE = NoiseConfig(histories=64, episodes=100, finish=(0.5, 1.0))
"""Settings of the measured noise histories, which have 640,000 transitions."""


class _StopCollectionError(Exception):
    """Raised to stop a collection after the measured updates."""


def collect_updates(profile: Profile, updates: int, save_seconds: float) -> dict[str, float]:
    """Collect `updates` updates of the profile's last task with a heuristic teammate, and return the timing."""
    work = _last_heuristic_work(profile)

    def report(done: int, speed: float) -> None:
        if done == updates:
            raise _StopCollectionError

    with tempfile.TemporaryDirectory() as folder:
        job = CollectionJob(work, profile, Path(folder))
        with suppress(_StopCollectionError):
            job.run(report, save_seconds=save_seconds)
        return last_timing(job.folder) or {}


def _last_heuristic_work(profile: Profile) -> WorkUnit:
    """Return the unit of work for the profile's last task with a heuristic teammate."""
    return replace(profile, presets=("default",)).units()[-1]


def collection_speed(profile_name: str, updates: int) -> dict[str, Any]:
    """Return the speed of a collection that saves its state every two seconds, 15 times as often as usual."""
    profile = load_profile(profile_name)
    timing = collect_updates(profile, updates, save_seconds=2)
    return {
        "profile": profile_name,
        "environments": profile.ego.environments,
        "steps_per_second": round(timing["steps_per_second"]),
        "recorded_transitions_per_second": round(timing["steps_per_second"] * KEPT_STEPS / EPISODE_STEPS),
        "recording_and_writing_share": round(timing["recording"] / timing["seconds"], 4),
    }


def noise_speed(layout: str) -> dict[str, Any]:
    """Return the speed of collecting noise histories with an H4 teammate, after a first task for compilation."""
    profile = replace(load_profile("smoke"), noise=_NOISE, sources=("noise",))
    mate = heuristic_teammate("utility_greedy", "default", 0)
    tasks = [make_task(layout_track(layout), "train", layout, mate, seed) for seed in range(2)]
    with tempfile.TemporaryDirectory() as folder:
        first, second = (elapsed(CollectionJob(WorkUnit(task, "noise"), profile, Path(folder)).run) for task in tasks)
    transitions = _NOISE.histories * _NOISE.episodes * KEPT_STEPS
    return {
        "layout": layout,
        "transitions": transitions,
        "transitions_per_second": round(transitions / second),
        "compile_seconds": round(first - second, 1),
    }


def collection_memory(updates: int) -> dict[str, Any]:
    """Return the peak memory in MiB of a collection and of its learner alone, each measured in its own process."""
    peaks = []
    for recording in (False, True):
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            peaks.append(round(process.submit(measure_peak_memory, updates, recording).result()))
    return {"environments": 1024, "updates": updates, "learner_peak_mib": peaks[0], "collection_peak_mib": peaks[1]}


def measure_peak_memory(updates: int, recording: bool) -> float:
    """Return this process's peak memory in MiB after learning, or after collecting and saving at every update."""
    profile = load_profile("paper")
    # A small network saves time, and memory mainly depends on the number of environments and the rollout length.
    profile = replace(profile, ego=replace(profile.ego, widths=Widths((4,), (4,), 8, 8, 8)))
    if recording:
        collect_updates(profile, updates, save_seconds=0)
        return peak_memory()
    learner = make_learner(_last_heuristic_work(profile).task, profile)
    state, update = jax.jit(learner.init)(jax.random.key(0)), jax.jit(learner.update, donate_argnums=0)
    for _ in range(updates):
        state, *_ = jax.block_until_ready(update(state))
    return peak_memory()


def transition_bytes(streams: int) -> dict[str, Any]:
    """Return the bytes per transition in each format, for the first `streams` histories of each bundled task."""
    dataset = load_icrl4aht(obs="uint8")
    chosen = [(task, dataset.filter(task_id=task.task_id)[:streams]) for task in read_tasks(dataset.root / TASKS)]
    new = [
        NewTask(task, dataset.provenance[task.task_id], len(part), lambda part=part: map(NewHistory.from_history, part))
        for task, part in chosen
    ]
    transitions = sum(history.entry.T for _, part in chosen for history in part)
    with tempfile.TemporaryDirectory() as folder:
        selected = dataset.select(np.concatenate([part.ids for _, part in chosen]))
        found = {"paper": folder_size(to_published(selected, Path(folder) / "paper", states=False)) / transitions}
        for kind in KINDS:
            root = write_release(Path(folder) / kind, kind, new, data_version="0.0.0", card="")
            found[kind] = folder_size(root) / transitions
    return {
        "histories": sum(len(part) for _, part in chosen),
        "transitions": transitions,
        **{f"{name}_bytes_per_transition": round(size, 3) for name, size in found.items()},
        **{f"{kind}_smaller_by": round(found["paper"] / found[kind], 2) for kind in KINDS},
    }


PARTS_OF_COLLECTION = ("speed", "noise", "memory", "bytes")


@click.command()
@click.argument("parts", nargs=-1, type=click.Choice(PARTS_OF_COLLECTION))
@click.option("--profile", default="smoke", show_default=True, help="Profile of the speed part.")
@click.option("--updates", type=COUNT, default=30, show_default=True, help="Updates of the speed part.")
@click.option("--layout", default="demo_wide", show_default=True, help="Layout of the noise part.")
@click.option("--wide-updates", type=COUNT, default=4, show_default=True, help="Updates of the memory part.")
@click.option("--streams", type=COUNT, default=8, show_default=True, help="Histories of each task in the bytes part.")
def main(parts: tuple[str, ...], profile: str, updates: int, layout: str, wide_updates: int, streams: int) -> None:
    """Measure speed, memory and bytes of a collection, and print a JSON line for each part.

    In the part `memory`, an update has 262,144 environment steps.
    """
    measures: dict[str, Callable[[], dict[str, Any]]] = {
        "speed": lambda: collection_speed(profile, updates),
        "noise": lambda: noise_speed(layout),
        "memory": lambda: collection_memory(wide_updates),
        "bytes": lambda: transition_bytes(streams),
    }
    for part in parts or PARTS_OF_COLLECTION:
        print_line("collect", part=part, **measures[part]())


if __name__ == "__main__":
    main()
