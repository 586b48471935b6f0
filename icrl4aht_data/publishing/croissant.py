"""A release's description in Croissant 1.1, the vocabulary by which dataset search engines and loaders know data.

Every file is a FileObject with its SHA-256, its address relative to the description; the Parquet twin of the index is a
RecordSet with every field described. Croissant does not read HDF5: of the shards it says what they are.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.schema import FIELDS, JSON_TYPES
from icrl4aht_data.utils.templates import card_file
from icrl4aht_data.writing.dataset_card import TWIN
from icrl4aht_data.writing.field_descriptions import ARRAY_TEXTS, ENTRY_TEXTS

CROISSANT = "croissant.json"

_LICENCE = "https://spdx.org/licenses/MIT.html"
_FORMATS = {
    ".h5": "application/x-hdf5",
    ".json": "application/json",
    ".jsonl": "application/jsonlines",
    ".npy": "application/x-npy",
    ".parquet": "application/x-parquet",
    ".safetensors": "application/vnd.safetensors",
}
_TYPES = {str: "sc:Text", bool: "sc:Boolean", float: "sc:Float", int: "sc:Integer", list: "sc:Integer"}
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
"""The standard's own, which its validator compares."""


def croissant(root: Path, digests: Mapping[str, str], published: datetime.date) -> dict[str, Any]:
    """The content of croissant.json.

    Args:
        root: a release folder with the Parquet twin of its index.
        digests: path below `root` -> SHA-256, of the files to describe.
        published: when the release came to be.
    """
    info = read_info(root)
    arrays = "; ".join(f"{name}: {ARRAY_TEXTS[name]}" for name, f in FIELDS.items() if info.kind not in f.absent)
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": "icrl4aht_learning_histories",
        "description": (
            "Learning histories of ego agents that learn to cook in OvercookedV2 beside one fixed teammate each, for "
            f"in-context reinforcement learning in ad-hoc teamwork: {info.histories:,} histories, "
            f"{info.transitions:,} transitions, layouts {', '.join(info.layouts)}. The shards are HDF5: {arrays}."
        ),
        "version": info.data_version,
        "datePublished": published.isoformat(),
        "license": _LICENCE,
        "citeAs": card_file("citation.bib").read_text(encoding="utf-8").strip(),
        "creator": {"@type": "Organization", "name": "The icrl4aht-data authors"},
        "keywords": ["reinforcement learning", "in-context learning", "ad-hoc teamwork", "Overcooked"],
        "distribution": [*(_file(root, name, digests[name]) for name in sorted(digests)), _TWINS],
        "recordSet": [_RECORDS],
    }


def _file(root: Path, name: str, digest: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{(root / name).stat().st_size} B",
        "encodingFormat": _FORMATS.get(Path(name).suffix, "text/plain"),
        "sha256": digest,
    }


_TWINS = {
    "@type": "cr:FileSet",
    "@id": TWIN,
    "name": TWIN,
    "description": "The index, one row a history, in one file for each layout and split.",
    "encodingFormat": _FORMATS[".parquet"],
    "includes": f"{TWIN}/*/*.parquet",
}


def _field(name: str, types: set[type]) -> dict[str, Any]:
    kind = next(kind for kind in _TYPES if kind in types)
    return {
        "@type": "cr:Field",
        "@id": f"histories/{name}",
        "name": name,
        "description": ENTRY_TEXTS[name],
        "dataType": _TYPES[kind],
        **({"isArray": True, "arrayShape": "3"} if kind is list else {}),
        "source": {"fileSet": {"@id": TWIN}, "extract": {"column": name}},
    }


_RECORDS = {
    "@type": "cr:RecordSet",
    "@id": "histories",
    "name": "histories",
    "description": "The learning histories, a record each: what they are, and where their arrays are.",
    "key": {"@id": "histories/history_id"},
    "field": [_field(name, types) for name, types in JSON_TYPES.items()],
}
