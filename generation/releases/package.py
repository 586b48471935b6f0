"""Artefacts -> a release folder: the best streams of each task, with expert actions."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from generation.collection.curate import best_streams, filter_report, plot_filter, relabel
from generation.collection.record import HistoryArrays
from generation.collection.task import TEAMMATE_NOISE
from generation.collection.task_folder import FILTER_CURVES, METADATA
from generation.learners.checkpoint import load_policy
from generation.populations.select import THRESHOLD
from generation.populations.train import population_threads
from generation.profiles import Profile
from generation.profiles.work import Work
from generation.releases.labeller import choose_labeller
from icrl4aht_data.benchmark.facts import KEPT_STEPS, LABEL_EPISODES
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.checkpoints import checkpoint_files, expert_files
from icrl4aht_data.format.provenance import ExpertLabels, Provenance, TeammateSuite, read_provenance
from icrl4aht_data.format.schema import PROVENANCE, TEAMMATES, Kind, episode_ends
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_data.writing.release_folder import atomic_folder, check_target


def package_release(
    artefacts: Path,
    target: Path,
    works: Sequence[Work],
    profile: Profile,
    suite: Path,
    kind: Kind,
    advance: Callable[[Literal[0, 1]], None] = lambda step: None,
) -> Path:
    """Write a release of tasks with the checkpoints of their learned teammates; see `write_release`.

    The histories of a task are labelled by the checkpoint of its ego that `choose_labeller` returns.

    Args:
        artefacts: folder of the tasks' finished artefacts.
        target: the release folder; a release of this profile there is replaced atomically.
        works: the units of work, by task in the release's order.
        profile: their profile.
        suite: folder of the learned teammates.
        kind: kind of the release.
        advance: called after each task with 0, when its labeller is chosen, and with 1, when it is written.

    Raises:
        OptionError: if something else is at `target`, see `check_release_folder`.
    """
    check_release_folder(target, profile)
    recorded, new = _recorded_provenance(suite), []
    for task in {work.task.task_id: work.task for work in works}.values():
        new.append(_new_task(artefacts / task.task_id, task, profile, suite, recorded))
        advance(0)
    return write_release(
        target, kind, new, data_version=profile.data_version, overwrite=True, done=lambda task: advance(1)
    )


def check_release_folder(target: Path, profile: Profile) -> None:
    """Check that nothing is at `target` but an unchanged release that was made with this profile.

    Raises:
        OptionError: if there is something else.
    """
    if not check_target(target, overwrite=True):
        return
    path = target / PROVENANCE
    profiles = {of_task.profile for of_task in read_provenance(path).values()} if path.is_file() else set()
    if profiles != {profile.name}:
        made = ", ".join(sorted(map(str, profiles - {None}))) or "no known profile"
        raise OptionError(
            f"{target}: has files made with {made}, not with profile {profile.name}, and is not replaced; move it "
            f"away, or give another --out"
        )


def bundle_release(release: Path) -> Path:
    """Replace the release that the package bundles by a copy of this one."""
    with atomic_folder(MINI, overwrite=True, sources=[release]) as copy:
        shutil.copytree(release, copy, dirs_exist_ok=True)
    return MINI


def recorded_sources(release: Path) -> dict[str, str]:
    """task id -> source, as a release says; empty for a folder that is none."""
    path = release / PROVENANCE
    return {task_id: made.source for task_id, made in read_provenance(path).items()} if path.is_file() else {}


def _recorded_provenance(suite: Path) -> dict[str, Provenance]:
    """Provenance of the release whose teammates the suite is, by task id; empty for the suite of a profile."""
    path = suite.parent / PROVENANCE
    return read_provenance(path) if suite.name == TEAMMATES and path.is_file() else {}


def _populations(task: Task, profile: Profile, suite: Path, recorded: Mapping[str, Provenance]) -> TeammateSuite | None:
    """The populations of a learned teammate: the profile's, or those named by the release that it is taken from."""
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


def _new_task(folder: Path, task: Task, profile: Profile, suite: Path, recorded: Mapping[str, Provenance]) -> NewTask:
    metadata = json.loads((folder / METADATA).read_text(encoding="utf-8"))
    rewards = np.load(folder / "rewards.npy", mmap_mode="r")
    streams = best_streams(rewards, profile.keep)
    plot_filter(folder / FILTER_CURVES, f"{task.layout.name} with {task.teammate_kind}", rewards, streams)
    labeller = choose_labeller(folder, task, suite)
    provenance = Provenance(
        profile=metadata["profile"],
        profile_hash=profile.hash,
        ego=metadata["ego"],
        ego_hash=metadata["ego_hash"],
        code_version=metadata["code_version"],
        jax_version=metadata["jax_version"],
        platform=metadata["platform"],
        xla_threads=metadata["xla_threads"],
        seed=task.seed,
        teammate={"slot": TEAMMATE, "noise": TEAMMATE_NOISE},
        streams_recorded=metadata["ego"]["environments"],
        streams_kept=profile.keep,
        filter=filter_report(rewards, streams),
        expert=ExpertLabels(
            policy_sha256=labeller.sha256,
            action="greedy, recurrent",
            step=labeller.step,
            return_greedy=labeller.return_greedy,
            return_sampled=labeller.return_sampled,
            episodes=LABEL_EPISODES,
            last_return_greedy=labeller.last_return_greedy,
        ),
        suite=_populations(task, profile, suite, recorded) if task.teammate_family == "rl" else None,
    )
    files = checkpoint_files(suite, task)
    if profile.policies:
        files |= expert_files(labeller.folder, labeller.sha256)
    return NewTask(task, provenance, profile.keep, lambda: _histories(folder, task, streams, labeller.folder), files)


def _histories(folder: Path, task: Task, streams: np.ndarray, labeller: Path) -> Iterator[NewHistory]:
    arrays = HistoryArrays(**{name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in HistoryArrays._fields})
    network, params, _ = load_policy(labeller)
    labels = relabel(task.layout, network, params, (arrays.state[stream] for stream in streams))
    dones = episode_ends(arrays.actions.shape[1], KEPT_STEPS)
    for stream, expert in zip(streams, labels, strict=True):
        recorded = {name: np.asarray(array[stream]) for name, array in arrays._asdict().items()}
        yield NewHistory(int(stream), recorded | {"dones": dones, "expert_actions": expert})
