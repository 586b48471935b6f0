"""Reading the index of published files, with names of teammates translated to the names in this package.

In published files, `teammate_kind` is "rl" or "heuristic", and `teammate_family` is the algorithm (ippo, fcp, brdiv,
...) or the heuristic. In this package, as in the paper, the family is rl or H1..H4, and the kind is the algorithm or
the heuristic.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_type_hints

import msgspec

from icrl4aht_data.benchmark.facts import FAMILIES, HEURISTIC_KINDS, KIND_FAMILIES
from icrl4aht_data.benchmark.tasks import named_task
from icrl4aht_data.errors import Icrl4ahtError, PublishedFormatError, unknown_name
from icrl4aht_data.format.schema import ENTRY_HINTS, Entry, check_name
from icrl4aht_data.utils.files import parse_json, read_lines

PUBLISHED_FIELDS = tuple(ENTRY_HINTS)[:14]
"""Fields of a line of the published index (paper, App. D.3)."""

_HINTS = get_type_hints(Entry, include_extras=True)
_Line = msgspec.defstruct("_Line", [(name, _HINTS[name]) for name in PUBLISHED_FIELDS])

_KINDS = {"ippo": "rl"} | KIND_FAMILIES
"""Families by name of the algorithm or heuristic."""

_FAMILY_MAP = (
    {name: name for name in FAMILIES} | {name: name for name in _KINDS} | {"recipe_aware": "recipe_aware_button"}
)
"""Family or kind of teammate in this package, by `teammate_family` in published files."""

_GENERAL = {"rl": ("rl",), "heuristic": tuple(HEURISTIC_KINDS.values())}
"""Possible families by `teammate_kind` in published files."""


def read_published_index(path: Path) -> list[dict[str, Any]]:
    """Read the index `histories_index.jsonl` of published files.

    Args:
        path: path of the index.

    Returns:
        The lines of the index, as dicts.

    Raises:
        PublishedFormatError: if a field is missing or invalid, or if two lines have the same group, or the same task
            and `env_idx`; the message has the line number.
    """
    lines: list[dict[str, Any]] = []
    seen: dict[Any, int] = {}
    for number, text in enumerate(read_lines(path), start=1):
        try:
            line = parse_json(text)
            msgspec.convert(line, _Line)
            for name in PUBLISHED_FIELDS:
                check_name(str(line[name]))
            line = _translate(line)
            named_task(line)
            for key, what in (
                (line["h5_group"].strip("/"), f"group {line['h5_group']!r}"),
                ((line["task_id"], line["env_idx"]), f"stream {line['env_idx']} of task {line['task_id']!r}"),
            ):
                if (first := seen.setdefault(key, number)) != number:
                    raise PublishedFormatError(f"{what} is already used by line {first}; change one of the lines")
        except (msgspec.ValidationError, Icrl4ahtError) as error:
            raise PublishedFormatError(f"{path}, line {number}: {error}") from error
        lines.append(line)
    if not lines:
        raise PublishedFormatError(f"{path}: expected at least one history, found none")
    return lines


def _translate(line: dict[str, Any]) -> dict[str, Any]:
    """Return an index line with the teammate's family and kind translated to the names in the paper."""
    family, kind = line["teammate_family"], line["teammate_kind"]
    new = _FAMILY_MAP.get(family) or _FAMILY_MAP.get(family.lower())
    if new is None:
        error = unknown_name("teammate_family", family, _FAMILY_MAP)
        raise PublishedFormatError(f"{error} Replace the name in the index by a valid one")
    new_family, new_kind = (new, kind) if new in FAMILIES else (_KINDS[new], new)
    if kind in _GENERAL:
        if new_family not in _GENERAL[kind]:
            raise PublishedFormatError(
                f"teammate_family {family!r} is {new_family}, but teammate_kind is {kind!r}; correct one of them"
            )
        named = {value: name for name, value in HEURISTIC_KINDS.items()}.get(new_family, family)
        new_kind = named if new in FAMILIES else new
    return line | {"teammate_family": new_family, "teammate_kind": new_kind}
