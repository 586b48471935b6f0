"""Prefetching of batches on a thread, with optional copies to a JAX device."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.install_hints import import_optional
from icrl4aht_data.utils.options import check_int

if TYPE_CHECKING:
    from icrl4aht_data.sampling.base import Sampler

B = TypeVar("B")


class Batches(Iterator[B], Generic[B]):
    """An iterator over a sampler's batches from number `start` on, prefetched by a thread.

    After `break`, a new loop continues with the next batch. `len(sampler)` batches have as many steps as the selection:
    one pass over the data on average. With `stop`, a loop ends after batch `stop - 1`, and each further loop has the
    next `stop - start` batches, as in `interop.torch_loader`.

    Exceptions in the thread are raised by `next`. The thread stops at the end of a `with` block, after `close()` and at
    the end of the iterator. Threads do not survive a fork: make a new iterator in the forked process.

    Args:
        sampler: the sampler that makes the batches.
        start: number of the first batch.
        stop: number after the last batch of the first loop; None for an endless iterator.
        prefetch: number of batches prepared in advance; with 0, `next` makes each batch itself, without a thread.
        device: a jax.Device or Sharding to which batches are copied as JAX arrays, while the previous batch is in use.
            If a sharding spans processes, each process contributes its share of the rows. Needs JAX.
        reuse: fill the same few buffers again and again, which is faster than allocating memory. A batch is then valid
            only until the next one is taken. With a device, host buffers are always reused.

    Attributes:
        next: number of the next batch.
        served: number of batches taken.
        waited: seconds that `next` has waited for batches.

    Raises:
        OptionError: for impossible options, for a device if JAX is not installed, or for `next` in a forked process.
    """

    def __init__(
        self,
        sampler: Sampler[Any, Any, Any],
        start: int = 0,
        stop: int | None = None,
        *,
        prefetch: int = 2,
        device: Any = None,
        reuse: bool = False,
    ) -> None:
        self._sampler = sampler
        self._stop = None if stop is None else check_int("stop", stop, 0)
        self._prefetch = check_int("prefetch", prefetch, 0)
        self._put = _device_put(device) if device is not None else None
        self._reuse = reuse or device is not None
        self.next, self.served, self.waited = check_int("start", start, 0), 0, 0.0
        self._per_pass = 0 if self._stop is None else max(0, self._stop - self.next)
        self._closed, self._ended, self._process = False, False, os.getpid()
        self._pool: ThreadPoolExecutor | None = None  # set at the first batch; until then, the iterator can be pickled
        self._pending: deque[tuple[Future[B], B | None]] = deque()  # submitted batches with their buffers
        self._free: list[B] = []
        self._lent: B | None = None  # buffer of the batch in use by the consumer

    def __iter__(self) -> Batches[B]:
        # A new pass starts only if a loop reached the end. After loading a position at the end, the next loop is empty.
        if self._ended and self._stop is not None and self._per_pass:
            self._stop += (self.next - self._stop) // self._per_pass * self._per_pass + self._per_pass
            self._closed = self._ended = False
        return self

    def __repr__(self) -> str:
        end = "" if self._stop is None else f" of those below {self._stop}"
        state = "closed" if self._closed else f"next is batch {self.next}{end}"
        return f"Batches({state}; {self.served} taken, waited {self.waited:.1f} s) of {self._sampler!r}"

    def __next__(self) -> B:
        if not self._closed and self._stop is not None and self.next >= self._stop:
            self.close()
            self._ended = True
        if self._closed:
            raise StopIteration
        if self._process != os.getpid():
            raise OptionError(
                f"this iterator belongs to process {self._process}; its thread does not exist in this forked process: "
                f"make a new iterator here with sampler.batches(start={self.next}), or take sampler[{self.next}]"
            )
        started = time.perf_counter()
        if self._lent is not None:
            self._free.append(self._lent)
            self._lent = None
        try:
            batch = self._take()
        except BaseException:
            self.close()
            raise
        self.waited += time.perf_counter() - started
        self.served += 1
        self.next += 1
        return batch

    def _take(self) -> B:
        """Return the next batch; the thread prepares the following batches."""
        if not self._prefetch:
            buffer = self._buffer()
            batch = _make_batch(self._sampler, self.next, buffer, self._put)
        else:
            # A batch is taken before another is submitted, so `prefetch + 1` buffers are enough.
            self._submit(self.next)
            future, buffer = self._pending.popleft()
            self._submit(self.next + 1)
            batch = future.result()
        if self._put is None:
            self._lent = buffer
        return batch

    def _submit(self, first: int) -> None:
        """Submit batches to the thread until `prefetch` batches are pending, from number `first` on."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="icrl4aht-prefetch")
        stop = first + self._prefetch
        for i in range(first + len(self._pending), stop if self._stop is None else min(stop, self._stop)):
            buffer = self._buffer()
            self._pending.append((self._pool.submit(_make_batch, self._sampler, i, buffer, self._put), buffer))

    def _buffer(self) -> B | None:
        """Return a buffer for the next batch, or None if buffers are not reused."""
        if not self._reuse:
            return None
        buffer = self._free.pop() if self._free else self._sampler.empty()
        if self._put is not None:
            self._free.append(buffer)  # the thread copies a batch to the device before it makes the next batch
        return buffer

    def close(self) -> None:
        """Stop the thread and discard prefetched batches; afterwards the iterator is exhausted, also for new loops."""
        self._closed, self._ended = True, False
        self._stop_thread()

    def _stop_thread(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None
        self._pending.clear()
        self._free.clear()
        self._lent = None

    def __enter__(self) -> Batches[B]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state_dict(self) -> dict[str, Any]:
        """Return the position as JSON: the number of the next batch, and the sampler's options."""
        return {"next": self.next, **self._sampler.options()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the position at which `state_dict` was called.

        Raises:
            OptionError: if the sampler's options or selection differ from the state; the message names the differences.
        """
        if not isinstance(state, Mapping):
            raise OptionError(f"state = {state!r:.100}: expected the result of state_dict()")
        expected, given = self._sampler.options(), {name: value for name, value in state.items() if name != "next"}
        if "channels" in expected:
            given.setdefault("channels", "own")  # states of version 0.1 have no `channels`
        if "order" in expected:
            given.setdefault("labels", "expert")  # older DPT states have no `labels`; labels were always "expert"
        wrong = [name for name in expected.keys() | given.keys() if expected.get(name) != given.get(name)]
        if wrong or "next" not in state:
            found = ", ".join(f"{name} = {given.get(name)!r}, not {expected.get(name)!r}" for name in sorted(wrong))
            raise OptionError(f"the state belongs to a different sampler: it has {found or 'no `next`'}")
        self._stop_thread()
        self._closed = self._ended = False
        self.next = check_int("next", state["next"], 0)


# A function, not a method: a reference from the thread to the iterator would keep an abandoned iterator alive.
def _make_batch(sampler: Sampler[Any, Any, Any], i: int, buffer: B | None, put: Callable[[B], B] | None) -> B:
    batch = sampler.batch(i, buffer)
    return batch if put is None else put(batch)


def _device_put(device: Any) -> Callable[[Any], Any]:
    """Return a function that copies a batch to a device."""
    jax = import_optional("jax", "a device")
    if not isinstance(device, (jax.Device, jax.sharding.Sharding)):
        raise OptionError(f"device = {device!r}: expected a device or a sharding of JAX, such as jax.devices()[0]")

    def put_array(x: Any) -> Any:
        if getattr(device, "is_fully_addressable", True):
            return jax.numpy.array(x, copy=True, device=device)
        return jax.make_array_from_process_local_data(device, x.copy())

    def put_batch(batch: Any) -> Any:
        # jax.device_put may use the host buffer later, but the buffer is refilled as soon as this function returns.
        return jax.block_until_ready(jax.tree.map(put_array, batch))

    return put_batch
