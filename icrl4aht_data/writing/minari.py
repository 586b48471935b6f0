"""Conversion to a Minari dataset, and back.

A Minari dataset has one Minari episode for each episode of the selection, in order, with the observations of the kept
steps and the one after them, the ego's actions, and the rewards. No episode terminates; each is truncated after its
last kept step. `infos` of an episode with n steps are arrays of n + 1 rows, one for each observation:

    state            uint8 (n + 1, S), state record, see `icrl4aht_data.overcooked.state`
    teammate_action  int8 (n + 1,), the teammate's action that led to the observation; -1 in the first row
    expert_action, oracle_action   int8 (n + 1,), labels of the observation, if the history has them; -1 in the last row

The metadata have a key `icrl4aht` with what a release needs besides: tasks, provenance and the histories' numbers.
Checkpoints are not converted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from icrl4aht_data.benchmark.tasks import parse_task
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.environments import environment_spec
from icrl4aht_data.errors import Icrl4ahtError, MinariFormatError, NotStoredError, OptionError
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import FIELDS, KINDS, PROVENANCE, Kind
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.channels import observation_shape
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.history import History
from icrl4aht_data.utils.installation import install_command
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_data.writing.release_folder import MINARI_FILES, atomic_folder, check_target, write_listing
from icrl4aht_data.writing.stored import HistoryProgress, with_source

if TYPE_CHECKING:
    from minari import EpisodeData, MinariDataset

_NAME = re.compile(r"[\w.-]+-v\d+")
_LABELS = {"expert_actions": "expert_action", "oracle_actions": "oracle_action"}


class _History(msgspec.Struct):
    """What the metadata say of one history."""

    task_id: str
    source: str
    env_idx: int
    learner: int
    episodes: int


class _About(msgspec.Struct):
    """The metadata `icrl4aht`: what a release needs and Minari does not have."""

    data_version: str
    kept_steps: int
    tasks: list[dict[str, Any]]
    provenance: dict[str, Any]
    histories: list[_History]


def to_minari(
    dataset: Dataset,
    target: Path,
    *,
    overwrite: bool = False,
    advance: HistoryProgress = lambda done, total: None,
) -> Path:
    """Write a selection as a Minari dataset; `minari.load_dataset(target.name)` opens it in MINARI_DATASETS_PATH.

    Observations have the layout's own channels if the selection's layouts have as many, else the canonical ones. The
    dataset of one task with a heuristic teammate has its environment: `recover_environment` of Minari makes it.

    Args:
        dataset: a release with state records, or a part of one.
        target: the folder to write, named as Minari names datasets: `<name>-v<number>`.
        overwrite: replace a folder that this function wrote, or a release.
        advance: progress.

    Raises:
        OptionError: if Minari is not installed, if `target` has another form of name, or if it may not be written, see
            `release_folder.check_target`.
        NotStoredError: for a release of observations, which does not have those after the last steps.
    """
    try:
        import minari
        from gymnasium import spaces
        from minari.dataset.minari_storage import MinariStorage
    except ImportError as error:
        raise OptionError(f"Minari is needed: {install_command('minari')}") from error
    if not dataset.has_states:
        raise NotStoredError(
            f"{dataset.root}: has observations only, without those after the last steps of episodes, which a Minari "
            f"dataset needs; convert a full or lite release"
        )
    if not _NAME.fullmatch(target.name):
        raise OptionError(f"{target}: expected a folder named as a Minari dataset, such as demo_wide-v0")
    canonical = len({layout.obs_shape for layout in dataset.layouts}) > 1
    about = _describe(dataset)
    with atomic_folder(target, overwrite=overwrite, sources=[dataset.root]) as folder:
        (folder / "data").mkdir()
        storage = MinariStorage.new(
            folder / "data",
            spaces.Box(0, 255, observation_shape(dataset.layouts[0], canonical), np.uint8),
            spaces.Discrete(len(ACTIONS)),
            _environment(dataset, about, canonical),
        )
        metadata = {
            "dataset_id": target.name,
            "minari_version": minari.__version__,
            "algorithm_name": ", ".join(sorted({one.source for one in about.histories})),
            "description": f"ICRL4AHT learning histories, data version {about.data_version}",
            "icrl4aht": msgspec.to_builtins(about),
        }
        storage.update_metadata(metadata)
        numbers: list[dict[str, Any]] = []
        for number, history in enumerate(dataset):
            storage.update_episodes(_buffers(history, about.kept_steps, canonical))
            facts = {"history": number, "task_id": history.entry.task_id, "layout": history.entry.layout}
            numbers += [{**facts, "episode": episode} for episode in range(history.entry.episodes)]
            advance(number + 1, len(dataset))
        storage.update_episode_metadata(numbers)
        write_listing(folder)
    return target


def _describe(dataset: Dataset) -> _About:
    entries = dataset.entries
    recorded = read_provenance(dataset.origin.file(PROVENANCE))
    first = {entry.task_id: entry for entry in entries}
    return _About(
        data_version=dataset.info.data_version,
        kept_steps=dataset.info.environment.kept_steps,
        tasks=[asdict(dataset.history_task(entry.history_id)) for entry in first.values()],
        provenance={
            name: with_source(recorded.get(name, Provenance()), entry.source).to_json() for name, entry in first.items()
        },
        histories=[_History(e.task_id, e.source, e.env_idx, e.learner, e.episodes) for e in entries],
    )


def _environment(dataset: Dataset, about: _About, canonical: bool) -> Any:
    """The spec of the environment of a single task with a heuristic teammate, else None."""
    if len(about.tasks) > 1 or about.tasks[0]["teammate"]["kind"] == "rl":
        return None
    noise = dataset.recover_teammate(dataset.entries[0].history_id).get("noise", "seeded")
    channels = "canonical" if canonical else "own"
    return environment_spec(
        dataset.info.environment.max_steps, {"task": about.tasks[0], "noise": noise, "channels": channels}
    )


def _buffers(history: History, steps: int, canonical: bool) -> Iterator[Any]:
    from minari.data_collector import EpisodeBuffer

    layout = get_layout(history.entry.layout)
    labels = {name: info for name, info in _LABELS.items() if history.entry.has(FIELDS[name])}
    arrays = {name: history.read(name) for name in ("state", "actions", "rewards", *labels)}
    teammate = history.read("teammate_actions") if history.entry.has_teammate_actions else None
    ends = history.read("episode_end_state")
    for episode, end in enumerate(ends):
        part = {name: array[episode * steps : (episode + 1) * steps] for name, array in arrays.items()}
        state = np.concatenate([part["state"], end[None]])
        observations = np.empty((len(state), *observation_shape(layout, canonical)), np.uint8)
        infos = {"state": state}
        infos |= {info: np.append(part[name], -1).astype(np.int8) for name, info in labels.items()}
        if teammate is not None:
            played = teammate[episode * steps : (episode + 1) * steps]
            infos["teammate_action"] = np.insert(played.astype(np.int8), 0, -1)
        yield EpisodeBuffer(
            observations=fast_observe(layout, state, observations, canonical=canonical),  # type: ignore[arg-type]
            actions=part["actions"].astype(np.int64),  # type: ignore[arg-type]
            rewards=part["rewards"].astype(np.float32),  # type: ignore[arg-type]
            terminations=[False] * steps,
            truncations=[False] * (steps - 1) + [True],
            infos=infos,
        )


def is_minari_dataset(folder: Path) -> bool:
    """Return whether a folder has the files of a Minari dataset."""
    return all((folder / name).is_file() for name in MINARI_FILES)


def from_minari(
    source: Path,
    target: Path,
    kind: Kind | None = None,
    *,
    overwrite: bool = False,
    advance: HistoryProgress = lambda done, total: None,
) -> Kind:
    """Write a release from a Minari dataset that `to_minari` wrote.

    Args:
        source: the folder of the Minari dataset.
        target: the folder to write, which appears when it is complete.
        kind: "lite" by default, or "full".
        overwrite: replace a release at `target`.
        advance: progress.

    Returns:
        The kind of the release.

    Raises:
        OptionError: if Minari is not installed, or if `target` may not be written, see `release_folder.check_target`.
        MinariFormatError: if the dataset cannot be read, or does not have what a release needs.
    """
    found: Kind = kind or "lite"
    if found not in KINDS:
        raise OptionError(f"{source}: a Minari dataset converts to {' or '.join(KINDS)}, found {found}")
    check_target(target, overwrite, [source])
    opened = _open(source)
    numbers = iter(range(1, len(opened.about.histories) + 1))

    def load(task_id: str) -> Iterator[NewHistory]:
        for number, first in opened.members(task_id):
            about = opened.about.histories[number]
            yield NewHistory(about.env_idx, opened.arrays(first, about.episodes), about.learner)
            advance(next(numbers), len(opened.about.histories))

    try:
        tasks = [parse_task(fields) for fields in opened.about.tasks]
        provenance = {name: Provenance.from_json(of) for name, of in opened.about.provenance.items()}
    except Icrl4ahtError as error:
        raise MinariFormatError(f"{source}: metadata icrl4aht: {error}") from error
    new = [
        NewTask(
            task,
            provenance.get(task.task_id, Provenance()),
            len(opened.members(task.task_id)),
            lambda name=task.task_id: load(name),
        )
        for task in tasks
    ]
    write_release(
        target,
        found,
        new,
        data_version=opened.about.data_version,
        kept_steps=opened.about.kept_steps,
        overwrite=overwrite,
        sources=[source],
    )
    return found


def _open(source: Path) -> _Opened:
    try:
        from minari import MinariDataset
    except ImportError as error:
        raise OptionError(f"Minari is needed: {install_command('minari')}") from error
    try:
        dataset = MinariDataset(source / "data")
        metadata = dataset.storage.metadata
    except Exception as error:  # whatever Minari raises on damaged files
        raise MinariFormatError(f"{source}: cannot be read as a Minari dataset: {error}") from error
    if "icrl4aht" not in metadata:
        raise MinariFormatError(
            f"{source}: its metadata have no icrl4aht, so it does not say which tasks its episodes are of; only "
            f"datasets of `convert --to minari` can be converted to a release"
        )
    try:
        about = msgspec.convert(metadata["icrl4aht"], _About)
    except msgspec.ValidationError as error:
        raise MinariFormatError(f"{source}: metadata icrl4aht: {error}") from error
    episodes = sum(one.episodes for one in about.histories)
    if episodes != len(dataset):
        raise MinariFormatError(f"{source}: expected the {episodes} episodes of its metadata, found {len(dataset)}")
    unknown_tasks = {one.task_id for one in about.histories} ^ {str(task.get("task_id")) for task in about.tasks}
    if unknown_tasks:
        raise MinariFormatError(
            f"{source}: metadata icrl4aht: expected the tasks of its histories, but {sorted(unknown_tasks)[0]!r} is "
            f"only in one of both"
        )
    return _Opened(source, dataset, about)


@dataclass(frozen=True)
class _Opened:
    """A Minari dataset with readable metadata; its episodes are read and checked on access."""

    source: Path
    dataset: MinariDataset
    about: _About

    def members(self, task_id: str) -> list[tuple[int, int]]:
        """Number and first Minari episode of each history of a task."""
        starts = np.cumsum([0, *(one.episodes for one in self.about.histories)]).tolist()
        return [(n, starts[n]) for n, one in enumerate(self.about.histories) if one.task_id == task_id]

    def arrays(self, first: int, episodes: int) -> Mapping[str, np.ndarray]:
        """The arrays of the history that starts with a Minari episode."""
        parts = [self._episode(number) for number in range(first, first + episodes)]
        names = set(parts[0])
        for number, part in enumerate(parts, start=first):
            if set(part) != names:
                odd = sorted(names ^ set(part))
                raise MinariFormatError(f"{self.source}, episode {number}: {odd} are in a part of its history only")
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return {name: array.astype(FIELDS[name].dtype, copy=False) for name, array in arrays.items()}

    def _episode(self, number: int) -> dict[str, np.ndarray]:
        where, steps = f"{self.source}, episode {number}", self.about.kept_steps
        try:
            episode: EpisodeData = next(iter(self.dataset.iterate_episodes([number])))
        except Exception as error:  # whatever h5py and Minari raise on damaged files
            raise MinariFormatError(f"{where}: cannot be read: {error}") from error
        infos = {name: np.asarray(values) for name, values in (episode.infos or {}).items()}
        if "state" not in infos:
            raise MinariFormatError(f"{where}: infos have no state, which observations do not determine")
        fields = {"actions": np.asarray(episode.actions), "rewards": np.asarray(episode.rewards)}
        wrong = {name: len(rows) for name, rows in infos.items() if len(rows) != steps + 1}
        wrong |= {name: len(rows) for name, rows in fields.items() if len(rows) != steps}
        if wrong:
            raise MinariFormatError(
                f"{where}: expected {steps} actions and rewards, and infos of {steps + 1} rows, found {wrong}"
            )
        fields |= {name: infos[info][:-1] for name, info in _LABELS.items() if info in infos}
        if "teammate_action" in infos:
            fields["teammate_actions"] = infos["teammate_action"][1:]
        fields["dones"] = np.arange(steps) == steps - 1
        return fields | {"state": infos["state"][:-1], "episode_end_state": infos["state"][-1:]}
