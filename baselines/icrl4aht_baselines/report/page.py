"""Reports of results: Markdown, CSV, and one self-contained HTML page.

Tables show the paper's numbers next to results of protocol `published`. The page has inline CSS and SVG, and GIFs as
data URIs, but no scripts and no external files.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from functools import cache
from html import escape
from importlib.metadata import version
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from icrl4aht_baselines.agents.egos import AGENTS
from icrl4aht_baselines.report.figures import SMOOTHING, bar_charts, curve_charts
from icrl4aht_baselines.report.gifs import EpisodePair, family_gifs
from icrl4aht_baselines.report.results import (
    PUBLISHED_PROTOCOL,
    TASK_KINDS,
    EvaluationRun,
    ResultCell,
    family_title,
    sorted_cells,
)
from icrl4aht_baselines.report.scores import (
    add_scales,
    block_returns_text,
    bundled_ids_by_cell,
    cell_scales,
    find_headlines,
    find_score,
    known_headroom,
    scored_cells,
)
from icrl4aht_baselines.training.seen import TRAINED_ON, describe_training, overlap_legend, overlap_marks
from icrl4aht_data.benchmark.facts import TRACKS, family_sort_key
from icrl4aht_data.benchmark.reference_returns import HEURISTICS
from icrl4aht_data.utils.files import json_hash, read_json, write_atomically
from icrl4aht_data.utils.text import card_file, counted_noun, markdown_table

REPORT_FILES = ("report.md", "report.csv")
"""Names of the files that `write_report` writes."""

_RUNS_WITH_EPISODES = 3  # a GIF takes up to 110 kB of the page


PAPER_METHODS = ("AD", "DPT")
"""Methods whose published results tables show in additional rows."""

AVERAGE = "Average"
"""Label of the row of means over families, as in cards/published.json."""

Published = tuple[float, float | None]
"""Mean and standard deviation that the paper states; None if it states no standard deviation."""


class TableScore(NamedTuple):
    """Results of an agent on a group of layouts and families, as one entry of a table.

    Attributes:
        text: mean return, standard deviation, and symbols for overlap with training data; a dash without results.
        notes: further texts: missing results, the paper's numbers, score, and returns in blocks of episodes.
        is_flat: whether headroom was measured and none was found, see `scores.known_headroom`.
        overlaps: kinds of overlap of training data and tasks, see `icrl4aht_baselines.training.seen.OVERLAPS`.
    """

    text: str = "–"
    notes: Sequence[str] = ()
    is_flat: bool = False
    overlaps: tuple[str, ...] = ()


def table_score(
    cells: Sequence[ResultCell], run: EvaluationRun | None, protocol: str, published: Published | None = None
) -> TableScore:
    """Return a run's results on a group of layouts and families, as a table entry.

    Args:
        cells: layouts and families of the group.
        run: results of the agent; None without results.
        protocol: name of the protocol of the run.
        published: the paper's mean and std; not shown next to incomplete results or other episode lengths.
    """
    played = [cell for cell in cells if run and cell in run.cells]
    headroom, scales = known_headroom(protocol), cell_scales(protocol)
    measured = [headroom[cell] for cell in cells if cell in headroom]
    is_flat = bool(measured) and not any(measured)
    std = f" ± {published[1]:z.1f}" if published and published[1] is not None else ""
    paper = [f"paper {published[0]:z.1f}{std}"] if published else []
    if run is None or not played:
        return TableScore(notes=paper, is_flat=is_flat)
    returns = [run.returns[cell] for cell in played]
    means = [of.mean.mean(axis=1) for of in returns]
    values = means[0] if len(cells) == 1 else np.array([of_cell.mean() for of_cell in means])
    std = f" ± {values.std():z.1f}" if len(values) > 1 else ""
    instances = {cell: len(bundled_ids_by_cell()[cell]) for cell in played if cell.kind == "test"}
    complete = all(len(run.tasks(cell)) == count for cell, count in instances.items())
    counts = f"{len(means[0])} of {counted_noun(instances.get(cells[0], 0), 'instance')}"
    score, overlaps = find_score(run.returns, scored_cells(run, played, scales), scales), run.overlaps(played)
    blocks = block_returns_text(returns)
    notes = [
        f"{len(played)} of {len(cells)} cells" if len(played) < len(cells) else "",
        "" if complete else counts if len(cells) == 1 else "incomplete cells",
        *(paper if len(played) == len(cells) and all(map(run.has_full_length, played)) else []),
        f"score {score.total.mean:z.2f}" if score else "",
        f"episodes {blocks}" if blocks else "",
        "no headroom" if is_flat else "",
    ]
    text = f"{values.mean():z.1f}{std}{overlap_marks(overlaps)}"
    return TableScore(text, [note for note in notes if note], is_flat, overlaps)


class ScoreTable(NamedTuple):
    """Table of results on one kind of tasks.

    Attributes:
        title: heading of the table.
        kind: kind of the tasks.
        columns: name of a column -> layouts of the column.
        rows: (label of a group of families, agent) -> entries, one for each column.
        caption: sentence with the conditions of the evaluation.
    """

    title: str
    kind: str
    columns: Mapping[str, Sequence[str]]
    rows: Mapping[tuple[str, str], list[TableScore]]
    caption: str


def returns_tables(runs: Sequence[EvaluationRun], protocol: str) -> list[ScoreTable]:
    """Return a table of returns for each kind of task that was played.

    Tables of test tasks also have averages. Under the paper's protocol they have rows with the paper's results of AD,
    DPT and `random`.

    Args:
        runs: results of agents under one protocol.
        protocol: name of the protocol.
    """
    tables = []
    for kind in TASK_KINDS:
        cells = sorted_cells(cell for run in runs for cell in run.cells if cell.kind == kind)
        if not cells:
            continue
        layouts = tuple(dict.fromkeys(cell.layout for cell in cells))
        families = tuple(sorted({cell.family for cell in cells}, key=family_sort_key))
        columns, labels = ({name: (name,) for name in names} for names in (layouts, families))
        if kind == "test":
            columns |= {AVERAGE: layouts} if len(layouts) > 1 else {}
            labels |= {AVERAGE: families} if len(families) > 1 else {}
        played = {run.label: run for run in runs if not run.cells.keys().isdisjoint(cells)}
        rows = {}
        quoted = (*PAPER_METHODS, "random") if (kind, protocol) == ("test", PUBLISHED_PROTOCOL) else ()
        for label, agent in product(labels, dict.fromkeys((*played, *quoted))):
            run, scores = played.get(agent), []
            for of_column in columns.values():
                group = [ResultCell(*cell, kind) for cell in product(of_column, labels[label])]
                stated = published_score(agent if run is None else run, group) if quoted else None
                scores.append(table_score(group, run, protocol, stated))
            if any(score.notes or score.text != TableScore().text for score in scores):
                rows[label, agent] = scores
        caption = describe_conditions(played.values(), cells)
        tables.append(ScoreTable(f"{kind.capitalize()} tasks", kind, columns, rows, caption))
    return tables


@cache
def read_published() -> dict[str, Any]:
    """Return the content of cards/published.json: the numbers of the paper and their sources."""
    return read_json(card_file("published.json"))


def published_cells(agent: str) -> dict[str, dict[str, tuple[float, float]]]:
    """Return the paper's (mean, std) of an agent's returns by layout, then by family or "Average"; may be empty."""
    return read_published()["methods"].get(agent, {})


def published_score(agent: EvaluationRun | str, cells: Sequence[ResultCell]) -> Published | None:
    """Return the paper's mean and std for one family on a layout, a complete layout, or a track; otherwise None.

    The paper's tables are for context K = 500 and the small size; its text states means for some other contexts.

    Args:
        agent: name of a published method, or results of the method.
        cells: layouts and families of the group.
    """
    name, context = (agent, None) if isinstance(agent, str) else (agent.agent, agent.sources[0].detail("context"))
    layouts, families = (tuple(dict.fromkeys(cell[part] for cell in cells)) for part in (0, 1))
    stated = read_published()["contexts"]["methods"].get(name, {}).get(layouts[0], {})
    if context != 500 and str(context) in stated:
        return (stated[str(context)], None) if (len(layouts), families) == (1, HEURISTICS) else None
    if len(layouts) == 1:
        label = AVERAGE if families == HEURISTICS else families[0]
        found = published_cells(name).get(layouts[0], {}).get(label) if label == AVERAGE or len(cells) == 1 else None
    else:
        track = next((track for track in TRACKS if (layouts, families) == (TRACKS[track]["test"], HEURISTICS)), "")
        found = read_published()["tracks"]["methods"].get(name, {}).get(track)
    return found and (found[0], found[1])


def describe_conditions(runs: Iterable[EvaluationRun], cells: Container[ResultCell] | None = None) -> str:
    """Return a sentence with the protocol, seeds, episodes and number of tasks per cell of some runs.

    If the conditions differ between runs, the sentence names the runs under each condition. If `cells` is given, only
    results in these cells are described.
    """
    shown = [(run, cell) for run in runs for cell in run.cells if cells is None or cell in cells]
    labels: dict[str, dict[str, None]] = {}
    for run, cell in shown:
        labels.setdefault(run.source(cell).conditions, {})[run.label] = None
    several = len(labels) > 1
    texts = [f"{' and '.join(names)} under {text}" if several else f"under {text}" for text, names in labels.items()]
    instances = instances_range(len(run.cells[cell]) for run, cell in shown)
    return f"Evaluated {'; '.join(texts)}; {instances} in a cell."


def instances_range(numbers: Iterable[int]) -> str:
    """Return text with the range of some counts of instances, such as "5 instances" or "1 to 5 instances"."""
    found = sorted(set(numbers))
    return counted_noun(found[0], "instance") if len(found) == 1 else f"{found[0]} to {found[-1]} instances"


def write_report(runs: Sequence[EvaluationRun], out: Path) -> list[Path]:
    """Write report.md and report.csv of some runs into the folder `out`. Return the paths of both files."""
    out.mkdir(parents=True, exist_ok=True)
    text, table = paths = [out / name for name in REPORT_FILES]
    write_atomically(text, markdown(runs))
    write_atomically(table, csv_text(runs))
    return paths


def markdown(runs: Sequence[EvaluationRun]) -> str:
    """Return a Markdown report of some runs: a summary, and a table for each protocol and kind of tasks."""
    lines = [
        "# Returns per layout and teammate family",
        "",
        *(f"* {escape(text, quote=False)}" for text in summary_lines(runs)),
        "",
        "Mean ± std over the instances' means, over the cells' means in averages. The paper's number of the same agent",
        "is below it if the protocol is `published`: 5 instances, 100 episodes of 100 steps.",
    ]
    for protocol in dict.fromkeys(run.protocol for run in runs):
        of_protocol = [run for run in runs if run.protocol == protocol]
        lines += [f"\n{section}" for section in markdown_sections(of_protocol, protocol)]
    return "\n".join(lines) + "\n"


def markdown_sections(runs: Sequence[EvaluationRun], protocol: str) -> list[str]:
    """Return a Markdown section for each kind of task that was played: a table and its legend."""
    sections = []
    for table in returns_tables(runs, protocol):
        body = [
            [label, escape(agent, quote=False), *("<br>".join([score.text, *score.notes]) for score in scores)]
            for (label, agent), scores in table.rows.items()
        ]
        marks = {name for scores in table.rows.values() for score in scores for name in score.overlaps}
        notes = [escape(table.caption, quote=False), TASK_KINDS[table.kind], *overlap_legend(marks)]
        listed = "\n".join(f"* {note}" for note in notes if note)
        text = markdown_table(["family", "agent", *table.columns], body)
        sections.append(f"## {table.title}, {protocol}\n\n{text}\n\n{listed}")
    return sections


def summary_lines(runs: Sequence[EvaluationRun]) -> list[str]:
    """Return the summary of some runs as lines of text, followed by a legend of the symbols for overlap."""
    headlines = [headline for run in runs for headline in find_headlines(run)]
    legend = overlap_legend({name for one in headlines for name in one.overlaps})
    return [*(headline.text for headline in headlines), *legend]


def csv_text(runs: Sequence[EvaluationRun]) -> str:
    """Return the results of all runs as CSV text, with the columns of docs/results.parquet, see `results`.

    The column `agent` has the labels of the runs, because several runs may be of the same agent.
    """
    table = pd.concat([run.table.assign(agent=run.label) for run in runs], ignore_index=True)
    return add_scales(table).round(3).to_csv(index=False, lineterminator="\n")


def write_page(
    runs: Sequence[EvaluationRun],
    path: Path,
    *,
    gifs: bool = False,
    suite: Path | None = None,
    progress: Callable[..., None] = lambda what, done, total: None,
) -> Path:
    """Write the HTML page of a report. Return the path of the page.

    Args:
        runs: merged results of agents, see `results.merge`, under any protocols.
        path: path of the page; an existing file is replaced atomically.
        gifs: whether the page has GIFs of episodes. At most three runs have GIFs, reference egos only if there is room.
        suite: folder of learned teammates' checkpoints.
        progress: function for progress, called with (description, tasks drawn, number of tasks).
    """
    shown = sorted(runs, key=lambda run: run.agent in AGENTS)[:_RUNS_WITH_EPISODES] if gifs else []
    left = [run.label for run in runs if run not in shown]
    notes = [f"episodes are of {_RUNS_WITH_EPISODES} runs at most; there is none of: {', '.join(left)}"]
    with TemporaryDirectory() as folder:
        episodes = family_gifs(shown, Path(folder), suite, progress)
        values = _page_values(runs, episodes, notes if shown and left else [])
        text = _template_environment().get_template("page.html").render(values)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.lstrip())  # `check_output` recognizes a page by its first bytes
    return path


@cache
def _template_environment() -> Environment:
    loader = PackageLoader("icrl4aht_baselines.report")
    blocks: Any = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, **blocks)
    environment.filters |= {
        "number": lambda value, digits=1: f"{value:z.{digits}f}",
        "picture": lambda path: f"data:image/gif;base64,{base64.b64encode(path.read_bytes()).decode()}",
        "family": family_title,
    }
    return environment


def _page_values(
    runs: Sequence[EvaluationRun], episodes: Sequence[EpisodePair], notes: Sequence[str]
) -> dict[str, Any]:
    """Return the variables of the template page.html."""
    protocols = list(dict.fromkeys(run.protocol for run in runs))
    labels = list(dict.fromkeys(run.label for run in runs))  # the index of a label gives its colour
    agents = list(dict.fromkeys(run.agent for run in runs))
    names = ", ".join(agents) if len(agents) <= 4 else f"{', '.join(agents[:3])} and {len(agents) - 3} more"
    found: dict[str, list[Any]] = {"bars": [], "curves": [], "tables": []}
    for protocol in protocols:
        numbered = {labels.index(run.label): run for run in runs if run.protocol == protocol}
        suffix = f" ({protocol})" if len(protocols) > 1 else ""
        for name, parts in (
            ("bars", bar_charts(numbered, protocol)),
            ("curves", curve_charts(numbered)),
            ("tables", returns_tables(list(numbered.values()), protocol)),
        ):
            found[name] += [part._replace(title=f"{part.title}{suffix}") for part in parts]
    published = read_published()
    sources = [published["source"], *(published[part]["source"] for part in ("tracks", "contexts", "auxiliary"))]
    sources += [f"auxiliary losses: {json.dumps(published['auxiliary']['methods'])}", published["not_stated"]]
    return {
        **found,
        "title": f"{names}, protocol{'s' if len(protocols) > 1 else ''} {' and '.join(protocols)}",
        "version": version("icrl4aht-data"),
        "headlines": [headline for run in runs for headline in find_headlines(run)],
        "conditions": [describe_conditions(run for run in runs if run.protocol == protocol) for protocol in protocols],
        "legend": overlap_legend({name for run in runs for name in run.overlaps(run.cells)}),
        "notes": notes,
        "smoothing": SMOOTHING,
        "episodes": sorted(episodes, key=lambda pair: pair.cell.order[1:]),
        "settings": _settings_table(runs),
        "protocols": protocols,
        "published_protocol": PUBLISHED_PROTOCOL,
        "sources": sources,
    }


def _settings_table(runs: Sequence[EvaluationRun]) -> dict[str, list[str]]:
    """Return the settings of evaluation and training: name -> its values as text, one for each source of results."""
    columns = []
    for label, source in [(run.label, source) for run in runs for source in run.sources]:
        shown = {"agent": label, "layouts": ", ".join(source.layouts), "results": source.folder}
        shown |= {"settings hash": json_hash(source.settings), "in training": describe_training(source.seen)}
        trained = dict(source.trained or {})
        record = shown | source.settings | trained.pop("config", {}) | trained
        columns.append(pd.json_normalize(record).iloc[0])
    frame = pd.concat(columns, axis=1).fillna("")
    frame = frame[~frame.index.str.contains(f"{TRAINED_ON}|groups|selections") & (frame != "").any(axis=1)]
    return {str(name): [str(value) for value in row] for name, row in frame.iterrows()}
