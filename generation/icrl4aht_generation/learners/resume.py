"""Save and resume a training run: the saved state, the log, the lock of the folder, and the times of saving.

Every training run of this project (egos, populations, in-context learners) depends only on its settings and its state
after the last update. Three parts of this module make the results of a resumed run identical: `StateFile` restores the
exact state and refuses states of other settings, `RunLog` removes log lines written after the state was saved, and
`run_lock` keeps other processes out of the folder.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from filelock import Timeout
from flax.traverse_util import flatten_dict
from jax._src.xla_bridge import backends_are_initialized  # private, because JAX has no public equivalent
from jax.experimental import multihost_utils
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as to_bytes

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, lock_file_path, process_lock

METRICS, TIMING = "metrics.jsonl", "timing.jsonl"

_FORMAT = "1"
_XLA_THREADS = ("PJRT_NPROC", "NPROC")  # environment variables, in the order in which XLA looks for them
_SUFFIX = ".safetensors"


class BusyError(OptionError):
    """Raised when another process is using the folder of a training run."""


class OtherSettingsError(OptionError):
    """Raised when a saved state belongs to a training run with other settings."""


def xla_threads() -> int | None:
    """Return the number of CPU threads that XLA uses for one operation; None if JAX does not run on a CPU.

    The number of threads decides the order of floating-point sums, and so the last bits of all trained parameters. XLA
    reads the number when JAX is first used, from `PJRT_NPROC` or `NPROC`, or else from the available CPU cores.
    """
    if jax.default_backend() != "cpu":
        return None
    for name in _XLA_THREADS:
        with suppress(ValueError):  # XLA ignores values that are not numbers
            return max(1, int(os.environ.get(name, "")))
    return len(os.sched_getaffinity(0))


def limit_xla_threads(threads: int) -> None:
    """Make XLA split operations over a given number of CPU threads; call this before JAX is first used.

    A program for one thread runs in the thread that calls it, so that parallel jobs do not wait for further threads.

    Raises:
        OptionError: if JAX is already in use with another number of threads.
    """
    if not backends_are_initialized():
        os.environ[_XLA_THREADS[0]] = str(threads)
        if threads == 1:
            jax.config.update("jax_cpu_enable_async_dispatch", False)
    elif xla_threads() not in (None, threads):
        raise OptionError(
            f"XLA runs with {xla_threads()} threads in this process, expected {threads}: set "
            f"{_XLA_THREADS[0]}={threads} before the process starts"
        )


def software_versions() -> dict[str, str | int | None]:
    """Return the software versions and the number of threads, on which the exact results of a training run depend."""
    return {
        "jax": jax.__version__,
        "platform": jax.default_backend(),
        "xla_threads": xla_threads(),
        "code_version": version("icrl4aht-data"),
    }


def last_line(path: Path) -> dict[str, Any] | None:
    """Return the last line of a log of JSON lines; None if the log is missing, empty or ends in an incomplete line."""
    with suppress(OSError, ValueError, IndexError):
        return json.loads(path.read_text(encoding="utf-8").splitlines()[-1])
    return None


def differing_settings(found: Mapping[str, Any], expected: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return pairs (found, expected) of settings that differ, by dotted name; missing settings are None."""
    one, other = (flatten_dict(json.loads(json.dumps(each)), sep=".") for each in (found, expected))
    names = sorted(one.keys() | other.keys())
    return {name: (one.get(name), other.get(name)) for name in names if one.get(name) != other.get(name)}


