"""Cards in Markdown: one for each trained model, and one with the headroom of the benchmark."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_baselines.agents.egos import AGENTS, NamedEgo
from icrl4aht_baselines.evaluate.protocols import EVALUATION_SPLITS, bundled_tasks, get_protocol
from icrl4aht_baselines.online.responses import find_behaviours
from icrl4aht_baselines.report.page import markdown_sections
from icrl4aht_baselines.report.results import (
    TEST_LAYOUTS,
    EvaluationRun,
    ResultSource,
    evaluate_agent,
)
from icrl4aht_baselines.report.submission import SUBMITTED_PROTOCOL, SUBMITTED_SEEDS
from icrl4aht_baselines.report.tables import PAPER_METHODS, instances_range, published_cells
from icrl4aht_baselines.training.seen import TRAINED_ON, describe_training, overlap_legend
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES, has_headroom, headroom_table
from icrl4aht_data.utils.templates import fill_template, markdown_table

HEADROOM_FILES = ("headroom.json", "headroom.md", "stay.json", "behaviours.json")

HeadroomCells = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Layout -> family -> reference ego -> mean return."""


def model_card(
    run: EvaluationRun,
    title: str,
    command: str,
    validation: Sequence[EvaluationRun],
    pictures: Mapping[str, str],
) -> str:
    """Return README.md of a bundled model, which has a model for each track.

    Args:
        run: results of all of its models on test tasks. The card's table of models has a row for each.
        title: name of the bundled model.
        command: command that makes it.
        validation: further results, on validation tasks under the same protocol, which get tables, too.
        pictures: path of a picture with curves, relative to the card -> what it shows.
    """
    models: dict[str, list[ResultSource]] = defaultdict(list)
    for source in run.sources:
        if source.trained:
            models[source.trained["run_hash"]].append(source)
    configs: list[dict[str, Any]] = [(sources[0].trained or {})["config"] for sources in models.values()]
    config = configs[0]
    seeds = ", ".join(dict.fromkeys(str(config["train"]["seed"]) for config in configs))
    overlaps = {name for one in (run, *validation) for name in one.overlaps(one.cells)}
    limits = [
        f"Each model is one run, of seed {seeds}: the variation between seeds is not known.",
        "Its input at each step must be what the evaluator passes, see `docs/protocol.md` in the repository.",
        *overlap_legend(overlaps),
    ]
    properties = {
        "method": config["method"],
        "created with": f"icrl4aht-data {config['package_version']}",
        "made by": f"`{command}`",
    }
    sections = [section for one in (run, *validation) for section in markdown_sections([one], one.protocol)]
    shown = [f"{text}:\n\n![{Path(at).stem}]({at})" for at, text in pictures.items()]
    return fill_template(
        "baseline.md",
        title=title,
        method=config["method"],
        training=" ".join(dict.fromkeys(map(training_sentence, configs))),
        properties="\n".join(f"| {name} | {value} |" for name, value in properties.items()),
        models="\n".join(_model_row(run, sources) for sources in models.values()),
        protocol=run.protocol,
        results="\n\n".join(f"#{section}" for section in sections),
        curves="\n\n".join(["## Curves", *shown, ""]) if shown else "",
        limits="\n".join(f"* {limit}" for limit in limits),
    )


def training_sentence(config: Mapping[str, Any]) -> str:
    """Return a sentence on what a model was trained on.

    Args:
        config: config.json of its run.
    """
    if "groups" in config["histories"]:
        sentence, play = "It was trained by playing with teammates, not on learning histories.", config.get("play", {})
        if not play.get("imitation"):
            return sentence
        part = f"In the first {play['imitation_end']:.0%} of its steps it also imitated the scripted oracle"
        return f"{sentence} {part}, which sees the full state."
    cells = config.get(TRAINED_ON, ())
    sources = sorted({cell["source"] for cell in cells if cell.get("source")})
    labels = sorted({cell["labels"] for cell in cells if cell.get("labels")})
    named = f" of source {' and '.join(f'`{source}`' for source in sources)}" if sources else ""
    targets = f", with {' and '.join(f'`{label}`' for label in labels)} labels" if labels else ""
    return f"It was trained on learning histories{named}{targets}."


