"""Numbers with nouns, for messages."""

from __future__ import annotations


def counted_noun(number: int, noun: str, plural: str | None = None) -> str:
    """A number with a noun in the singular or plural; by default the plural has an s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def counted_histories(number: int) -> str:
    """A number of histories in words."""
    return counted_noun(number, "history", "histories")
