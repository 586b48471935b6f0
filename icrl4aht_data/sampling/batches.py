"""Batches made ahead of their use, on a thread, and put on a device if one is asked for."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.validation import check_int

if TYPE_CHECKING:
    from icrl4aht_data.sampling.base import Sampler

B = TypeVar("B")
_POLL = 0.1  # seconds after which a waiting producer looks whether it is still wanted


class Batches(Iterator[B], Generic[B]):
    """An iterator over `sampler[start]`, `sampler[start + 1]`, ..: at most `prefetch` finished ones wait in memory.

    An exception that making a batch raises comes out of `next`. Leaving a `with` block, `close()` or the iterator's
    end stops the thread. `waited` is how long the consumer has waited, in seconds, over `served` batches.

    Args:
        sampler: the batches.
        start: the first batch's number.
        stop: the number behind the last; None goes on without end.
        prefetch: how many batches may wait; 0 makes each one when it is asked for, without a thread.
        device: a jax.Device or Sharding: batches become JAX arrays there, the next one's transfer running while the
            last one is used. Where a sharding spans processes, each gives its share of the rows. Needs JAX.
        reuse: give the same few buffers again and again: a batch is valid until the next one is taken. New memory costs
            more than filling it. With a device, host buffers are always reused.
    """

    def __init__(
        self,
        sampler: Sampler,
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
        self._reuse = reuse
        self.next, self.served, self.waited = check_int("start", start, 0), 0, 0.0
        self._worker: _Worker | None = None
        self._held: Any = None
        self._closed = False

    def __iter__(self) -> Batches[B]:
        return self

    def __next__(self) -> B:
        if self._closed or (self._stop is not None and self.next >= self._stop):
            self.close()
            raise StopIteration
        started = time.perf_counter()
        if self._worker is None:
            self._worker = _Worker(self._sampler, self.next, self._stop, self._prefetch, self._put, self._reuse)
        if self._held is not None:
            self._worker.give_back(self._held)
            self._held = None
        try:
            batch, self._held = self._worker.take()
        except BaseException:
            self.close()
            raise
        self.waited += time.perf_counter() - started
        self.served += 1
        self.next += 1
        return batch

    def close(self) -> None:
        """Stop the thread and drop what it has made. The iterator is then at its end."""
        self._closed = True
        self._stop_worker()

    def _stop_worker(self) -> None:
        if self._worker is not None:
            self._worker.close()
            self._worker = self._held = None

    def __enter__(self) -> Batches[B]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_worker", None) is not None:
            self._stop_worker()

    def state_dict(self) -> dict[str, Any]:
        """Where the consumer is, as JSON: the number of the next batch, and what the batches are a function of."""
        return {"next": self.next, **self._sampler.options()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from where `state_dict` was taken, exactly.

        Raises:
            OptionError: if it was taken from a sampler with other options or another selection; names them.
        """
        expected, given = self._sampler.options(), {name: value for name, value in state.items() if name != "next"}
        wrong = [name for name in expected.keys() | given.keys() if expected.get(name) != given.get(name)]
        if wrong or "next" not in state:
            told = ", ".join(f"{name} = {given.get(name)!r}, not {expected.get(name)!r}" for name in sorted(wrong))
            raise OptionError(f"the state is of other batches: it has {told or 'no `next`'}")
        self._stop_worker()
        self._closed = False
        self.next = check_int("next", state["next"], 0)


class _Worker:
    """Makes batches in order; `take` gives the next one with the buffer to give back."""

    def __init__(
        self, sampler: Sampler, start: int, stop: int | None, prefetch: int, put: Callable | None, reuse: bool
    ) -> None:
        buffers = 1 if put else prefetch + 2 if reuse else 0
        if not prefetch:
            buffers = min(buffers, 1)
        self._free: queue.Queue = queue.Queue()
        for _ in range(buffers):
            self._free.put(None)  # made when first needed
        self._made: queue.Queue = queue.Queue(maxsize=max(prefetch, 1))
        self._ended = threading.Event()
        self._numbers = iter(range(start, stop if stop is not None else 2**62))
        make = _maker(sampler, put, self._free if buffers else None, self._ended)
        self._make = make
        self._thread = None
        if prefetch:
            arguments = (self._numbers, make, self._made, self._ended)
            self._thread = threading.Thread(target=_produce, args=arguments, name="icrl4aht-prefetch", daemon=True)
            self._thread.start()

    def take(self) -> tuple[Any, Any]:
        if self._thread is None:
            return self._make(next(self._numbers))
        batch, buffer, error = self._made.get()
        if error is not None:
            raise error
        return batch, buffer

    def give_back(self, buffer: Any) -> None:
        self._free.put(buffer)

    def close(self) -> None:
        self._ended.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            while self._thread.is_alive():
                try:
                    self._made.get(timeout=0.01)  # a producer that waits for room
                except queue.Empty:
                    continue
            self._thread.join()


class _Ended(Exception):
    """The consumer is gone."""


def _maker(
    sampler: Sampler, put: Callable | None, free: queue.Queue | None, ended: threading.Event
) -> Callable[[int], tuple[Any, Any]]:
    """Number -> batch, and the buffer that the consumer has to give back before it is filled again, if any."""

    def make(i: int) -> tuple[Any, Any]:
        buffer = None if free is None else _free_buffer(sampler, free, ended)
        batch = sampler.batch(i, buffer)
        if put is None:
            return batch, buffer
        on_device = put(batch)
        if free is not None:
            free.put(buffer)
        return on_device, None

    return make


def _free_buffer(sampler: Sampler, free: queue.Queue, ended: threading.Event) -> Any:
    while True:
        try:
            return free.get(timeout=_POLL) or sampler.empty()
        except queue.Empty:
            if ended.is_set():
                raise _Ended from None


def _produce(numbers: Iterator[int], make: Callable, made: queue.Queue, ended: threading.Event) -> None:
    for i in numbers:
        try:
            item = (*make(i), None)
        except _Ended:
            return
        except BaseException as error:
            item = (None, None, error)
        while not ended.is_set():
            try:
                made.put(item, timeout=_POLL)
                break
            except queue.Full:
                continue
        if ended.is_set() or item[2] is not None:
            return


def _device_put(device: Any) -> Callable[[Any], Any]:
    try:
        import jax
        import jax.numpy as jnp
    except ImportError as error:
        raise OptionError("a device needs JAX: pip install 'icrl4aht-data[generation]'") from error

    def one(x: Any) -> Any:
        if getattr(device, "is_fully_addressable", True):
            return jnp.array(x, copy=True, device=device)
        return jax.make_array_from_process_local_data(device, x.copy())

    def put(batch: Any) -> Any:
        # jax.device_put may keep using a host buffer, on a CPU for good; ours is filled again as soon as this returns.
        return jax.block_until_ready(jax.tree.map(one, batch))

    return put
