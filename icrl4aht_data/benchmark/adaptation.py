"""Adaptation headroom: how much more an ego earns that knows its teammate from the start.

`icrl4aht-data adaptation-headroom` measures it, and stores it in `cards/adaptation.json`. An *informed* ego observes
the task's number in every step. An *episodic* ego has to identify the teammate in each episode.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.text import markdown_table

EGO_KINDS = ("informed", "episodic")

ADAPTATION = "adaptation.json"
"""Name of the file of measured returns, in a folder of training runs and among the package's cards."""


def read_adaptation(folder: Path, tracks: Collection[str] = ()) -> list[dict[str, Any]]:
    """Return the entries of a folder's file `ADAPTATION`; an empty list if the file does not exist.

    Args:
        folder: folder of the file.
        tracks: if given, only the entries of tasks of these tracks.
    """
    path = folder / ADAPTATION
    entries = parse_json(read_text(path)) if path.is_file() else []
    return [entry for entry in entries if not tracks or entry["tasks"].partition("-")[0] in tracks]


def headroom_text(entry: Mapping[str, Any]) -> str:
    """Return the informed ego's return minus that of the episodic ego, with its interval in parentheses.

    The interval is a 95 % Student's t interval over the training seeds; there is none for a single seed.
    """
    informed, episodic = (fmean(entry["returns"][kind].values()) for kind in EGO_KINDS)
    interval = "" if entry["interval"] is None else " ({:+z.1f} to {:+z.1f})".format(*entry["interval"])
    return f"{informed - episodic:+z.1f}{interval}"


def adaptation_table(folder: Path, layouts: bool = True, tracks: Collection[str] = ()) -> str:
    """Return a Markdown table of measured sets of tasks: the return of each kind of ego, and the difference.

    Args:
        folder, tracks: see `read_adaptation`.
        layouts: whether a set of several layouts also gets a row for each layout.
    """
    rows = []
    for entry in read_adaptation(folder, tracks):
        means = [f"{fmean(entry['returns'][kind].values()):.1f}" for kind in EGO_KINDS]
        training = [str(len(entry["returns"]["informed"])), f"{entry['steps']:,}", str(entry["width"])]
        rows.append([entry["tasks"], str(entry["number"]), *means, headroom_text(entry), *training])
        for layout, of in entry["layouts"].items() if layouts and len(entry["layouts"]) > 1 else ():
            one, other = (of[kind] for kind in EGO_KINDS)
            rows.append([layout, "", f"{one:.1f}", f"{other:.1f}", f"{one - other:+.1f}", "", "", ""])
    return markdown_table(["set", "tasks", *EGO_KINDS, "difference", "seeds", "steps of each", "width"], rows, right=7)
