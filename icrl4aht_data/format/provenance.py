"""TODO."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.utils.files import parse_json, read_text


def read_provenance(path: Path) -> dict[str, dict[str, Any]]:
    """How the histories of each task were made, by task_id; what it says of a teammate is an object, too.

    Raises:
        IndexFormatError: names the file.
    """
    text = read_text(path)
    try:
        content = parse_json(text)
    except IndexFormatError as error:
        raise IndexFormatError(f"{path}: {error}") from error
    notes = content.values() if isinstance(content, dict) else [content]
    if not all(isinstance(note, dict) and isinstance(note.get("teammate", {}), dict) for note in notes):
        raise IndexFormatError(
            f"{path}: not as `generation` writes it: expected an object of objects, one for each task"
        )
    return content
