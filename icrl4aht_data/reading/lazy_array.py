"""An array that is read when it is used, with the operators, comparisons and reductions of NumPy arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import DTypeLike

from icrl4aht_data.errors import OptionError

_BLOCK = 1000  # rows that iteration reads at a time


def _delegated(name: str) -> Callable[..., Any]:
    """Return a method that reads the complete array and calls its method of that name."""

    def method(self: LazyArray, *args: Any, **kwargs: Any) -> Any:
        return getattr(self[:], name)(*args, **kwargs)

    method.__name__, method.__qualname__ = name, f"LazyArray.{name}"
    method.__doc__ = f"Read the complete array and return its `{name}`, see `numpy.ndarray.{name}`."
    return method


class LazyArray(NDArrayOperatorsMixin):
    """An array on disk. Indexing reads the rows it needs; everything else reads the array first.

    Indexing, iteration, operators, comparisons, ufuncs, NumPy's functions and the methods below give what they give for
    the NumPy array `lazy[:]`. Nothing can be assigned: take a copy, `np.array(lazy)`, to change values.

    Args:
        name: the array's name, for messages.
        shape: its shape, with at least one axis.
        dtype: its dtype.
        read: function from a first row and the one after the last to a new array of these rows.

    Attributes:
        shape: the shape; the first axis counts rows.
        dtype: the dtype.
        ndim: number of axes.
        size: number of elements.
        nbytes: bytes of the complete array in memory.
    """

    def __init__(
        self, name: str, shape: tuple[int, ...], dtype: DTypeLike, read: Callable[[int, int], np.ndarray]
    ) -> None:
        self._name, self._rows = name, read
        self.shape, self.dtype = shape, np.dtype(dtype)
        self.ndim, self.size = len(shape), math.prod(shape)
        self.nbytes = self.size * self.dtype.itemsize

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"LazyArray({self._name}, shape={self.shape}, dtype={self.dtype})"

    def __getitem__(self, key: Any) -> Any:
        key = tuple(map(_read, key)) if isinstance(key, tuple) else _read(key)
        first, *rest = key if isinstance(key, tuple) and key else (key,)
        if isinstance(first, slice):
            rows = range(len(self))[first]
            low, high = sorted((rows[0], rows[-1])) if rows else (0, -1)
            return self._rows(low, high + 1)[:: rows.step][(slice(None), *rest)]
        if isinstance(first, (int, np.integer)) and not isinstance(first, bool):  # NumPy reads a bool as a mask
            row = range(len(self))[first]
            return self._rows(row, row + 1)[(0, *rest)]
        return self._rows(0, len(self))[key]

    def __setitem__(self, key: Any, value: Any) -> None:
        raise self._read_only()

    def __iter__(self) -> Iterator[Any]:
        for start in range(0, len(self), _BLOCK):
            yield from self._rows(start, min(start + _BLOCK, len(self)))

    def __contains__(self, value: Any) -> bool:
        return value in self[:]

    def __bool__(self) -> bool:
        if self.size == 1:
            return bool(self[:])
        raise OptionError(f"{self!r} is neither true nor false; use .any() or .all(), or len() for its length")

    def __bytes__(self) -> bytes:
        return self[:].tobytes()

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise OptionError(f"{self!r} is on disk and cannot become an array without a copy; leave out copy=False")
        return self[:].astype(self.dtype if dtype is None else dtype, copy=False)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        outputs = kwargs.get("out", ())
        if any(isinstance(one, LazyArray) for one in outputs) or (method == "at" and isinstance(inputs[0], LazyArray)):
            raise self._read_only()
        return getattr(ufunc, method)(*map(_read, inputs), **_read(kwargs))

    def _read_only(self) -> OptionError:
        return OptionError(f"{self!r} is read-only; change a copy of it: np.array(..)")

    @property
    def T(self) -> np.ndarray:
        """The transposed array, read completely."""
        return self[:].T

    @property
    def flat(self) -> np.flatiter:
        """An iterator over all elements, of the complete array."""
        return self[:].flat

    all = _delegated("all")
    any = _delegated("any")
    argmax = _delegated("argmax")
    argmin = _delegated("argmin")
    argsort = _delegated("argsort")
    astype = _delegated("astype")
    clip = _delegated("clip")
    copy = _delegated("copy")
    cumprod = _delegated("cumprod")
    cumsum = _delegated("cumsum")
    dot = _delegated("dot")
    flatten = _delegated("flatten")
    item = _delegated("item")
    max = _delegated("max")
    mean = _delegated("mean")
    min = _delegated("min")
    nonzero = _delegated("nonzero")
    prod = _delegated("prod")
    ravel = _delegated("ravel")
    repeat = _delegated("repeat")
    reshape = _delegated("reshape")
    round = _delegated("round")
    searchsorted = _delegated("searchsorted")
    squeeze = _delegated("squeeze")
    std = _delegated("std")
    sum = _delegated("sum")
    swapaxes = _delegated("swapaxes")
    take = _delegated("take")
    tobytes = _delegated("tobytes")
    tolist = _delegated("tolist")
    transpose = _delegated("transpose")
    var = _delegated("var")


def _read(value: Any) -> Any:
    """Return a lazy array as an array; in a tuple or a dictionary each of its lazy values; anything else unchanged."""
    if isinstance(value, LazyArray):
        return value[:]
    if type(value) is tuple:
        return tuple(map(_read, value))
    if type(value) is dict:
        return {name: _read(one) for name, one in value.items()}
    return value
