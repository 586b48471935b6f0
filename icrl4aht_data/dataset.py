"""`load_icrl4aht` and the `Dataset` that it returns: a selection of learning histories with samplers."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, Unpack

import msgspec
import numpy as np
from msgspec import Meta

from icrl4aht_data.benchmark.tasks import Task, make_task, read_tasks, task_fields, teammate_id
from icrl4aht_data.environments import make_environment
from icrl4aht_data.errors import NotStoredError, OptionError, UnknownNameError, check_choice, unknown_name
from icrl4aht_data.fetch import ReleaseLocation, open_root
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.manifest import check_meta
from icrl4aht_data.format.schema import ENTRY_HINTS, INFO, TASKS, TEAMMATES, Entry
from icrl4aht_data.overcooked.channels import Channels
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import columns
from icrl4aht_data.plotting import Picture, plot_learning_curves
from icrl4aht_data.reading.episodes import Episode
from icrl4aht_data.reading.history import Labels, Obs
from icrl4aht_data.reading.selection import FilterValues, ReadOptions, Selection
from icrl4aht_data.reading.shard import Shards
from icrl4aht_data.reading.sources import CacheMode
from icrl4aht_data.reading.splitting import SPLIT_BY, SplitBy, choose_histories, choose_teammates
from icrl4aht_data.sampling.ad import ADSampler
from icrl4aht_data.sampling.base import SamplerOptions, warn_of_mixed_splits
from icrl4aht_data.sampling.dpt import ContextOrder, DPTSampler
from icrl4aht_data.sampling.draws import draw_subset
from icrl4aht_data.utils.options import check_int, check_number
from icrl4aht_data.utils.system import usable_cores
from icrl4aht_data.utils.text import counted_histories

if TYPE_CHECKING:
    import gymnasium

MINI = Path(__file__).parent / "mini"
"""Path of the bundled mini release."""


def load_icrl4aht(
    root: str | Path | None = None,
    *,
    split: FilterValues = None,
    layout: FilterValues = None,
    layout_family: FilterValues = None,
    track: FilterValues = None,
    teammate_family: FilterValues = None,
    teammate_kind: FilterValues = None,
    algorithm: FilterValues = None,
    source: FilterValues = None,
    label_view: FilterValues = None,
    task_id: FilterValues = None,
    learner: int | Sequence[int] | None = None,
    min_expert_return: float | None = None,
    obs: Obs = "float32",
    cache: CacheMode = "auto",
    threads: int | None = None,
    channels: Channels = "own",
) -> Dataset:
    """Open a release and return a selection of its histories.

    Args:
        root: a release folder, or an address: `hf://datasets/<org>/<repo>[@<revision>]`, `s3://...`, `https://...`, or
            another address that fsspec opens; by default the bundled mini release. Opening a remote release downloads
            only its index; data is downloaded when it is read.
        split: "train", "validation", "test" or "heldout". Each filter is one value, a sequence of values, or None
            for any value. Train models on "train" only; samplers warn about a mixture of splits.
        layout: a short name (coord_simple) or an environment name (grounded_coord_simple).
        layout_family: "published", or a family of layouts that the release stores, such as "templates".
        track: "teammate", "layout" or "preference": what is new in the test tasks.
        teammate_family: "rl" (learned) or "H1".."H4" (heuristics).
        teammate_kind: an algorithm or a heuristic, such as "fcp" or "utility_greedy".
        algorithm: alias of `teammate_kind` for learned teammates, such as "fcp" or "comedi".
        source: how the histories were made: "ppo" (an ego learned by PPO), "noise" (the scripted oracle, with
            random actions that become rarer), "agent" (a trained agent), "search" (a script that finds out the wanted
            dish) or "human" (a person); see docs/format.md.
        label_view: input of the policy that chose the expert actions: "ego" for the ego's observation, or "state" for
            the full state. Older releases do not record this field.
        task_id: id of a task; a task is a layout, a teammate and a seed.
        learner: number of a learner within its task, counted from 0, or several numbers.
        min_expert_return: only histories whose expert actions come from a policy that earned at least this much per
            episode, acting greedily with the history's teammate: `entry.expert_return`.
        obs: dtype of observations: "float32", "uint8" (the same integers), or "state" for state records instead of
            observations; see `history.Obs`.
        cache: "ram" and "mmap" (files that processes share) decode the selection once for all batches, "stream" reads
            the chunks that a batch needs, "auto" chooses by size and free memory. All modes return the same batches.
            See `sources.CacheMode`.
        threads: number of threads that decode and render; by default one for each usable core.
        channels: channels of observations: "own", which differ between layouts, or "canonical", the union of all
            layouts' channels, for batches that mix layouts; see `overcooked.channels`. With obs="state", call
            `observe` with canonical=True instead.

    Raises:
        UnknownNameError: for a name that does not exist; the message lists the valid names and suggests the nearest.
        EmptySelectionError: if no history matches the filters; the message lists existing values.
        OptionError: for impossible options, such as obs="state" for a release of observations.
        NotStoredError: if `min_expert_return` is given but the release does not store returns of experts.
        ReleaseError: if the release cannot be read.
    """
    options = ReadOptions(obs, cache, usable_cores() if threads is None else threads, channels)
    dataset = open_dataset(open_root(MINI if root is None else root), options)
    return dataset.filter(
        split=split,
        layout=layout,
        layout_family=layout_family,
        track=track,
        teammate_family=teammate_family,
        teammate_kind=teammate_kind,
        algorithm=algorithm,
        source=source,
        label_view=label_view,
        task_id=task_id,
        learner=learner,
        min_expert_return=min_expert_return,
    )


def open_dataset(location: ReleaseLocation, options: ReadOptions) -> Dataset:
    """Return a dataset of all histories of a release; see `load_icrl4aht` for the errors."""
    if os.path.isfile(location.folder / INFO):  # noqa: PTH113 - never raises; `read_index` reports a missing file
        check_meta(location.folder)
    return Dataset(Shards(location, read_index(location.folder)), options)


class Dataset(Selection):
    """A selection of learning histories that can be sampled; `load_icrl4aht` returns a `Dataset`.

    `len(dataset)` is the number of histories, `dataset[i]` the i-th `History`, `dataset[a:b]` a smaller selection;
    iteration yields histories in order. `filter`, `select` and `split` return smaller selections, `sort` orders the
    histories, `ad` and `dpt` sample batches, and `sample_episodes` samples episodes.
    """

    @property
    def has_tasks(self) -> bool:
        """Whether the release stores its tasks, which are optional in a release of observations."""
        return self.has_states or bool(self.tasks)

    def sort(self, *names: str, reverse: bool = False) -> Self:
        """Return this selection sorted by index fields; the sort is stable.

        Args:
            names: fields of `Entry`, such as "return_end"; the first field is the main key. Text is sorted
                alphabetically.
            reverse: sort from the largest value to the smallest. Histories without a number are last in either order;
                missing text counts as "".

        Raises:
            OptionError: if no field is given, or an argument is not a string.
            UnknownNameError: for a field that does not exist; the message suggests the nearest.
        """
        if not names or not all(isinstance(name, str) for name in names):
            raise OptionError(
                f'sort: expected names of index fields, such as ds.sort("layout", "return_end"), found {names!r}; for '
                f"another order pass the history ids to ds.select"
            )
        keys = []
        for name in names:
            values = self.column(name)
            rank = np.unique(values, axis=0, return_inverse=True)[1].reshape(-1)
            absent = values == -1 if ENTRY_HINTS.get(name) == int | None else values != values  # True only for NaN
            rank = np.where(absent, len(self), -rank if reverse else rank) if values.ndim == 1 else rank
            keys.append(rank)
        return self.select(self.ids[np.lexsort(keys[::-1])])

    def split(self, validation: float = 0.1, seed: int = 0, by: SplitBy = "teammate") -> tuple[Self, Self]:
        """Split this selection into training and validation histories.

        The split depends on the seed and on the names of teammates or histories, not on the order of the selection.
        `icrl4aht-data train` splits releases without a validation split in the same way.

        Args:
            validation: fraction of the teammates, or of the histories, to hold out; at least one is held out.
            seed: seed of the choice.
            by: "teammate" holds out teammates with all their histories, separately on each layout, so no validation
                teammate is in training; "history" holds out histories, and keeps at least one per task in training.

        Returns:
            The training histories and the validation histories; each selected history is in exactly one of the two.

        Raises:
            UnknownNameError: if `by` is neither "teammate" nor "history".
            OptionError: if `validation` is not between 0 and 1, there is only one teammate, or every task has only
                one history.
        """
        check_choice("split by", by, SPLIT_BY)
        share = check_number("validation", validation, Annotated[float, Meta(gt=0, lt=1)])
        seed = check_int("seed", seed, 0)
        if by == "history":
            held = choose_histories(self, share, seed)
        else:
            held = choose_teammates(teammate_names(self), share, seed)
            if not held.any():
                raise OptionError(
                    f'by = "teammate": {self!r} has one teammate, so none can be held out; use by="history", or '
                    f"select more tasks"
                )
        return self.select(~held), self.select(held)

    def sample_episodes(self, n: int, seed: int = 0) -> list[Episode]:
        """Draw episodes uniformly without replacement from the selected histories.

        Args:
            n: number of episodes.
            seed: seed of the draw; equal seed, selection and `n` give equal episodes.

        Returns:
            The drawn episodes, in the order of the selection and, within a history, by number.

        Raises:
            OptionError: if `n` is not a positive integer, or is larger than the number of episodes.
        """
        count, ends = check_int("n", n, 1), np.cumsum(self.column("episodes"))
        if count > ends[-1]:
            raise OptionError(
                f"n = {count}: the selection has {ends[-1]:,} episodes; draw fewer, or select more histories"
            )
        drawn = draw_subset(check_int("seed", seed, 0), int(ends[-1]), count)
        rows = np.searchsorted(ends, drawn, side="right")
        before = np.concatenate([[0], ends])[rows]
        chosen = []
        for row in np.unique(rows).tolist():
            episodes = self[row].episodes
            chosen += [episodes[number] for number in (drawn - before)[rows == row].tolist()]
        return chosen

    def plot(self) -> Picture:
        """Return a plot of returns by episode, source and layout; notebooks display the plot.

        Plotting reads the rewards of all selected histories.

        Raises:
            OptionError: if matplotlib is not installed.
        """
        return Picture(f"Returns of {counted_histories(len(self))} by episode", plot_learning_curves(self))

    @cached_property
    def tasks(self) -> dict[str, Task]:
        """Tasks of the release by id; empty if a release of kind `observations` was made without tasks."""
        return {task.task_id: task for task in read_tasks(self.origin.file(TASKS))}

    def recover_environment(self, history_id: int, episode: int = 0, **options: Any) -> gymnasium.Env:
        """Return the Gymnasium environment of a history: the caller acts as the ego, the environment as the teammate.

        Episodes have the length used to make the history, 400 steps in the benchmark. The release has the first 100.
        `reset(options=dataset.reset_options(history_id, episode))` repeats the start of a recorded episode.

        Args:
            history_id: a history of the release, whether selected or not.
            episode: number of the episode whose teammate plays, for histories in which teammates change.
            options: options of `gymnasium.make`, such as `max_episode_steps` or `render_mode`, and of
                `icrl4aht_generation.adapters.gymnasium_env.TaskEnv`. By default `channels` is that of the dataset.

        Raises:
            NotStoredError: if the release was made without its tasks.
            OptionError: if Gymnasium or JAX is not installed, or if the release does not have the checkpoint of a
                learned teammate.
        """
        teammate = self.recover_teammate(history_id, episode)
        task = self.history_task(history_id)
        if (swaps := self.provenance.of(task.task_id).swaps) is not None:
            played = swaps.teammate(episode)
            task = make_task(task.track, task.split, task.layout_name, played, task.seed, task.recipes)
        known: dict[str, Any] = {
            "task": task_fields(task),
            "noise": teammate.get("noise", "seeded"),
            "channels": self.channels,
            "max_episode_steps": self.info.environment.max_steps,
        }
        if task.teammate["kind"] == "rl":
            name = f"{TEAMMATES}/{task.teammate['theta']['sha256']}"
            if not self.origin.fetch_folder(name).is_dir():
                raise OptionError(
                    f"{self.root / name}: the checkpoint of history {history_id}'s teammate is missing, because this "
                    f"release was made without checkpoints; copy it from the original release"
                )
            known["suite"] = str(self.root / TEAMMATES)
        return make_environment(**known | options)

    def reset_options(self, history_id: int, episode: int = 0) -> dict[str, np.ndarray]:
        """Return options for `reset` that make an environment of `recover_environment` repeat the start of an episode.

        The environment then starts at the recorded state, the teammate repeats its recorded actions, and each delivery
        is followed by the recorded recipe. If the ego repeats its recorded actions too, the states, observations and
        rewards equal the recorded ones. After the recorded steps, the teammate's policy
        acts.

        Args:
            history_id: a history of the release, whether selected or not.
            episode: number of the episode in the history, counted from 0.

        Returns:
            `state` uint8 (S,), `teammate_actions` int8 (n,) and `recipes` uint8 (n,), for the episode's n stored steps.

        Raises:
            NotStoredError: for a release of observations.
            LabelsMissingError: for a history without teammate actions.
            OptionError: for an episode that the history does not have.
        """
        history = self.history(history_id)
        recorded = history.episodes[_check_episode(history.entry, episode)]
        after = np.concatenate([recorded.state[1:], recorded.episode_end_state[None]])
        return {
            "state": recorded.state[0],
            "teammate_actions": recorded.teammate_actions,
            "recipes": after[:, columns(get_layout(history.entry.layout)).recipe],
        }

    def environment_parameters(self, history_id: int) -> dict[str, Any]:
        """Return the parameters needed to rebuild a history's environment: layout names, map, recipes, episode lengths.

        Args:
            history_id: a history of the release, whether selected or not.
        """
        entry = self.index.entry(history_id)
        task = self.tasks.get(entry.task_id)
        layout = get_layout(entry.layout) if task is None else task.layout
        return {
            "layout": layout.name,
            "environment_name": layout.alias,
            "map": list(layout.rows),
            "recipes": [list(recipe) for recipe in layout.recipes],
            **msgspec.structs.asdict(self.info.environment),
        }

    def recover_teammate(self, history_id: int, episode: int = 0) -> dict[str, Any]:
        """Return the parameters needed to rebuild a history's teammate.

        Args:
            history_id: a history of the release, whether selected or not.
            episode: number of the episode whose teammate is returned, for histories in which teammates change.

        Returns:
            The task's teammate entry (`kind`, `family`, `theta` and others), the teammate's agent number (`slot`) and
            the source of its randomness (`noise`).

        Raises:
            NotStoredError: if the release was made without its tasks.
            OptionError: for an episode that the history does not have.
        """
        task, episode = self.history_task(history_id), _check_episode(self.index.entry(history_id), episode)
        made = self.provenance.of(task.task_id)
        return (made.swaps.teammate(episode) if made.swaps else task.teammate) | (made.teammate or {})

    def history_task(self, history_id: int) -> Task:
        """Return the task of a history.

        Args:
            history_id: a history of the release, whether selected or not.

        Raises:
            NotStoredError: if the release was made without its tasks.
        """
        entry = self.index.entry(history_id)
        if not self.has_tasks:
            raise NotStoredError(
                f"{self.root / TASKS} is empty: this release was converted without its tasks, so only the teammate's "
                f"family {entry.teammate_family} and kind {entry.teammate_kind} are known; convert again with "
                f"tasks.jsonl in the folder"
            )
        if entry.task_id not in self.tasks:
            raise unknown_name(f"task of history {history_id} in {self.root / TASKS}", entry.task_id, self.tasks)
        return self.tasks[entry.task_id]

    def ad(
        self,
        *,
        batch_size: int,
        length: int,
        every: int = 1,
        labels: Labels | None = None,
        at_start: float = 0.0,
        families: bool = False,
        **options: Unpack[SamplerOptions],
    ) -> ADSampler:
        """Return a sampler of windows of `length` steps for Algorithm Distillation; see `ADSampler` for the options.

        Warns:
            MixedSplitsWarning: if histories of split "train" and of other splits are selected.
            WeakLabelsWarning: see `ADSampler`.
        """
        warn_of_mixed_splits(self)
        own: Any = {"every": every, "labels": labels, "at_start": at_start, "families": families}
        return ADSampler(self, batch_size=batch_size, length=length, **own, **options)

    def dpt(
        self,
        *,
        batch_size: int,
        context: int,
        order: ContextOrder = "contiguous",
        labels: Labels = "expert",
        queries: int = 1,
        **options: Unpack[SamplerOptions],
    ) -> DPTSampler:
        """Return a sampler of queries with contexts of `context` transitions for Decision-Pretrained Transformers.

        See `DPTSampler` for the options.

        Warns:
            MixedSplitsWarning: if histories of split "train" and of other splits are selected.
            WeakLabelsWarning: see `DPTSampler`.
        """
        warn_of_mixed_splits(self)
        return DPTSampler(
            self, batch_size=batch_size, context=context, order=order, labels=labels, queries=queries, **options
        )


def _check_episode(entry: Entry, episode: int) -> int:
    if check_int("episode", episode, 0) >= entry.episodes:
        raise OptionError(f"episode = {episode}: history {entry.history_id} has episodes 0..{entry.episodes - 1}")
    return int(episode)


def teammate_ids(dataset: Dataset, history_ids: Iterable[int]) -> list[str] | None:
    """Return the sorted teammate ids of some histories, or None if the release does not describe their teammates.

    See `tasks.teammate_id`.
    """
    try:
        found: set[str] = set()
        for history_id in history_ids:
            spans = dataset.index.entry(history_id).teammate_of_episode
            found |= {name for _, name in spans or ((0, teammate_id(dataset.recover_teammate(history_id))),)}
        return sorted(found)
    except (NotStoredError, UnknownNameError):  # tasks are optional in a release of observations
        return None


def teammate_names(dataset: Dataset) -> np.ndarray:
    """Return a name for each history's teammate, as strings of shape (H,).

    Teammates with the same policy on the same layout have equal names. A name consists of layout and teammate id, or
    is the task id if the release does not describe the teammate. Teammates that take turns within a history share one
    name.
    """
    codes, first, number = np.unique(dataset.column_codes("task_id"), return_index=True, return_inverse=True)
    values, of_task = dataset.index.values("task_id"), list[str]()
    name_of: dict[str, str] = {}
    for code, history_id in zip(codes.tolist(), dataset.ids[first].tolist(), strict=True):
        ids = teammate_ids(dataset, [history_id])
        layout = dataset.index.entry(history_id).layout
        own = [values[code]] if ids is None else [f"{layout} {one}" for one in ids]
        of_task.append(own[0])
        merged = {name_of.setdefault(one, one) for one in own}
        if len(merged) > 1:
            name_of = {one: min(merged) if name in merged else name for one, name in name_of.items()}
    return np.array([name_of[one] for one in of_task])[number]
