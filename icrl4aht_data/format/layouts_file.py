"""The layouts that a release carries: meta/layouts.jsonl, one line for each layout that this package does not have.

    {"name": "templates-0-17", "map": ["WWPWW", ...], "recipes": [[0, 0, 1], ...], "indicates_delivery": false,
     "family": "templates", "seed": 0, "number": 17}

Reading a release makes its layouts known to `get_layout` by their names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError
from icrl4aht_data.format.schema import LAYOUTS_FILE, check_name
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout, LayoutLine, add_layouts
from icrl4aht_data.overcooked.solvable import check_solvable
from icrl4aht_data.utils.files import read_lines, resolve_inside

LAYOUTS_NAME = LAYOUTS_FILE.rpartition("/")[2]
"""Name of a file of layouts, next to a file of tasks on them."""

PUBLISHED = "published"
"""Family of the layouts of the benchmark, which every copy of this package has."""

OTHER = "other"
"""Family of layouts that were not generated."""

_GENERATED = re.compile(r"(\w+)-(\d+)-(\d+)", re.ASCII).fullmatch


@dataclass(frozen=True)
class ReleaseLayouts:
    """The layouts that a release carries.

    Args:
        families: name -> family.
        layouts: the layouts, in the order of the file.
    """

    families: dict[str, str]
    layouts: tuple[Layout, ...] = ()

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A process that unpickles a dataset has not read the release.
        self.__dict__.update(state)
        add_layouts(self.layouts)

    def family(self, layout: str) -> str:
        """Return the family of a layout of the release."""
        return PUBLISHED if layout in LAYOUTS else self.families.get(layout, OTHER)


def read_layouts(root: Path) -> ReleaseLayouts:
    """Read the layouts of a release, and make them known to `get_layout`.

    Raises:
        IndexFormatError: if a line is malformed, if a name occurs twice or is already known for another map, if a
            recipe cannot be delivered, or if family, seed and number are not those in the name. The error has the
            file and the number of the line.
    """
    return _read_layouts_file(resolve_inside(root, LAYOUTS_FILE))


def _read_layouts_file(path: Path) -> ReleaseLayouts:
    """Read a file of layouts, see `read_layouts`; there are none without the file."""
    families: dict[str, str] = {}
    layouts = []
    for number, line in enumerate(read_lines(path) if path.is_file() else (), start=1):
        try:
            layout, family = _parse(line)
            if layout.name in families:
                raise IndexFormatError(f"layout {layout.name!r} is listed twice")
            families[layout.name] = family
            layouts += add_layouts([layout])
        except (msgspec.MsgspecError, Icrl4ahtError) as error:
            raise IndexFormatError(f"{path}, line {number}: {error}") from error
    return ReleaseLayouts(families, tuple(layouts))


@lru_cache(maxsize=1024)  # a check of solvability takes 0.5 ms, and opening a release reads the file twice
def _parse(line: str) -> tuple[Layout, str]:
    """Return the layout of a line, and its family; see `read_layouts` for the errors."""
    fields = msgspec.json.decode(line, type=LayoutLine)
    check_name(fields.name)
    check_name(fields.family)
    layout = fields.layout()
    if (expected := _origin(fields.name)) != (found := (fields.family, fields.seed, fields.number)):
        raise IndexFormatError(
            f"layout {fields.name!r}: expected family, seed and number {expected} for this name, found {found}"
        )
    check_solvable(layout)
    return layout, fields.family


def read_tasks_and_layouts(path: Path) -> list[Task]:
    """Return the tasks of a JSONL file; the layouts in a file `layouts.jsonl` next to it become known to `get_layout`.

    So `meta/tasks.jsonl` of a release is read without opening the release.

    Raises:
        TaskFormatError: names the file and the line.
        IndexFormatError: if the file of layouts is malformed, see `read_layouts`.
    """
    _read_layouts_file(path.with_name(LAYOUTS_NAME))
    return read_tasks(path)


def write_layouts_file(path: Path, layouts: Iterable[Layout]) -> None:
    """Write the layouts that the benchmark does not have to a file; no file if there are none.

    Raises:
        OptionError: if a recipe of one of them cannot be delivered, which readers would refuse.
    """
    own = [layout for layout in dict.fromkeys(layouts) if layout.name not in LAYOUTS]
    for layout in own:
        check_solvable(layout)
    if lines := list(map(_line, own)):
        path.write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))


def layout_title(name: str) -> str:
    """Return the name under which tables and figures show a layout: generated ones have that of their family."""
    generated = _GENERATED(name)
    return name if generated is None else generated[1]


def _line(layout: Layout) -> LayoutLine:
    return LayoutLine(layout.name, layout.rows, layout.recipes, layout.indicates_delivery, *_origin(layout.name))


def _origin(name: str) -> tuple[str, int | None, int | None]:
    """Return family, seed and number of a layout, which the name of a generated one consists of."""
    generated = _GENERATED(name)
    return (OTHER, None, None) if generated is None else (generated[1], int(generated[2]), int(generated[3]))


def check_layouts_carried(names: Iterable[str], layouts: ReleaseLayouts, path: Path) -> None:
    """Check that the layouts of an index are published, or carried by the release.

    Raises:
        IndexFormatError: if one is not; other releases opened in this process, and installed packages, do not count.
    """
    for name in names:
        if name not in LAYOUTS and name not in layouts.families:
            raise IndexFormatError(f"{path}: layout {name!r} is neither published nor in {LAYOUTS_FILE}; add it there")
