"""Results as text: Markdown tables with the published numbers, CSV, and the short report of both with curves."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_baselines.plotting import plot_return_curves
from icrl4aht_baselines.report.headline import find_headlines, headline_text
from icrl4aht_baselines.report.intervals import bootstrap_interval
from icrl4aht_baselines.report.overlap import overlap_legend, overlap_marks
from icrl4aht_baselines.report.results import (
    GROUP_TEXTS,
    TEST_LAYOUTS,
    EvaluationRun,
    family_of,
    group_of,
    groups_of,
    instances_range,
    instances_text,
    normalised_score,
    published_cells,
    published_instances,
    split_cells,
)
from icrl4aht_data.benchmark.facts import TRACKS, track_layouts
from icrl4aht_data.benchmark.reference_returns import REFERENCES, Cell, has_headroom, headroom_table, read_headroom
from icrl4aht_data.plotting import MOST_PANELS, check_can_draw
from icrl4aht_data.utils.templates import markdown_table

_FIRST_CURVES = "curves.png"

_PAPER_AGENTS = ("random", "AD", "DPT")

HeadroomCells = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Layout -> family -> reference ego -> mean return."""


def report_begins(runs: Sequence[EvaluationRun] = ()) -> dict[str, bytes | None]:
    """Returns the files of a report with their first bytes, by which they are recognised before they are replaced.

    The bytes are None for a picture, which carries this package's mark. Without runs the only picture is curves.png.
    """
    pictures = [name for name, _ in _curve_pictures(runs)] or [_FIRST_CURVES]
    return {
        "report.md": b"# Returns per layout and teammate family\n",
        "report.csv": b"agent,protocol,layout,family,instances,episodes,mean,std,",
    } | dict.fromkeys(pictures)


def _curve_pictures(runs: Sequence[EvaluationRun]) -> list[tuple[str, list[Cell]]]:
    """Returns the names of the pictures of curves and the cells in each: curves.png, curves-2.png and so on."""
    parts = split_cells({cell for run in runs for cell in run.cells}, MOST_PANELS)
    return [
        (_FIRST_CURVES if number == 1 else f"curves-{number}.png", cells) for number, cells in enumerate(parts, start=1)
    ]


def rows(run: EvaluationRun) -> list[dict[str, Any]]:
    """Returns one row per cell of a run.

    A row has the agent, the conditions of the evaluation, mean return, std and 95 % interval over the instances (None
    for a single instance), the paper's numbers (None unless the protocol is `published`), the adaptation gain,
    headroom, the normalised score (None for cells without headroom and incomplete cells), and `overlap`: the ways in
    which training data and tasks overlap, see `icrl4aht_baselines.report.overlap.OVERLAPS`.
    """
    published: dict[str, Any] = {} if run.variant else published_cells(run.agent)
    headroom = read_headroom(run.protocol)
    rng = np.random.default_rng(0)
    found = []
    for cell in run.cells:
        layout, family = cell
        means, settings = run.means(cell), run.source(cell).settings
        several = len(means) > 1
        low, high = bootstrap_interval(means, rng) if several else (None, None)
        published_mean, published_std = (
            published.get(layout, {}).get(family, (None, None)) if run.is_like_the_papers(cell) else (None, None)
        )
        found.append(
            {
                "agent": run.agent,
                "protocol": run.protocol,
                "layout": layout,
                "family": family_of(cell),
                "instances": len(means),
                "episodes": run.cells[cell].shape[1],
                "mean": float(means.mean()),
                "std": float(means.std()) if several else None,
                "low": low,
                "high": high,
                "published_mean": published_mean,
                "published_std": published_std,
                "gain": run.gain(cell),
                "headroom": has_headroom(headroom[cell]) if cell in headroom else None,
                "normalised": normalised_score(run, cell, headroom),
                "tasks": group_of(cell),
                "seeds": len(settings["seeds"]),
                "steps": settings["protocol"]["steps"],
                "overlap": " ".join(run.overlaps([cell])),
                "acting": run.source(cell).acting,
                "encoder": run.source(cell).encoder,
                "variant": "" if run.variant is None else "{} = {}".format(*run.variant),
            }
        )
    return found


def write_report(runs: list[EvaluationRun], out: Path) -> list[Path]:
    """Write report.md, report.csv and the curves of some runs into the folder `out`. Returns their paths.

    More cells than fit a picture are drawn in several: curves.png, curves-2.png and so on.

    Raises:
        OptionError: if matplotlib is not installed; nothing is written then.
    """
    check_can_draw()
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / name for name in report_begins(runs)]
    paths[0].write_text(markdown(runs), encoding="utf-8")
    paths[1].write_text(csv_text(runs), encoding="utf-8")
    for name, cells in _curve_pictures(runs):
        plot_return_curves([(run.name, run.cells) for run in runs], cells, out / name)
    return paths


def markdown(runs: list[EvaluationRun]) -> str:
    """Returns a Markdown report: a summary, and a table of returns per run, track and kind of tasks."""
    lines = [
        "# Returns per layout and teammate family",
        "",
        *(f"* {text}" for text in summary_lines(runs)),
        "",
        "Mean ± std over the instances' means. The published number of the same agent is below it if the protocol is",
        "`published`: the paper's 5 instances, 100 episodes of 100 steps.",
    ]
    for run in runs:
        for part, table in track_tables(run):
            lines += ["", f"## {run.name}, {part}", "", table]
    return "\n".join(lines) + "\n"


