"""Hostile releases: each case is a function that spoils a release, or published files, in one way.

A case's hashes hold, unless it is about the manifest or its file cannot be hashed: whoever means harm can write hashes.
"""

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
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import CHUNK_DTYPE, HISTORIES, INFO, MANIFEST, PROVENANCE, TASKS
from icrl4aht_data.remote.download import ORIGIN
from tests.helpers.random_play import SHARD

TABLE = "meta/chunks/teammate/coord_simple/train-00000-of-00001.npy"
TERABYTE = 2**40

Spoil = Callable[[Path], object]
"""Called with the folder to spoil. Beside it lies `outside`, a folder with `secret.txt` and `secret.h5`."""

CASES: dict[str, tuple[Spoil, str]] = {}
"""name -> what it does, and what some message about it says (a regular expression)"""


def case(name: str, message: str, spoil: Spoil, *, hashed: bool = True) -> None:
    """Add one; `hashed`: write the manifest anew afterwards."""

    def run(root: Path) -> None:
        spoil(root)
        if hashed:
            write_manifest(root)

    assert name not in CASES, name
    CASES[name] = run, message


def teammate(root: Path) -> str:
    """The weights of the release's learned teammate."""
    return next((root / "teammates").glob("*/policy.safetensors")).relative_to(root).as_posix()


def outside(root: Path) -> Path:
    return root.parent / "outside"


def listed(name: str, digest: str = "0" * 64) -> Spoil:
    """One more line in the manifest."""

    def spoil(root: Path) -> None:
        with (root / MANIFEST).open("a", encoding="utf-8") as stream:
            stream.write(f"{digest}  {name}\n")

    return spoil


def replaced(name: str | Callable[[Path], str], make: Callable[[Path, Path], object]) -> Spoil:
    """Another thing in place of a file: make(its path, the root)."""

    def spoil(root: Path) -> None:
        path = root / (name if isinstance(name, str) else name(root))
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        make(path, root)

    return spoil


