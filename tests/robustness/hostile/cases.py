"""Hostile releases, published files and servers, each with the message that must report the fault.

A hostile release has matching hashes, unless the case concerns the manifest or a file that cannot be hashed.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from icrl4aht_data.benchmark.tasks import Task, task_id
from icrl4aht_data.format.chunks import chunk_hash
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import CHUNK_DTYPE, HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from tests.helpers.random_releases import SHARD
from tests.servers.faults import Fault, LongBody, Redirect

TABLE = "meta/chunks/teammate/coord_simple/train-00000-of-00001.npy"
TERABYTE = 2**40

Tamper = Callable[[Path], object]
"""Called with the folder to change; its sibling `outside` has the files `secret.txt` and `secret.h5` and a pipe."""
Make = Callable[[Path, Path], object]
"""Called with a path where nothing exists and the root; creates something at the path."""
ChangeFile = Callable[[Any, Path], object]
"""Called with an open HDF5 file or group and the folder `outside`."""


def outside_folder(root: Path) -> Path:
    """Return the folder outside the release, which readers of the release must not touch."""
    return root.parent / "outside"


def policy_path(root: Path) -> str:
    """Return the path of the learned teammate's weights, relative to the release."""
    return next((root / "teammates").glob("*/policy.safetensors")).relative_to(root).as_posix()


def add_line(name: str) -> Tamper:
    """Return a function that adds a line to the manifest."""

    def append_line(root: Path) -> None:
        with (root / MANIFEST).open("a", encoding="utf-8") as stream:
            stream.write(f"{'0' * 64}  {name}\n")

    return append_line


def replace_file(name: str | Callable[[Path], str], make: Make) -> Tamper:
    """Return a function that removes a file or folder and calls `make` to create something in its place."""

    def replace_path(root: Path) -> None:
        path = root / (name if isinstance(name, str) else name(root))
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        make(path, root)

    return replace_path


def secret_link(path: Path, root: Path) -> None:
    path.symlink_to(outside_folder(root) / "secret.txt")


def folder_link(path: Path, root: Path) -> None:
    path.symlink_to(outside_folder(root))


def named_pipe(path: Path, root: Path) -> None:
    os.mkfifo(path)


def terabyte_file(path: Path, root: Path) -> None:
    """Create a sparse file of one terabyte, which takes no disk space."""
    with path.open("wb") as stream:
        stream.truncate(TERABYTE)


def file_writer(text: str | bytes) -> Make:
    """Return a function that creates a file with the given content."""
    return lambda path, root: path.write_bytes(text if isinstance(text, bytes) else text.encode())


def deep_json(levels: int) -> Make:
    """Return a function that creates a file of nested JSON objects."""
    return file_writer('{"a":' * levels + "1" + "}" * levels)


def change_json(name: str, change: Callable[[Any], Any]) -> Tamper:
    """Return a function that rewrites a JSON file; `change` edits the content in place or returns new content."""

    def rewrite_json(root: Path) -> None:
        value = json.loads((root / name).read_text())
        changed = change(value)
        (root / name).write_text(json.dumps(value if changed is None else changed))

    return rewrite_json


def change_lines(change: Callable[[list[dict[str, Any]]], list | None], name: str = HISTORIES) -> Tamper:
    """Return a function that rewrites a JSONL file; `change` edits the lines in place or returns new lines."""

    def rewrite_lines(root: Path) -> None:
        values = [json.loads(line) for line in (root / name).read_text().splitlines()]
        changed = change(values)
        text = "".join(json.dumps(value) + "\n" for value in (values if changed is None else changed))
        (root / name).write_text(text)

    return rewrite_lines


def set_entry(name: str = HISTORIES, /, **changes: Any) -> Tamper:
    """Return a function that changes fields of the first line of the index."""
    return change_lines(lambda values: values[0].update(changes), name)


def change_info(**changes: Any) -> Tamper:
    """Return a function that changes fields of info.json."""
    return change_json(INFO, lambda value: value.update(changes))


def set_theta(**changes: Any) -> Tamper:
    """Return a function that changes parameters of the learned teammate and updates the id of its task."""

    def rewrite_task(root: Path) -> None:
        tasks = [Task(**json.loads(line)) for line in (root / TASKS).read_text().splitlines()]
        old = next(task for task in tasks if task.teammate["kind"] == "rl")
        mate = old.teammate | {"theta": old.teammate["theta"] | changes}
        new = replace(old, teammate=mate)
        new = replace(new, task_id=task_id(new))
        changed = [new if task is old else task for task in tasks]
        (root / TASKS).write_text("".join(json.dumps(asdict(task)) + "\n" for task in changed))
        for name in (HISTORIES, PROVENANCE):
            (root / name).write_text((root / name).read_text().replace(old.task_id, new.task_id))

    return rewrite_task


