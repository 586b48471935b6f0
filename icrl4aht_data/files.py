"""Text and JSON files of a release: whatever is wrong with one becomes an error that names it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from icrl4aht_data.errors import IndexFormatError


def read_text(path: Path) -> str:
    """A text file's content.

    Raises:
        IndexFormatError: if it is missing, unreadable or not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise IndexFormatError(f"{path}: missing; fetch the release again") from error
    except OSError as error:
        raise IndexFormatError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise IndexFormatError(f"{path}: not UTF-8 text: {error}") from error


def parse_json(text: str) -> Any:
    """A JSON value.

    Raises:
        IndexFormatError: without file and line, which the caller adds.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # also too many digits, too deep
        raise IndexFormatError(f"not JSON: {error}") from error


def write_json(path: Path, content: Any) -> None:
    """Indented, for people."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
