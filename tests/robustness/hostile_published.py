"""The published code's files, hostile: each case spoils a folder of them in one way; see `hostile_folders`."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.robustness.hostile_folders import STRUCTURES, Spoil, content, instead, lines, outside, replaced, sparse

PUBLISHED = ("histories.h5", "histories_index.jsonl", "tasks.jsonl", "provenance.json")

PUBLISHED_CASES: dict[str, tuple[Spoil, str]] = {}
"""The same of folders with the published code's files."""


def inside_h5(change: Callable[[Any, Path], object]) -> Spoil:
    def spoil(root: Path) -> None:
        with h5py.File(root / "histories.h5", "r+") as file:
            change(file, outside(root))

    return spoil


def row(**changes: Any) -> Spoil:
    return lines(lambda values: values[0].update(changes), "histories_index.jsonl")


def endless(file: Any, out: Path) -> None:
    file["0"].create_dataset("actions", (2**39,), "i4", chunks=(4096,), compression="gzip")


def endless_history(root: Path) -> None:
    row(T=2**39)(root)
    with h5py.File(root / "histories.h5", "r+") as file:
        group: Any = file["0"]
        for name, dataset in list(group.items()):
            rest, dtype = dataset.shape[1:], dataset.dtype
            del group[name]
            group.create_dataset(name, (2**39, *rest), dtype, chunks=(100, *rest), compression="gzip")


def bomb_chunk(root: Path) -> None:
    with h5py.File(root / "histories.h5", "r+") as file:
        group: Any = file["0"]
        maker = zlib.compressobj(9)
        data = b"".join(maker.compress(bytes(2**24)) for _ in range(64)) + maker.flush()
        for name in ("dones", "actions", "obs", "state"):
            group[name].id.write_direct_chunk((0,) * group[name].ndim, data)


PUBLISHED_CASES |= {
    f"link out: {name}": (replaced(name, lambda path, root: path.symlink_to(outside(root) / "secret.txt")), "leads out")
    for name in PUBLISHED
}
PUBLISHED_CASES |= {
    f"pipe: {name}": (replaced(name, lambda path, root: os.mkfifo(path)), "neither a file") for name in PUBLISHED
}
PUBLISHED_CASES |= {f"a terabyte: {name}": (replaced(name, sparse), "at most|HDF5") for name in PUBLISHED}
PUBLISHED_CASES |= {
    name: (inside_h5(change), f"group /0.*({message})|cannot be read: .*{message}")
    for name, (message, change) in STRUCTURES.items()
    if "attribute" not in name and name not in ("one name more", "endless rows", "huge chunks", "circle of groups")
}
PUBLISHED_CASES |= {
    "endless rows": (inside_h5(instead(lambda group, out: endless(group.parent, out))), "expected numbers of shape"),
    "endless history": (endless_history, "cannot hold them|memory"),
    "huge chunks": (
        inside_h5(
            instead(
                lambda group, out: group.create_dataset(
                    "actions", (120,), "i4", chunks=(2**28,), maxshape=(None,), compression="gzip"
                )
            )
        ),
        "cannot hold|chunks of",
    ),
    "a built-in that needs a library": (
        inside_h5(
            instead(lambda group, out: group.create_dataset("actions", data=np.zeros(120, "i4"), compression="lzf"))
        ),
        "filters",
    ),
    "chunk that inflates to a gigabyte": (bomb_chunk, "not stored as|inflate"),
    "group above": (row(h5_group="../0"), "missing"),
    "group by a circle": (inside_h5(lambda file, out: file["0"].__setitem__("a", file["0"])), "lite"),
    "env_idx of 100 digits": (row(env_idx=10**100), "Expected `int` <="),
    "rows below zero": (row(T=-5), "Expected `int` >= 1"),
    "task id of surrogates": (row(task_id="\ud800"), "printable"),
    "one endless line": (replaced("histories_index.jsonl", content(b"a" * 2**24)), "expected at most"),
    "provenance: a list": (replaced("provenance.json", content("[]")), "an object of objects"),
}
