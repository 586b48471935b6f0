"""Reports of results: Markdown, CSV and curves, and one self-contained HTML page.

The page has inline CSS and SVG and GIFs as data URIs, no script and no external files.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Container, Iterable, Sequence
from functools import cache
from html import escape
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from icrl4aht_baselines.plotting import SMOOTHING, plot_return_curves
from icrl4aht_baselines.report.figures import (
    BarChart,
    NumberedRuns,
    PanelFigure,
    curve_figure,
    reported_series,
    return_bars,
    score_bars,
)
from icrl4aht_baselines.report.gifs import EpisodePair, family_gifs
from icrl4aht_baselines.report.results import (
    PUBLISHED_PROTOCOL,
    TASK_KINDS,
    EvaluationRun,
    ResultCell,
    ResultSource,
    family_title,
    read_published,
    split_cells,
)
from icrl4aht_baselines.report.scores import describe_conditions, find_headlines, returns_tables, rows
from icrl4aht_baselines.training.seen import describe_training, overlap_legend, overlap_marks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import MOST_PANELS, check_can_draw
from icrl4aht_data.utils.files import atomic_write, json_hash
from icrl4aht_data.utils.templates import markdown_table

_RUNS_WITH_EPISODES = 3  # a GIF takes up to 110 kB of the page
_REFERENCE_RANK = {"oracle": 1, "random": 2, "stay": 3}
_SHOWN_SETTINGS = {
    "train": ("steps", "batch_size", "context", "learning_rate", "seed"),
    "model": ("layers", "width", "encoder", "positions"),
    "histories": ("channels",),
}


def report_files(runs: Sequence[EvaluationRun] = ()) -> list[str]:
    """Return the names of the files of a report; without runs the only picture is curves.png."""
    return ["report.md", "report.csv", *(_curve_pictures(runs) or ["curves.png"])]


def _curve_pictures(runs: Sequence[EvaluationRun]) -> dict[str, list[ResultCell]]:
    """Return the names of the pictures of curves and the cells in each: curves.png, curves-2.png and so on."""
    parts = split_cells({cell for run in runs for cell in run.cells}, MOST_PANELS)
    return {"curves.png" if n == 1 else f"curves-{n}.png": cells for n, cells in enumerate(parts, start=1)}


def write_report(runs: list[EvaluationRun], out: Path) -> list[Path]:
    """Write report.md, report.csv and the curves of some runs into the folder `out`. Return their paths.

    Raises:
        OptionError: if matplotlib is not installed; nothing is written then.
    """
    check_can_draw()
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / name for name in report_files(runs)]
    paths[0].write_text(markdown(runs), encoding="utf-8")
    paths[1].write_text(csv_text(runs), encoding="utf-8")
    for name, cells in _curve_pictures(runs).items():
        panels = {cell.title: {run.name: run.cells[cell] for run in runs if cell in run.cells} for cell in cells}
        plot_return_curves(panels, out / name)
    return paths


def markdown(runs: list[EvaluationRun]) -> str:
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


def markdown_sections(runs: list[EvaluationRun], protocol: str) -> list[str]:
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
    legend = overlap_legend({name for one in headlines for name in one.run.overlaps(one.cells)})
    return [*(headline.text for headline in headlines), *legend]


def csv_text(runs: list[EvaluationRun]) -> str:
    """Return the rows of all runs as CSV with a header, see `scores.rows`."""
    body = pd.DataFrame([row for run in runs for row in rows(run)], dtype=object)
    return body.to_csv(index=False, lineterminator="\n")


class _Chart(NamedTuple):
    """A figure of the page; `series` has the number and name of each run in it."""

    title: str
    figure: BarChart | PanelFigure
    series: list[tuple[int, str]]
    caption: str


def write_page(
    runs: Sequence[EvaluationRun], path: Path, episodes: Sequence[EpisodePair] = (), notes: Sequence[str] = ()
) -> Path:
    """Write the page. Return its path.

    Args:
        runs: merged, see `results.merge`; of any protocols, sweeps among them.
        path: ends in .html; replaced atomically.
        episodes: see `gifs.family_gifs`.
        notes: facts about these runs for the reader, such as layouts that were left out.

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
    notes: Sequence[str] = (),
    suite: Path | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Path:
    """Write the page with episodes of a task per family of teammates, of at most three runs. Return its path.

    Args:
        runs, path, notes: see `write_page`.
        episodes: False for a page without episodes.
        suite: folder of learned teammates' checkpoints.
        progress: called with (description, tasks drawn, tasks).
    """
    # The page has few episodes: different agents come before the second run of one, and reference egos come last.
    repeats = [sum(earlier.agent == run.agent for earlier in runs[:number]) for number, run in enumerate(runs)]
    order = sorted(range(len(runs)), key=lambda k: (_REFERENCE_RANK.get(runs[k].agent, 0), repeats[k], k))
    shown = [runs[number] for number in order[:_RUNS_WITH_EPISODES]] if episodes else []
    left = [run.label for run in runs if run not in shown]
    if shown and left:
        notes = [*notes, f"episodes are of {_RUNS_WITH_EPISODES} runs at most; there is none of: {', '.join(left)}"]
    with TemporaryDirectory() as folder:
        return write_page(runs, path, family_gifs(shown, Path(folder), suite, progress), notes)