def change_table(change: Callable[[np.ndarray], np.ndarray | None]) -> Tamper:
    """Return a function that rewrites the chunk table; `change` edits the table in place or returns a new table."""

    def rewrite_table(root: Path) -> None:
        rows = np.load(root / TABLE)
        changed = change(rows)
        np.save(root / TABLE, rows if changed is None else changed)

    return rewrite_table


def npy_header_only(header: str, version: bytes = b"\x01\x00", length: int | None = None) -> Make:
    """Return a function that creates a .npy file that ends after the header."""
    size = len(header) if length is None else length
    return file_writer(b"\x93NUMPY" + version + size.to_bytes(2 if version[0] == 1 else 4, "little") + header.encode())


def change_hdf5(change: ChangeFile, name: str = SHARD) -> Tamper:
    """Return a function that changes an HDF5 file without updating the chunk table."""

    def rewrite_hdf5(root: Path) -> None:
        with h5py.File(root / name, "r+") as file:
            change(file, outside_folder(root))

    return rewrite_hdf5


def set_actions(make: ChangeFile) -> ChangeFile:
    """Return a function that replaces the actions of the first group by the object that `make` creates."""

    def replace_actions(file: Any, out: Path) -> None:
        del file["0/actions"]
        make(file["0"], out)

    return replace_actions


def actions_dataset(shape: tuple[int, ...] = (4, 120), dtype: Any = "i1", **options: Any) -> ChangeFile:
    """Return a function that replaces the actions by a dataset of a given shape, dtype and storage."""
    return set_actions(lambda group, out: group.create_dataset("actions", shape, dtype, **options))


def actions_of_type(dtype: Any) -> ChangeFile:
    """Return a function that replaces the actions by a dataset of the given type."""
    return actions_dataset(dtype=dtype, chunks=(1, 120), compression="gzip")


def link_actions(target: Callable[[Path], Any]) -> ChangeFile:
    """Return a function that replaces the actions by a link."""
    return set_actions(lambda group, out: group.__setitem__("actions", target(out)))


class Case(NamedTuple):
    """Hostile input and the message that must report the fault.

    Attributes:
        kind: "release", "published" (files of the published code) or "served" (by a faulty server).
        message: a regular expression that some error or finding must match.
        tamper: function that damages a valid release or folder of published files.
        rules: faults of the server by path pattern, for a served release.
    """

    kind: str
    message: str
    tamper: Tamper
    rules: Mapping[str, Fault] = {}


CASES: dict[str, Case] = {}


def add_cases(kind: str, message: str, tamperings: Mapping[str, Tamper]) -> None:
    """Add hostile inputs of one kind that must be reported with the same message."""
    for name, tamper in tamperings.items():
        add_case(f"{kind}: {name}", Case(kind, message, tamper))


def add_hashed_cases(message: str, tamperings: Mapping[str, Tamper]) -> None:
    """Add hostile releases with a matching manifest, because an attacker can also write the manifest."""

    def with_manifest(tamper: Tamper) -> Tamper:
        return lambda root: (tamper(root), write_manifest(root))

    add_cases("release", message, {name: with_manifest(tamper) for name, tamper in tamperings.items()})


def add_case(name: str, case: Case) -> None:
    assert name not in CASES, name
    CASES[name] = case


# Cases of paths that point outside the release

_NAMES = {
    "up": "../outside/new",
    "absolute": "/tmp/new",
    "backslash": "..\\outside\\new",
    "drive": "C:/new",
    "control": "meta/\x1b[2J",
    "long": "x" * 300,
}
add_cases(
    "release", "points outside the release", {f"manifest: {name}": add_line(path) for name, path in _NAMES.items()}
)
add_cases(
    "release", "are the same file on some systems", {"manifest: case": add_line(SHARD.replace("teammate", "TEAMMATE"))}
)
add_cases("release", "not a file that a release may contain", {"manifest: code": add_line("sitecustomize.py")})
_many = "".join(f"data/d/d/{number}.h5\n{number:064}  " for number in range(50_000)) + "data/d/d/last.h5"
add_cases("release", "listed in the manifest, but missing", {"manifest: many lines": add_line(_many)})

