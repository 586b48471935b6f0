"""Conversion of histories to a Minari dataset.

The Minari dataset has one Minari episode per episode of the selection, in order. An episode of n stored steps has n
actions of the ego, n rewards, and n + 1 observations; the last observation shows the state after the last step.
Episodes never terminate, but are truncated after the last stored step. `infos` has arrays of n + 1 rows, one for each
observation:

    state            uint8 (n + 1, S), state record, see `icrl4aht_data.overcooked.state`
    teammate_action  int8 (n + 1,), the teammate's action that led to the observation; -1 in the first row
    expert_action, oracle_action   int8 (n + 1,), labels, if the history has labels; -1 in the last row

The metadata key `icrl4aht` has the values that Minari has no field for: data version, tasks, provenance, and the task,
source, stream, learner and number of episodes of every history. Checkpoints are not converted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.environments import environment_spec
from icrl4aht_data.errors import NotStoredError, OptionError
from icrl4aht_data.format.schema import ACTION_FIELDS, FIELDS
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.history import History
from icrl4aht_data.utils.install_hints import AUTHORS, import_optional
from icrl4aht_data.utils.text import counted_noun
from icrl4aht_data.writing.convert import HistoryProgress
from icrl4aht_data.writing.release_folder import as_path, atomic_folder

_NAME = re.compile(r"[\w.-]+-v\d+")
_INFOS = {name: name.removesuffix("s") for name in ACTION_FIELDS if name != "actions"}


def to_minari(
    dataset: Dataset,
    target: str | Path,
    *,
    overwrite: bool = False,
    advance: HistoryProgress = lambda done, total: None,
) -> Path:
    """Write a selection as a Minari dataset, which `minari.load_dataset(target.name)` opens in MINARI_DATASETS_PATH.

    Observations have the layouts' own channels if all layouts have the same number of channels, else the canonical
    channels. For one task with one heuristic teammate, Minari's `recover_environment` makes the task's environment.

    Args:
        dataset: a release with state records, or a selection of its histories.
        target: the folder to write, with a Minari name `<name>-v<number>`.
        overwrite: whether to replace a folder written by this function, or a release.
        advance: function called with the number of written histories and the number of all histories.

    Raises:
        OptionError: if Minari is not installed, if the name of `target` has another form, or if `target` may not be
            written, see `release_folder.check_target`.
        NotStoredError: if the release has no state records, so that observations after the last steps are unknown.
    """
    minari, spaces = import_optional("minari", "Minari"), import_optional("gymnasium.spaces", "Minari")
    storage_module = import_optional("minari.dataset.minari_storage", "Minari")
    target = as_path(target)
    if not dataset.has_states:
        raise NotStoredError(
            f"{dataset.root} has observations only, but a Minari dataset also needs the observation after the last "
            f"step of each episode; convert a full or lite release"
        )
    if not _NAME.fullmatch(target.name):
        raise OptionError(f"{target}: expected a folder with a Minari name, such as demo_wide-v0")
    canonical = len({layout.obs_shape for layout in dataset.layouts}) > 1
    about = _metadata(dataset)
    with atomic_folder(target, overwrite=overwrite, sources=[dataset.root]) as folder:
        (folder / "data").mkdir()
        environment = _environment_spec(dataset, about["tasks"], canonical)
        storage = storage_module.MinariStorage.new(
            folder / "data",
            spaces.Box(0, 255, observation_shape(dataset.layouts[0], canonical), np.uint8),
            spaces.Discrete(len(ACTIONS)),
            environment,
        )
        note = "; there is no single environment to recover, episodes name their tasks" if environment is None else ""
        metadata = {
            "dataset_id": target.name,
            "minari_version": minari.__version__,
            "algorithm_name": ", ".join(sorted({entry.source for entry in dataset.entries})),
            "author": {AUTHORS},
            "description": (
                f"ICRL4AHT learning histories, data version {dataset.info.data_version}: {len(dataset)} histories of "
                f"{counted_noun(len(about['tasks']), 'task')}{note}"
            ),
            "icrl4aht": about,
        }
        storage.update_metadata(metadata)
        numbers: list[dict[str, Any]] = []
        for number, history in enumerate(dataset):
            storage.update_episodes(_episode_buffers(history, dataset.info.environment.kept_steps, canonical))
            facts = {"history": number, "task_id": history.entry.task_id, "layout": history.entry.layout}
            numbers += [{**facts, "episode": episode} for episode in range(history.entry.episodes)]
            advance(number + 1, len(dataset))
        storage.update_episode_metadata(numbers)
    return target


def _metadata(dataset: Dataset) -> dict[str, Any]:
    """Return the content of the metadata key `icrl4aht`."""
    first = {entry.task_id: entry for entry in dataset.entries}
    names = ("task_id", "source", "env_idx", "learner", "episodes")  # `provenance` has swapped teammates
    return {
        "data_version": dataset.info.data_version,
        "kept_steps": dataset.info.environment.kept_steps,
        "tasks": [asdict(dataset.history_task(entry.history_id)) for entry in first.values()],
        "provenance": {name: dataset.provenance.of(name).to_json() for name in first},
        "histories": [{name: getattr(entry, name) for name in names} for entry in dataset.entries],
    }


def _environment_spec(dataset: Dataset, tasks: list[dict[str, Any]], canonical: bool) -> Any:
    """Return the environment spec of a selection with one task and one heuristic teammate; else None."""
    swaps = any(entry.teammate_of_episode for entry in dataset.entries)
    if len(tasks) > 1 or tasks[0]["teammate"]["kind"] == "rl" or swaps:
        return None
    noise = dataset.recover_teammate(dataset.entries[0].history_id).get("noise", "seeded")
    channels = "canonical" if canonical else "own"
    return environment_spec(
        dataset.info.environment.max_steps, {"task": tasks[0], "noise": noise, "channels": channels}
    )


def _episode_buffers(history: History, steps: int, canonical: bool) -> Iterator[Any]:
    from minari.data_collector import EpisodeBuffer

    layout = get_layout(history.entry.layout)
    infos = {name: info for name, info in _INFOS.items() if history.entry.has(FIELDS[name])}
    arrays = {name: history.read(name) for name in ("state", "actions", "rewards", *infos)}
    for episode, end in enumerate(history.read("episode_end_state")):
        part = {name: array[episode * steps : (episode + 1) * steps] for name, array in arrays.items()}
        state = np.concatenate([part["state"], end[None]])
        observations = np.empty((len(state), *observation_shape(layout, canonical)), np.uint8)
        padding = {name: (1, 0) if name == "teammate_actions" else (0, 1) for name in infos}
        padded = {
            info: np.pad(part[name].astype(np.int8), padding[name], constant_values=-1) for name, info in infos.items()
        }
        yield EpisodeBuffer(
            observations=fast_observe(layout, state, observations, canonical=canonical),  # type: ignore[arg-type]
            actions=part["actions"].astype(np.int64),  # type: ignore[arg-type]
            rewards=part["rewards"].astype(np.float32),  # type: ignore[arg-type]
            terminations=[False] * steps,
            truncations=[False] * (steps - 1) + [True],
            infos={"state": state, **padded},
        )
