"""Samplers and histories for the data loaders of other libraries.

A sampler is a sequence of batches, each a pure function of its number, so most loaders accept it directly:

    plain loop     for batch in sampler.batches(): ...
    Grain          grain.MapDataset.source(sampler); no shuffling is needed, batches are random already
    PyTorch        torch_loader(sampler, workers=4); needs the extra `torch`
    Hugging Face   hf_index(dataset), hf_episodes(dataset), hf_windows(sampler); need the extra `hf`

`len(sampler)` batches make one pass: together they have as many steps as the selection. Reading a sampler again gives
equal batches, so for several passes take loaders that continue: `sampler.batches()` never ends, each pass over
`sampler.batches(stop=len(sampler))` or a `torch_loader` continues after the previous one, and for Grain there is
`grain.MapDataset.range(passes * len(sampler)).map(sampler.batch)` (`repeat` would repeat batches).

Targets are int64 everywhere but in JAX, so PyTorch's losses take them from `DataLoader(sampler, batch_size=None)`, too.
Other integers are int32, and int64 from `torch_loader` and `hf_windows`, where targets are -100 on padding.

Rows of episodes have state records, also rows from `datasets.load_dataset(release, "episodes", streaming=True)`;
`render_observations(rows)` renders them as observations.
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
"""Ways in which `torch_loader` can start its processes."""

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
    """Return a DataLoader over a sampler's batches as named tuples of tensors, in order for any number of workers.

    Tensors fit PyTorch's losses and embeddings: integers are int64 (observations keep their dtype), and
    `target_actions` are -100 on padding, which `F.cross_entropy` ignores. So `F.cross_entropy(logits, targets)` is
    correct for logits (B, 6, L), or (B, 6) for `query_target`. Absent fields are None.

    Each pass over the loader, `for batch in loader`, continues after the last batch of the previous pass, even if that
    was left early. `len(loader)` is the number of batches of the next pass. Passes end at multiples of `len(sampler)`;
    with `stop`, the first one has the batches start..stop - 1 and each further one as many.

    With workers, load the dataset with cache="mmap" or "stream": with "ram" each spawned worker decodes its own copy.
    Batches are random already, so DataLoader must not shuffle. To resume, pass the number of the next batch as `start`.

    Args:
        sampler: makes the batches.
        start: number of the first batch.
        stop: number after the last batch of the first pass; the next multiple of `len(sampler)` by default.
        workers: number of processes, which are kept between passes; 0 makes batches in this process.
        context: "spawn", "forkserver" or "fork". Fork only while the process runs no threads, including JAX's.
        options: further options of DataLoader, such as prefetch_factor or pin_memory.

    Raises:
        OptionError: if PyTorch is not installed, for anything but a sampler, or for impossible numbers.
        UnknownNameError: for another `context`.
    """
    loader = import_optional("torch.utils.data", "a DataLoader").DataLoader
    numbers, per_pass = _numbers(sampler, start, stop), len(sampler)
    check_choice("context", context, START_METHODS)
    if stop is None:
        numbers = range(numbers.start, (numbers.start // per_pass + 1) * per_pass)
    if workers and sampler.dataset.cache.cache != "stream":
        _ = sampler.dataset.storage  # decode once in this process; workers map the files or inherit the arrays
    processes = {"multiprocessing_context": context, "persistent_workers": True} if workers else {}
    return loader(
        sampler,
        batch_size=None,
        sampler=_Passes(numbers, per_pass if stop is None else len(numbers)),
        num_workers=check_int("workers", workers, 0),
        **{"collate_fn": _to_tensors, **processes, **options},
    )


def _numbers(sampler: Sampler, start: int, stop: int | None) -> range:
    """Return the range of batch numbers start..stop; `stop` is `len(sampler)` by default.

    Raises:
        OptionError: for anything but a sampler, or for impossible numbers.
    """
    if not isinstance(sampler, Sampler):
        raise OptionError(f"sampler = {sampler!r}: expected a sampler, such as ds.ad(batch_size=16, length=100)")
    start = check_int("start", start, 0)
    return range(start, len(sampler) if stop is None else check_int("stop", stop, start))


class _Passes:
    """Sampler of batch numbers for a DataLoader; each iteration continues after the previous one.

    Args:
        numbers: batches of the first pass.
        size: batches of each further pass.
    """

    def __init__(self, numbers: range, size: int) -> None:
        self._numbers, self._size = numbers, size

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[int]:
        # A generator: with workers, DataLoader makes two iterators in its first pass but uses only one.
        numbers = self._numbers
        self._numbers = range(numbers.stop, numbers.stop + self._size)
        yield from numbers


def _to_tensors(batch: Any) -> Any:
    """Return a batch as tensors in PyTorch's dtypes."""
    return import_module("torch.utils.data").default_convert(_for_losses(batch))


def _for_losses(batch: Any) -> Any:
    """Return a batch with int64 instead of int32, and `IGNORED` targets on padding."""
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
    library = _datasets()
    features = library.Features.from_arrow_schema(index_schema())
    return library.Dataset.from_list([entry.to_row() for entry in dataset.entries], features=features)


