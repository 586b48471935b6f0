"""Saving and resuming a training: its state, its log, its lock, and when to save.

Every training of this project (egos, populations, in-context learners) is a pure function of its settings and of its
state after the last update. So it resumes to the same bits if three things hold, and each has one class here:
`StateFile` restores the state exactly and refuses one of other settings, `RunLog` drops the log lines that came after
the state was saved, and `run_lock` keeps a second process out of the folder.
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
from jax._src.xla_bridge import backends_are_initialized  # JAX has no public way to ask without initializing
from jax.experimental import multihost_utils
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as to_bytes

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, lock_path, process_lock

METRICS, TIMING = "metrics.jsonl", "timing.jsonl"

_FORMAT = "1"
_XLA_THREADS = ("PJRT_NPROC", "NPROC")  # environment variables, in the order in which XLA looks for them
_SUFFIX = ".safetensors"


class BusyError(OptionError):
    """Error: another process is using this folder."""


class OtherSettingsError(OptionError):
    """Error: the saved state was made with other settings."""


def xla_threads() -> int | None:
    """Return the number of threads that XLA splits one operation over on this CPU; None on other platforms.

    It decides the order of floating-point sums, and so the bits of everything that is trained. XLA reads it once, when
    JAX is first used: from `PJRT_NPROC` or `NPROC`, otherwise from the CPU cores that this process may use.
    """
    if jax.default_backend() != "cpu":
        return None
    for name in _XLA_THREADS:
        with suppress(ValueError):  # XLA ignores values that are not numbers
            return max(1, int(os.environ.get(name, "")))
    return len(os.sched_getaffinity(0))


def limit_xla_threads(threads: int) -> None:
    """Make XLA split operations over this many threads on a CPU; call before JAX is first used.

    Raises:
        OptionError: if JAX has been used with another number, which can no longer change.
    """
    if not backends_are_initialized():
        os.environ[_XLA_THREADS[0]] = str(threads)
    elif xla_threads() not in (None, threads):
        raise OptionError(
            f"XLA runs with {xla_threads()} threads in this process, expected {threads}: set "
            f"{_XLA_THREADS[0]}={threads} before it starts"
        )


def software_versions() -> dict[str, str | int | None]:
    """Return the versions and threads that a resumed training needs to reach the bits of an uninterrupted one."""
    return {
        "jax": jax.__version__,
        "platform": jax.default_backend(),
        "xla_threads": xla_threads(),
        "code_version": version("icrl4aht-data"),
    }


def last_line(path: Path) -> dict[str, Any] | None:
    """Return the last complete line of a log of JSON lines, perhaps still written; None if there is none."""
    with suppress(OSError, ValueError, IndexError):
        return json.loads(path.read_text(encoding="utf-8").splitlines()[-1])
    return None


def differing_settings(found: Mapping[str, Any], expected: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Settings that differ, by dotted name: (found, expected), None for a missing one. Tuples equal lists."""
    one, other = (flatten_dict(json.loads(json.dumps(each)), sep=".") for each in (found, expected))
    names = sorted(one.keys() | other.keys())
    return {name: (one.get(name), other.get(name)) for name in names if one.get(name) != other.get(name)}


