"""Artefacts -> a release folder: the best streams of each task, labelled."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from generation import record
from generation.artefact import FILTER_CURVES, METADATA
from generation.collect import TEAMMATE_NOISE
from generation.curate import best_streams, filter_report, plot_filter, relabel
from generation.learners.checkpoint import load_policy
from generation.learners.ppo import PPOConfig
from generation.profiles import Profile, TeammateConfig
from generation.select import THRESHOLD
from icrl4aht_data.benchmark import ALGORITHMS, KEPT_STEPS, TEAMMATE
from icrl4aht_data.dataset import MINI
from icrl4aht_data.release import NewHistory, NewTask, checkpoint_files, folder_in_place_of, write_release
from icrl4aht_data.schema import Kind, episode_ends
from icrl4aht_data.statistics import STREAMS_RECORDED
from icrl4aht_data.tasks import Task


def package(
    artefacts: Path,
    target: Path,
    tasks: Sequence[Task],
    profile: Profile,
    suite: Path,
    kind: Kind,
    done: Callable[[Task], None] = lambda task: None,
) -> Path:
    """Write a release of these tasks' artefacts, with the checkpoints of learned teammates; see `write_release`."""
    new = [_new_task(artefacts / task.task_id, task, profile, suite) for task in tasks]
    return write_release(target, kind, new, data_version=profile.data_version, card=_card(profile, new), done=done)


def bundle_release(release: Path) -> Path:
    """Put a copy of a release in the place of the one that the package bundles."""
    with folder_in_place_of(MINI) as copy:
        shutil.copytree(release, copy, dirs_exist_ok=True)
    return MINI


def _new_task(folder: Path, task: Task, profile: Profile, suite: Path) -> NewTask:
    metadata = json.loads((folder / METADATA).read_text(encoding="utf-8"))
    rewards = np.load(folder / "rewards.npy", mmap_mode="r")
    streams = best_streams(rewards, profile.keep)
    plot_filter(folder / FILTER_CURVES, f"{task.layout.name} with {task.teammate_kind}", rewards, streams)
    provenance = {
        "profile": metadata["profile"],
        "profile_hash": profile.hash,
        "ego": metadata["ego"],
        "ego_hash": metadata["ego_hash"],
        "code_version": metadata["code_version"],
        "jax_version": metadata["jax_version"],
        "platform": metadata["platform"],
        "seed": task.seed,
        "teammate": {"slot": TEAMMATE, "noise": TEAMMATE_NOISE},
        STREAMS_RECORDED: metadata["ego"]["environments"],
        "streams_kept": profile.keep,
        "filter": filter_report(rewards, streams),
        "expert": {"policy_sha256": metadata["files"]["policy.safetensors"], "action": "greedy, recurrent"},
    }
    files = checkpoint_files(suite, task)
    return NewTask(task, provenance, profile.keep, lambda: _histories(folder, task, streams), files)


def _histories(folder: Path, task: Task, streams: np.ndarray) -> Iterator[NewHistory]:
    arrays = record.Histories(
        **{name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in record.Histories._fields}
    )
    network, params, _ = load_policy(folder)
    labels = relabel(task.layout, network, params, (arrays.state[stream] for stream in streams))
    dones = episode_ends(arrays.actions.shape[1], KEPT_STEPS)
    for stream, expert in zip(streams, labels, strict=True):
        recorded = {name: np.asarray(array[stream]) for name, array in arrays._asdict().items()}
        yield NewHistory(int(stream), recorded | {"dones": dones, "expert_actions": expert})


def _card(profile: Profile, new: Sequence[NewTask]) -> str:
    tasks = [task.task for task in new]
    layouts = ", ".join(dict.fromkeys(task.layout.name for task in tasks))
    teammates, limits = [], []
    if profile.presets:
        teammates.append("presets of the heuristic H4 (`utility_greedy`)")
        limits.append(_PRESETS)
    if profile.algorithms:
        teammates.append(_learned(profile))
        limits += _missing(profile, tasks) + _smaller(profile)
    return f"""# ICRL4AHT learning histories, profile `{profile.name}`

Learning histories of ego agents (recurrent PPO, from scratch) in OvercookedV2, each beside one fixed teammate.

* Layouts: {layouts}.
* Tasks: {len(tasks)}; of each, the best {profile.keep} of {profile.ego.environments} streams by end + improvement.
* Each history: {profile.ego.episodes} episodes, the first 100 of 400 steps of each; T = {profile.ego.episodes * 100:,}.
* Expert actions: the final ego's greedy action, its recurrent state carried through the episode.
* Teammates: {"; ".join(teammates)}.

## Learning curves

Mean return of the kept steps, over the kept streams, in the first and in the last tenth of the episodes.

{_curves(new)}

## What it is not

{"".join(f"* {limit}{chr(10)}" for limit in limits)}\
* On coord_simple and test_simple the ego's room shares nothing with the teammate's: the ego cannot raise the return (on
  coord_simple it can lower it, by pressing the button). A flat, high curve there is the teammate's work.
* Streams of one task come from one learner: they are not independent runs.
* The filter keeps the streams that ended best; the mean over all streams is lower (`meta/provenance.json` has both).
"""


_PRESETS = """\
Its teammates that are presets of a heuristic stand in for the learned ones of the paper's training split, and the
  presets act alike. H4 is also a family of the benchmark's test side: do not report teammate generalisation from a
  model trained on them."""


def _learned(profile: Profile) -> str:
    config = profile.teammates
    return (
        f"checkpoints of {', '.join(profile.algorithms)} populations of {config.members} ({config.ppo.total_steps:,} "
        f"steps a member), drawn from those with whom their own partner's return of 400 steps exceeds "
        f"{THRESHOLD:g}; they act greedily, and `teammates/` has their weights"
    )


def _missing(profile: Profile, tasks: Sequence[Task]) -> list[str]:
    """What the quality filter left too few of."""
    found = Counter((task.layout.name, task.teammate_kind) for task in tasks)
    wanted = profile.teammates.train
    few = [
        f"{algorithm} on {layout} ({found[layout, algorithm]} of {wanted})"
        for layout in profile.layouts
        for algorithm in profile.algorithms
        if found[layout, algorithm] < wanted
    ]
    return [f"Complete: too few checkpoints passed the filter of {', '.join(few)}."] if few else []


def _smaller(profile: Profile) -> list[str]:
    """Where it falls short of the paper's scale, if it does."""
    paper, own = TeammateConfig(), profile.teammates
    if own.ppo.total_steps >= paper.ppo.total_steps and profile.ego.total_steps >= PPOConfig().total_steps:
        return []
    return [
        f"The paper's scale: its teammates learn for {paper.ppo.total_steps:,} steps and are "
        f"{paper.train * len(ALGORITHMS)} a layout, its egos learn for {PPOConfig().total_steps:,}. Here teammates "
        f"learned for {own.ppo.total_steps:,} steps, egos for {profile.ego.total_steps:,}."
    ]


def _curves(new: Sequence[NewTask]) -> str:
    lines = ["| layout | teammate | first | last |", "| --- | --- | ---: | ---: |"]
    for task in new:
        kept = task.provenance["filter"]["after"]
        teammate = f"{task.task.teammate_kind} {task.task.teammate['theta_id']}"
        lines.append(
            f"| {task.task.layout.name} | {teammate} | {kept['return_start']:.1f} | {kept['return_end']:.1f} |"
        )
    return "\n".join(lines)