def hf_episodes(dataset: Selection) -> datasets.Dataset:
    """Return the selection's episodes as a `datasets.Dataset`, one row for each episode, in order.

    The rows are those of the configuration `episodes` of a published release, with records as wide as the longest one
    of the selection's layouts. For the columns and their types see `arrow_tables.EPISODE_COLUMNS`: ids, names and
    return; lists with one element for each step, rewards, actions, teammate_actions, expert_actions and oracle_actions
    (null if the history has none) and state (bytes of the state record); and episode_end_state.

    Raises:
        NotStoredError: for a release of observations.
        OptionError: if `datasets` is not installed.
    """
    if not dataset.has_states:
        raise NotStoredError(f"{dataset.root}: has observations only, no state records; take hf_windows")
    library = _datasets()
    features = library.Features.from_arrow_schema(episode_schema(dataset))
    return library.Dataset.from_generator(_episodes, features=features, gen_kwargs={"dataset": dataset})


def _episodes(dataset: Selection) -> Iterator[dict[str, Any]]:
    schema = episode_schema(dataset)
    for history in dataset:
        yield from episode_table(history, schema).to_pylist()


def render_observations(
    rows: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    *,
    channels: Channels = "own",
    obs: Rendered = "float32",
) -> np.ndarray:
    """Return the ego's observations in episodes of the configuration `episodes`, or of `hf_episodes`.

    With `datasets`, render while reading: `rows.map(lambda batch: {"obs": render_observations(batch)}, batched=True)`.

    Args:
        rows: one row; several rows; or a batch as `datasets` gives it, a mapping of columns. Of their columns only
            `layout` and `state` are read, lists or arrays.
        channels: channels of the observations; see `channels.CHANNELS`. With own channels, all rows must have
            layouts with equally many channels.
        obs: the dtype.

    Returns:
        (T, 5, 5, C) for one row, T the steps of an episode; (B, T, 5, 5, C) for B rows.

    Raises:
        UnknownNameError: for channels, a dtype or a layout that does not exist.
        OptionError: for no rows, layouts with different numbers of channels, records too short for their layout, or
            an argument that is not rows.
        NotStoredError: for rows without state records, as in a release of observations.
    """
    check_choice("channels", channels, CHANNELS)
    check_choice("obs", obs, RENDERED)
    if isinstance(rows, Mapping) and isinstance(rows.get("layout"), str):
        return render_observations([rows], channels=channels, obs=obs)[0]
    names = _column(rows, "layout")
    if not isinstance(names, Iterable):
        raise OptionError(f"layout = {names!r}: expected the name of a layout for each row")
    layouts, canonical = list(map(get_layout, names)), channels == "canonical"
    shapes = {observation_shape(layout, canonical): layout for layout in layouts}
    if len(shapes) != 1:
        found = ", ".join(f"{layout.name} {shape}" for shape, layout in shapes.items())
        raise OptionError(
            f"observations of {len(layouts)} rows: expected one shape, found {found or 'none'}: give at least one row, "
            f'and take channels="canonical" for rows of several layouts'
        )
    try:
        records = np.asarray(_column(rows, "state"), np.uint8)
    except (TypeError, ValueError, OverflowError) as error:  # nested lists of unequal length, or not bytes
        raise OptionError(f"state: expected bytes of equally long episodes: {error}") from error
    longest = record_width(layouts)
    if records.ndim != 3 or records.shape[-1] < longest:
        raise OptionError(f"state: expected (B, T, S) with S at least {longest}, found {records.shape}")
    out = new_array((*records.shape[:2], *next(iter(shapes))), obs, f"observations of {len(layouts)} episodes")
    for layout, record, seen in zip(layouts, records, out, strict=True):
        fast_observe(layout, record[:, : record_size(layout)], seen, canonical=canonical)
    return out


def _column(rows: Mapping[str, Any] | Sequence[Mapping[str, Any]], name: str) -> Any:
    try:
        return rows[name] if isinstance(rows, Mapping) else [row[name] for row in rows]
    except TypeError as error:
        raise OptionError(
            f"rows = {str(rows)[:80]!r}: expected rows of episodes, such as hf_episodes(ds)[:8]"
        ) from error
    except KeyError as error:
        raise NotStoredError(
            f"rows without a column {name!r}: expected rows of the configuration `episodes`, or of hf_episodes, of a "
            f"full or lite release; for a release of observations, which has no state records, take hf_windows"
        ) from error


def hf_windows(sampler: Sampler, start: int = 0, stop: int | None = None) -> datasets.IterableDataset:
    """Return the rows of batches start..stop as a `datasets.IterableDataset`, with the columns of the batch.

    Integers are int64, and `target_actions` are -100 on padding, as in `torch_loader`. Rows hold NumPy arrays of the
    batch's dtypes. The result declares no `features`: with them, `datasets` makes lists of one-dimensional arrays, and
    its format "numpy" makes int64 of uint8.

    The `state_dict` of the result resumes after the last row taken. A second pass has the same rows.

    Args:
        sampler: makes the batches.
        start: number of the first batch.
        stop: number after the last batch; `len(sampler)` by default.

    Raises:
        OptionError: if `datasets` is not installed, for anything but a sampler, or for impossible numbers.
    """
    numbers = list(_numbers(sampler, start, stop))
    library = _datasets()
    return library.IterableDataset.from_generator(_windows, gen_kwargs={"sampler": sampler, "numbers": numbers})


def _windows(sampler: Sampler, numbers: list[int]) -> Iterator[dict[str, np.ndarray]]:
    for i in numbers:
        batch = {name: array for name, array in _for_losses(sampler[i])._asdict().items() if array is not None}
        for row in range(sampler.local_size):
            yield {name: array[row] for name, array in batch.items()}


def _datasets() -> Any:
    return import_optional("datasets", "a data set of Hugging Face")
