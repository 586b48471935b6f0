"""What the benchmark leaves an ego to do: the reference egos on every test task."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from baselines.agents.egos import get_agent
from baselines.evaluate.evaluator import evaluate
from baselines.evaluate.protocols import get_protocol
from baselines.report.results import TEST_LAYOUTS, Run, as_run, published_cells
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES, has_headroom, headroom_table
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks
from icrl4aht_data.commands.options import counted
from icrl4aht_data.utils.templates import card_file, markdown_table

_PAPER = ("random", "AD", "DPT")


def measure(out: Path, protocols: Sequence[str], show: Callable[..., None]) -> list[Run]:
    """Evaluate every reference ego under every protocol, resumably, into out/<protocol>/<agent>."""
    tasks = [task for track in TRACKS for task in read_tasks(manifest_path(track, "test"))]
    runs = []
    for protocol in protocols:
        for agent in REFERENCES:
            results = evaluate(
                agent,
                get_agent(agent),
                tasks,
                get_protocol(protocol),
                out=out / protocol / agent,
                done=counted(show, f"{agent}, {protocol}", len(tasks)),
            )
            runs.append(as_run(results))
    return runs


def write_cards(runs: Sequence[Run], folder: Path | None = None) -> list[Path]:
    """headroom.json (protocol -> layout -> family -> agent -> mean return) and headroom.md, into `cards` by default."""
    folder = folder or card_file("headroom.json").parent
    table: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for run in runs:
        for layout, family in run.cells:
            cell = table.setdefault(run.protocol, {}).setdefault(layout, {}).setdefault(family, {})
            cell[run.agent] = round(float(run.means((layout, family)).mean()), 3)
    paths = [folder / "headroom.json", folder / "headroom.md"]
    paths[0].write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    paths[1].write_text(_markdown(table), encoding="utf-8")
    return paths


def _markdown(table: dict[str, dict[str, dict[str, dict[str, float]]]]) -> str:
    lines = [
        "# Headroom: what an ego can change",
        "",
        "Mean return of the reference egos `stay` / `random` / `oracle` (scripted, full information) over the",
        "published test instances. **bold**: the oracle gets more than staying does; elsewhere no reference ego can",
        "raise the return, so a method's score there says nothing about adaptation.",
    ]
    for protocol, layouts in table.items():
        names = [layout for layout in TEST_LAYOUTS if layout in layouts]
        cells = {(layout, family): cell for layout in names for family, cell in layouts[layout].items()}
        lines += ["", f"## Protocol `{protocol}`", "", headroom_table(cells, names)]
    if "published" in table:
        lines += ["", "## The paper's methods beside the reference egos", "", published_table(table["published"])]
    return "\n".join(lines) + "\n"


def published_table(layouts: dict[str, dict[str, dict[str, float]]]) -> str:
    """Markdown: a row a layout, mean returns over its families under protocol `published`, the paper's numbers beside.

    Args:
        layouts: layout -> family -> reference ego -> mean return.
    """
    rows = []
    for layout in (name for name in TEST_LAYOUTS if name in layouts):
        cells = layouts[layout]
        ours = {agent: np.mean([cell[agent] for cell in cells.values()]) for agent in REFERENCES}
        paper = {name: np.mean([published_cells(name)[layout][family][0] for family in cells]) for name in _PAPER}
        open_cells = sum(map(has_headroom, cells.values()))
        numbers = [ours["stay"], ours["random"], *paper.values(), ours["oracle"]]
        rows.append([layout, *(f"{number:z.1f}" for number in numbers), f"{open_cells} of {len(cells)}"])
    names = ["stay", "random", *(f"{name} (paper)" for name in _PAPER), "oracle", "cells with headroom"]
    return markdown_table(["layout", *names], rows)
