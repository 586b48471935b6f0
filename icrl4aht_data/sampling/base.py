"""Base class of the AD and DPT samplers: a sequence of batches of declared shapes, divided among processes."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Mapping
from functools import cached_property
from textwrap import indent
from typing import Any, Generic, SupportsIndex, TypedDict, TypeVar, overload

import numpy as np

from icrl4aht_data.errors import LabelsMissingError, MixedSplitsWarning, OptionError, WeakLabelsWarning, check_choice
from icrl4aht_data.format.schema import are_labels_weak
from icrl4aht_data.reading.history import LABELS, Labels
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.sampling.batches import Batches
from icrl4aht_data.sampling.draws import Curriculum, EpisodeRange, HistoryDraws, Weights, random_uint32
from icrl4aht_data.sampling.observer import ArraySpec, Observer
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.system import new_array
from icrl4aht_data.utils.text import counted_histories, counted_noun, listed_names

A = TypeVar("A")
"""Type of the arrays of a batch: NumPy arrays, JAX arrays on a device, or PyTorch tensors."""

B = TypeVar("B", bound=tuple)
"""A batch: a named tuple of NumPy arrays, some of which may be None. Targets are int64, which PyTorch's losses need."""

D = TypeVar("D", bound=tuple)
"""A batch on a device: a named tuple of JAX arrays, whose integers are int32 unless JAX is set to 64 bits."""

T = TypeVar("T", bound=tuple)
"""A batch for PyTorch: a named tuple of tensors; see `interop.torch_loader`."""


class SamplerOptions(TypedDict, total=False):
    """Options that both samplers share; see `ADSampler` and `DPTSampler`."""

    seed: int
    teammate_actions: bool
    weights: Weights
    episodes: EpisodeRange | None
    curriculum: Curriculum | None
    process_index: int
    process_count: int