for _file in (INFO, SHARD, policy_path):
    _label = _file if isinstance(_file, str) else "teammate"
    add_cases("release", "points outside the release", {f"link out: {_label}": replace_file(_file, secret_link)})
    add_cases("release", "neither a file nor a folder", {f"pipe: {_label}": replace_file(_file, named_pipe)})
    _too_large = r"expected at most|more than|truncated|twice|chunk table"
    add_cases("release", _too_large, {f"a terabyte: {_label}": replace_file(_file, terabyte_file)})


def deep_folder(root: Path) -> None:
    with contextlib.chdir(root / "meta"):
        for _ in range(1500):
            Path("d").mkdir()
            os.chdir("d")
        Path("file").touch()


_folders = ("data", "meta")
add_cases(
    "release",
    "points outside the release",
    {f"folder linked out: {name}": replace_file(name, folder_link) for name in _folders},
)
add_cases("release", "extra: not listed", {"unlisted pipe": replace_file("extra", named_pipe)})
add_cases("release", "not listed in the manifest", {"folders too deep": deep_folder})


def _add_name_with_terminal_codes(root: Path) -> None:
    Path(os.fsdecode(os.fsencode(root) + b"/\x1b]0;owned\x07\xff")).touch()


add_cases("release", r"\\x1b\]0;owned.*not listed", {"name with terminal codes": _add_name_with_terminal_codes})

add_hashed_cases("matching regex", {"checkpoint's hash": set_theta(sha256="../../outside")})
_paths = {"above": "../../outside", "absolute": "/etc", "backslash": "..\\..\\outside", "surrogate": "\ud800"}
add_hashed_cases(
    "expected a path in the teammate suite",
    {f"checkpoint path: {name}": set_theta(checkpoint=path) for name, path in _paths.items()},
)

# Cases of extreme numbers, sizes and texts

_integers = {"T": 2**62, "seed": 10**4000}
add_hashed_cases(
    "Expected `int` <=", {f"large {name}": set_entry(**{name: value}) for name, value in _integers.items()}
)
add_hashed_cases("expected episodes of 20 steps", {"rows: 2**39": set_entry(T=2**39)})
add_hashed_cases("the index implies", {"rows: 20 * 2**35": set_entry(T=20 * 2**35, episodes=2**35)})
add_hashed_cases("histories", {"info: histories 2**62": change_info(histories=2**62)})
_size = change_json(INFO, lambda value: value["shards"].update({SHARD: 2**61}))
add_hashed_cases(r"expected 2,305,843,009,213,693,952 bytes, found \d", {"info: shard of 2**61 bytes": _size})
add_hashed_cases("shards: expected", {"info: no shards": change_info(shards={})})
_digits = file_writer('{"format_version": ' + "9" * 10**6 + "}")
add_hashed_cases(
    "malformed", {"info: deep": replace_file(INFO, deep_json(100_000)), "info: digits": replace_file(INFO, _digits)}
)
add_hashed_cases("SemVer", {"info: version with terminal codes": change_info(data_version="\x1b[2J")})


_nested = json.loads("[" * 400 + "]" * 400)
_deep_theta = change_lines(lambda values: values[0]["teammate"]["theta"].update(x=_nested), TASKS)
_deep_files = {f"deep: {name}": replace_file(name, deep_json(500)) for name in (INFO, PROVENANCE)}
add_hashed_cases("levels, found more", _deep_files | {"tasks: deep theta": _deep_theta})
_endless_line = file_writer(b"a" * 2**24)
for _of, _file in {"index": HISTORIES, "tasks": TASKS}.items():
    add_hashed_cases("expected at most", {f"{_of}: one endless line": replace_file(_file, _endless_line)})
add_hashed_cases("line 1: ", {"index: a surrogate": set_entry(task_id="\ud800")})
add_hashed_cases("line 1: JSON is malformed", {"index: not a number": set_entry(score=float("nan"))})
add_hashed_cases("Expected `float` <", {"index: infinite": set_entry(return_end=1e308)})

# Cases of damaged chunk tables and chunks