def _model_row(run: EvaluationRun, sources: Sequence[ResultSource]) -> str:
    """Return a row of the table of models: training data and seed of one model, and its evaluation."""
    trained: dict[str, Any] = sources[0].trained or {}
    histories = trained["config"]["histories"]
    instances = instances_range(len(run.cells[cell]) for source in sources for cell in source.tasks)
    values = [
        ", ".join(dict.fromkeys(layout for source in sources for layout in source.layouts)),
        f"`{Path(histories['root']).name}`, data version {histories['data_version']}, manifest with SHA-256 "
        f"`{trained['manifest_sha256']}`",
        describe_training(sources[0].seen),
        str(trained["config"]["train"]["seed"]),
        f"{sources[0].conditions}, {instances} in a cell",
    ]
    return f"| {' | '.join(values)} |"


def measure_headroom(out: Path, protocols: Sequence[str], show: Callable[..., None]) -> list[EvaluationRun]:
    """Evaluate every reference ego under every protocol into out/<protocol>/<agent>; finished tasks are kept.

    `stay` also plays the validation tasks, since scores are relative to it. Under the protocol of the scores, the egos
    play with the seeds of the agents' results, under others with seed 0.

    Args:
        out: folder of the results.
        protocols: their names.
        show: called with (name, episodes played, episodes), for progress.
    """
    runs = []
    for protocol in protocols:
        seeds = SUBMITTED_SEEDS if protocol == SUBMITTED_PROTOCOL else (0,)
        for agent in REFERENCES:
            splits = EVALUATION_SPLITS if agent == "stay" else ("test",)
            tasks = [task for split in splits for track in TRACKS for task in bundled_tasks(track, split)]
            ego, folder = NamedEgo(agent, AGENTS[agent]), out / protocol / agent
            what = f"{agent}, {protocol}"
            rules = get_protocol(protocol)
            runs.append(evaluate_agent(ego, tasks, rules, folder, seeds=seeds, show=show, what=what))
    return runs


def find_alike_tasks() -> list[list[str]]:
    """Return lists of test task ids; the teammates of the tasks in a list act alike."""
    tasks = [task for track in TRACKS for task in bundled_tasks(track, "test")]
    return [[task.task_id for task in alike] for alike in find_behaviours(tasks) if len(alike) > 1]


def write_headroom_cards(runs: Sequence[EvaluationRun], alike: Sequence[Sequence[str]], folder: Path) -> list[Path]:
    """Write `HEADROOM_FILES` into a folder. Return their paths.

    headroom.json holds protocol -> layout -> family -> reference ego -> mean return with the test tasks, stay.json
    protocol -> task id -> mean return of `stay`, behaviours.json `alike`, see `find_alike_tasks`.
    """
    content: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    stays: dict[str, dict[str, float]] = {}
    for run in runs:
        for cell, returns in run.returns.items():
            if cell.kind == "test":
                egos = content.setdefault(run.protocol, {}).setdefault(cell.layout, {}).setdefault(cell.family, {})
                egos[run.agent] = round(float(returns.mean.mean()), 3)
            if run.agent == "stay":
                means = returns.mean.mean(axis=1)
                found = {task.task_id: round(float(of), 3) for task, of in zip(run.tasks(cell), means, strict=True)}
                stays.setdefault(run.protocol, {}).update(found)
    paths = [folder / name for name in HEADROOM_FILES]
    paths[0].write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    paths[1].write_text(headroom_markdown(content), encoding="utf-8")
    for path, value in zip(paths[2:], (stays, alike), strict=True):
        path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
    return paths


def headroom_markdown(protocols: Mapping[str, HeadroomCells]) -> str:
    """Return the headroom card: protocol -> cells, as Markdown."""
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
    """Return a Markdown table of reference egos and the paper's methods: a row per layout, means over families.

    Args:
        layouts: measured under the protocol `published`.
    """
    body, paper = [], ("random", *PAPER_METHODS)
    for layout in (name for name in TEST_LAYOUTS if name in layouts):
        cells = layouts[layout]
        egos = {agent: np.mean([cell[agent] for cell in cells.values()]) for agent in REFERENCES}
        stated = [np.mean([published_cells(name)[layout][family][0] for family in cells]) for name in paper]
        numbers = [egos["stay"], egos["random"], *stated, egos["oracle"]]
        open_count = sum(map(has_headroom, cells.values()))
        body.append([layout, *(f"{number:z.1f}" for number in numbers), f"{open_count} of {len(cells)}"])
    names = ["stay", "random", *(f"{name} (paper)" for name in paper), "oracle", "cells with headroom"]
    return markdown_table(["layout", *names], body)
