"""Texts of `cards/dataset_texts.toml`: sentences of dataset cards, and descriptions of a release's fields."""

from __future__ import annotations

import tomllib
from functools import cache
from string import Template

from icrl4aht_data.reading.arrow_tables import EPISODE_COLUMNS
from icrl4aht_data.utils.templates import card_file


@cache
def card_texts(section: str) -> dict[str, str]:
    """Return a section of the file, name -> text.

    Args:
        section: "sentences", "sources" (of histories), "kinds" (of release), "arrays" (`schema.FIELDS`), "index"
            (fields of `schema.Entry`) or "episodes" (columns that differ from both, see `episode_texts`).
    """
    return tomllib.loads(card_file("dataset_texts.toml").read_text(encoding="utf-8"))[section]


def episode_texts() -> dict[str, str]:
    """Return a description of each column of `EPISODE_COLUMNS`, name -> text."""
    texts = card_texts("index") | card_texts("arrays") | card_texts("episodes")
    return {name: texts[name] for name in EPISODE_COLUMNS}


def sentence(name: str, **values: object) -> str:
    """Return a sentence with every $name replaced by its value."""
    return Template(card_texts("sentences")[name].strip("\n")).substitute(values)
