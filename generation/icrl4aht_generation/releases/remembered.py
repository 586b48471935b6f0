"""Measurements cached in a JSON file with the settings that they depend on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.utils.files import atomic_write, read_text

T = TypeVar("T")


def measured_once(path: Path, settings: dict[str, Any], kind: type[T], measure: Callable[[], T]) -> T:
    """Return the measurements cached in a JSON file; measure and write them if its settings differ.

    Args:
        path: the file.
        settings: what the measurements depend on.
        kind: their type, which msgspec checks.
        measure: function that measures them.
    """
    try:
        content = msgspec.json.decode(read_text(path))  # unlike `json`, it refuses NaN
        if content["settings"] == json.loads(json.dumps(settings)):
            return msgspec.convert(content["measured"], kind)
    except (IndexFormatError, KeyError, TypeError, msgspec.MsgspecError):
        pass  # damaged, or written by another version
    measured = measure()
    with atomic_write(path) as partial:
        partial.write_bytes(msgspec.json.encode({"settings": settings, "measured": measured}))
    return measured