@contextmanager
def run_lock(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Context manager that holds the lock of a training run's folder.

    Args:
        folder: the folder, which need not exist; its parent is created.
        wait: whether to wait until another process releases the lock, instead of raising.

    Raises:
        BusyError: if another process holds the lock.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(process_lock(lock_file_path(folder), wait=wait))
        except Timeout as error:
            message = f"{folder}: another process works in this folder; wait for that process, or choose another folder"
            raise BusyError(message) from error
        yield


class SaveInterval:
    """Schedule for saving a training run: after a number of updates or seconds, and after the last update.

    Args:
        last: number of the last update.
        updates: save when the number of updates is a multiple of this number.
        seconds: save when this many seconds have passed since the last save. Processes that must call `save` together
            have different clocks, so one process must decide for all.
    """

    def __init__(self, last: int, *, updates: int | None = None, seconds: float | None = None) -> None:
        self._last, self._updates, self._seconds = last, updates, seconds
        self._saved = time.monotonic()

    def due(self, update: int) -> bool:
        """Return whether to save after the given number of updates; if so, the next interval starts."""
        now = time.monotonic()
        due = (
            update == self._last
            or (self._updates is not None and update % self._updates == 0)
            or (self._seconds is not None and now - self._saved >= self._seconds)
        )
        self._saved = now if due else self._saved
        return due


class StateFile:
    """A safetensors file with the state, the settings and the progress of a training run.

    Arrays are named by their path in the state's pytree ("params/actor/kernel"); typed keys (of JAX's default kind) are
    stored as their data. Metadata: `format`, `settings` (JSON), `progress` (number of updates). The file
    is replaced atomically, and equal states and settings give equal bytes. With several processes, all call `save`,
    process 0 writes, and every process can `load`.

    Args:
        path: path of the file, which need not exist.
        settings: settings as JSON values; a state with other settings is refused. None accepts any state.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any] | None = None) -> None:
        self.path, self.settings = path, settings

    @property
    def progress(self) -> int | None:
        """Number of updates that led to the saved state; None if nothing is saved.

        Raises:
            OtherSettingsError: if the state was saved with other settings; the message names the first difference.
            OptionError: if the file is damaged.
        """
        if not self.path.is_file():
            return None
        try:
            with safe_open(self.path, "numpy") as file:
                metadata = dict(file.metadata() or {})
            if metadata["format"] != _FORMAT:
                raise ValueError(f"format {metadata['format']!r}, expected {_FORMAT!r}")
            settings, progress = json.loads(metadata["settings"]), int(metadata["progress"])
        except (SafetensorError, KeyError, ValueError) as error:
            raise self._invalid_state_error(repr(error)) from error
        different = {} if self.settings is None else differing_settings(settings, self.settings)
        for name, (found, expected) in different.items():
            resume = f"set {_XLA_THREADS[0]}={found} to resume it, " if name == "xla_threads" and found else ""
            raise OtherSettingsError(
                f"{self.path}: saved by a training run with other settings: {name} was {found!r}, now it is "
                f"{expected!r}; {resume}remove the file to start again, or choose another folder"
            )
        return progress

    def save(self, state: Any, progress: int) -> None:
        """Save a state: a pytree of arrays and typed keys, sharded or replicated over any devices."""
        arrays = {name: _host_array(leaf) for name, leaf in _named_leaves(state).items()}
        if jax.process_index() == 0:
            metadata = {"format": _FORMAT, "progress": str(progress), "settings": json.dumps(self.settings or {})}
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.path) as partial:
                partial.write_bytes(_file_bytes(arrays, metadata))
        if jax.process_count() > 1:  # all processes wait until the file is complete
            multihost_utils.sync_global_devices(f"saved {self.path.name}")

    def load(self, like: Any, part: str = "") -> Any:
        """Return the saved state.

        Args:
            like: a pytree of arrays or `jax.ShapeDtypeStruct`s with the state's structure, shapes and dtypes; leaves
                without a sharding are placed on the default device.
            part: path of the only subtree to load, such as "params"; `like` then describes this subtree.

        Raises:
            OtherSettingsError: if the state was saved with other settings.
            OptionError: if the file is missing or damaged, or contains other arrays.
        """
        if self.progress is None:
            raise self._invalid_state_error("no such file")
        wanted = _named_leaves(like, part)
        try:
            with safe_open(self.path, "numpy") as file:
                names = [name for name in file.keys() if not part or f"{name}/".startswith(f"{part}/")]  # noqa: SIM118
                saved = {name: file.get_tensor(name) for name in names}
        except SafetensorError as error:
            raise self._invalid_state_error(str(error)) from error
        expected = {name: _shape_text(leaf) for name, leaf in wanted.items()}
        found = {name: _shape_text(array) for name, array in saved.items()}
        # Report only the first difference, because a state of another network differs in most arrays.
        for name in sorted(expected.keys() | found.keys()):
            if expected.get(name) != found.get(name):
                raise self._invalid_state_error(
                    f"{name}: expected {expected.get(name, 'nothing')}, found {found.get(name, 'nothing')}"
                )
        leaves = [_with_sharding(saved[name], leaf) for name, leaf in wanted.items()]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    def _invalid_state_error(self, problem: str) -> OptionError:
        return OptionError(
            f"{self.path}: not a state of this training: {problem}; restore the file, or remove it to start again"
        )


class Checkpoints:
    """The latest states of a training run, each in a `StateFile` FOLDER/<step>.safetensors.

    Args:
        folder: folder of the files, which need not exist.
        settings: settings of the training run, see `StateFile`.
        keep: number of states to keep; older files are removed.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any] | None = None, keep: int = 2) -> None:
        self.folder, self.settings, self.keep = folder, settings, keep

    @property
    def steps(self) -> list[int]:
        """Steps at which checkpoints were saved, ascending."""
        return sorted(int(path.stem) for path in self.folder.glob(f"*{_SUFFIX}") if path.stem.isdecimal())

    @property
    def latest(self) -> int | None:
        """Step of the last checkpoint; None if no checkpoint exists."""
        return max(self.steps, default=None)

    def state_file(self, step: int) -> StateFile:
        """Return the state file of the checkpoint at a step."""
        return StateFile(self.folder / f"{step}{_SUFFIX}", self.settings)

    def save(self, state: Any, step: int) -> None:
        """Write a checkpoint, then remove all but the latest `keep` checkpoints."""
        self.state_file(step).save(state, step)
        if jax.process_index() == 0:
            for old in self.steps[: -self.keep]:
                self.state_file(old).path.unlink()

    def load(self, like: Any, part: str = "") -> tuple[Any, int]:
        """Return the state of the last checkpoint, or a part of the state, and the step; see `StateFile.load`.

        Raises:
            OptionError: if no checkpoint exists, or the last checkpoint cannot be loaded.
        """
        step = self.latest
        if step is None:
            raise OptionError(f"{self.folder}: expected a checkpoint, found none; train until one is saved")
        return self.state_file(step).load(like, part), step


