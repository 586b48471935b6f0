"""Samplers and histories for other libraries' loaders.

A sampler is a sequence of batches that are functions of their number alone, so most loaders take it as it is:

    plain loop   for batch in sampler.batches(): ...
    Grain        grain.MapDataset.source(sampler); shuffling is the sampler's own
    PyTorch      torch_loader(sampler, workers=4); extra `torch`
    Hugging Face hf_index(dataset), hf_episodes(dataset), hf_windows(sampler); extra `hf`
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl4aht_data.errors import NotStoredError, OptionError
from icrl4aht_data.utils.validation import check_int

if TYPE_CHECKING:
    import datasets
    from torch.utils.data import DataLoader

    from icrl4aht_data.dataset import Dataset
    from icrl4aht_data.sampling.base import Sampler


def torch_loader(
    sampler: Sampler,
    *,
    start: int = 0,
    stop: int | None = None,
    workers: int = 0,
    context: str = "spawn",
    **options: Any,
) -> DataLoader:
    """A DataLoader over batches start..stop, as tensors, in order on any number of workers.

    With workers, hold the data with cache="mmap" or "stream": each spawned worker would decode its own copy for "ram".
    Shuffling is the sampler's own; to resume, give the next number as `start`.

    Args:
        sampler: of batches.
        start, stop: numbers; `stop` is `len(sampler)` by default.
        workers: processes; they are kept between epochs.
        context: "spawn", "forkserver" or "fork". Fork only while the process runs no threads, JAX's included.
        options: more of DataLoader's, such as prefetch_factor or pin_memory.

    Raises:
        OptionError: if PyTorch is not installed.
    """
    try:
        from torch.utils.data import DataLoader
    except ImportError as error:
        raise OptionError("a DataLoader needs PyTorch: pip install 'icrl4aht-data[torch]'") from error
    numbers = range(check_int("start", start, 0), len(sampler) if stop is None else check_int("stop", stop, 0))
    if workers and sampler.dataset.cache.cache != "stream":
        _ = sampler.dataset.holding  # decoded here once: mapped by the workers, or inherited by forked ones
    processes = {"multiprocessing_context": context, "persistent_workers": True} if workers else {}
    return DataLoader(
        sampler,  # type: ignore[arg-type]
        batch_size=None,
        sampler=numbers,
        num_workers=check_int("workers", workers, 0),
        **processes,  # type: ignore[arg-type]
        **options,
    )


def hf_index(dataset: Dataset) -> datasets.Dataset:
    """The selection's index as a `datasets.Dataset`, one row a history."""
    return _datasets().Dataset.from_list([entry.to_json() for entry in dataset.entries])


def hf_episodes(dataset: Dataset) -> datasets.Dataset:
    """The selection's episodes as a `datasets.Dataset`, one row each, in order.

    Columns: history_id, task_id, layout, episode (number in its history), return, and for each step actions, rewards,
    teammate_actions, expert_actions where the history has them, and state (bytes; see `overcooked.state`).

    Raises:
        NotStoredError: for a release of observations.
    """
    if not dataset.has_states:
        raise NotStoredError(f"{dataset.root}: has observations only, no state records; take hf_windows")
    library = _datasets()
    step = {name: library.List(library.Value("int8")) for name in ("actions", "teammate_actions", "expert_actions")}
    features = library.Features(
        {
            "history_id": library.Value("int64"),
            "task_id": library.Value("string"),
            "layout": library.Value("string"),
            "episode": library.Value("int32"),
            "return": library.Value("float32"),
            "rewards": library.List(library.Value("float32")),
            **step,
            "state": library.List(library.Value("binary")),
        }
    )
    return library.Dataset.from_generator(_episodes, features=features, gen_kwargs={"dataset": dataset})


def _episodes(dataset: Dataset) -> Iterator[dict[str, Any]]:
    for history in dataset:
        entry = history.entry
        names = ["actions", "teammate_actions", "rewards", "dones", "state"]
        arrays = {name: history.read(name) for name in names + ["expert_actions"] * entry.has_expert_actions}
        ends = np.flatnonzero(arrays.pop("dones")) + 1
        for episode, (start, stop) in enumerate(zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True)):
            part = {name: array[start:stop] for name, array in arrays.items()}
            yield {
                "history_id": entry.history_id,
                "task_id": entry.task_id,
                "layout": entry.layout,
                "episode": episode,
                "return": float(part["rewards"].sum()),
                "expert_actions": None,
                **part,
                "state": [record.tobytes() for record in part["state"]],
            }


def hf_windows(sampler: Sampler, start: int = 0, stop: int | None = None) -> datasets.IterableDataset:
    """The windows of batches start..stop, one a row, as a `datasets.IterableDataset`.

    Its `state_dict` resumes after the last window taken.
    """
    numbers = list(range(check_int("start", start, 0), len(sampler) if stop is None else check_int("stop", stop, 0)))
    library = _datasets()
    return library.IterableDataset.from_generator(_windows, gen_kwargs={"sampler": sampler, "numbers": numbers})


def _windows(sampler: Sampler, numbers: list[int]) -> Iterator[dict[str, np.ndarray]]:
    for i in numbers:
        batch = {name: array for name, array in sampler[i]._asdict().items() if array is not None}
        for row in range(sampler.local_size):
            yield {name: array[row] for name, array in batch.items()}


def _datasets() -> Any:
    try:
        import datasets
    except ImportError as error:
        raise OptionError("Hugging Face datasets are needed: pip install 'icrl4aht-data[hf]'") from error
    return datasets