def summary_lines(runs: Sequence[EvaluationRun]) -> list[str]:
    """Returns the summary of some runs for the console and Markdown, see `headline.headline_text`, and its legend."""
    headlines = [headline for run in runs for headline in find_headlines(run)]
    legend = overlap_legend({name for one in headlines for name in one.run.overlaps(one.cells)})
    return [*map(headline_text, headlines), *legend]


def track_tables(run: EvaluationRun) -> Iterator[tuple[str, str]]:
    """Yields each track and kind of tasks that was played, and a Markdown table with caption and meaning of its marks.

    Test tasks come first, as "track teammate"; others have tables of their own, as "track teammate, validation tasks".
    A table has a column per layout and a row per family of teammates.
    """
    cells = dict(zip(run.cells, rows(run), strict=True))
    for track, kind in product(TRACKS, ("test", *GROUP_TEXTS)):
        of_track = dict.fromkeys((*track_layouts(track, "test"), *track_layouts(track, "train")))
        shown = [cell for cell in run.cells if cell[0] in of_track and group_of(cell) == kind]
        layouts = [layout for layout in of_track if any(cell[0] == layout for cell in shown)]
        if shown:
            body = [
                [group, *(_cell_text((layout, group), cells.get((layout, group))) for layout in layouts)]
                for group in groups_of(shown)
            ]
            notes = [*table_caption(run, shown), *overlap_legend(run.overlaps(shown))]
            table = markdown_table(["family", *layouts], body)
            title = f"track {track}" + ("" if kind == "test" else f", {kind} tasks")
            yield title, "\n".join([table, "", *(f"* {note}" for note in notes)])


def table_caption(run: EvaluationRun, cells: Sequence[Cell]) -> list[str]:
    """Returns sentences on the conditions, instances and tasks of some of a run's cells."""
    conditions = dict.fromkeys(run.source(cell).conditions for cell in cells)
    instances = instances_range(len(run.cells[cell]) for cell in cells)
    sentences = [f"{text[0].upper()}{text[1:]}, {instances} in a cell." for text in conditions]
    groups = {group_of(cell) for cell in cells}
    return sentences + [text for group, text in GROUP_TEXTS.items() if group in groups]


def _cell_text(cell: Cell, row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    text = f"{row['mean']:.1f}" + ("" if row["std"] is None else f" ± {row['std']:.1f}")
    text += overlap_marks(row["overlap"].split())
    if row["instances"] != published_instances(cell):
        text += f"<br>{instances_text(cell, row['instances'])}"
    if row["published_mean"] is not None:
        text += f"<br>published {row['published_mean']:.1f} ± {row['published_std']:.1f}"
    text += f"<br>gain {row['gain']:+z.1f}"
    if row["headroom"] is False:
        text += "<br>no headroom"
    if row["normalised"] is not None:
        text += f"<br>normalised {row['normalised']:z.2f}"
    return text


def csv_text(runs: list[EvaluationRun]) -> str:
    """Returns the rows of all runs as CSV with a header."""
    body = [row for run in runs for row in rows(run)]
    stream = StringIO()
    writer = csv.DictWriter(stream, fieldnames=list(body[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(body)
    return stream.getvalue()


def headroom_markdown(protocols: Mapping[str, HeadroomCells]) -> str:
    """Returns the headroom card: protocol -> cells, as Markdown."""
    lines = [
        "# Headroom: what an ego can change",
        "",
        "Mean return of the reference egos `stay` / `random` / `oracle` (scripted, full information) over the five",
        "published test instances of a cell, each played with seed 0 for 100 episodes of 100 steps. **bold**: the",
        "oracle gets over one point more than staying does; elsewhere no reference ego can raise the return by more,",
        "so a method's score there says nothing about adaptation.",
    ]
    for protocol, layouts in protocols.items():
        names = [layout for layout in TEST_LAYOUTS if layout in layouts]
        cells: dict[Cell, Any] = {
            (layout, family): cell for layout in names for family, cell in layouts[layout].items()
        }
        lines += ["", f"## Protocol `{protocol}`", "", headroom_table(cells, names)]
    if "published" in protocols:
        lines += ["", "## The paper's methods and the reference egos", "", published_table(protocols["published"])]
    return "\n".join(lines) + "\n"


def published_table(layouts: HeadroomCells) -> str:
    """Returns a Markdown table of reference egos and the paper's methods: a row per layout, means over families.

    Args:
        layouts: measured under the protocol `published`.
    """
    body = []
    for layout in (name for name in TEST_LAYOUTS if name in layouts):
        cells = layouts[layout]
        ours = {agent: np.mean([cell[agent] for cell in cells.values()]) for agent in REFERENCES}
        paper = {
            name: np.mean([published_cells(name)[layout][family][0] for family in cells]) for name in _PAPER_AGENTS
        }
        open_cells = sum(map(has_headroom, cells.values()))
        numbers = [ours["stay"], ours["random"], *paper.values(), ours["oracle"]]
        body.append([layout, *(f"{number:z.1f}" for number in numbers), f"{open_cells} of {len(cells)}"])
    names = ["stay", "random", *(f"{name} (paper)" for name in _PAPER_AGENTS), "oracle", "cells with headroom"]
    return markdown_table(["layout", *names], body)