@cache
def _environment() -> Environment:
    loader = PackageLoader("icrl4aht_baselines.report")
    blocks: Any = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, **blocks)
    environment.filters |= {
        "number": lambda value, digits=1: f"{value:z.{digits}f}",
        "signed": lambda value, digits=1: f"{value:+z.{digits}f}",
        "picture": lambda path: f"data:image/gif;base64,{base64.b64encode(path.read_bytes()).decode()}",
        "family": family_title,
    }
    return environment


def _page_values(
    runs: Sequence[EvaluationRun], episodes: Sequence[EpisodePair], notes: Sequence[str]
) -> dict[str, Any]:
    """Return the values of the template page.html."""
    headlines = [headline for run in runs for headline in find_headlines(run)]
    protocols = list(dict.fromkeys(run.protocol for run in runs))
    labels = list(dict.fromkeys(run.label for run in runs))  # an agent has one colour under all protocols
    agents = list(dict.fromkeys(run.agent for run in runs))
    names = ", ".join(agents) if len(agents) <= 4 else f"{', '.join(agents[:3])} and {len(agents) - 3} more"

    def of_protocols(make: Callable[[str, NumberedRuns], Sequence[Any]]) -> list[Any]:
        """Return what is made of each protocol's runs; titles name the protocol if there are several."""
        made = []
        for protocol in protocols:
            numbered = {labels.index(run.label): run for run in runs if run.protocol == protocol}
            suffix = f" ({protocol})" if len(protocols) > 1 else ""
            made += [part._replace(title=f"{part.title}{suffix}") for part in make(protocol, numbered)]
        return made

    published = read_published()
    sources = [published["source"], *(published[part]["source"] for part in ("tracks", "contexts", "auxiliary"))]
    return {
        "title": f"{names}, protocol{'s' if len(protocols) > 1 else ''} {' and '.join(protocols)}",
        "version": version("icrl4aht-data"),
        "headlines": headlines,
        "reasons": list(dict.fromkeys(one.why_no_score for one in headlines if one.why_no_score)),
        "bar_charts": of_protocols(_bar_charts),
        "legend": overlap_legend({name for run in runs for name in run.overlaps(run.cells)}),
        "notes": notes,
        "curves": of_protocols(_curve_charts),
        "smoothing": SMOOTHING,
        "episodes": _episodes_by_family(episodes),
        "tables": of_protocols(lambda protocol, some: returns_tables(list(some.values()), protocol)),
        "settings": _settings_table(runs),
        "protocols": protocols,
        "published_protocol": PUBLISHED_PROTOCOL,
        "sources": [
            *sources,
            f"auxiliary losses: {json.dumps(published['auxiliary']['methods'])}",
            published["not_stated"],
        ],
    }


def _episodes_by_family(episodes: Sequence[EpisodePair]) -> dict[str, list[EpisodePair]]:
    """Return heading -> episodes: of each family, or of all without a heading if there is one pair of each family."""
    ordered = sorted(episodes, key=lambda pair: pair.cell.order[1:])
    names = ["Learned teammates" if pair.cell.group == "rl" else pair.cell.group for pair in ordered]
    if len(set(names)) == len(names):
        return {"": ordered} if ordered else {}
    return {name: [pair for pair, own in zip(ordered, names, strict=True) if own == name] for name in names}