def socket_at(path: Path, root: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's path is short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def sparse(path: Path, root: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(TERABYTE)


def content(text: str | bytes) -> Callable[[Path, Path], object]:
    return lambda path, root: path.write_bytes(text if isinstance(text, bytes) else text.encode())


def json_file(name: str, change: Callable[[Any], Any]) -> Spoil:
    """A JSON file with its parsed content changed in place, or replaced by what `change` gives."""

    def spoil(root: Path) -> None:
        value = json.loads((root / name).read_text())
        changed = change(value)
        (root / name).write_text(json.dumps(value if changed is None else changed))

    return spoil


def lines(change: Callable[[list[dict[str, Any]]], list | None], name: str = HISTORIES) -> Spoil:
    """The same of a file of JSON lines."""

    def spoil(root: Path) -> None:
        values = [json.loads(line) for line in (root / name).read_text().splitlines()]
        changed = change(values)
        text = "".join(json.dumps(value) + "\n" for value in (values if changed is None else changed))
        (root / name).write_text(text)

    return spoil


def entry(**changes: Any) -> Spoil:
    return lines(lambda values: values[0].update(changes))


def theta(**changes: Any) -> Spoil:
    """Another theta of the learned teammate, under a task id that fits."""

    def spoil(root: Path) -> None:
        tasks = [Task(**json.loads(line)) for line in (root / TASKS).read_text().splitlines()]
        old = next(task for task in tasks if task.teammate["kind"] == "rl")
        mate = old.teammate | {"theta": old.teammate["theta"] | changes}
        new = replace(old, teammate=mate, task_id=task_id(old.track, old.split, old.layout_name, mate, old.seed))
        made = [new if task is old else task for task in tasks]
        (root / TASKS).write_text("".join(json.dumps(asdict(task)) + "\n" for task in made))
        for name in (HISTORIES, PROVENANCE):
            (root / name).write_text((root / name).read_text().replace(old.task_id, new.task_id))

    return spoil


def table(change: Callable[[np.ndarray], np.ndarray | None]) -> Spoil:
    def spoil(root: Path) -> None:
        rows = np.load(root / TABLE)
        changed = change(rows)
        np.save(root / TABLE, rows if changed is None else changed)

    return spoil


def npy(header: str, version: bytes = b"\x01\x00", length: int | None = None) -> Callable[[Path, Path], object]:
    size = len(header) if length is None else length
    return content(b"\x93NUMPY" + version + size.to_bytes(2 if version[0] == 1 else 4, "little") + header.encode())


class Bomb:
    """What would run if it were unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.target),)


def pickled(path: Path, root: Path) -> None:
    np.save(path, np.array([Bomb(outside(root) / "executed")], object), allow_pickle=True)


def archive(path: Path, root: Path) -> None:
    np.savez(path.with_suffix(".npz"), np.zeros(4, CHUNK_DTYPE))
    path.with_suffix(".npz").rename(path)


def inflating(root: Path) -> None:
    """The first chunk becomes one that inflates to a gigabyte."""
    maker = zlib.compressobj(9)
    data = b"".join(maker.compress(bytes(2**24)) for _ in range(64)) + maker.flush()
    path, rows = root / SHARD, np.load(root / TABLE)
    rows["offset"][0], rows["size"][0], rows["crc32"][0] = path.stat().st_size, len(data), zlib.crc32(data)
    with path.open("ab") as stream:
        stream.write(data)
    np.save(root / TABLE, rows)


def inflating_within_bounds(root: Path) -> None:
    """The same, with a size that such a chunk may have."""
    rows = np.load(root / TABLE)
    data = zlib.compress(bytes(300 * int(rows["size"][0])), 9)
    assert len(data) <= rows["size"][0]
    with (root / SHARD).open("r+b") as stream:
        stream.seek(int(rows["offset"][0]))
        stream.write(data.ljust(int(rows["size"][0]), b"\0"))
        stream.seek(int(rows["offset"][0]))
        rows["crc32"][0] = zlib.crc32(stream.read(int(rows["size"][0])))
    np.save(root / TABLE, rows)


def deep_folder(root: Path) -> None:
    here = Path.cwd()
    os.chdir(root / "meta")
    try:
        for _ in range(1500):
            Path("d").mkdir()
            os.chdir("d")
        Path("file").touch()
    finally:
        os.chdir(here)


def nested(levels: int) -> list:
    value: list = []
    for _ in range(levels):
        value = [value]
    return value


def many_names(values: list[dict[str, Any]]) -> list:
    """Many short task ids and one long one: side by side in one array they would have gigabytes."""
    ids = [f"t{number}" for number in range(20_000)] + ["x" * 200_000]
    return [values[0] | {"history_id": number, "task_id": name} for number, name in enumerate(ids)]


def many_sets(root: Path) -> None:
    """Each line names another set of 99,999 shards."""

    def change(values: list[dict[str, Any]]) -> list:
        names = (f"data/teammate/coord_simple/train-{k:05}-of-{99_999 - k:05}.h5" for k in range(500))
        return [values[0] | {"history_id": number, "shard": name} for number, name in enumerate(names)]

    lines(change)(root)
    json_file(INFO, lambda value: value.update(histories=500))(root)


# Paths

for name, path in {
    "up": "../outside/new",
    "up within": "meta/../../outside/new",
    "absolute": "/tmp/new",
    "backslash": "..\\outside\\new",
    "drive": "C:/new",
    "control": "meta/\x1b[2J",
    "long": "x" * 300,
    "device": "meta/NUL.json",
    "ends in a dot": "meta/info.json.",
}.items():
    case(f"manifest: {name}", "leads out of the release", listed(path), hashed=False)
case("manifest: upper case", "are one file on some systems", listed("meta/INFO.json"), hashed=False)
case("manifest: file as folder", "is a file by another line", listed("meta/info.json/x"), hashed=False)
case(
    "manifest: many lines",
    "listed in the manifest, but missing",
    listed("".join(f"d/{number}\n{number:064}  " for number in range(50_000)) + "d/last"),
    hashed=False,
)

_ANY = (INFO, HISTORIES, TASKS, PROVENANCE, TABLE, SHARD, "README.md", teammate)
for name in (*_ANY, MANIFEST, ORIGIN):
    label = name if isinstance(name, str) else "teammate"
    out = replaced(name, lambda path, root: path.symlink_to(outside(root) / "secret.txt"))
    case(f"link out: {label}", "leads out of the release", out, hashed=False)
    pipe = replaced(name, lambda path, root: os.mkfifo(path))
    case(f"pipe: {label}", "neither a file nor a folder", pipe, hashed=False)
    case(
        f"a terabyte: {label}",
        r"expected at most|more than|truncated|twice|chunk table",
        replaced(name, sparse),
        hashed=False,
    )
for name in ("data", "teammates", "meta/chunks", "meta"):
    out = replaced(name, lambda path, root: path.symlink_to(outside(root)))
    case(f"folder linked out: {name}", "leads out of the release", out, hashed=False)


def chain(path: Path, root: Path) -> None:
    path.symlink_to("two")
    (path.parent / "two").symlink_to("three")
    (path.parent / "three").symlink_to("../../outside/secret.txt")


case("links in a chain", "leads out of the release", replaced(TASKS, chain), hashed=False)
case(
    "links in a circle",
    "cannot be followed",
    replaced(TASKS, lambda path, root: path.symlink_to(path.name)),
    hashed=False,
)
case("socket", "neither a file nor a folder", replaced(TASKS, socket_at), hashed=False)
case("device", "leads out", replaced(TASKS, lambda path, root: path.symlink_to("/dev/zero")), hashed=False)
case("pipe that nobody lists", "extra: not listed", replaced("extra", lambda path, root: os.mkfifo(path)), hashed=False)
case("folders too deep", "not listed in the manifest", deep_folder, hashed=False)
case(
    "name for a terminal",
    r"\\x1b\]0;owned.*not listed",
    lambda root: Path(os.fsdecode(os.fsencode(root) + b"/\x1b]0;owned\x07\xff")).touch(),
    hashed=False,
)
case("checkpoint by its hash, above", "expected 64 digits", theta(sha256="../../outside"))
case("checkpoint by its hash, absolute", "expected 64 digits", theta(sha256="/etc"))
case("checkpoint by its path, above", "expected a path within", theta(checkpoint="../../outside"))
case("checkpoint by its path, absolute", "expected a path within", theta(checkpoint="/etc"))
case("checkpoint by its path, backslash", "expected a path within", theta(checkpoint="..\\..\\outside"))
case("checkpoint by its path, surrogate", "expected a path within", theta(checkpoint="\ud800"))

# Sizes

case("rows: 2**62", "expected less than", entry(T=2**62))
case("rows: 2**39", "the index implies", entry(T=2**39))
case("episodes: 2**62", "episodes in", entry(episodes=2**62))
case("env_idx: 2**70", "at most 64 bits", entry(env_idx=2**70))
case("seed: 4,000 digits", "at most 64 bits", entry(seed=10**4000))
case("info: histories 2**62", "histories", json_file(INFO, lambda value: value.update(histories=2**62)))
case(
    "info: steps 2**200",
    "environment",
    json_file(INFO, lambda value: value["environment"].update(kept_steps=2**200)),
)
case(
    "info: shard of 2**61 bytes",
    "shards: expected",
    json_file(INFO, lambda value: value["shards"].update({SHARD: 2**61})),
)
case("info: no shards", "shards: expected", json_file(INFO, lambda value: value.update(shards={})))
case("info: too deep", "malformed", replaced(INFO, content('{"a":' * 100_000 + "1" + "}" * 100_000)))
case("info: deep", "levels deep", replaced(INFO, content('{"a":' * 500 + "1" + "}" * 500)))
case(
    "info: a number of a million digits",
    "malformed",
    replaced(INFO, content('{"format_version": ' + "9" * 10**6 + "}")),
)
case(
    "info: version for a terminal", "data_version", json_file(INFO, lambda value: value.update(data_version="\x1b[2J"))
)
case("index: one endless line", "a line has more than", replaced(HISTORIES, content(b"a" * 2**24)))
case("index: wide names", "printable characters", lines(many_names))
case("index: a surrogate", "printable characters", entry(task_id="\ud800"))
case("index: not a number", "expected a number below", entry(score=float("nan")))
case("index: infinite", "expected a number below", entry(return_end=1e308))
case("index: many sets of shards", "implies this shard", many_sets)
case("tasks: one endless line", "expected at most", replaced(TASKS, content(b"a" * 2**24)))
case(
    "tasks: deep theta",
    "levels deep",
    lines(lambda values: values[0]["teammate"]["theta"].update(x=nested(400)), TASKS),
)
case("tasks: seed of 4,000 digits", "at most 64 bits", lines(lambda values: values[0].update(seed=10**4000), TASKS))
case("provenance: a list", "an object of objects", replaced(PROVENANCE, content("[]")))
case(
    "provenance: lists",
    "an object of objects",
    json_file(PROVENANCE, lambda value: value.update({name: [] for name in value})),
)
case(
    "provenance: streams in words",
    "statistics",
    json_file(PROVENANCE, lambda value: [note.update(streams_recorded="many") for note in value.values()]),
)
case("provenance: deep", "levels deep", replaced(PROVENANCE, content('{"a":' * 500 + "1" + "}" * 500)))

_HEADER = "{{'descr': {}, 'fortran_order': {}, 'shape': {}, }}"
_ROWS = str(CHUNK_DTYPE.descr)
for name, make in {
    "promises rows": npy(_HEADER.format(_ROWS, False, "(2**50,)".replace("2**50", str(2**50)))),
    "promises rows beyond 64 bits": npy(_HEADER.format(_ROWS, False, f"({2**70},)")),
    "promises a header": npy("{", b"\x03\x00", 2**32 - 1),
    "objects": npy(_HEADER.format("[('offset', '|O'), ('size', '<u4')]", False, "(4,)")),
    "calls": npy(_HEADER.format("__import__('os').system('true')", False, "(4,)")),
    "pickle": pickled,
    "archive": archive,
    "columns first": lambda path, root: np.save(path, np.asfortranarray(np.zeros((4, 4)))),
}.items():
    case(f"table: {name}", "chunk table|expected rows of", replaced(TABLE, make))
case("table: huge chunks", "covers more than", table(lambda rows: rows["size"].__setitem__(0, 2**32 - 1)))
case("table: one place for all", "cover|crc32", table(lambda rows: rows["offset"].__setitem__(slice(None), 0)))
case("table: no bytes", "cannot be", table(lambda rows: rows["size"].__setitem__(0, 0)))
case("table: many empty lines", "cover", table(lambda rows: np.concatenate([rows, np.zeros(10**6, CHUNK_DTYPE)])))
case("chunk that inflates to a gigabyte", "cannot be|twice", inflating)
case("chunk that inflates a little", "does not inflate to", inflating_within_bounds)

# What libhdf5 would follow, load or believe


def structure(change: Callable[[Any, Path], object]) -> Spoil:
    """The shard's structure changed, the chunk table left alone."""

    def spoil(root: Path) -> None:
        with h5py.File(root / SHARD, "r+") as file:
            change(file, outside(root))

    return spoil


def instead(make: Callable[[Any, Path], Any]) -> Callable[[Any, Path], object]:
    """Something in place of the actions of the first group."""

    def change(file: Any, out: Path) -> None:
        del file["0/actions"]
        make(file["0"], out)

    return change


def link(target: Callable[[Path], Any]) -> Callable[[Any, Path], object]:
    def make(group: Any, out: Path) -> None:
        group["actions"] = target(out)

    return instead(make)


def virtual(group: Any, out: Path) -> None:
    layout = h5py.VirtualLayout((4, 120), "i1")
    layout[0] = h5py.VirtualSource(str(out / "secret.h5"), "secret", (120,))
    group.create_virtual_dataset("actions", layout)


def filtered(group: Any, out: Path, shape: tuple[int, ...] = (4, 120), chunk: tuple[int, ...] = (1, 120)) -> None:
    low: Any = h5py
    made = low.h5p.create(low.h5p.DATASET_CREATE)
    made.set_chunk(chunk)
    made.set_filter(32_004, low.h5z.FLAG_OPTIONAL, (1,))
    space = low.h5s.create_simple(shape)
    low.h5d.create(group.id, b"actions", low.h5t.NATIVE_INT8, space, made)


def kind(dtype: Any) -> Callable[[Any, Path], object]:
    return lambda group, out: group.create_dataset("actions", (4, 120), dtype, chunks=(1, 120), compression="gzip")


STRUCTURES: dict[str, tuple[str, Callable[[Any, Path], object]]] = {
    "soft link": ("lead out of the file", link(lambda out: h5py.SoftLink("/0/state"))),
    "link to a file": ("lead out of the file", link(lambda out: h5py.ExternalLink(str(out / "secret.h5"), "/secret"))),
    "link to a pipe": ("lead out of the file", link(lambda out: h5py.ExternalLink(str(out / "pipe"), "/secret"))),
    "external storage": (
        "in other files",
        instead(
            lambda group, out: group.create_dataset(
                "actions", (480,), "i1", external=[(str(out / "secret.txt"), 0, 480)]
            )
        ),
    ),
    "virtual": ("in other files", instead(virtual)),
    "a plugin's filter": (r"filters \[32004\]", instead(filtered)),
    "texts": ("expected numbers", instead(kind(h5py.string_dtype()))),
    "references": ("expected numbers", instead(kind(h5py.ref_dtype))),
    "lists": ("expected numbers", instead(kind(h5py.vlen_dtype("i4")))),
    "records": ("expected numbers", instead(kind([("a", "i4"), ("b", "i4")]))),
    "endless rows": (
        "expected",
        instead(lambda group, out: group.create_dataset("actions", (2**50,), "i1", chunks=(120,), compression="gzip")),
    ),
    "huge chunks": (
        "chunks",
        instead(
            lambda group, out: group.create_dataset(
                "actions", (4, 120), "i1", chunks=(1, 2**30), maxshape=(4, None), compression="gzip"
            )
        ),
    ),
    "circle of groups": ("not a dataset|expected", instead(lambda group, out: group.__setitem__("actions", group))),
    "one name more": (
        r"expected \[.*found \[.*'more'",
        lambda file, out: file["0"].__setitem__("more", h5py.ExternalLink(str(out / "secret.h5"), "/secret")),
    ),
    "group linked out": (
        "groups: expected|lead out of the file",
        lambda file, out: (
            file.move("0", "kept"),
            file.__setitem__("0", h5py.ExternalLink(str(out / "secret.h5"), "/")),
        ),
    ),
    "attribute of texts": ("attribute", lambda file, out: file.attrs.create("layout", ["x"] * 9)),
    "attribute of references": (
        "attribute",
        lambda file, out: file.attrs.create("layout", file.ref, dtype=h5py.ref_dtype),
    ),
}


def heap_without_end(root: Path) -> None:
    """The room that is left in the heap of texts becomes none."""
    data = bytearray((root / SHARD).read_bytes())
    left = data.index(b"GCOL") + 16 + 16 + 16  # the heap's head, and "coord_simple" with its own
    assert data[left : left + 2] == b"\0\0"
    data[left + 8 : left + 16] = bytes(8)
    (root / SHARD).write_bytes(data)


case("shard: texts without end", "not stored as libhdf5", heap_without_end)
for name, (message, change) in STRUCTURES.items():
    case(f"shard: {name}", message, structure(change))