@contextmanager
def run_lock(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder's lock.

    Args:
        folder: need not exist; its parent is made.
        wait: whether to wait until another process releases the lock, instead of raising.

    Raises:
        BusyError: if another process holds the lock.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(process_lock(lock_path(folder), wait=wait))
        except Timeout as error:
            message = f"{folder}: another process works in this folder; wait for it, or choose another"
            raise BusyError(message) from error
        yield


class SaveInterval:
    """Schedule for saving a training: after its last update, and whenever an interval has passed.

    Args:
        last: number of the last update.
        updates: save when the number of updates is a multiple of this.
        seconds: save when this much time has passed since the last save. Processes must
            call `save` together but their clocks differ, so one process decides for all.
    """

    def __init__(self, last: int, *, updates: int | None = None, seconds: float | None = None) -> None:
        self._last, self._updates, self._seconds = last, updates, seconds
        self._saved = time.monotonic()

    def due(self, update: int) -> bool:
        """Return whether to save after this many updates; a positive answer starts the next interval."""
        now = time.monotonic()
        due = (
            update == self._last
            or (self._updates is not None and update % self._updates == 0)
            or (self._seconds is not None and now - self._saved >= self._seconds)
        )
        self._saved = now if due else self._saved
        return due


class StateFile:
    """One safetensors file with the state of a training, the settings it belongs to, and its progress.

    Arrays are named by their path in the state's pytree ("params/actor/kernel"); typed keys (of JAX's default kind) are
    stored as their data. Metadata: `format`, `settings` (JSON), `progress` (number of updates). The file
    is replaced atomically, and equal states and settings give equal bytes. With several processes, all call `save`,
    process 0 writes, and every process can `load`.

    Args:
        path: the file, which need not exist.
        settings: values that JSON can hold; a state saved under others is refused. None accepts any.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any] | None = None) -> None:
        self.path, self.settings = path, settings

    @property
    def progress(self) -> int | None:
        """Number of updates that led to the saved state; None if nothing is saved.

        Raises:
            OtherSettingsError: if the state was saved under other settings; names the first that differs.
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
            raise self._unreadable(repr(error)) from error
        different = {} if self.settings is None else differing_settings(settings, self.settings)
        for name, (found, expected) in different.items():
            resume = f"set {_XLA_THREADS[0]}={found} to resume it, " if name == "xla_threads" and found else ""
            raise OtherSettingsError(
                f"{self.path}: saved by a training of other settings: {name} was {found!r}, now it is {expected!r}; "
                f"{resume}remove the file to start again, or choose another folder"
            )
        return progress

    def save(self, state: Any, progress: int) -> None:
        """Write a pytree of arrays and typed keys, sharded or replicated over any devices."""
        arrays = {name: _host_array(leaf) for name, leaf in _named_leaves(state).items()}
        if jax.process_index() == 0:
            metadata = {"format": _FORMAT, "progress": str(progress), "settings": json.dumps(self.settings or {})}
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.path) as partial:
                partial.write_bytes(_file_bytes(arrays, metadata))
        if jax.process_count() > 1:  # no process continues before the file is complete
            multihost_utils.sync_global_devices(f"saved {self.path.name}")

    def load(self, like: Any, part: str = "") -> Any:
        """Return the saved state.

        Args:
            like: a pytree of arrays or `jax.ShapeDtypeStruct`s with the state's structure, shapes and dtypes; leaves
                with a sharding are placed by it, the others on the default device.
            part: path of a subtree in the saved state ("params") to load alone; `like` describes that subtree.

        Raises:
            OtherSettingsError: if the state was saved under other settings.
            OptionError: if there is no file, if it is damaged, or if it holds other arrays.
        """
        if self.progress is None:
            raise self._unreadable("no such file")
        wanted = _named_leaves(like, part)
        try:
            with safe_open(self.path, "numpy") as file:
                names = [name for name in file.keys() if not part or f"{name}/".startswith(f"{part}/")]  # noqa: SIM118
                saved = {name: file.get_tensor(name) for name in names}
        except SafetensorError as error:
            raise self._unreadable(str(error)) from error
        expected = {name: _shape_text(_data_shape(leaf)) for name, leaf in wanted.items()}
        found = {name: _shape_text(array) for name, array in saved.items()}
        # The first difference is enough: a state of another network differs in most arrays.
        for name in sorted(expected.keys() | found.keys()):
            if expected.get(name) != found.get(name):
                raise self._unreadable(
                    f"{name}: expected {expected.get(name, 'nothing')}, found {found.get(name, 'nothing')}"
                )
        leaves = [_with_sharding(saved[name], leaf) for name, leaf in wanted.items()]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    def _unreadable(self, problem: str) -> OptionError:
        return OptionError(f"{self.path}: not a state of this training: {problem}; remove the file to start again")


