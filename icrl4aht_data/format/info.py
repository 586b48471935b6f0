"""meta/info.json of a release: read and checked."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.errors import (
    FormatTooNewError,
    FormatTooOldError,
    IndexFormatError,
    OptionError,
    RootNotFoundError,
)
from icrl4aht_data.format.schema import (
    ALL_KINDS,
    FORMAT_VERSION,
    INFO,
    Entry,
    Kind,
    is_name,
)
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.paths import resolve_inside

_SEMVER = re.compile(r"\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?(\+[0-9A-Za-z.-]+)?")

_INFO_TYPES: dict[str, type | tuple[type, ...]] = {
    "kind": str,
    "data_version": str,
    "histories": int,
    "environment": dict,
    "layouts": dict,
    "shards": dict,
}


def read_info(root: Path) -> dict[str, Any]:
    """meta/info.json of a release whose format this package reads."""
    path = resolve_inside(root, INFO)
    if not path.is_file():
        raise RootNotFoundError(f"{root}: no release here, expected {INFO} in it; {_instead(root)}")
    try:
        info = parse_json(read_text(path))
    except IndexFormatError as error:
        raise IndexFormatError(f"{path}: malformed: {error}") from error
    version = info.get("format_version") if isinstance(info, dict) else None
    if not isinstance(version, int):
        raise IndexFormatError(f"{path}: malformed: expected an object with an integer format_version")
    if version > FORMAT_VERSION:
        raise FormatTooNewError(
            f"{path}: format version {version}, this package reads {FORMAT_VERSION}: `pip install -U icrl4aht-data`"
        )
    if version < FORMAT_VERSION:
        raise FormatTooOldError(
            f"{path}: format version {version}, this package reads {FORMAT_VERSION}: rebuild or fetch the release again"
        )
    if isinstance(info.get("data_version"), str) and not is_name(info["data_version"]):
        raise IndexFormatError(f"{path}: malformed: data_version {info['data_version'][:100]!r}, expected a short name")
    wrong = [name for name, kind in _INFO_TYPES.items() if not isinstance(info.get(name), kind)]
    if wrong or info["kind"] not in ALL_KINDS or not _is_environment(info["environment"]) or not _are_sizes(info):
        what = ", ".join(wrong) or "kind, environment or shards"
        raise IndexFormatError(f"{path}: malformed: {what} not as expected")
    return info


def _instead(root: Path) -> str:
    """What to give in place of a folder that is no release."""
    if root.is_dir():
        below = sorted(str(path.parent.parent) for path in root.glob(f"*/{INFO}"))
        if below:
            return f"did you mean {' or '.join(below[:3])}?"
    return (
        f"{'give the folder of a release' if root.is_dir() else 'there is no such folder: check the path'}, fetch one "
        f"with `icrl4aht-data download`, or give none for the bundled one"
    )


def check_version(version: str) -> str:
    """A data version, if it is one.

    Raises:
        OptionError: if it is not of the form of SemVer.
    """
    if not _SEMVER.fullmatch(version):
        raise OptionError(f"data version {version!r}: expected one such as 1.0.0 or 1.0.0-rc.1 (SemVer)")
    return version


def _is_environment(value: dict[str, Any]) -> bool:
    steps = [value.get(name) for name in ("max_steps", "kept_steps")]
    return len(value) == 2 and all(isinstance(n, int) and 0 < n < 2**31 for n in steps)


def _are_sizes(info: dict[str, Any]) -> bool:
    return all(isinstance(size, int) and 0 <= size < 2**62 for size in info["shards"].values())


def describe(kind: Kind, data_version: str, kept_steps: int, entries: list[Entry]) -> dict[str, Any]:
    """The content of meta/info.json."""
    layouts = {}
    for name in dict.fromkeys(entry.layout for entry in entries):
        mine = [entry for entry in entries if entry.layout == name]
        layout = get_layout(name)
        layouts[name] = {
            "environment_name": layout.alias,
            "map": list(layout.rows),
            "recipes": [list(recipe) for recipe in layout.recipes],
            "obs_shape": list(layout.obs_shape),
            "histories": len(mine),
            "tasks": len({entry.task_id for entry in mine}),
            "transitions": sum(entry.T for entry in mine),
            "mean_final_return": round(float(np.mean([entry.return_end for entry in mine])), 3),
        }
    return {
        "format_version": FORMAT_VERSION,
        "data_version": data_version,
        "kind": kind,
        "actions": list(ACTIONS),
        "environment": {"max_steps": EPISODE_STEPS, "kept_steps": kept_steps},
        "histories": len(entries),
        "transitions": sum(entry.T for entry in entries),
        "layouts": layouts,
    }


def shard_sizes(root: Path, entries: Iterable[Entry]) -> dict[str, int]:
    """Bytes of every shard, in the order of the index."""
    return {name: (root / name).stat().st_size for name in dict.fromkeys(entry.shard for entry in entries)}
