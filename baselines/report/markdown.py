"""TODO."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from io import StringIO
from typing import Any

import numpy as np

from baselines.report.results import Run, families_of, normalised, published_cells
from icrl4aht_data.benchmark.facts import FAMILIES, TRACKS
from icrl4aht_data.benchmark.reference_returns import Cell, has_headroom, read_headroom
from icrl4aht_data.utils.templates import markdown_table

_RESAMPLES = 10_000


def interval(means: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """The bootstrap 95 % interval of the mean over instances (n,)."""
    resampled = rng.choice(means, (_RESAMPLES, len(means))).mean(axis=1)
    low, high = np.percentile(resampled, (2.5, 97.5))
    return float(low), float(high)


def rows(run: Run) -> list[dict[str, Any]]:
    """One row per cell: ours, the published number of the same agent, interval, gain, and the normalised score."""
    published: dict[str, Any] = {} if run.variant else published_cells(run.agent)
    headroom = read_headroom(run.protocol)
    rng = np.random.default_rng(0)
    table = []
    for cell in run.cells:
        layout, family = cell
        means = run.means(cell)
        low, high = interval(means, rng)
        theirs = published.get(layout, {}).get(family, (None, None))
        table.append(
            {
                "agent": run.agent,
                "protocol": run.protocol,
                "layout": layout,
                "family": family,
                "instances": len(means),
                "episodes": run.cells[cell].shape[1],
                "mean": float(means.mean()),
                "std": float(means.std()),
                "low": low,
                "high": high,
                "published_mean": theirs[0],
                "published_std": theirs[1],
                "gain": run.gain(cell),
                "headroom": has_headroom(headroom[cell]) if cell in headroom else None,
                "normalised": normalised(float(means.mean()), headroom.get(cell)),
                "variant": "" if run.variant is None else "{} = {}".format(*run.variant),
            }
        )
    return table


def markdown(runs: list[Run]) -> str:
    """The tables of both tracks, one block per run."""
    lines = ["# Returns per layout and teammate family", ""]
    lines += [
        "Mean ± std over the instances' means; below it the published number of the same agent, where there is one."
    ]
    for run in runs:
        for track, table in tables(run):
            lines += ["", f"## {run.name}, track {track}", "", table]
    return "\n".join(lines) + "\n"


def tables(run: Run) -> Iterator[tuple[str, str]]:
    """Of each track that was played, its name and its table, a column a layout."""
    cells = {(row["layout"], row["family"]): row for row in rows(run)}
    for track, splits in TRACKS.items():
        of_track = dict.fromkeys((*splits["test"], *splits["train"]))
        layouts = [layout for layout in of_track if any((layout, family) in cells for family in FAMILIES)]
        if layouts:
            yield track, _grid(cells, layouts)


def _grid(cells: dict[Cell, dict[str, Any]], layouts: list[str]) -> str:
    rows = [[family, *(_cell_text(cells.get((layout, family))) for layout in layouts)] for family in families_of(cells)]
    return markdown_table(["family", *layouts], rows)


def _cell_text(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    text = f"{row['mean']:.1f} ± {row['std']:.1f}"
    if row["published_mean"] is not None:
        text += f"<br>published {row['published_mean']:.1f} ± {row['published_std']:.1f}"
    text += f"<br>gain {row['gain']:+.1f}"
    if row["headroom"] is False:
        text += "<br>no headroom"
    if row["normalised"] is not None:
        text += f"<br>normalised {row['normalised']:.2f}"
    return text


def csv_text(runs: list[Run]) -> str:
    """Every row of every run."""
    table = [row for run in runs for row in rows(run)]
    stream = StringIO()
    writer = csv.DictWriter(stream, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return stream.getvalue()