class Checkpoints:
    """The latest states of a training, one `StateFile` each: FOLDER/<step>.safetensors.

    Args:
        folder: need not exist.
        settings: see `StateFile`.
        keep: how many to keep; older ones are removed.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any] | None = None, keep: int = 2) -> None:
        self.folder, self.settings, self.keep = folder, settings, keep

    @property
    def steps(self) -> list[int]:
        """Steps of the checkpoints, ascending."""
        return sorted(int(path.stem) for path in self.folder.glob(f"*{_SUFFIX}") if path.stem.isdecimal())

    @property
    def latest(self) -> int | None:
        """Step of the last checkpoint; None if there is none."""
        return max(self.steps, default=None)

    def at(self, step: int) -> StateFile:
        """Return the checkpoint of a step."""
        return StateFile(self.folder / f"{step}{_SUFFIX}", self.settings)

    def save(self, state: Any, step: int) -> None:
        """Write a checkpoint, then remove the oldest ones."""
        self.at(step).save(state, step)
        if jax.process_index() == 0:
            for old in self.steps[: -self.keep]:
                self.at(old).path.unlink()

    def load(self, like: Any, part: str = "") -> tuple[Any, int]:
        """Return the last checkpoint's state, or a part of it, and its step; see `StateFile.load`.

        Raises:
            OptionError: if there is no checkpoint, and as `StateFile.load`.
        """
        step = self.latest
        if step is None:
            raise OptionError(f"{self.folder}: no checkpoint yet; continue the training with the same command")
        return self.at(step).load(like, part), step


class RunLog:
    """The log of a training: FOLDER/metrics.jsonl and FOLDER/timing.jsonl, JSON lines in the order of the updates.

    Metrics are a function of the settings, timing is not, so the two are apart. Opening the log cuts both files at the
    first line that `keep` refuses: lines that a killed run wrote after its last save, or half a line. Only process 0
    writes.

    Args:
        folder: an existing folder.
        keep: whether a line was written before the state was saved from which the training resumes.
    """

    def __init__(self, folder: Path, keep: Callable[[dict[str, Any]], bool]) -> None:
        self._writes = jax.process_index() == 0
        paths = [folder / METRICS, folder / TIMING]
        if self._writes:
            for path in paths:
                _cut(path, keep)
        self._metrics, self._timing = (
            (path if self._writes else Path(os.devnull)).open("a", encoding="utf-8") for path in paths
        )

    def write(self, *metrics: dict[str, Any], timing: dict[str, Any] | None = None) -> None:
        """Append lines; readers see them at once."""
        for file, lines in ((self._metrics, metrics), (self._timing, [timing] if timing else [])):
            file.writelines(json.dumps(line) + "\n" for line in lines)
            file.flush()

    def sync(self) -> None:
        """Force the metrics to the disk; call before saving the state that they led to."""
        if self._writes:
            os.fsync(self._metrics.fileno())

    def close(self) -> None:
        """Close both files."""
        for file in (self._metrics, self._timing):
            with suppress(OSError):  # `write` leaves nothing to be written, unless it has raised the same error
                file.close()


def _cut(path: Path, keep: Callable[[dict[str, Any]], bool]) -> None:
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    kept: list[bytes] = []
    with suppress(ValueError):  # half a line, written by a run that was killed
        for line in lines:
            if not (line.endswith(b"\n") and keep(json.loads(line))):
                break
            kept.append(line)
    if kept != lines:
        with atomic_write(path) as partial:
            partial.write_bytes(b"".join(kept))


def _named_leaves(tree: Any, part: str = "") -> dict[str, Any]:
    """Return the leaves by path: "params/actor/kernel" for attributes, items and indices alike."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    names = [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in leaves]
    named = {"/".join(filter(None, (part, name))): leaf for name, (_, leaf) in zip(names, leaves, strict=True)}
    if len(named) < len(leaves):
        raise ValueError("two leaves of the state have the same path")
    return named


def _file_bytes(arrays: dict[str, np.ndarray], metadata: dict[str, str]) -> bytes:
    """Return a safetensors file whose bytes are a function of its content."""
    # The library writes metadata in a random order, so they are put into the header of a file that has none. And it is
    # not `save_file`, which has errors of its own for a full disk.
    content = to_bytes(arrays)
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps({"__metadata__": metadata} | json.loads(content[8:end]), separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # safetensors aligns the arrays by padding the header with spaces
    return b"".join([len(header).to_bytes(8, "little"), header, memoryview(content)[end:]])


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data_shape(leaf: Any) -> Any:
    return jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf


def _shape_text(array: Any) -> str:
    return f"{np.dtype(array.dtype)} {tuple(array.shape)}"


def _host_array(leaf: Any) -> np.ndarray:
    data = jax.random.key_data(leaf) if _is_key(leaf) else leaf
    # Parts on devices of other processes have to be gathered, by all processes together.
    if isinstance(data, jax.Array) and not (data.is_fully_addressable or data.is_fully_replicated):
        data = multihost_utils.process_allgather(data, tiled=True)
    return np.require(np.asarray(data), requirements="C")


def _with_sharding(array: np.ndarray, like: Any) -> Any:
    """Return a loaded array on the devices of `like`, if `like` has a sharding."""
    sharding = getattr(like, "sharding", None)
    if _is_key(like):
        wrap: Any = jax.random.wrap_key_data
        return wrap(array) if sharding is None else jax.jit(wrap, out_shardings=sharding)(array)
    if sharding is None:
        return jnp.asarray(array)
    return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])
