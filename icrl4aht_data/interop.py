"""Adapters from samplers and histories to the data loaders of other libraries.

A sampler is a sequence of batches, each a pure function of its number, so most loaders accept it directly:

    Python loop    for batch in sampler.batches(): ...
    Grain          grain.MapDataset.source(sampler); no shuffling is needed, batches are random already
    PyTorch        torch_loader(sampler, workers=4); needs the extra `torch`
    Hugging Face   hf_index(dataset), hf_episodes(dataset), hf_windows(sampler); need the extra `hf`

`len(sampler)` batches make one pass: together they have as many steps as the selection. Iterating over a sampler again
repeats the same batches. For several passes, use loaders that continue with new batches: `sampler.batches()` never
ends; each pass over `sampler.batches(stop=len(sampler))` or a `torch_loader` continues after the previous pass; for
Grain, use `grain.MapDataset.range(passes * len(sampler)).map(sampler.batch)` (`repeat` would repeat batches).

Targets are int64 everywhere except in JAX, so PyTorch's losses also accept them from `DataLoader(sampler,
batch_size=None)`. Other integers are int32, but int64 in `torch_loader` and `hf_windows`, where targets are -100 on
padding.

Rows of episodes, for example from `datasets.load_dataset(release, "episodes", streaming=True)`, have state records,
which `render_observations(rows)` renders as observations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from icrl4aht_data.errors import NotStoredError, OptionError, check_choice
from icrl4aht_data.overcooked.channels import CHANNELS, Channels, observation_shape
from icrl4aht_data.overcooked.fast_observe import fast_observe
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.reading.arrow_tables import episode_schema, episode_table, index_schema, record_width
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.sampling.ad import ADBatch
from icrl4aht_data.sampling.base import Sampler
from icrl4aht_data.utils.install_hints import import_optional
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.system import new_array

if TYPE_CHECKING:
    import datasets
    from torch.utils.data import DataLoader

T = TypeVar("T", bound=tuple)
"""A batch of PyTorch tensors."""

Rendered = Literal["float32", "uint8"]
RENDERED: tuple[Rendered, ...] = ("float32", "uint8")
"""Dtypes that `render_observations` can return."""

START_METHODS = ("spawn", "forkserver", "fork")
"""Start methods for the worker processes of `torch_loader`."""

IGNORED = -100
"""Target of padding in `torch_loader` and `hf_windows`; PyTorch's cross entropy ignores it."""