class Sampler(Generic[B, D, T]):
    """A sequence of batches, each a pure function of its number; see `ADSampler` and `DPTSampler` for the options.

    `len(sampler)` batches have about as many steps as the selection; larger numbers are valid too.

    Attributes:
        dataset: the selection.
        layouts: the selection's layouts, in order of first appearance.
        batch_size: rows of a batch, over all processes.
        length: steps of a window, or transitions of a context.
        seed: seed of the random draws.
        teammate_actions: whether batches have the teammate's actions.
        process_index, process_count: index of this process, and number of processes.
        local_size: rows of each batch in this process: batch_size / process_count.
    """

    batch_type: type[B]
    length_option = "length"
    """Name of the option that sets `length`, for messages."""

    def __init__(
        self,
        dataset: Selection,
        *,
        batch_size: int,
        length: int,
        seed: int = 0,
        teammate_actions: bool = False,
        weights: Weights = "uniform",
        episodes: EpisodeRange | None = None,
        curriculum: Curriculum | None = None,
        process_index: int = 0,
        process_count: int = 1,
    ) -> None:
        self.batch_size, self.length = check_int("batch_size", batch_size, 1), check_int("length", length, 1)
        self.seed = check_int("seed", seed, 0)
        self.process_index, self.process_count = check_int("process_index", process_index, 0), process_count
        if process_index >= check_int("process_count", process_count, 1) or batch_size % process_count:
            raise OptionError(
                f"process_index = {process_index}, process_count = {process_count}, batch_size = {batch_size}: "
                f"expected an index below the count, and a batch that divides evenly among the processes"
            )
        self.local_size = batch_size // process_count
        self.dataset, self.layouts, self._observer = dataset, dataset.layouts, Observer(dataset)
        # Checked here, since a training run may take the first batch only after an hour of compilation.
        if teammate_actions and not dataset.column("has_teammate_actions").all():
            raise LabelsMissingError(
                "teammate_actions = True: some histories have no teammate actions; leave these histories out by "
                'ds.select(ds.column("has_teammate_actions"))'
            )
        self.teammate_actions = teammate_actions
        self._draws = HistoryDraws(dataset, weights, episodes, curriculum)

    @cached_property
    def specs(self) -> dict[str, ArraySpec]:
        """Dtype and shape of each array of a batch, by field name."""
        raise NotImplementedError

    def __len__(self) -> int:
        # A pass is defined by a number of steps, since windows are drawn with replacement.
        return max(1, int(self._draws.lengths.sum()) // (self.batch_size * self.length))

    def __getitem__(self, index: SupportsIndex) -> B:
        return self.batch(check_int("batch", index, 0))

    def __repr__(self) -> str:
        layouts = ", ".join(layout.name for layout in self.layouts)
        return (
            f"{type(self).__name__}({counted_noun(len(self), 'batch', 'batches')}, batch_size {self.batch_size}, "
            f"{self.length_option} {self.length}, seed {self.seed}, of {counted_histories(len(self.dataset))} on "
            f"{layouts}; each has\n"
            f"{indent(_array_lines(self.specs), '    ')}\n)"
        )

    def __iter__(self) -> Iterator[B]:
        return (self[i] for i in range(len(self)))

    def batch(self, i: int, out: B | None = None) -> B:
        """Return batch number `i`; if a batch from `empty()` is given as `out`, fill and return this batch.

        Raises:
            OptionError: if `out` has another type, shape or dtype, or the batch is larger than the free memory.
        """
        raise NotImplementedError

    def empty(self) -> B:
        """Return a batch of uninitialized arrays to pass to `batch` as `out`: reusing memory is faster.

        Raises:
            OptionError: if an array is larger than the free memory.
        """
        what = f"batch_size = {self.batch_size}, {self.length_option} = {self.length}: "
        arrays = {name: new_array(spec.shape, spec.dtype, what + name) for name, spec in self.specs.items()}
        return self.batch_type(**arrays)

    @overload
    def batches(
        self, start: int = 0, stop: int | None = None, *, prefetch: int = 2, device: None = None, reuse: bool = False
    ) -> Batches[B]: ...

    @overload
    def batches(
        self, start: int = 0, stop: int | None = None, *, prefetch: int = 2, device: Any, reuse: bool = False
    ) -> Batches[D]: ...

    def batches(self, start: int = 0, stop: int | None = None, **options: Any) -> Batches[Any]:
        """Return an iterator over batches from number `start` on, prefetched by a thread; see `Batches`."""
        return Batches(self, start, stop, **options)

    def options(self) -> dict[str, Any]:
        """Return the options that determine the batches, as JSON; `Batches` compares the options when it resumes."""
        return {
            "sampler": type(self).__name__,
            # The ids are hashed, since these options are stored in checkpoints and a selection can have 82,000 ids.
            "selection": hashlib.blake2b(self.dataset.ids.astype("<i8").tobytes(), digest_size=16).hexdigest(),
            "data_version": self.dataset.info.data_version,
            "obs": self.dataset.obs,
            "channels": self.dataset.channels,
            "batch_size": self.batch_size,
            "length": self.length,
            "seed": self.seed,
            "teammate_actions": self.teammate_actions,
            **self._draws.options(),
        }

    def _random(self, i: int, count: int) -> np.ndarray:
        """Return random integers below 2**32 for this process's rows of batch i, uint64 (count, local_size)."""
        # Every process draws all rows, so a batch does not depend on the number of processes.
        first = self.process_index * self.local_size
        return random_uint32(self.seed, i, count, self.batch_size)[:, first : first + self.local_size]

    def _layout_specs(self) -> dict[str, ArraySpec]:
        """Return dtype and shape of the field `layouts`; {} unless batches have state records of several layouts."""
        # Unlike a rendered observation, a state record cannot be interpreted without its layout.
        several = self.dataset.obs == "state" and len(self.layouts) > 1
        return {"layouts": ArraySpec("int32", (self.local_size,))} if several else {}

    def _buffer(self, out: B | None) -> B:
        """Return `out` after checking its arrays, or a new batch if `out` is None; see `empty`."""
        if out is None:
            return self.empty()
        if not isinstance(out, self.batch_type):
            raise OptionError(f"out = {out!r}: expected a batch from sampler.empty()")
        arrays = {name: array for name, array in out._asdict().items() if array is not None}  # type: ignore[attr-defined]
        for array in arrays.values():
            if not (isinstance(array, np.ndarray) and array.flags.c_contiguous and array.flags.writeable):
                raise OptionError("out: expected writeable, C-contiguous arrays; take a batch from sampler.empty()")
        # A narrower dtype would change values without an error, and a larger buffer would keep old values.
        found = {name: ArraySpec(str(array.dtype), array.shape) for name, array in arrays.items()}
        if found != self.specs:
            raise OptionError(f"out: expected {self.specs}, found {found}; take a batch from sampler.empty()")
        return out


def warn_of_mixed_splits(dataset: Selection) -> None:
    """Warn if training histories are sampled together with validation or test histories."""
    counts = dataset.counts("split")
    if "train" in counts and len(counts) > 1:
        warnings.warn(
            f"the histories are of several splits, {dataset.counts_text('split')}: a model trained on them has seen "
            f'the teammates that it is tested with. Choose the training histories: load_icrl4aht(split="train"), or '
            f'ds.filter(split="train")',
            MixedSplitsWarning,
            stacklevel=3,  # shows the line that called Dataset.ad or Dataset.dpt
        )


def check_labels(dataset: Selection, labels: Labels) -> None:
    """Check that all histories of a selection have labels of the given kind, and warn of weak labels.

    Raises:
        UnknownNameError: if `labels` is not a kind of labels.
        LabelsMissingError: if a history does not have the labels; the message names existing labels.
    """
    check_choice("labels", labels, LABELS)
    has = {name: dataset.has_labels(name) for name in LABELS}
    if has[labels].all():
        _warn_of_weak_labels(dataset, labels)
        return
    missing = np.flatnonzero(~has[labels])
    counts = ", ".join(f"{int(has[name].sum())} have {name} actions" for name in LABELS)
    tasks = dataset.column("task_id")[missing]
    advice = f"use labels that all histories have, or ds.select(ds.has_labels({labels!r}))"
    if not any(found.any() for found in has.values()):
        advice = "AD can learn the histories' own actions (labels=None); for labels, choose another release"
    raise LabelsMissingError(
        f"{dataset.index.root}: labels = {labels}: {len(missing)} of {len(dataset)} histories have no {labels} "
        f"actions, in {counted_noun(len(np.unique(tasks)), 'task')} (first: history {dataset.ids[missing[0]]} of task "
        f"{tasks[0]}); {counts}: {advice}"
    )


def _warn_of_weak_labels(dataset: Selection, labels: Labels) -> None:
    """Warn of tasks whose labels come from a policy that earns less than half of the histories' final return.

    The final return is the mean of `return_end` over a task's selected histories; see `schema.are_labels_weak`.
    """
    # All histories of a task have labels with the same return, so one history of each task is enough.
    codes, first, task = np.unique(dataset.column_codes("task_id"), return_index=True, return_inverse=True)
    ends = np.bincount(task, dataset.column("return_end")) / np.bincount(task)
    values = dataset.index.values("task_id")
    names = [values[code] for code in codes.tolist()]
    if labels == "expert":
        earned = dataset.column("expert_return")[first]
        weaker = "ds.column('expert_return') < LEAST"
        advice = f"leave them out by min_expert_return, or, if some returns are unknown, ds.select(~({weaker}))"
    else:
        # The reference is the return with the task's first teammate, so it is no measure if teammates change.
        made = [dataset.provenance.of(name) for name in names]
        earned = np.array([np.nan if one.references is None or one.swaps else one.references.oracle for one in made])
        advice = "leave them out by ds.select(~np.isin(ds.column('task_id'), NAMES))"
    weak = np.flatnonzero(are_labels_weak(earned, ends))
    if not len(weak):
        return
    named = listed_names([f"{names[k]} (labels {earned[k]:.1f}, histories {ends[k]:.1f})" for k in weak.tolist()])
    player = "a policy that earns, acting greedily," if labels == "expert" else "the oracle, which earns"
    warnings.warn(
        f"the {labels} actions of {len(weak)} of {len(codes)} tasks come from {player} less than half of what their "
        f"histories earn at the end: {named}. A model would learn to play worse than its contexts: {advice}",
        WeakLabelsWarning,
        stacklevel=5,  # shows the line that called Dataset.ad or Dataset.dpt
    )


def describe_batch(self: Any) -> str:
    """Return the dtype and shape of each field as text, one field per line."""
    return _array_lines({name: array for name, array in self._asdict().items() if array is not None})


def _array_lines(arrays: Mapping[str, Any]) -> str:
    """Return one line per array with its name, dtype and shape; other objects, such as shardings, are shown as text."""
    width = max(map(len, arrays), default=0)
    shown = {
        name: f"{str(array.dtype).removeprefix('torch.'):<8} {tuple(array.shape)}" if hasattr(array, "dtype") else array
        for name, array in arrays.items()
    }
    return "\n".join(f"{name:<{width}}  {text}" for name, text in shown.items())


def batch_repr(self: Any) -> str:
    """Return a batch's type, and the dtype and shape of each field, as text."""
    return f"{type(self).__name__}(\n{indent(describe_batch(self), '    ')}\n)"
