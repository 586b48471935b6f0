"""Description of a release in Croissant 1.1, a metadata format for datasets, and its responsible-AI vocabulary 1.0.

Every file is a FileObject with its SHA-256 and an address relative to croissant.json. The Parquet copies of the index
and of the episodes are RecordSets with a description of every field. Croissant does not support HDF5, so the
description text lists the shards' arrays.
"""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icrl4aht_data.format.schema import PARQUET_EPISODES, PARQUET_INDEX
from icrl4aht_data.utils.install_hints import AUTHORS, import_optional, project_url
from icrl4aht_data.utils.text import card_file, counted_histories, counted_noun
from icrl4aht_data.writing.card import card_facts, card_texts, episode_texts, rai_texts

if TYPE_CHECKING:
    import mlcroissant

CROISSANT = "croissant.json"

_STANDARD = "http://mlcommons.org/croissant/1.1"
_FORMATS = {
    ".h5": "application/x-hdf5",
    ".json": "application/json",
    ".jsonl": "application/jsonlines",
    ".npy": "application/x-npy",
    ".parquet": "application/x-parquet",
    ".safetensors": "application/vnd.safetensors",
}
_TYPES = {"bool": "BOOL", "string": "TEXT", "float": "FLOAT", "double": "FLOAT"}  # all other Arrow types are integers
_TERMS_OF_1_1 = {
    "arrayShape": "cr:arrayShape",
    "containedIn": "cr:containedIn",
    "isArray": "cr:isArray",
    "description": {"@container": "@language"},
    "name": {"@container": "@language"},
}
"""JSON-LD terms of Croissant 1.1 that are missing in mlcroissant's default context (1.0)."""


def croissant(root: Path, digests: Mapping[str, str], published: datetime.date) -> dict[str, Any]:
    """Return the content of croissant.json.

    Args:
        root: a release folder with the Parquet copies of its index and, if it has state records, of its episodes.
        digests: path relative to `root` -> SHA-256, for the files to describe.
        published: the date of publication.

    Raises:
        OptionError: if mlcroissant is not installed.
    """
    mlc = import_optional("mlcroissant", "croissant.json")
    content, texts = card_facts(root), card_texts("arrays")
    info = content["info"]
    arrays = "; ".join(f"{name}: {texts[name]}" for name in content["arrays"])
    terms = mlc.Rdf(context=mlc.Rdf().context | _TERMS_OF_1_1)
    context = mlc.Context(rdf=terms, conforms_to=_STANDARD)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # raised by dependencies of mlcroissant
        files = [
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
        sets, records = zip(*_file_sets(context, root), strict=True)
        return mlc.Metadata(
            ctx=context,
            conforms_to=[_STANDARD, "http://mlcommons.org/croissant/RAI/1.0"],
            name="icrl4aht_learning_histories",
            description=(
                "Learning histories of egos that cook in OvercookedV2 with unknown teammates, for in-context "
                f"reinforcement learning in ad-hoc teamwork: {counted_histories(info.histories)}, "
                f"{counted_noun(info.transitions, 'transition')}, layouts {', '.join(info.layouts)}. "
                f"The shards are HDF5: {arrays}."
            ),
            version=info.data_version,
            date_published=datetime.datetime.combine(published, datetime.time.min),
            license=["https://spdx.org/licenses/MIT.html"],
            url=project_url(),
            cite_as=card_file("citation.bib").read_text(encoding="utf-8").strip(),
            creators=[mlc.Organization(ctx=context, name=AUTHORS)],
            keywords=["reinforcement learning", "in-context learning", "ad-hoc teamwork", "Overcooked"],
            distribution=[*files, *sets],
            record_sets=list(records),
            **rai_texts(content),
        ).to_json()


def _file_sets(context: mlcroissant.Context, root: Path) -> Iterator[tuple[mlcroissant.FileSet, mlcroissant.RecordSet]]:
    """Yield the file set and record set of the Parquet index and, if present, of the Parquet episodes."""
    import mlcroissant as mlc
    import pyarrow.parquet as pq

    of_history = "One record per learning history: what it is, and where its arrays are stored."
    of_episode = "One record per episode: its history's names, returns, actions, rewards, labels, state records."
    for folder, name, said, key, texts in (
        (PARQUET_INDEX, "histories", of_history, ["history_id"], card_texts("index")),
        (PARQUET_EPISODES, "episodes", of_episode, ["history_id", "episode"], episode_texts()),
    ):
        path = next((root / folder).glob("*/*.parquet"), None)
        if path is None:
            continue
        files = mlc.FileSet(
            ctx=context,
            id=f"{folder}-files",
            name=folder,
            description=f"The {name}, one row each, in files for each layout and split.",
            encoding_formats=[_FORMATS[".parquet"]],
            includes=[f"{folder}/*/*.parquet"],
        )
        fields = [
            mlc.Field(
                ctx=context,
                id=f"{name}/{column}",
                name=column,
                description=texts[column],
                data_types=[getattr(mlc.DataType, kind)],
                is_array=True if shape else None,
                array_shape=shape,
                source=mlc.Source(ctx=context, file_set=files.id, extract=mlc.Extract(ctx=context, column=column)),
            )
            for column, kind, shape in map(_column_type, pq.read_schema(path))
        ]
        keys = [f"{name}/{column}" for column in key]
        yield files, mlc.RecordSet(ctx=context, id=name, name=name, description=said, key=keys, fields=fields)


def _column_type(field: Any) -> tuple[str, str, str | None]:
    """Return the name and data type of an Arrow field, and the lengths of nested lists as text, such as "100,36"."""
    kind, lengths = field.type, []
    while hasattr(kind, "list_size"):
        lengths.append(str(kind.list_size))
        kind = kind.value_type
    return field.name, _TYPES.get(str(kind), "INTEGER"), ",".join(lengths) or None