class RunLog:
    """The log of a training run: FOLDER/metrics.jsonl and FOLDER/timing.jsonl, JSON lines in the order of the updates.

    The timing has a separate file, because unlike the metrics it differs between equal runs. Opening the log cuts both
    files at the first line that `keep` rejects or that is incomplete, since a killed run may have written lines after
    its last save. Only process 0 writes.

    Args:
        folder: an existing folder.
        keep: function that returns whether a line belongs to an update before the last save.
    """

    def __init__(self, folder: Path, keep: Callable[[dict[str, Any]], bool]) -> None:
        self._writes = jax.process_index() == 0
        paths = [folder / METRICS, folder / TIMING]
        if self._writes:
            for path in paths:
                _truncate_log(path, keep)
        self._metrics, self._timing = (
            (path if self._writes else Path(os.devnull)).open("a", encoding="utf-8") for path in paths
        )

    def write(self, *metrics: dict[str, Any], timing: dict[str, Any] | None = None) -> None:
        """Append lines, and flush the files so that readers see the lines at once."""
        for file, lines in ((self._metrics, metrics), (self._timing, [timing] if timing else [])):
            file.writelines(json.dumps(line) + "\n" for line in lines)
            file.flush()

    def sync(self) -> None:
        """Flush the metrics to the disk; call this before a state is saved, which must not be ahead of the log."""
        if self._writes:
            os.fsync(self._metrics.fileno())

    def close(self) -> None:
        """Close the files of the metrics and the timing."""
        for file in (self._metrics, self._timing):
            with suppress(OSError):  # `write` has already raised the error of a failed flush
                file.close()


def _truncate_log(path: Path, keep: Callable[[dict[str, Any]], bool]) -> None:
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    kept: list[bytes] = []
    with suppress(ValueError):  # incomplete line, left by a killed run
        for line in lines:
            if not (line.endswith(b"\n") and keep(json.loads(line))):
                break
            kept.append(line)
    if kept != lines:
        with atomic_write(path) as partial:
            partial.write_bytes(b"".join(kept))


def _named_leaves(tree: Any, part: str = "") -> dict[str, Any]:
    """Return the leaves of a pytree by path, such as "params/actor/kernel"."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    names = [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in leaves]
    named = {"/".join(filter(None, (part, name))): leaf for name, (_, leaf) in zip(names, leaves, strict=True)}
    if len(named) < len(leaves):
        raise ValueError(
            f"{len(leaves)} leaves of the state, but {len(named)} different paths: give every leaf its own path"
        )
    return named


def _file_bytes(arrays: dict[str, np.ndarray], metadata: dict[str, str]) -> bytes:
    """Return arrays and metadata as the bytes of a safetensors file; equal content gives equal bytes."""
    # safetensors writes metadata in a random order. Therefore `to_bytes` gets the arrays only, and the metadata is
    # inserted into the header below. `save_file` is not used, because it does not raise an OSError for a full disk.
    content = to_bytes(arrays)
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps({"__metadata__": metadata} | json.loads(content[8:end]), separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # safetensors aligns the arrays by padding the header with spaces
    return b"".join([len(header).to_bytes(8, "little"), header, memoryview(content)[end:]])


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _shape_text(leaf: Any) -> str:
    data = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    return f"{np.dtype(data.dtype)} {tuple(data.shape)}"


def _host_array(leaf: Any) -> np.ndarray:
    data = jax.random.key_data(leaf) if _is_key(leaf) else leaf
    # If parts of the array are on devices of other processes, all processes must gather it together.
    if isinstance(data, jax.Array) and not (data.is_fully_addressable or data.is_fully_replicated):
        data = multihost_utils.process_allgather(data, tiled=True)
    return np.require(np.asarray(data), requirements="C")


def _with_sharding(array: np.ndarray, like: Any) -> Any:
    """Return a loaded array with the sharding of `like`, or on the default device if `like` has no sharding."""
    sharding = getattr(like, "sharding", None)
    if _is_key(like):
        wrap: Any = jax.random.wrap_key_data
        return wrap(array) if sharding is None else jax.jit(wrap, out_shardings=sharding)(array)
    if sharding is None:
        return jnp.asarray(array)
    return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])
