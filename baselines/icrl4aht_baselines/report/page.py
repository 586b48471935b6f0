"""Reports of results: Markdown, CSV, and one self-contained HTML page.

The page has inline CSS and SVG and GIFs as data URIs, no script and no external files.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from functools import cache
from html import escape
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from icrl4aht_baselines.agents.egos import AGENTS
from icrl4aht_baselines.report.figures import SMOOTHING, bar_charts, curve_charts
from icrl4aht_baselines.report.gifs import EpisodePair, family_gifs
from icrl4aht_baselines.report.results import (
    PUBLISHED_PROTOCOL,
    TASK_KINDS,
    EvaluationRun,
    family_title,
)
from icrl4aht_baselines.report.scores import add_scales
from icrl4aht_baselines.report.tables import describe_conditions, find_headlines, read_published, returns_tables
from icrl4aht_baselines.training.seen import TRAINED_ON, describe_training, overlap_legend
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, json_hash
from icrl4aht_data.utils.templates import markdown_table

REPORT_FILES = ("report.md", "report.csv")
"""Files that `write_report` writes."""

_RUNS_WITH_EPISODES = 3  # a GIF takes up to 110 kB of the page


def write_report(runs: Sequence[EvaluationRun], out: Path) -> list[Path]:
    """Write report.md and report.csv of some runs into the folder `out`. Return their paths."""
    out.mkdir(parents=True, exist_ok=True)
    text, table = paths = [out / name for name in REPORT_FILES]
    text.write_text(markdown(runs), encoding="utf-8")
    table.write_text(csv_text(runs), encoding="utf-8")
    return paths


def markdown(runs: Sequence[EvaluationRun]) -> str:
    """Return a Markdown report: a summary, and a table of returns per protocol and kind of tasks."""
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
    """Return a section of Markdown for each kind of tasks that was played: a table, and the meaning of its marks."""
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
    """Return the summary of some runs for the console and Markdown, and the legend of its marks."""
    headlines = [headline for run in runs for headline in find_headlines(run)]
    legend = overlap_legend({name for one in headlines for name in one.overlaps})
    return [*(headline.text for headline in headlines), *legend]


def csv_text(runs: Sequence[EvaluationRun]) -> str:
    """Return the results of all runs as CSV, with the columns of docs/results.csv, see `results`.

    The column `agent` has the runs' labels, which distinguish several runs of an agent.
    """
    table = pd.concat([run.table.assign(agent=run.label) for run in runs], ignore_index=True)
    return add_scales(table).round(3).to_csv(index=False, lineterminator="\n")


def write_page(
    runs: Sequence[EvaluationRun], path: Path, episodes: Sequence[EpisodePair] = (), notes: Sequence[str] = ()
) -> Path:
    """Write the page. Return its path.

    Args:
        runs: merged, see `results.merge`; of any protocols.
        path: ends in .html; replaced atomically.
        episodes: see `gifs.family_gifs`.
        notes: facts about these runs for the reader, such as those without episodes.

    Raises:
        OptionError: if the path does not end in .html, or there is no run.
    """
    if path.suffix not in (".html", ".htm"):
        raise OptionError(f"{path}: expected a name that ends in .html")
    if not runs:
        raise OptionError("no run to report; give at least one folder of results")
    text = _environment().get_template("page.html").render(_page_values(runs, episodes, notes))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def write_page_with_episodes(
    runs: Sequence[EvaluationRun],
    path: Path,
    *,
    episodes: bool = True,
    suite: Path | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Path:
    """Write the page with episodes of a task per family of teammates, of at most three runs. Return its path.

    Reference egos come after the other runs.

    Args:
        runs, path: see `write_page`.
        episodes: False for a page without episodes.
        suite: folder of learned teammates' checkpoints.
        progress: called with (description, tasks drawn, tasks).
    """
    shown = sorted(runs, key=lambda run: run.agent in AGENTS)[:_RUNS_WITH_EPISODES] if episodes else []
    left = [run.label for run in runs if run not in shown]
    notes = []
    if shown and left:
        notes.append(f"episodes are of {_RUNS_WITH_EPISODES} runs at most; there is none of: {', '.join(left)}")
    with TemporaryDirectory() as folder:
        return write_page(runs, path, family_gifs(shown, Path(folder), suite, progress), notes)


@cache
def _environment() -> Environment:
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
    """Return the values of the template page.html."""
    protocols = list(dict.fromkeys(run.protocol for run in runs))
    labels = list(dict.fromkeys(run.label for run in runs))  # an agent has one colour under all protocols
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
    """Return setting -> its value for each source of results; the settings of the evaluation and of the training."""
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
