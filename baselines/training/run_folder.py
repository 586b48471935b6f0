"""Run folders: config.json, metrics.jsonl, timing.jsonl, curves.png, checkpoints/ (Orbax), perhaps tensorboard/."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import orbax.checkpoint as ocp

from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.utils.files import atomic_write, parse_json, read_text, write_json

RUN_FORMAT = 1
CONFIG, METRICS, TIMING, CURVES, CHECKPOINTS, TENSORBOARD = (
    "config.json",
    "metrics.jsonl",
    "timing.jsonl",
    "curves.png",
    "checkpoints",
    "tensorboard",
)

logging.getLogger("absl").setLevel(logging.WARNING)  # Orbax tells of every step it takes


class Restored(NamedTuple):
    """A checkpoint."""

    step: int
    params: Any
    rest: Any


def versions() -> dict[str, Any]:
    """What a run folder states of what wrote it."""
    return {"run_format": RUN_FORMAT, "package_version": version("icrl4aht-data")}


def read_config(folder: Path) -> dict[str, Any]:
    """A run's settings.

    Raises:
        OptionError: if the folder is not a run, or one of another format.
    """
    path = folder / CONFIG
    try:
        config = parse_json(read_text(path))
        found = config["run_format"]
    except (IndexFormatError, KeyError, TypeError) as error:
        raise OptionError(f"{folder}: not a run: expected {CONFIG} with run_format ({error})") from error
    if found != RUN_FORMAT:
        raise OptionError(
            f"{path}: run_format {found!r}, expected {RUN_FORMAT}: written by version "
            f"{config.get('package_version')!r} of this package, this is {versions()['package_version']}; use that "
            f"version, or train again into another folder"
        )
    return config


def open_run(folder: Path, config: dict[str, Any]) -> bool:
    """Start a run in a folder, or go on with the one that is there. Returns whether there is one.

    Raises:
        OptionError: if the folder holds a run of other settings; names them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / CONFIG).exists():
        check_same(folder, read_config(folder), json.loads(json.dumps(config)))
        return True
    if jax.process_index() == 0:
        with atomic_write(folder / CONFIG) as partial:
            write_json(partial, config)
    return False


def check_same(folder: Path, found: dict[str, Any], expected: dict[str, Any]) -> None:
    """Whether a run has these settings.

    Raises:
        OptionError: otherwise; names each one that differs.
    """
    one, two = _flat(found), _flat(expected)
    wrong = [name for name in sorted(one.keys() | two.keys()) if one.get(name) != two.get(name)]
    if wrong:
        told = "; ".join(f"{name}: the run has {one.get(name)!r}, asked for {two.get(name)!r}" for name in wrong)
        raise OptionError(f"{folder}: holds a run of other settings ({told}); give another --out")


def _flat(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in content.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


class Checkpoints:
    """The latest states of a run, written beside the training, each whole or not at all."""

    def __init__(self, folder: Path, keep: int = 2) -> None:
        self._folder = (folder / CHECKPOINTS).absolute()
        self._keep = keep
        self._open: Any = None

    @property
    def _manager(self) -> Any:
        if self._open is None:
            options = ocp.CheckpointManagerOptions(max_to_keep=self._keep)
            handlers: Any = {part: ocp.StandardCheckpointHandler() for part in ("params", "rest")}
            self._open = ocp.CheckpointManager(self._folder, options=options, item_handlers=handlers)
        return self._open

    @property
    def latest(self) -> int | None:
        """The step of the last one."""
        return self._manager.latest_step() if self._folder.is_dir() else None

    def save(self, step: int, params: Any, rest: Any) -> None:
        """Write a checkpoint: returns once the arrays are copied."""
        parts = {"params": ocp.args.StandardSave(params), "rest": ocp.args.StandardSave(rest)}
        self._manager.save(step, args=ocp.args.Composite(**parts))

    def restore(self, params: Any, rest: Any = None) -> Restored:
        """The last checkpoint.

        Args:
            params: what the parameters look like: shapes and dtypes, and shardings if they matter.
            rest: the same of the rest; None to leave it out.

        Raises:
            OptionError: if there is none, or it has other parameters than these.
        """
        step = self.latest
        if step is None:
            raise OptionError(f"{self._folder}: no checkpoint yet; train on, with the same command")
        self._check(step, params)
        parts = {"params": params} | ({} if rest is None else {"rest": rest})
        wanted = {name: ocp.args.StandardRestore(tree) for name, tree in parts.items()}
        found = self._manager.restore(step, args=ocp.args.Composite(**wanted))
        return Restored(step, found["params"], found.get("rest"))

    def _check(self, step: int, params: Any) -> None:
        metadata = self._manager.item_metadata(step)["params"]
        found, expected = _shapes(metadata.tree if hasattr(metadata, "tree") else metadata), _shapes(params)
        wrong = [name for name in sorted(found.keys() | expected.keys()) if found.get(name) != expected.get(name)]
        if wrong:
            name = wrong[0]
            raise OptionError(
                f"{self._folder / str(step)}: parameters of another model: {name} has shape {found.get(name)}, "
                f"expected {expected.get(name)}, and {len(wrong) - 1} more differ; {CONFIG} is not of this checkpoint"
            )

    def close(self) -> None:
        """Wait until all is written."""
        if self._open is not None:
            self._open.close()
            self._open = None


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_flatten_with_path(tree, is_leaf=lambda leaf: hasattr(leaf, "shape"))[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): tuple(leaf.shape) for path, leaf in leaves}


def forget_after(path: Path, step: int) -> None:
    """Drop a log's lines of later steps, which a run that was killed wrote behind its last checkpoint."""
    if path.exists():
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if _step_of(line) <= step]
        with atomic_write(path) as partial:
            partial.write_text("".join(line + "\n" for line in lines), encoding="utf-8")


def _step_of(line: str) -> float:
    try:
        return json.loads(line)["step"]
    except ValueError:
        return float("inf")  # cut off in the middle


def append(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    """Add JSON lines to a log."""
    with path.open("a", encoding="utf-8") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)
