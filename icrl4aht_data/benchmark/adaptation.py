"""Adaptation headroom: how much more an ego earns if it knows the teammate than if it has to identify the teammate.

`icrl4aht-data adaptation-headroom` measures it, and stores it in `cards/adaptation.json`. An *informed* ego observes
the task's number in every step. An *episodic* ego has to identify the teammate in each episode.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES
from icrl4aht_data.utils.files import read_json
from icrl4aht_data.utils.text import card_file, markdown_table

EGO_KINDS = ("informed", "episodic")

SCRIPTS = (*REFERENCES, "search")
"""Reference egos that play the same tasks on the track `preference`. `cards/headroom.json` has returns of the first
three on published layouts."""

_LAYOUT_TASKS = 20  # number of test tasks on each published layout

ADAPTATION = "adaptation.json"
"""Name of the file of measured returns, in a folder of training runs and among the package's cards. The Markdown file
of the same name has the returns as a table."""


def read_adaptation(folder: Path) -> list[dict[str, Any]]:
    """Return the entries of a folder's file `ADAPTATION`; an empty list if the file does not exist."""
    path = folder / ADAPTATION
    return read_json(path) if path.is_file() else []


def task_set_name(track: str, split: str, layout: str, families: Iterable[str] = ()) -> str:
    """Return the name of a set of tasks on a layout, for entries."""
    return "-".join((track, split, layout, *families))


def published_adaptation() -> dict[str, dict[str, Any]]:
    """Return the stored measurements of published layouts, by name of the layout.

    A layout is left out if some of its test tasks were not measured.
    """
    entries = {entry["tasks"]: entry for entry in read_adaptation(card_file(ADAPTATION).parent)}
    names = {layout: task_set_name(track, "test", layout) for track, of in TRACKS.items() for layout in of["test"]}
    found = {layout: entries[name] for layout, name in names.items() if name in entries}
    return {layout: entry for layout, entry in found.items() if entry["number"] == _LAYOUT_TASKS}


def _mean_returns(entry: Mapping[str, Any]) -> list[float]:
    """Return the mean return over the training seeds of each of `EGO_KINDS`."""
    return [fmean(entry["returns"][kind].values()) for kind in EGO_KINDS]


def headroom_text(entry: Mapping[str, Any]) -> str:
    """Return the informed ego's mean return minus the episodic ego's, with the difference's interval in parentheses.

    The interval is a 95 % Student's t interval over the training seeds; it is left out for a single seed.
    """
    informed, episodic = _mean_returns(entry)
    interval = " ({:+z.1f} to {:+z.1f})".format(*entry["interval"]) if entry.get("interval") else ""
    return f"{informed - episodic:+z.1f}{interval}"


def adaptation_table(entries: Iterable[Mapping[str, Any]]) -> str:
    """Return a Markdown table with a row for each measured set of tasks.

    A row has the mean returns of scripts and of both kinds of ego, and the difference between the two kinds.

    Columns of scripts are left out if no set has their returns.

    Args:
        entries: entries from `read_adaptation`.
    """
    entries, rows = list(entries), []
    scripts = [name for name in SCRIPTS if any("scripts" in entry for entry in entries)]
    for entry in entries:
        earned = [f"{entry['scripts'][name]:z.1f}" if "scripts" in entry else "" for name in scripts]
        means = [f"{mean:z.1f}" for mean in _mean_returns(entry)]
        training = [str(len(entry["returns"]["informed"])), f"{entry['steps']:,}", str(entry["width"])]
        rows.append([entry["tasks"], str(entry["number"]), *earned, *means, headroom_text(entry), *training])
    header = ["set", "tasks", *scripts, *EGO_KINDS, "difference", "seeds", "steps of each", "width"]
    return markdown_table(header, rows, right=len(header) - 1)


def published_adaptation_table(best: Mapping[str, float | None]) -> str:
    """Return a Markdown table of the published layouts that were measured: returns, and two estimates of headroom.

    The first estimate is B minus the episodic ego's return, the second the informed ego's return minus that of the
    episodic ego, see `headroom_text`.

    Args:
        best: layout -> B, the mean of the best known returns over the layout's test tasks; None if it is not known.
    """
    rows = []
    for layout, entry in published_adaptation().items():
        informed, episodic = _mean_returns(entry)
        known = best.get(layout)
        texts = ["–", "–"] if known is None else [f"{known:z.1f}", f"{known - episodic:+z.1f}"]
        steps = f"{len(entry['returns']['informed'])} x {entry['steps']:,}"
        rows.append([layout, texts[0], f"{informed:z.1f}", f"{episodic:z.1f}", texts[1], headroom_text(entry), steps])
    header = ["layout", "B", *EGO_KINDS, "B - episodic", "informed - episodic", "runs x steps"]
    return markdown_table(header, rows, right=6)
