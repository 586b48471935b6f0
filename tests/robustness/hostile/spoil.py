"""Functions that spoil a release or a folder of published files in one way."""

from __future__ import annotations

import json
import os
import shutil
import socket
import zlib
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from icrl4aht_data.benchmark.tasks import Task, task_id
from icrl4aht_data.format.schema import CHUNK_DTYPE, HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from tests.helpers.random_play import SHARD

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


def socket_at(path: Path, root: Path) -> None:
    working_directory = Path.cwd()
    os.chdir(path.parent)  # the address of a socket is at most about 100 bytes
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(working_directory)


def chain_of_links(path: Path, root: Path) -> None:
    path.symlink_to("two")
    (path.parent / "two").symlink_to("three")
    (path.parent / "three").symlink_to("../../outside/secret.txt")


def deep_folder(root: Path) -> None:
    working_directory = Path.cwd()
    os.chdir(root / "meta")
    try:
        for _ in range(1500):
            Path("d").mkdir()
            os.chdir("d")
        Path("file").touch()
    finally:
        os.chdir(working_directory)


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
        new = replace(old, teammate=mate, task_id=task_id(old.track, old.split, old.layout_name, mate, old.seed))
        changed = [new if task is old else task for task in tasks]
        (root / TASKS).write_text("".join(json.dumps(asdict(task)) + "\n" for task in changed))
        for name in (HISTORIES, PROVENANCE):
            (root / name).write_text((root / name).read_text().replace(old.task_id, new.task_id))

    return spoil


def nested(levels: int) -> list:
    """Return lists in lists."""
    value: list = []
    for _ in range(levels):
        value = [value]
    return value


def many_names(values: list[dict[str, Any]]) -> list:
    """Return lines with many short task ids and one long one; an array of them would take gigabytes."""
    ids = [f"t{number}" for number in range(20_000)] + ["x" * 200_000]
    return [values[0] | {"history_id": number, "task_id": name} for number, name in enumerate(ids)]


def many_sets_of_shards(root: Path) -> None:
    """Let each line name another set of 99,999 shards."""

    def change(values: list[dict[str, Any]]) -> list:
        names = (f"data/teammate/coord_simple/train-{k:05}-of-{99_999 - k:05}.h5" for k in range(500))
        return [values[0] | {"history_id": number, "shard": name} for number, name in enumerate(names)]

    lines(change)(root)
    info(histories=500)(root)


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


class Bomb:
    """Object that creates a folder when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.target),)


def pickled(path: Path, root: Path) -> None:
    np.save(path, np.array([Bomb(outside(root) / "executed")], object), allow_pickle=True)


def archive(path: Path, root: Path) -> None:
    np.savez(path.with_suffix(".npz"), np.zeros(4, CHUNK_DTYPE))
    path.with_suffix(".npz").rename(path)


def gigabyte_of_zeros() -> bytes:
    """Return a gigabyte of zeros, deflated."""
    compressor = zlib.compressobj(9)
    return b"".join(compressor.compress(bytes(2**24)) for _ in range(64)) + compressor.flush()


def inflating(root: Path) -> None:
    """Replace the first chunk by one that inflates to a gigabyte."""
    data, path, rows = gigabyte_of_zeros(), root / SHARD, np.load(root / TABLE)
    rows["offset"][0], rows["size"][0], rows["crc32"][0] = path.stat().st_size, len(data), zlib.crc32(data)
    with path.open("ab") as stream:
        stream.write(data)
    np.save(root / TABLE, rows)


def inflating_within_bounds(root: Path) -> None:
    """Replace the first chunk by one of its size that inflates to more than a chunk has."""
    rows = np.load(root / TABLE)
    data = zlib.compress(bytes(300 * int(rows["size"][0])), 9)
    assert len(data) <= rows["size"][0]
    with (root / SHARD).open("r+b") as stream:
        stream.seek(int(rows["offset"][0]))
        stream.write(data.ljust(int(rows["size"][0]), b"\0"))
        stream.seek(int(rows["offset"][0]))
        rows["crc32"][0] = zlib.crc32(stream.read(int(rows["size"][0])))
    np.save(root / TABLE, rows)


def endless_heap(root: Path) -> None:
    """Set the size of the free space in the heap of texts to zero."""
    data = bytearray((root / SHARD).read_bytes())
    left = data.index(b"GCOL") + 16 + 16 + 16  # after the heap's header and "coord_simple" with its own
    assert data[left : left + 2] == b"\0\0"
    data[left + 8 : left + 16] = bytes(8)
    (root / SHARD).write_bytes(data)


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


def virtual(group: Any, out: Path) -> None:
    layout = h5py.VirtualLayout((4, 120), "i1")
    layout[0] = h5py.VirtualSource(str(out / "secret.h5"), "secret", (120,))
    group.create_virtual_dataset("actions", layout)


def external(group: Any, out: Path) -> None:
    group.create_dataset("actions", (480,), "i1", external=[(str(out / "secret.txt"), 0, 480)])


def filtered(group: Any, out: Path) -> None:
    """Create a dataset whose filter libhdf5 would load from a plugin."""
    low: Any = h5py
    properties = low.h5p.create(low.h5p.DATASET_CREATE)
    properties.set_chunk((1, 120))
    properties.set_filter(32_004, low.h5z.FLAG_OPTIONAL, (1,))
    space = low.h5s.create_simple((4, 120))
    low.h5d.create(group.id, b"actions", low.h5t.NATIVE_INT8, space, properties)


def another_name(file: Any, out: Path) -> None:
    file["0"]["more"] = h5py.ExternalLink(str(out / "secret.h5"), "/secret")


def group_link_out(file: Any, out: Path) -> None:
    file.move("0", "kept")
    file["0"] = h5py.ExternalLink(str(out / "secret.h5"), "/")


def endless_history(root: Path) -> None:
    """Let all datasets of the first published history have 2**39 rows, as its line states."""
    entry("histories_index.jsonl", T=2**39)(root)
    with h5py.File(root / "histories.h5", "r+") as file:
        group: Any = file["0"]
        for name, old in list(group.items()):
            rest, dtype = old.shape[1:], old.dtype
            del group[name]
            group.create_dataset(name, (2**39, *rest), dtype, chunks=(100, *rest), compression="gzip")


def inflating_published(file: Any, out: Path) -> None:
    """Replace the first chunks of the first published history by ones that inflate to a gigabyte."""
    data = gigabyte_of_zeros()
    for name in ("dones", "actions", "obs", "state"):
        stored = file["0"][name].id
        stored.write_direct_chunk((0,) * stored.rank, data)
