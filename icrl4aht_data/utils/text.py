"""Formatting of numbers with nouns, and of lists of names."""

from __future__ import annotations

from collections.abc import Sequence


def counted_noun(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun in the singular or plural; the default plural adds an s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def counted_histories(number: int) -> str:
    """Return a number of histories as text, such as "1 history" or "2,000 histories"."""
    return counted_noun(number, "history", "histories")


_LISTED = 10  # length of the longest list of names that is shown completely


def listed_names(names: Sequence[str]) -> str:
    """Return a list of names as text. A long list is shortened, for example to "a, b and 198 others"."""
    if len(names) <= _LISTED:
        return ", ".join(names)
    return f"{', '.join(names[: _LISTED - 1])} and {len(names) - _LISTED + 1} others"
