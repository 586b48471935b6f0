"""A release's description in Croissant 1.1, the vocabulary by which dataset search engines and loaders know data.

Every file is a FileObject with its SHA-256, its address relative to the description; the Parquet copy of the index is a
RecordSet with every field described. Croissant does not read HDF5: the shards' arrays are described in the text.
"""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.schema import ENTRY_HINTS, FIELDS
from icrl4aht_data.utils.installation import install_command
from icrl4aht_data.utils.templates import card_file
from icrl4aht_data.writing.card_texts import card_texts
from icrl4aht_data.writing.dataset_card import PARQUET_INDEX

if TYPE_CHECKING:
    import mlcroissant

CROISSANT = "croissant.json"

_STANDARD = "http://mlcommons.org/croissant/1.1"
_LICENCE = "https://spdx.org/licenses/MIT.html"
_FORMATS = {
    ".h5": "application/x-hdf5",
    ".json": "application/json",
    ".jsonl": "application/jsonlines",
    ".npy": "application/x-npy",
    ".parquet": "application/x-parquet",
    ".safetensors": "application/vnd.safetensors",
}
_SHAPE = tuple[int, int, int]
_TYPES = {str: "TEXT", bool: "BOOL", float: "FLOAT", int: "INTEGER", _SHAPE: "INTEGER"}
_TYPES |= {int | None: "INTEGER", float | None: "FLOAT"}
_TERMS_OF_1_1 = {
    "arrayShape": "cr:arrayShape",
    "containedIn": "cr:containedIn",
    "isArray": "cr:isArray",
    "description": {"@container": "@language"},
    "name": {"@container": "@language"},
}
"""Terms of the standard's JSON-LD context that mlcroissant's default context, which is 1.0's, does not have."""


def croissant(root: Path, digests: Mapping[str, str], published: datetime.date) -> dict[str, Any]:
    """Return the content of croissant.json.

    Args:
        root: a release folder with the Parquet copy of its index.
        digests: path below `root` -> SHA-256, of the files to describe.
        published: the date of publication.

    Raises:
        OptionError: if mlcroissant is not installed.
    """
    try:
        import mlcroissant as mlc
    except ImportError as error:
        raise OptionError(f"croissant.json needs mlcroissant: {install_command('hf')}") from error
    info, texts = read_info(root), card_texts("arrays")
    arrays = "; ".join(f"{name}: {texts[name]}" for name, field in FIELDS.items() if info.kind not in field.absent)
    terms = mlc.Rdf(context=mlc.Rdf().context | _TERMS_OF_1_1)
    context = mlc.Context(rdf=terms, conforms_to=_STANDARD)  # pyright: ignore[reportArgumentType]  # it parses addresses
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # raised by libraries that mlcroissant is built on
        return mlc.Metadata(
            ctx=context,
            conforms_to=[_STANDARD],
            name="icrl4aht_learning_histories",
            description=(
                "Learning histories of ego agents that learn to cook in OvercookedV2 with one fixed teammate each, "
                f"for in-context reinforcement learning in ad-hoc teamwork: {info.histories:,} histories, "
                f"{info.transitions:,} transitions, layouts {', '.join(info.layouts)}. "
                f"The shards are HDF5: {arrays}."
            ),
            version=info.data_version,
            date_published=datetime.datetime.combine(published, datetime.time.min),
            license=[_LICENCE],
            cite_as=card_file("citation.bib").read_text(encoding="utf-8").strip(),
            creators=[mlc.Organization(ctx=context, name="The icrl4aht-data authors")],
            keywords=["reinforcement learning", "in-context learning", "ad-hoc teamwork", "Overcooked"],
            distribution=[*_files(context, root, digests), _parquet_index(context)],
            record_sets=[_records(context)],
        ).to_json()


def _files(context: mlcroissant.Context, root: Path, digests: Mapping[str, str]) -> list[mlcroissant.FileObject]:
    import mlcroissant as mlc

    return [
        mlc.FileObject(
            ctx=context,
            id=name,
            name=name,
            content_url=name,
            content_size=f"{(root / name).stat().st_size} B",
            encoding_formats=[_FORMATS.get(Path(name).suffix, "text/plain")],
            sha256=digests[name],
        )
        for name in sorted(digests)
    ]


def _parquet_index(context: mlcroissant.Context) -> mlcroissant.FileSet:
    import mlcroissant as mlc

    return mlc.FileSet(
        ctx=context,
        id=PARQUET_INDEX,
        name=PARQUET_INDEX,
        description="The index, one row per history, in one file for each layout and split.",
        encoding_formats=[_FORMATS[".parquet"]],
        includes=[f"{PARQUET_INDEX}/*/*.parquet"],
    )


def _records(context: mlcroissant.Context) -> mlcroissant.RecordSet:
    """Return the record set of histories, with a field for each column of the Parquet index."""
    import mlcroissant as mlc

    columns = [
        mlc.Field(
            ctx=context,
            id=f"histories/{name}",
            name=name,
            description=card_texts("index")[name],
            data_types=[getattr(mlc.DataType, _TYPES[hint])],
            is_array=True if hint == _SHAPE else None,
            array_shape="3" if hint == _SHAPE else None,
            source=mlc.Source(ctx=context, file_set=PARQUET_INDEX, extract=mlc.Extract(ctx=context, column=name)),
        )
        for name, hint in ENTRY_HINTS.items()
    ]
    return mlc.RecordSet(
        ctx=context,
        id="histories",
        name="histories",
        description="One record per learning history: what it is, and where its arrays are stored.",
        key=["histories/history_id"],
        fields=columns,
    )
