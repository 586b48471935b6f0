"""Samplers and histories for the data loaders of other libraries.

A sampler is a sequence of batches, each a pure function of its number, so most loaders accept it directly:

    plain loop     for batch in sampler.batches(): ...
    Grain          grain.MapDataset.source(sampler); no shuffling is needed, batches are random already
    PyTorch        torch_loader(sampler, workers=4); needs the extra `torch`
    Hugging Face   hf_index(dataset), hf_episodes(dataset), hf_windows(sampler); need the extra `hf`
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from icrl4aht_data.errors import NotStoredError, OptionError
from icrl4aht_data.format.schema import ACTION_FIELDS, FIELDS
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.sampling.ad import ADBatch, ADSampler
from icrl4aht_data.sampling.base import Sampler
from icrl4aht_data.sampling.dpt import DPTBatch, DPTSampler
from icrl4aht_data.utils.installation import install_command
from icrl4aht_data.utils.validation import check_int

if TYPE_CHECKING:
    import datasets
    import torch
    from torch.utils.data import DataLoader

IGNORED = -100
"""The target of padding in `torch_loader` and `hf_windows`: the number that PyTorch's cross entropy ignores."""


@overload
def torch_loader(
    sampler: ADSampler,
    *,
    start: int = 0,
    stop: int | None = None,
    workers: int = 0,
    context: str = "spawn",
    **options: Any,
) -> DataLoader[ADBatch[torch.Tensor]]: ...


@overload
def torch_loader(
    sampler: DPTSampler,
    *,
    start: int = 0,
    stop: int | None = None,
    workers: int = 0,
    context: str = "spawn",
    **options: Any,
) -> DataLoader[DPTBatch[torch.Tensor]]: ...


def torch_loader(
    sampler: Sampler,
    *,
    start: int = 0,
    stop: int | None = None,
    workers: int = 0,
    context: str = "spawn",
    **options: Any,
) -> DataLoader[Any]:
    """Return a DataLoader over batches start..stop as named tuples of tensors, in order for any number of workers.

    The tensors are what PyTorch's losses and embeddings take: integers are int64 (observations keep their dtype), and
    `target_actions` are -100 on padding, which `F.cross_entropy` ignores. So `F.cross_entropy(logits, targets)` is
    right as it is for logits (B, 6, L), or (B, 6) for `query_target`. Fields that a batch does not have are None.

    With workers, load the dataset with cache="mmap" or "stream": with "ram" each spawned worker decodes its own copy.
    Batches are random already, so DataLoader must not shuffle. To resume, pass the number of the next batch as `start`.

    Args:
        sampler: makes the batches.
        start: number of the first batch.
        stop: number after the last batch; `len(sampler)` by default.
        workers: number of processes, which are kept between epochs; 0 makes batches in this process.
        context: "spawn", "forkserver" or "fork". Fork only while the process runs no threads, including JAX's.
        options: further options of DataLoader, such as prefetch_factor or pin_memory.

    Raises:
        OptionError: if PyTorch is not installed, or for numbers that are not integers from 0.
    """
    try:
        from torch.utils.data import DataLoader
    except ImportError as error:
        raise OptionError(f"a DataLoader needs PyTorch: {install_command('torch')}") from error
    numbers = range(check_int("start", start, 0), len(sampler) if stop is None else check_int("stop", stop, 0))
    if workers and sampler.dataset.cache.cache != "stream":
        _ = sampler.dataset.storage  # decoded here once: mapped by the workers, or inherited by forked ones
    processes = {"multiprocessing_context": context, "persistent_workers": True} if workers else {}
    return DataLoader(
        _TorchBatches(sampler),  # type: ignore[arg-type]
        batch_size=None,
        sampler=numbers,
        num_workers=check_int("workers", workers, 0),
        **processes,  # type: ignore[arg-type]
        **options,
    )


