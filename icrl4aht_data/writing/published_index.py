"""Reading the index of published files, with their names of teammates translated to ours.

In published files, `teammate_kind` is "rl" or "heuristic", and `teammate_family` is the algorithm (ippo, fcp, brdiv,
...) or the heuristic. In this package, as in the paper, the family is rl or H1..H4, and the kind is the algorithm or
the heuristic.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_type_hints

import msgspec

from icrl4aht_data.benchmark.facts import FAMILIES, HEURISTIC_KINDS, KIND_FAMILIES
from icrl4aht_data.benchmark.tasks import named_task
from icrl4aht_data.errors import Icrl4ahtError, OptionError, PublishedFormatError, unknown
from icrl4aht_data.format.schema import ENTRY_HINTS, Entry, check_name
from icrl4aht_data.utils.files import parse_json, read_lines

PUBLISHED_FIELDS = tuple(ENTRY_HINTS)[:14]
"""Fields of an index line (paper, App. D.3)."""

_HINTS = get_type_hints(Entry, include_extras=True)
_Line = msgspec.defstruct("_Line", [(name, _HINTS[name]) for name in PUBLISHED_FIELDS])

_KINDS = {"ippo": "rl"} | KIND_FAMILIES
"""Name of an algorithm or heuristic -> family."""

FAMILY_MAP = (
    {name: name for name in FAMILIES} | {name: name for name in _KINDS} | {"recipe_aware": "recipe_aware_button"}
)
"""`teammate_family` in published files -> family or kind of teammate in this package."""

_GENERAL = {"rl": ("rl",), "heuristic": tuple(HEURISTIC_KINDS.values())}
"""`teammate_kind` in published files -> possible families."""


def parse_family_map(pairs: tuple[str, ...]) -> dict[str, str]:
    """Parse command-line pairs OLD=NEW as a dict.

    Raises:
        OptionError: if a text is not such a pair.
        UnknownNameError: if NEW is neither a family nor a kind of teammate.
    """
    found = {}
    for pair in pairs:
        old, equals, new = pair.partition("=")
        if not (old and equals and new):
            raise OptionError(f"{pair!r}: expected OLD=NEW, such as ippo=fcp")
        if new not in FAMILIES and new not in _KINDS:
            raise unknown("family or kind of teammates", new, (*FAMILIES, *_KINDS))
        found[old] = new
    return found


def read_published_index(path: Path, family_map: Mapping[str, str] | None = None) -> list[dict[str, Any]]:
    """Read `histories_index.jsonl`.

    Args:
        path: the file.
        family_map: `teammate_family` of the file -> family or kind of teammate, in addition to `FAMILY_MAP`.

    Returns:
        The lines as dicts. If names were translated, "published" has the original ones.

    Raises:
        PublishedFormatError: if a field is missing or invalid, or if two lines have the same group, or the same stream
            of a task; with the line number.
    """
    lines: list[dict[str, Any]] = []
    seen: dict[Any, int] = {}
    for number, text in enumerate(read_lines(path), start=1):
        try:
            line = parse_json(text)
            msgspec.convert(line, _Line)
            for name in PUBLISHED_FIELDS:
                check_name(str(line[name]))
            line = _translate(line, FAMILY_MAP | dict(family_map or {}))
            named_task(line)
            for key, what in (
                (line["h5_group"].strip("/"), f"group {line['h5_group']!r}"),
                ((line["task_id"], line["env_idx"]), f"stream {line['env_idx']} of task {line['task_id']!r}"),
            ):
                if (first := seen.setdefault(key, number)) != number:
                    raise PublishedFormatError(f"{what} is already that of line {first}; every history has its own")
        except (msgspec.ValidationError, Icrl4ahtError) as error:
            raise PublishedFormatError(f"{path}, line {number}: {error}") from error
        lines.append(line)
    if not lines:
        raise PublishedFormatError(f"{path}: no histories")
    return lines


def _translate(line: dict[str, Any], family_map: Mapping[str, str]) -> dict[str, Any]:
    """Return a line with family and kind of the teammate translated to the paper's names."""
    family, kind = line["teammate_family"], line["teammate_kind"]
    new = family_map.get(family) or family_map.get(family.lower())
    if new is None:
        error = unknown("teammate_family", family, family_map)
        raise PublishedFormatError(f"{error} Say what it is by --family-map {family}=NEW")
    new_family, new_kind = (new, kind) if new in FAMILIES else (_KINDS[new], new)
    if kind in _GENERAL:
        if new_family not in _GENERAL[kind]:
            raise PublishedFormatError(f"teammate_kind {kind!r}, but teammate_family {family!r} is of {new_family}")
        named = {value: name for name, value in HEURISTIC_KINDS.items()}.get(new_family, family)
        new_kind = named if new in FAMILIES else new
    elif new not in FAMILIES and family in FAMILIES:
        new_kind = kind
    translated = {"teammate_family": new_family, "teammate_kind": new_kind}
    original = {"teammate_family": family, "teammate_kind": kind}
    return line | translated | ({"published": original} if translated != original else {})
