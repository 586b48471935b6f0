"""Validation of a card's metadata as the Hub does it, for the fields that our cards have."""

from __future__ import annotations

import re
from typing import Literal

import msgspec
import yaml


class _DataFiles(msgspec.Struct, forbid_unknown_fields=True):
    split: str
    path: str | list[str]


class _Config(msgspec.Struct, forbid_unknown_fields=True):
    config_name: str
    data_files: list[_DataFiles] = []
    default: bool = False


class _Metadata(msgspec.Struct, forbid_unknown_fields=True):
    license: Literal["mit"]
    tags: list[str] = []
    datasets: list[str] = []
    library_name: str = ""
    pipeline_tag: str = ""
    pretty_name: str = ""
    task_categories: list[str] = []
    configs: list[_Config] = []


def card_error(content: str) -> str | None:
    """What the Hub would refuse in a card's metadata; None for a valid card."""
    found = re.match(r"---\n(.*?)^---$", content, re.DOTALL | re.MULTILINE)
    if found is None:
        return "no metadata at the start of the card"
    try:
        metadata = msgspec.convert(yaml.safe_load(found[1]), _Metadata)
    except (yaml.YAMLError, msgspec.ValidationError) as error:
        return str(error)
    names = [config.config_name for config in metadata.configs]
    return "a config_name twice" if len(set(names)) < len(names) else None