def torch_loader(
    sampler: Sampler[Any, Any, T],
    *,
    start: int = 0,
    stop: int | None = None,
    workers: int = 0,
    context: str = "spawn",
    **options: Any,
) -> DataLoader[T]:
    """Return a PyTorch DataLoader that yields a sampler's batches in order, as named tuples of tensors.

    Tensors fit PyTorch's losses and embeddings: integers are int64 (observations keep their dtype), and
    `target_actions` are -100 on padding, which `F.cross_entropy` ignores. So `F.cross_entropy(logits, targets)` is
    correct for logits (B, 6, L), or (B, 6) for `query_target`. Absent fields are None.

    Each pass over the loader, `for batch in loader`, continues after the last batch of the previous pass, even if that
    pass was stopped early. `len(loader)` is the number of batches of the next pass. Passes end at multiples of
    `len(sampler)`; with `stop`, the first pass has the batches start..stop - 1, and each later pass has equally many
    batches.

    With workers, load the dataset with cache="mmap" or "stream": with "ram" each spawned worker decodes its own copy.
    Batches are random already, so DataLoader must not shuffle. To resume, pass the number of the next batch as `start`.

    Args:
        sampler: the sampler that makes the batches.
        start: number of the first batch.
        stop: number after the last batch of the first pass; the next multiple of `len(sampler)` by default.
        workers: number of worker processes, which stay alive between passes; with 0, this process makes the batches.
        context: "spawn", "forkserver" or "fork". Use "fork" only if this process has no threads; JAX starts threads.
        options: further options of DataLoader, such as prefetch_factor or pin_memory.

    Raises:
        OptionError: if PyTorch is not installed, `sampler` is not a sampler, or a number is out of range.
        UnknownNameError: if `context` is not one of `START_METHODS`.
    """
    loader = import_optional("torch.utils.data", "a DataLoader").DataLoader
    numbers, per_pass = _batch_numbers(sampler, start, stop), len(sampler)
    check_choice("context", context, START_METHODS)
    if stop is None:
        numbers = range(numbers.start, (numbers.start // per_pass + 1) * per_pass)
    if workers and sampler.dataset.cache.cache != "stream":
        _ = sampler.dataset.storage  # decode once in this process; workers map the files or inherit the arrays
    processes = {"multiprocessing_context": context, "persistent_workers": True} if workers else {}
    return loader(
        sampler,
        batch_size=None,
        sampler=_BatchNumberSampler(numbers, per_pass if stop is None else len(numbers)),
        num_workers=check_int("workers", workers, 0),
        **{"collate_fn": _to_tensors, **processes, **options},
    )


def _batch_numbers(sampler: Sampler, start: int, stop: int | None) -> range:
    """Return the range of batch numbers from `start` to `stop` - 1; `stop` is `len(sampler)` by default.

    Raises:
        OptionError: if `sampler` is not a sampler, or a number is out of range.
    """
    if not isinstance(sampler, Sampler):
        raise OptionError(f"sampler = {sampler!r}: expected a sampler, such as ds.ad(batch_size=16, length=100)")
    start = check_int("start", start, 0)
    return range(start, len(sampler) if stop is None else check_int("stop", stop, start))


class _BatchNumberSampler:
    """Sampler of batch numbers for a DataLoader; each iteration continues after the previous one.

    Args:
        numbers: numbers of the batches of the first pass.
        size: number of batches of each later pass.
    """

    def __init__(self, numbers: range, size: int) -> None:
        self._numbers, self._size = numbers, size

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[int]:
        # This is a generator, because with workers, DataLoader makes two iterators in its first pass but uses only one.
        numbers = self._numbers
        self._numbers = range(numbers.stop, numbers.stop + self._size)
        yield from numbers


def _to_tensors(batch: Any) -> Any:
    """Convert a batch to tensors with the dtypes that PyTorch's losses need."""
    return import_module("torch.utils.data").default_convert(_prepare_for_losses(batch))


def _prepare_for_losses(batch: Any) -> Any:
    """Convert the int32 arrays of a batch to int64, and set the targets of padding to `IGNORED`."""
    present = {name: array for name, array in batch._asdict().items() if array is not None}
    arrays = {name: array.astype(np.int64) if array.dtype == np.int32 else array for name, array in present.items()}
    if isinstance(batch, ADBatch):
        arrays["target_actions"] = np.where(batch.attention_mask, batch.target_actions, IGNORED)
    return batch._replace(**arrays)


def hf_index(dataset: Selection) -> datasets.Dataset:
    """Return the selection's index entries as a `datasets.Dataset`: one row per history, with the columns of `Entry`.

    Raises:
        OptionError: if `datasets` is not installed.
    """
    library = _import_datasets()
    features = library.Features.from_arrow_schema(index_schema())
    return library.Dataset.from_list([entry.to_row() for entry in dataset.entries], features=features)


def hf_episodes(dataset: Selection) -> datasets.Dataset:
    """Return the selection's episodes as a `datasets.Dataset`, one row for each episode, in order.

    Rows have the form of the configuration `episodes` of a published release, with state records padded to the longest
    record of the selection's layouts. For the columns and their types see `arrow_tables.EPISODE_COLUMNS`: ids, names
    and return; lists with one element for each step, rewards, actions, teammate_actions, expert_actions and
    oracle_actions (null if the history has none) and state (bytes of the state record); and episode_end_state.

    Raises:
        NotStoredError: for a release of observations.
        OptionError: if `datasets` is not installed.
    """
    if not dataset.has_states:
        raise NotStoredError(f"{dataset.root}: has observations only, no state records; use hf_windows")
    library = _import_datasets()
    features = library.Features.from_arrow_schema(episode_schema(dataset))
    return library.Dataset.from_generator(_episode_rows, features=features, gen_kwargs={"dataset": dataset})


def _episode_rows(dataset: Selection) -> Iterator[dict[str, Any]]:
    schema = episode_schema(dataset)
    for history in dataset:
        yield from episode_table(history, schema).to_pylist()


def render_observations(
    rows: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    *,
    channels: Channels = "own",
    obs: Rendered = "float32",
) -> np.ndarray:
    """Render the ego's observations from rows of `hf_episodes`, or of a release's Parquet files of episodes.

    With `datasets`, render while reading: `rows.map(lambda batch: {"obs": render_observations(batch)}, batched=True)`.

    Args:
        rows: one row, several rows, or a batch of `datasets`, which is a mapping of columns. Only the columns `layout`
            and `state` are read; their values may be lists or arrays.
        channels: channels of the observations; see `channels.CHANNELS`. With "own", the layouts of all rows must have
            the same number of channels.
        obs: dtype of the observations.

    Returns:
        Array of shape (T, 5, 5, C) for one row with an episode of T steps, or (B, T, 5, 5, C) for B rows.

    Raises:
        UnknownNameError: for channels, a dtype or a layout that does not exist.
        OptionError: if `rows` is empty or does not contain rows, if layouts have different numbers of channels, or if a
            record is too short for its layout.
        NotStoredError: for rows without state records, as in a release of observations.
    """
    check_choice("channels", channels, CHANNELS)
    check_choice("obs", obs, RENDERED)
    if isinstance(rows, Mapping) and isinstance(rows.get("layout"), str):
        return render_observations([rows], channels=channels, obs=obs)[0]
    names = _read_column(rows, "layout")
    if not isinstance(names, Iterable):
        raise OptionError(f"layout = {names!r}: expected the name of a layout for each row")
    layouts, canonical = list(map(get_layout, names)), channels == "canonical"
    shapes = {observation_shape(layout, canonical): layout for layout in layouts}
    if len(shapes) != 1:
        found = ", ".join(f"{layout.name} {shape}" for shape, layout in shapes.items())
        raise OptionError(
            f"observations of {len(layouts)} rows: expected one shape, found {found or 'none'}: give at least one row, "
            f'and use channels="canonical" for rows of several layouts'
        )
    try:
        records = np.asarray(_read_column(rows, "state"), np.uint8)
    except (TypeError, ValueError, OverflowError) as error:  # unequal lengths, or values that are not bytes
        raise OptionError(f"state: expected bytes of equally long episodes: {error}") from error
    longest = record_width(layouts)
    if records.ndim != 3 or records.shape[-1] < longest:
        raise OptionError(f"state: expected shape (B, T, S) with S at least {longest}, found {records.shape}")
    out = new_array((*records.shape[:2], *next(iter(shapes))), obs, f"observations of {len(layouts)} episodes")
    for layout, record, seen in zip(layouts, records, out, strict=True):
        fast_observe(layout, record[:, : record_size(layout)], seen, canonical=canonical)
    return out


def _read_column(rows: Mapping[str, Any] | Sequence[Mapping[str, Any]], name: str) -> Any:
    try:
        return rows[name] if isinstance(rows, Mapping) else [row[name] for row in rows]
    except TypeError as error:
        raise OptionError(
            f"rows = {str(rows)[:80]!r}: expected rows of episodes, such as hf_episodes(ds)[:8]"
        ) from error
    except KeyError as error:
        raise NotStoredError(
            f"rows without a column {name!r}: expected rows of hf_episodes, or of the configuration `episodes` of a "
            f"full or lite release; a release of observations has no state records: use hf_windows"
        ) from error


def hf_windows(sampler: Sampler, start: int = 0, stop: int | None = None) -> datasets.IterableDataset:
    """Return the rows of batches `start` to `stop` - 1 as a `datasets.IterableDataset`, one column per batch field.

    Integers are int64 except in observations, and `target_actions` are -100 on padding, as in `torch_loader`. Rows hold
    NumPy arrays. The result declares no `features`: with features, `datasets` would convert one-dimensional arrays to
    lists, and its format "numpy" would convert uint8 to int64.

    The `state_dict` of the result resumes after the last row taken. A second pass has the same rows.

    Args:
        sampler: the sampler that makes the batches.
        start: number of the first batch.
        stop: number after the last batch; `len(sampler)` by default.

    Raises:
        OptionError: if `datasets` is not installed, `sampler` is not a sampler, or a number is out of range.
    """
    numbers = list(_batch_numbers(sampler, start, stop))
    library = _import_datasets()
    return library.IterableDataset.from_generator(_window_rows, gen_kwargs={"sampler": sampler, "numbers": numbers})


def _window_rows(sampler: Sampler, numbers: list[int]) -> Iterator[dict[str, np.ndarray]]:
    for i in numbers:
        batch = {name: array for name, array in _prepare_for_losses(sampler[i])._asdict().items() if array is not None}
        for row in range(sampler.local_size):
            yield {name: array[row] for name, array in batch.items()}


def _import_datasets() -> Any:
    return import_optional("datasets", "a data set of Hugging Face")
