"""Functions that spoil a release or a folder of published files in one way."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.benchmark.tasks import Task, task_id
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from tests.helpers.random_releases import SHARD

TABLE = "meta/chunks/teammate/coord_simple/train-00000-of-00001.npy"
TERABYTE = 2**40

Spoil = Callable[[Path], object]
"""Called with the folder to spoil; its sibling `outside` has the files `secret.txt` and `secret.h5` and a pipe."""
Make = Callable[[Path, Path], object]
"""Called with a path where nothing exists and the root; creates something at the path."""
ChangeFile = Callable[[Any, Path], object]
"""Called with an open HDF5 file or group and the folder `outside`."""


def outside(root: Path) -> Path:
    """Return the folder that no release may touch."""
    return root.parent / "outside"


def teammate(root: Path) -> str:
    """Return the path of the weights of the release's learned teammate."""
    return next((root / "teammates").glob("*/policy.safetensors")).relative_to(root).as_posix()


def listed(name: str) -> Spoil:
    """Add a line to the manifest."""

    def spoil(root: Path) -> None:
        with (root / MANIFEST).open("a", encoding="utf-8") as stream:
            stream.write(f"{'0' * 64}  {name}\n")

    return spoil


def replaced(name: str | Callable[[Path], str], make: Make) -> Spoil:
    """Replace a file or folder by what `make` creates."""

    def spoil(root: Path) -> None:
        path = root / (name if isinstance(name, str) else name(root))
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        make(path, root)

    return spoil


def link_out(path: Path, root: Path) -> None:
    path.symlink_to(outside(root) / "secret.txt")


def folder_link_out(path: Path, root: Path) -> None:
    path.symlink_to(outside(root))


def pipe(path: Path, root: Path) -> None:
    os.mkfifo(path)


def sparse(path: Path, root: Path) -> None:
    """Create a file of a terabyte that takes no disk space."""
    with path.open("wb") as stream:
        stream.truncate(TERABYTE)


def content(text: str | bytes) -> Make:
    """Create a file with this content."""
    return lambda path, root: path.write_bytes(text if isinstance(text, bytes) else text.encode())


def deep(levels: int) -> Make:
    """Create a file of nested JSON objects."""
    return content('{"a":' * levels + "1" + "}" * levels)


def json_file(name: str, change: Callable[[Any], Any]) -> Spoil:
    """Change the parsed content of a JSON file in place, or replace it by the result of `change`."""

    def spoil(root: Path) -> None:
        value = json.loads((root / name).read_text())
        changed = change(value)
        (root / name).write_text(json.dumps(value if changed is None else changed))

    return spoil


def lines(change: Callable[[list[dict[str, Any]]], list | None], name: str = HISTORIES) -> Spoil:
    """Change the parsed lines of a file of JSON lines in place, or replace them by the result of `change`."""

    def spoil(root: Path) -> None:
        values = [json.loads(line) for line in (root / name).read_text().splitlines()]
        changed = change(values)
        text = "".join(json.dumps(value) + "\n" for value in (values if changed is None else changed))
        (root / name).write_text(text)

    return spoil


def entry(name: str = HISTORIES, /, **changes: Any) -> Spoil:
    """Change fields of the first line of the index."""
    return lines(lambda values: values[0].update(changes), name)


def info(**changes: Any) -> Spoil:
    """Change fields of info.json."""
    return json_file(INFO, lambda value: value.update(changes))


def theta(**changes: Any) -> Spoil:
    """Change theta of the learned teammate, and its task's id to one that fits."""

    def spoil(root: Path) -> None:
        tasks = [Task(**json.loads(line)) for line in (root / TASKS).read_text().splitlines()]
        old = next(task for task in tasks if task.teammate["kind"] == "rl")
        mate = old.teammate | {"theta": old.teammate["theta"] | changes}
        new = replace(old, teammate=mate)
        new = replace(new, task_id=task_id(new))
        changed = [new if task is old else task for task in tasks]
        (root / TASKS).write_text("".join(json.dumps(asdict(task)) + "\n" for task in changed))
        for name in (HISTORIES, PROVENANCE):
            (root / name).write_text((root / name).read_text().replace(old.task_id, new.task_id))

    return spoil


def table(change: Callable[[np.ndarray], np.ndarray | None]) -> Spoil:
    """Change the chunk table of the shard in place, or replace it by the result of `change`."""

    def spoil(root: Path) -> None:
        rows = np.load(root / TABLE)
        changed = change(rows)
        np.save(root / TABLE, rows if changed is None else changed)

    return spoil


def npy(header: str, version: bytes = b"\x01\x00", length: int | None = None) -> Make:
    """Create a .npy file that ends after its header."""
    size = len(header) if length is None else length
    return content(b"\x93NUMPY" + version + size.to_bytes(2 if version[0] == 1 else 4, "little") + header.encode())


def hdf5(change: ChangeFile, name: str = SHARD) -> Spoil:
    """Change an HDF5 file, not its chunk table."""

    def spoil(root: Path) -> None:
        with h5py.File(root / name, "r+") as file:
            change(file, outside(root))

    return spoil


def actions(make: ChangeFile) -> ChangeFile:
    """Replace the actions of the first group by what `make` creates in the group."""

    def change(file: Any, out: Path) -> None:
        del file["0/actions"]
        make(file["0"], out)

    return change


def dataset(shape: tuple[int, ...] = (4, 120), dtype: Any = "i1", **options: Any) -> ChangeFile:
    """Replace the actions by a dataset with these properties."""
    return actions(lambda group, out: group.create_dataset("actions", shape, dtype, **options))


def typed(dtype: Any) -> ChangeFile:
    """Replace the actions by values of another type."""
    return dataset(dtype=dtype, chunks=(1, 120), compression="gzip")


def link(target: Callable[[Path], Any]) -> ChangeFile:
    """Replace the actions by a link."""
    return actions(lambda group, out: group.__setitem__("actions", target(out)))
