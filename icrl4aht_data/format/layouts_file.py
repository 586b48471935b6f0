"""Layouts stored in a release: meta/layouts.jsonl has one line per layout that the benchmark does not have.

    {"name": "templates-0-17", "map": ["WWPWW", ...], "recipes": [[0, 0, 1], ...], "indicates_delivery": false,
     "family": "templates", "seed": 0, "number": 17}

Reading a release makes its layouts available to `get_layout` by name.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable
from functools import lru_cache
from pathlib import Path

import msgspec

from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError
from icrl4aht_data.format.schema import LAYOUTS_FILE, check_name
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, LayoutLine, add_layouts
from icrl4aht_data.overcooked.solvable import check_solvable
from icrl4aht_data.utils.files import read_lines, resolve_inside

LAYOUTS_NAME = LAYOUTS_FILE.rpartition("/")[2]
"""Name of the file of layouts, which is in the same folder as the file of tasks that use the layouts."""

PUBLISHED = "published"
"""Family of the benchmark's layouts, which are part of this package."""

OTHER = "other"
"""Family of layouts that were not generated."""

_GENERATED = re.compile(r"(\w+)-(\d+)-(\d+)", re.ASCII).fullmatch


def is_generated(name: str) -> bool:
    """Return whether a name has the form of names of generated layouts, such as templates-0-17."""
    return _GENERATED(name) is not None


def layout_family(name: str) -> str:
    """Return the family of a layout: `PUBLISHED`, the family in the name of a generated layout, or `OTHER`."""
    return PUBLISHED if name in LAYOUTS else _origin(name)[0]


def read_layouts(root: Path) -> dict[str, Layout]:
    """Return a mapping of names to the layouts stored in a release, and make the layouts available to `get_layout`.

    Raises:
        IndexFormatError: if a line is malformed, if a name occurs twice or already belongs to another map, if a recipe
            cannot be delivered, or if family, seed and number differ from those in the name. The message has the file
            and the line number.
    """
    return read_layouts_file(resolve_inside(root, LAYOUTS_FILE))


def read_layouts_file(path: Path) -> dict[str, Layout]:
    """Return a mapping of names to the layouts in a file, see `read_layouts`; empty if the file does not exist."""
    layouts: dict[str, Layout] = {}
    for number, line in enumerate(read_lines(path) if path.is_file() else (), start=1):
        try:
            layout = _parse_line(line)
            if layout.name in layouts:
                raise IndexFormatError(f"layout {layout.name!r} is listed twice; remove one of the lines")
            (layouts[layout.name],) = add_layouts([layout])
        except (msgspec.MsgspecError, Icrl4ahtError) as error:
            raise IndexFormatError(f"{path}, line {number}: {error}") from error
    return layouts


@lru_cache(maxsize=1024)  # opening a release again takes half the time
def _parse_line(line: str) -> Layout:
    """Return the layout that a line describes; see `read_layouts` for the errors."""
    fields = msgspec.json.decode(line, type=LayoutLine)
    check_name(fields.name)
    check_name(fields.family)
    layout = fields.layout()
    if (expected := _origin(fields.name)) != (found := (fields.family, fields.seed, fields.number)):
        raise IndexFormatError(
            f"layout {fields.name!r}: expected family, seed and number {expected} for this name, found {found}"
        )
    check_solvable(layout)
    return layout


def read_tasks_and_layouts(path: Path) -> list[Task]:
    """Return the tasks of a JSONL file, after reading the layouts from `layouts.jsonl` in the same folder.

    This reads `meta/tasks.jsonl` of a release without opening the release.

    Raises:
        TaskFormatError: if a task is malformed; the message names the file and the line.
        IndexFormatError: if the file of layouts is malformed, see `read_layouts`.
    """
    read_layouts_file(path.with_name(LAYOUTS_NAME))
    return read_tasks(path)


def write_layouts_file(path: Path, layouts: Iterable[Layout]) -> None:
    """Write a file with those layouts that are not in the benchmark; write no file if all layouts are in the benchmark.

    Raises:
        OptionError: if a recipe of a layout cannot be delivered, since readers would reject such a layout.
    """
    own = [layout for layout in dict.fromkeys(layouts) if layout.name not in LAYOUTS]
    for layout in own:
        check_solvable(layout)
    if own:
        lines = (LayoutLine(one.name, one.rows, one.recipes, one.indicates_delivery, *_origin(one.name)) for one in own)
        path.write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))


def layout_title(name: str) -> str:
    """Return the name of a layout for tables and figures: for a generated layout, the name of the layout's family."""
    generated = _GENERATED(name)
    return name if generated is None else generated[1]


def _origin(name: str) -> tuple[str, int | None, int | None]:
    """Return family, seed and number from the name of a generated layout; (OTHER, None, None) for other names."""
    generated = _GENERATED(name)
    return (OTHER, None, None) if generated is None else (generated[1], int(generated[2]), int(generated[3]))


def check_layouts_stored(names: Iterable[str], stored: Container[str], path: Path) -> None:
    """Check that each layout of an index belongs to the benchmark or is stored in the release.

    Raises:
        IndexFormatError: if a layout is in neither, even if another release or an installed package has the layout.
    """
    for name in names:
        if name not in LAYOUTS and name not in stored:
            raise IndexFormatError(
                f"{path}: layout {name!r} is neither in the benchmark nor in {LAYOUTS_FILE}; add it to the file"
            )
