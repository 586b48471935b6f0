"""Collection: speed, memory and size on disk: `make bench-collect`.

One JSON line each for
  speed   recorded transitions/s of the whole path (PPO, recording, writing), and the share of the time that recording
          and writing take
  memory  the highest resident memory of a collection with the paper's 1024 environments beside that of its learner
          alone, each in a process of its own
  bytes   per transition of the bundled histories, everything included: `lite` and `full` releases beside the paper's
          format (App. D.1: float32 observations, gzip-6, one group per history) of the same histories
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import h5py
import jax

from benchmarks.histories import folder_size
from generation.collection.task import make_learner, run_task
from generation.collection.task_folder import last_timing
from generation.learners.network import Widths
from generation.profiles import Profile, load_profile
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS
from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import HISTORIES, KINDS, TASKS
from icrl4aht_data.reading.history import History
from icrl4aht_data.writing.published import PUBLISHED_CHUNK
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

_PAPER_DTYPES = {
    "obs": "float32",
    "actions": "int32",
    "rewards": "float32",
    "dones": "bool",
    "teammate_actions": "int32",
    "expert_actions": "int32",
}
_PARTS = ("speed", "memory", "bytes")


class _EnoughError(Exception):
    """Stops a collection that only had to be measured."""


def collect_some(profile: Profile, updates: int, save_seconds: float) -> dict[str, float]:
    """The timing of a collection of the profile's last task after so many updates."""
    task = _task(profile)

    def report(update: int, metrics: dict[str, float]) -> None:
        if update + 1 == updates:
            raise _EnoughError

    with tempfile.TemporaryDirectory() as folder:
        artefact = Path(folder) / task.task_id
        with suppress(_EnoughError):
            run_task(task, profile, artefact, report, save_seconds=save_seconds)
        return last_timing(artefact) or {}


def speed(profile_name: str, updates: int) -> dict[str, Any]:
    """The learner's state is saved every two seconds here, fifteen times as often as when collecting."""
    profile = load_profile(profile_name)
    timing = collect_some(profile, updates, save_seconds=2)
    return {
        "profile": profile_name,
        "environments": profile.ego.environments,
        "steps_per_second": round(timing["steps_per_second"]),
        "recorded_transitions_per_second": round(timing["steps_per_second"] * KEPT_STEPS / EPISODE_STEPS),
        "recording_and_writing_share": round(timing["recording"] / timing["seconds"], 4),
    }


def memory(updates: int) -> dict[str, Any]:
    peaks = {}
    for part in (learn_only, learn_and_record):
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            peaks[part] = process.submit(part, updates).result()
    return {
        "environments": 1024,
        "rollout": 256,
        "updates": updates,
        "learner_peak_mib": round(peaks[learn_only]),
        "collection_peak_mib": round(peaks[learn_and_record]),
        "over_the_learner_mib": round(peaks[learn_and_record] - peaks[learn_only]),
    }


def learn_only(updates: int) -> float:
    """Peak MiB of a process that only learns."""
    profile = _wide()
    learner = make_learner(_task(profile), profile)
    state, update = jax.jit(learner.init)(jax.random.key(0)), jax.jit(learner.update, donate_argnums=0)
    for _ in range(updates):
        state, *_ = jax.block_until_ready(update(state))
    return _peak()


def learn_and_record(updates: int) -> float:
    """Peak MiB of a process that collects; the histories are synced and the state saved at every update."""
    collect_some(_wide(), updates, save_seconds=0)
    return _peak()


def _task(profile: Profile) -> Task:
    """A task beside a teammate that needs no training."""
    return replace(profile, presets=("default",)).heuristic_tasks()[-1]


def _wide() -> Profile:
    """The paper's streams and roll-outs, with a network that does not make this long."""
    profile = load_profile("paper")
    return replace(profile, ego=replace(profile.ego, widths=Widths((4,), (4,), 8, 8, 8)))


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def sizes(streams: int) -> dict[str, Any]:
    """Bytes per transition of the first streams of every task of the bundled release, in all formats."""
    dataset = load_icrl4aht(obs="uint8")
    tasks = read_tasks(dataset.root / TASKS)
    chosen = {task.task_id: dataset.filter(task_id=task.task_id)[:streams] for task in tasks}
    new = [
        NewTask(
            task,
            Provenance(),
            len(chosen[task.task_id]),
            lambda part=chosen[task.task_id]: map(NewHistory.copied, part),
        )
        for task in tasks
    ]
    transitions = sum(history.entry.T for part in chosen.values() for history in part)
    with tempfile.TemporaryDirectory() as folder:
        found = {"paper": folder_size(_paper_format(Path(folder) / "paper", chosen)) / transitions}
        for kind in KINDS:
            root = write_release(Path(folder) / kind, kind, new, data_version="0.0.0", card="")
            found[kind] = folder_size(root) / transitions
    return {
        "histories": sum(map(len, chosen.values())),
        "transitions": transitions,
        **{f"{name}_bytes_per_transition": round(size, 3) for name, size in found.items()},
        **{f"{kind}_smaller_by": round(found["paper"] / found[kind], 2) for kind in KINDS},
    }


def _paper_format(root: Path, chosen: dict[str, Dataset]) -> Path:
    """One HDF5 file a layout, and the index."""
    (root / "meta").mkdir(parents=True)
    for part in chosen.values():
        with h5py.File(root / f"{part[0].entry.layout}.h5", "a") as file, (root / HISTORIES).open("a") as index:
            for history, (name, array) in _paper_fields(part):
                group = file.require_group(str(history.entry.history_id))
                chunk = (min(PUBLISHED_CHUNK, len(array)), *array.shape[1:])
                group.create_dataset(name, data=array, chunks=chunk, compression="gzip", compression_opts=6)
            index.writelines(json.dumps(entry.to_json()) + "\n" for entry in part.entries)
    return root


def _paper_fields(part: Dataset) -> Iterator[tuple[History, tuple[str, Any]]]:
    for history in part:
        for name, dtype in _PAPER_DTYPES.items():
            yield history, (name, history.read(name).astype(dtype))


@click.command()
@click.argument("parts", nargs=-1, type=click.Choice(_PARTS))
@click.option("--profile", "profile_name", default="smoke", show_default=True, help="Of the speed.")
@click.option("--updates", default=30, show_default=True, help="Of the speed.")
@click.option("--wide-updates", default=4, show_default=True, help="Of the memory, 262,144 steps each.")
@click.option("--streams", default=8, show_default=True, help="Of each task, for the bytes.")
def main(parts: tuple[str, ...], profile_name: str, updates: int, wide_updates: int, streams: int) -> None:
    """Speed, memory and bytes of a collection, one JSON line each."""
    measures = {
        "speed": lambda: speed(profile_name, updates),
        "memory": lambda: memory(wide_updates),
        "bytes": lambda: sizes(streams),
    }
    for part in parts or _PARTS:
        click.echo(json.dumps({"benchmark": "collect", "part": part, **measures[part]()}))


if __name__ == "__main__":
    main()