class _TorchBatches:
    """The batches of a sampler, in PyTorch's dtypes. DataLoader makes tensors of the arrays."""

    def __init__(self, sampler: Sampler) -> None:
        self._sampler = sampler

    def __len__(self) -> int:
        return len(self._sampler)

    def __getitem__(self, i: int) -> Any:
        return _for_losses(self._sampler[i])


def _for_losses(batch: Any) -> Any:
    """A batch with int64 for int32, and targets that losses ignore on padding."""
    present = {name: array for name, array in batch._asdict().items() if array is not None}
    arrays = {name: array.astype(np.int64) if array.dtype == np.int32 else array for name, array in present.items()}
    if isinstance(batch, ADBatch):
        arrays["target_actions"][~batch.attention_mask] = IGNORED
    return batch._replace(**arrays)


def hf_index(dataset: Selection) -> datasets.Dataset:
    """The selection's index entries as a `datasets.Dataset`, one row for each history, with the columns of `Entry`.

    Raises:
        OptionError: if `datasets` is not installed.
    """
    return _datasets().Dataset.from_list([entry.to_json() for entry in dataset.entries])


def hf_episodes(dataset: Selection) -> datasets.Dataset:
    """The selection's episodes as a `datasets.Dataset`, one row for each episode, in order.

    Columns: history_id, task_id, layout, episode (number in its history, from 0), return, and lists with one element
    for each step: actions, teammate_actions, rewards, expert_actions and oracle_actions (null if the history has none)
    and state (bytes of the state record; see `overcooked.state`).

    Raises:
        NotStoredError: for a release of observations.
        OptionError: if `datasets` is not installed.
    """
    if not dataset.has_states:
        raise NotStoredError(f"{dataset.root}: has observations only, no state records; take hf_windows")
    library = _datasets()
    step = {name: library.List(library.Value("int8")) for name in ACTION_FIELDS}
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


def _episodes(dataset: Selection) -> Iterator[dict[str, Any]]:
    for history in dataset:
        entry = history.entry
        present = [name for name in ACTION_FIELDS if entry.has(FIELDS[name])]
        arrays = {name: history.read(name) for name in (*present, "rewards", "dones", "state")}
        ends = np.flatnonzero(arrays.pop("dones")) + 1
        for episode, (start, stop) in enumerate(zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True)):
            part = {name: array[start:stop] for name, array in arrays.items()}
            yield {
                "history_id": entry.history_id,
                "task_id": entry.task_id,
                "layout": entry.layout,
                "episode": episode,
                "return": float(part["rewards"].sum()),
                **dict.fromkeys(ACTION_FIELDS),
                **part,
                "state": [record.tobytes() for record in part["state"]],
            }


def hf_windows(sampler: Sampler, start: int = 0, stop: int | None = None) -> datasets.IterableDataset:
    """The rows of batches start..stop as a `datasets.IterableDataset`, with the columns of the batch.

    Integers are int64, and `target_actions` are -100 on padding, as in `torch_loader`.

    The `state_dict` of the result resumes after the last row taken.

    Args:
        sampler: makes the batches.
        start: number of the first batch.
        stop: number after the last batch; `len(sampler)` by default.

    Raises:
        OptionError: if `datasets` is not installed, or for numbers that are not integers from 0.
    """
    numbers = list(range(check_int("start", start, 0), len(sampler) if stop is None else check_int("stop", stop, 0)))
    library = _datasets()
    return library.IterableDataset.from_generator(_windows, gen_kwargs={"sampler": sampler, "numbers": numbers})


def _windows(sampler: Sampler, numbers: list[int]) -> Iterator[dict[str, np.ndarray]]:
    for i in numbers:
        batch = {name: array for name, array in _for_losses(sampler[i])._asdict().items() if array is not None}
        for row in range(sampler.local_size):
            yield {name: array[row] for name, array in batch.items()}


def _datasets() -> Any:
    try:
        import datasets
    except ImportError as error:
        raise OptionError(f"Hugging Face datasets are needed: {install_command('hf')}") from error
    return datasets
