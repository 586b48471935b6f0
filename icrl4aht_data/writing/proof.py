"""Mean returns of models that were trained on one release only, for the dataset card of this release.

`icrl4aht-data research proof --bundle` measures the returns on validation tasks and writes `cards/proof.json`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from icrl4aht_data.benchmark.facts import SOURCES
from icrl4aht_data.format.chunks import chunk_table_name, read_table
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.utils.files import read_json
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import card_file, markdown_table

PROOF_FILE = "proof.json"

RUN_KEY = ("histories", "method", "labels", "seed")
"""Fields that identify a training run in `PROOF_FILE`."""

_COLUMNS = {
    "first": "episode 1",
    "late": "episodes 6-20",
    "late_cleared": "6-20, cleared",
    "share": "teammate track",
}


def read_proof(root: Path) -> dict[str, Any] | None:
    """Return the content of `cards/proof.json` with the training runs on histories of a release.

    `trainings` is added: the number of runs in each row of `proof_table`. The result is None if there are no such runs.

    Args:
        root: folder of the release.
    """
    content = read_json(card_file(PROOF_FILE))
    runs = runs_on(read_index(root), content["runs"])
    return content | {"runs": runs, "trainings": [len(own) for own in _runs_by_row(runs).values()]} if runs else None


def _runs_by_row(runs: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str, str], list[Mapping[str, Any]]]:
    """Return histories, method and labels -> training runs, ordered by the source of the histories."""
    order = [*SOURCES, "all"]
    ordered = sorted(runs, key=lambda one: order.index(one["histories"]))
    return grouped(ordered, lambda one: (one["histories"], one["method"], one["labels"]))


def runs_on(index: Index, runs: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the training runs that learned from the histories of a release, as the release contains them now."""
    hashes = {source: histories_hash(index, source) for source in {one["histories"] for one in runs}}
    return [one for one in runs if one["histories_sha256"] == hashes[one["histories"]]]


def histories_hash(index: Index, source: str) -> str:
    """Return the SHA-256 of the content of a release's histories of one source, or of all sources if it is "all"."""
    digest = hashlib.sha256()
    for shard, entries in grouped(index.entries, lambda entry: entry.shard).items():
        if source != "all" and all(entry.source != source for entry in entries):
            continue
        hashes, first = read_table(index.root / chunk_table_name(shard))["hash"], 0
        for entry in entries:  # the table lists the chunks by history
            end = first + sum(map(entry.chunks, entry.stored_fields(index.info.kind)))
            if source in ("all", entry.source):
                digest.update(f"{entry.task_id} {entry.T} ".encode() + hashes[first:end].tobytes())
            first = end
    return digest.hexdigest()


def proof_table(proof: Mapping[str, Any]) -> str:
    """Return a Markdown table of models, their training histories, and their mean returns (lowest..highest run).

    Episode 1 has no column for cleared memory, because the memory is empty in this episode.
    """
    rows = [
        [*row, *(_mean_text([one[key] for one in own], key) for key in _COLUMNS)]
        for row, own in _runs_by_row(proof["runs"]).items()
    ]
    return markdown_table(["histories", "model", "labels", *_COLUMNS.values()], rows, right=len(_COLUMNS))


def _mean_text(values: Sequence[float], key: str) -> str:
    digits = 2 if key == "share" else 1
    ends = f" ({min(values):z.{digits}f}..{max(values):z.{digits}f})" if len(values) > 1 else ""
    return f"{sum(values) / len(values):z.{digits}f}{ends}"