class Bomb:
    """Object that creates a folder when unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.target),)


def pickled_table(path: Path, root: Path) -> None:
    np.save(path, np.array([Bomb(outside_folder(root) / "executed")], object), allow_pickle=True)


def archived_table(path: Path, root: Path) -> None:
    np.savez(path.with_suffix(".npz"), np.zeros(4, CHUNK_DTYPE))
    path.with_suffix(".npz").rename(path)


def gigabyte_of_zeros() -> bytes:
    """Return a gigabyte of zeros in zlib format: a first block of 16 MiB, then 63 copies of one compressed block."""
    compressor = zlib.compressobj(9)
    first, part = (compressor.compress(bytes(2**24)) + compressor.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    checksum = (2**30 % 65521) << 16 | 1  # Adler-32 checksum of a gigabyte of zeros
    return first + 63 * part + compressor.flush()[:-4] + checksum.to_bytes(4, "big")


def inflating_chunk(root: Path) -> None:
    """Replace the first chunk by a chunk that inflates to a gigabyte."""
    data, path, rows = gigabyte_of_zeros(), root / SHARD, np.load(root / TABLE)
    rows["offset"][0], rows["size"][0] = path.stat().st_size, len(data)
    rows["crc32"][0], rows["hash"][0] = zlib.crc32(data), np.frombuffer(chunk_hash(data), np.uint8)
    with path.open("ab") as stream:
        stream.write(data)
    np.save(root / TABLE, rows)


_HEADER = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"
_ROWS = str(CHUNK_DTYPE.descr)
_TABLES = {
    "2**50 rows": npy_header_only(_HEADER.format(_ROWS, f"({2**50},)")),
    "long header": npy_header_only("{", b"\x03\x00", 2**32 - 1),
    "objects": npy_header_only(_HEADER.format("[('offset', '|O'), ('size', '<u4')]", "(4,)")),
    "calls": npy_header_only(_HEADER.format("__import__('os').system('true')", "(4,)")),
    "pickle": pickled_table,
    "archive": archived_table,
}
add_hashed_cases(
    "chunk table|expected rows of", {f"table: {name}": replace_file(TABLE, make) for name, make in _TABLES.items()}
)
add_hashed_cases(
    "found a larger chunk", {"table: huge chunks": change_table(lambda rows: rows["size"].__setitem__(0, 2**32 - 1))}
)
add_hashed_cases(
    "cover|crc32", {"table: one offset": change_table(lambda rows: rows["offset"].__setitem__(slice(None), 0))}
)
add_hashed_cases("cannot be", {"table: no bytes": change_table(lambda rows: rows["size"].__setitem__(0, 0))})
add_hashed_cases("cannot be|twice", {"chunk that inflates to a gigabyte": inflating_chunk})

# Cases of HDF5 structures that libhdf5 would follow, load or trust


def virtual_data(group: Any, out: Path) -> None:
    layout = h5py.VirtualLayout((4, 120), "i1")
    layout[0] = h5py.VirtualSource(str(out / "secret.h5"), "secret", (120,))
    group.create_virtual_dataset("actions", layout)


def external_data(group: Any, out: Path) -> None:
    group.create_dataset("actions", (480,), "i1", external=[(str(out / "secret.txt"), 0, 480)])


def filtered_data(group: Any, out: Path) -> None:
    """Create a dataset with a filter that libhdf5 would load from a plugin."""
    low: Any = h5py
    properties = low.h5p.create(low.h5p.DATASET_CREATE)
    properties.set_chunk((1, 120))
    properties.set_filter(32_004, low.h5z.FLAG_OPTIONAL, (1,))
    space = low.h5s.create_simple((4, 120))
    low.h5d.create(group.id, b"actions", low.h5t.NATIVE_INT8, space, properties)


def add_external_link(file: Any, out: Path) -> None:
    file["0"]["more"] = h5py.ExternalLink(str(out / "secret.h5"), "/secret")


def replace_group_by_link(file: Any, out: Path) -> None:
    file.move("0", "kept")
    file["0"] = h5py.ExternalLink(str(out / "secret.h5"), "/")


_SHARED: dict[str, dict[str, ChangeFile]] = {
    "may lead to another file": {
        "soft link": link_actions(lambda out: h5py.SoftLink("/0/state")),
        "link to a file": link_actions(lambda out: h5py.ExternalLink(str(out / "secret.h5"), "/secret")),
        "link to a pipe": link_actions(lambda out: h5py.ExternalLink(str(out / "pipe"), "/secret")),
    },
    "in other files|local heap": {"external storage": set_actions(external_data), "virtual": set_actions(virtual_data)},
    r"filters \[32004\]|found \(\[32004\]": {"a plugin's filter": set_actions(filtered_data)},
    "expected numbers": {
        "texts": actions_of_type(h5py.string_dtype()),
        "references": actions_of_type(h5py.ref_dtype),
        "records": actions_of_type([("a", "i4"), ("b", "i4")]),
    },
    "groups: expected|may lead to another file": {"group linked out": replace_group_by_link},
}
"""Message -> changes of the first group, of shards and of published files."""
_OF_SHARDS: dict[str, dict[str, ChangeFile]] = {
    "expected": {"endless rows": actions_dataset((2**50,), chunks=(120,), compression="gzip")},
    "chunks": {"huge chunks": actions_dataset(chunks=(1, 2**30), maxshape=(4, None), compression="gzip")},
    "not a dataset|expected": {"circle of groups": set_actions(lambda group, out: group.__setitem__("actions", group))},
    r"expected \[.*found \[.*'more'": {"one name more": add_external_link},
    "attribute": {"attribute of texts": lambda file, out: file.attrs.create("layout", ["x"] * 9)},
}
for _message, _changes in (_SHARED | _OF_SHARDS).items():
    add_hashed_cases(_message, {f"shard: {name}": change_hdf5(change) for name, change in _changes.items()})

# Cases of published files


def endless_history(root: Path) -> None:
    """Change the first published history to 2**39 rows, in all its datasets and in the index."""
    set_entry("histories_index.jsonl", T=2**39)(root)
    with h5py.File(root / "histories.h5", "r+") as file:
        group: Any = file["0"]
        for name, old in list(group.items()):
            rest, dtype = old.shape[1:], old.dtype
            del group[name]
            group.create_dataset(name, (2**39, *rest), dtype, chunks=(100, *rest), compression="gzip")


def inflating_published_chunks(file: Any, out: Path) -> None:
    """Replace the first chunks of the first published history by chunks that inflate to a gigabyte."""
    data = gigabyte_of_zeros()
    for name in ("dones", "actions", "obs", "state"):
        stored = file["0"][name].id
        stored.write_direct_chunk((0,) * stored.rank, data)


_H5, _INDEX = "histories.h5", "histories_index.jsonl"
for _message, _changes in _SHARED.items():
    _tamperings = {name: change_hdf5(change, _H5) for name, change in _changes.items()}
    add_cases("published", f"group /0.*({_message})|cannot be read: .*{_message}", _tamperings)
_PUBLISHED = (_H5, _INDEX)
for _message, _make in {
    "points outside": secret_link,
    "neither a file": named_pipe,
    "at most|HDF5": terabyte_file,
}.items():
    add_cases("published", _message, {f"{_make.__name__}: {name}": replace_file(name, _make) for name in _PUBLISHED})
_endless = change_hdf5(actions_dataset((2**39,), "i4", chunks=(4096,), compression="gzip"), _H5)
add_cases("published", "expected numbers of shape", {"endless rows": _endless})
add_cases("published", "cannot contain the declared|memory", {"endless history": endless_history})
add_cases(
    "published",
    "contradicts the|inflate",
    {"chunk that inflates to a gigabyte": change_hdf5(inflating_published_chunks, _H5)},
)
add_cases("published", "Expected `int` >= 1", {"rows below zero": set_entry(_INDEX, T=-5)})
add_cases("published", "missing", {"group above": set_entry(_INDEX, h5_group="../0")})
add_cases(
    "published", "lite", {"circle of groups": change_hdf5(lambda file, out: file["0"].__setitem__("a", file["0"]), _H5)}
)
add_cases("published", "printable", {"task id of surrogates": set_entry(_INDEX, task_id="\ud800")})
add_cases("published", "expected at most", {"one endless line": replace_file(_INDEX, _endless_line)})

# Cases of faulty servers

add_cases(
    "served",
    "expected at most",
    {f"a terabyte: {name}": replace_file(name, terabyte_file) for name in (MANIFEST, TABLE)},
)
add_cases("served", "expected at most|sha256", {"a terabyte: shard": replace_file(SHARD, terabyte_file)})
add_cases("served", "points outside the release", {"names above": add_line("../../new")})
for _name, _message, _rules in (
    ("endless manifest", "MANIFEST", {"*/MANIFEST.sha256": LongBody(TERABYTE)}),
    ("endless index", "expected at most|sent more|says", {f"*/{HISTORIES}": LongBody(TERABYTE)}),
    ("endless shard", "expected at most", {"*.h5": LongBody(TERABYTE)}),
    ("to a local file", "info.json", {f"*/{INFO}": Redirect("file:///etc/passwd")}),
    ("to another protocol", "h5", {"*.h5": Redirect("ftp://127.0.0.1/x")}),
    ("in a circle", "info.json", {f"*/{INFO}": Redirect(f"/{INFO}")}),
):
    add_case(f"served: {_name}", Case("served", _message, lambda root: None, _rules))