def _bar_charts(protocol: str, runs: NumberedRuns) -> list[_Chart]:
    """Return charts of the normalised scores, and of the returns with tasks that have none."""
    agents = reported_series(runs)
    scores = score_bars(agents, protocol)
    about = (
        "A bar runs from the return of an ego that stays to that of the agent, relative to the oracle, which knows "
        "everything; next to a family are both egos' returns. *: beyond the chart."
    )
    charts = [_bar_chart("Normalised score in each cell", scores, agents, "test", about)] if scores else []
    for kind, text in TASK_KINDS.items():
        shown = agents if kind == "test" else runs
        bars = None if kind == "test" and scores else return_bars(shown, kind)
        charts += [_bar_chart(f"Return in each cell, {kind} tasks", bars, shown, kind, text)] if bars else []
    return charts


def _bar_chart(title: str, bars: BarChart, runs: NumberedRuns, kind: str, about: str) -> _Chart:
    drawn = [bar for of_layout in bars.layouts.values() for row in of_layout for bar in row.bars]
    shown = {number: run for number, run in runs.items() if number in {bar.series for bar in drawn}}
    cells = {cell for run in shown.values() for cell in run.cells if cell.kind == kind}
    lines = "Lines: 95 % intervals over the instances." if any(bar.interval for bar in drawn) else ""
    return _Chart(title, bars, _series(shown), _caption(shown.values(), cells, lines, about, *bars.left_out))


def _curve_charts(protocol: str, runs: NumberedRuns) -> list[_Chart]:
    charts = []
    parts = split_cells({cell for run in runs.values() for cell in run.cells}, MOST_PANELS)
    kinds = [cells[0].kind for cells in parts]
    for cells in parts:
        shown = {number: run for number, run in runs.items() if not run.cells.keys().isdisjoint(cells)}
        title = f"{cells[0].kind.capitalize()} tasks"
        if kinds.count(cells[0].kind) > 1:
            title += f" on {', '.join(dict.fromkeys(cell.layout for cell in cells))}"
        charts.append(_Chart(title, curve_figure(shown, cells), _series(shown), _caption(shown.values(), cells)))
    return charts


def _series(runs: NumberedRuns) -> list[tuple[int, str]]:
    return [(number, run.label) for number, run in runs.items()]


def _caption(runs: Iterable[EvaluationRun], cells: Container[ResultCell] | None, *sentences: str) -> str:
    """Return the caption of a figure of some cells, or all: conditions, sentences, and overlap with the training data.

    A figure has no marks, so its caption names the cells that overlap.
    """
    runs, marked = list(runs), []
    for run in runs:
        marks = {cell: overlap_marks(run.overlaps([cell])) for cell in run.cells if cells is None or cell in cells}
        named = [f"{cell.layout} {cell.group}{mark}" for cell, mark in marks.items() if mark]
        if named:
            everywhere = len(named) == len(marks) and len(set(marks.values())) == 1
            marked.append(f"{run.label}: {f'all cells{marks.popitem()[1]}' if everywhere else ', '.join(named)}")
    overlap = f"Overlap with the training data: {'; '.join(marked)}." if marked else ""
    return " ".join(filter(None, [describe_conditions(runs, cells), *sentences, overlap]))


def _settings_table(runs: Sequence[EvaluationRun]) -> dict[str, Any]:
    """Return a table of text with a column for each source of results."""
    sources = [(run, source) for run in runs for source in run.sources]
    found = [_source_settings(source) for _, source in sources]
    names = [name for name in found[0] if any(of_source[name] for of_source in found)]
    return {
        "title": "Evaluation and training",
        "columns": ["setting", *(run.label for run, _ in sources)],
        "rows": [[name, *(of_source[name] for of_source in found)] for name in names],
    }


def _source_settings(source: ResultSource) -> dict[str, str]:
    settings, trained = source.settings, source.trained or {}
    config, protocol = trained.get("config", {}), source.settings["protocol"]
    training = [
        f"{name} {config[part][name]}"
        for part, names in _SHOWN_SETTINGS.items()
        for name in names
        if name in config.get(part, {})
    ]
    return {
        "layouts": ", ".join(source.layouts),
        "protocol": protocol["name"],
        "episodes × steps": f"{protocol['episodes']} × {protocol['steps']}",
        "seeds": ", ".join(map(str, settings["seeds"])),
        "acting": source.detail("acting"),
        "settings hash": json_hash(settings),
        "package version": settings["code_version"],
        "trained on": describe_training(source.seen),
        "data version": config.get("histories", {}).get("data_version", ""),
        "training": ", ".join(training),
        "run hash": trained.get("run_hash", ""),
        "data manifest (SHA-256)": trained.get("manifest_sha256") or "",
        "results": source.folder,
    }
