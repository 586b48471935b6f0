"""Put wrong values into releases, update their checksums, and list the problems that `verify_release` finds."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from icrl4aht_data import verify_release
from icrl4aht_data.checking.report import Level
from icrl4aht_data.format.manifest import write_manifest

Change = Callable[[Any], Any]


def problems(root: Path, level: Level = "full") -> list[str]:
    """Return the problems that `verify_release` finds in a release, as `<file>: <problem>`."""
    return [f"{finding.file}: {finding.problem}" for finding in verify_release(root, level=level).findings]


def read_lines(path: Path) -> list[Any]:
    """Return the parsed lines of a JSONL file."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def first_value(content: dict[str, Any]) -> Any:
    """Return the first value of a dict, such as the provenance of the first task."""
    return next(iter(content.values()))


def change_file(path: Path, change: Change) -> None:
    """Apply a function that changes the content of a JSON or JSONL file in place."""
    is_lines = path.suffix == ".jsonl"
    content = read_lines(path) if is_lines else json.loads(path.read_text())
    change(content)
    path.write_text("".join(json.dumps(line) + "\n" for line in content) if is_lines else json.dumps(content))


def tamper(root: Path, name: str, change: Change) -> None:
    """Change a JSON or JSONL file of a release, and update the manifest with the file's new checksum."""
    change_file(root / name, change)
    write_manifest(root)


def tampered_copy(source: Path, target: Path, name: str, change: Change) -> Path:
    """Copy a release and change one file of the copy by `tamper`."""
    shutil.copytree(source, target)
    tamper(target, name, change)
    return target
