"""Evaluate the reference egos on every test task, and write their mean returns to the folder cards/."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.protocols import EVALUATION_SPLITS, SUBMITTED_SEEDS, bundled_tasks, get_protocol
from icrl4aht_baselines.online.responses import find_behaviours
from icrl4aht_baselines.report.page import PAPER_METHODS, published_cells
from icrl4aht_baselines.report.results import TEST_LAYOUTS, EvaluationRun, evaluate_agent
from icrl4aht_baselines.report.submission import SUBMITTED_PROTOCOL
from icrl4aht_data.benchmark.facts import PREFERENCE, TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES, has_headroom, headroom_table
from icrl4aht_data.utils.text import markdown_table

HEADROOM_FILES = ("headroom.json", "headroom.md", "stay.json", "behaviours.json")

HeadroomCells = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Layout -> teammate family -> reference ego -> mean return."""


def measure_headroom(out: Path, protocols: Sequence[str]) -> list[EvaluationRun]:
    """Evaluate every reference ego under every protocol; results are stored in OUT/PROTOCOL/AGENT and reused.

    The ego `stay` also plays validation tasks and, under the protocol of the scores, the test tasks of the track
    `preference`, since scores are relative to its returns. Under this protocol, egos play with the seeds of submitted
    results, under other protocols with seed 0.

    Args:
        out: folder of the results.
        protocols: names of the protocols.
    """
    runs = []
    for protocol, agent in product(protocols, REFERENCES):
        seeds = SUBMITTED_SEEDS if protocol == SUBMITTED_PROTOCOL else (0,)
        splits = EVALUATION_SPLITS if agent == "stay" else ("test",)
        tasks = [task for split, track in product(splits, TRACKS) for task in bundled_tasks(track, split)]
        tasks += bundled_tasks(PREFERENCE, "test") if agent == "stay" and protocol == SUBMITTED_PROTOCOL else []
        folder = out / protocol / agent
        runs.append(evaluate_agent(find_agent(agent), tasks, get_protocol(protocol), folder, seeds=seeds))
    return runs


def find_equal_teammates() -> list[list[str]]:
    """Return groups of test tasks with teammates that behave the same; each group has two or more task ids."""
    tasks = [task for track in TRACKS for task in bundled_tasks(track, "test")]
    return [[task.task_id for task in alike] for alike in find_behaviours(tasks) if len(alike) > 1]


def write_headroom_cards(runs: Sequence[EvaluationRun], alike: Sequence[Sequence[str]], folder: Path) -> list[Path]:
    """Write the files `HEADROOM_FILES` into a folder. Return their paths.

    headroom.json holds protocol -> layout -> family -> reference ego -> mean return in the test tasks, stay.json holds
    protocol -> task id -> mean return of `stay`, and behaviours.json holds the result of `find_equal_teammates`.
    """
    content: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    stays: dict[str, dict[str, float]] = {}
    for run in runs:
        for cell, returns in run.returns.items():
            means = returns.mean.mean(axis=1)  # mean return of each task
            if cell.kind == "test":
                egos = content.setdefault(run.protocol, {}).setdefault(cell.layout, {}).setdefault(cell.family, {})
                egos[run.agent] = round(float(means.mean()), 3)
            if run.agent == "stay":
                of_task = zip(run.tasks(cell), means.tolist(), strict=True)
                stays.setdefault(run.protocol, {}).update({task.task_id: round(mean, 3) for task, mean in of_task})
    numbers, *lists = (json.dumps(value, indent=1) + "\n" for value in (content, stays, alike))
    paths = [folder / name for name in HEADROOM_FILES]
    for path, text in zip(paths, (numbers, headroom_markdown(content), *lists), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def headroom_markdown(protocols: Mapping[str, HeadroomCells]) -> str:
    """Return the headroom card as Markdown, with a table for each protocol.

    Args:
        protocols: protocol -> returns of the reference egos.
    """
    lines = [
        "# Headroom: what an ego can change",
        "",
        "Mean return of the reference egos `stay` / `random` / `oracle` (scripted, full information) over the five",
        "published test instances of a cell, each played for 100 episodes of 100 steps with seed 0, under `seeded`",
        f"with the seeds {', '.join(map(str, SUBMITTED_SEEDS))}. **bold**: the oracle earns over one point more than",
        "`stay`; elsewhere no reference ego can raise the return by more, so a method's score there says nothing about",
        "adaptation.",
    ]
    for protocol, layouts in protocols.items():
        names = [layout for layout in TEST_LAYOUTS if layout in layouts]
        cells = {(layout, family): cell for layout in names for family, cell in layouts[layout].items()}
        lines += ["", f"## Protocol `{protocol}`", "", headroom_table(cells, names)]
    if "published" in protocols:
        lines += ["", "## The paper's methods and the reference egos", "", published_table(protocols["published"])]
    return "\n".join(lines) + "\n"


def published_table(layouts: HeadroomCells) -> str:
    """Return a Markdown table with the mean returns of the reference egos and the paper's methods on each layout.

    Args:
        layouts: returns of the reference egos under the protocol `published`.
    """
    body, paper = [], ("random", *PAPER_METHODS)
    for layout in (name for name in TEST_LAYOUTS if name in layouts):
        cells = layouts[layout]
        stay, drawn, oracle = (np.mean([cell[agent] for cell in cells.values()]) for agent in REFERENCES)
        stated = [np.mean([published_cells(name)[layout][family][0] for family in cells]) for name in paper]
        numbers = [f"{number:z.1f}" for number in (stay, drawn, *stated, oracle)]
        body.append([layout, *numbers, f"{sum(map(has_headroom, cells.values()))} of {len(cells)}"])
    names = ["stay", "random", *(f"{name} (paper)" for name in paper), "oracle", "cells where the oracle earns more"]
    return markdown_table(["layout", *names], body)
