"""The report as one self-contained HTML page: inline CSS and SVG, GIFs as data URIs, no script, no external files."""

from __future__ import annotations

import json
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeVar

from icrl4aht_generation.teammates.instances import INSTANCES

from icrl4aht_baselines.plotting import SMOOTHING
from icrl4aht_baselines.report.charts import (
    BarChart,
    PanelFigure,
    curve_figure,
    reported_series,
    return_bars,
    score_bars,
    sweep_figure,
)
from icrl4aht_baselines.report.episode_gifs import EpisodePair, family_gifs
from icrl4aht_baselines.report.headline import find_headlines
from icrl4aht_baselines.report.overlap import describe_training, overlap_legend, overlap_marks
from icrl4aht_baselines.report.rendering import render
from icrl4aht_baselines.report.results import (
    GROUP_TEXTS,
    PUBLISHED_PROTOCOL,
    EvaluationRun,
    ResultSource,
    cell_order,
    group_of,
    group_title,
    instances_range,
    read_published,
    split_cells,
)
from icrl4aht_baselines.report.tables import (
    PAPER_TABLES,
    TableRow,
    TableScore,
    fill_table,
    returns_table,
    sweep_points,
    sweep_scores,
    table_cells,
)
from icrl4aht_data.benchmark.facts import family_order
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, REFERENCES, Cell, read_headroom
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import MOST_PANELS
from icrl4aht_data.utils.files import atomic_write, json_hash
from icrl4aht_data.utils.text import counted_noun

_RUNS_WITH_EPISODES = 3  # a GIF takes up to 110 kB of the page
_REFERENCE_RANK = {"oracle": 1, "random": 2, "stay": 3}
_SHOWN_TRAINING = ("steps", "batch_size", "context", "learning_rate", "seed")
_SHOWN_MODEL = ("layers", "width", "encoder", "positions")
_PAPER_CONDITIONS = f"Paper: protocol {PUBLISHED_PROTOCOL}, {INSTANCES} instances, 100 episodes of 100 steps."
_SWEEPS = {"K": "Context length", "size": "Model scale and training budget"}


class _Chart(NamedTuple):
    """A figure of the page. `series` has the number and name of each run in it."""

    title: str
    figure: BarChart | PanelFigure
    series: list[tuple[int, str]]
    caption: str


class _Row(NamedTuple):
    """A row of a table of scores. `first` starts a group of rows; tooltips begin with `agent`."""

    headers: list[str]
    agent: str
    scores: list[TableScore]
    first: bool = False


class _Table(NamedTuple):
    """A table of scores, or of texts, whose rows then begin with a header."""

    title: str
    caption: str
    columns: list[str]
    rows: Sequence[_Row] | Sequence[Sequence[str]]


_Part = TypeVar("_Part", "_Chart", "_Table", "_Sweep")


class _Sweep(NamedTuple):
    """Figure and table of one varied quantity."""

    title: str
    figure: PanelFigure
    series: list[tuple[int, str]]
    caption: str
    table: _Table


def write_page(
    runs: Sequence[EvaluationRun], path: Path, episodes: Sequence[EpisodePair] = (), notes: Sequence[str] = ()
) -> Path:
    """Write the page. Returns its path.

    Args:
        runs: merged, see `results.merge`; of any protocols, sweeps among them.
        path: ends in .html; replaced atomically.
        episodes: see `episode_gifs.family_gifs`.
        notes: facts about these runs for the reader, such as layouts that were left out.

    Raises:
        OptionError: if the path does not end in .html, there is no run, Jinja2 is not installed, or a template or a
            picture is missing.
    """
    if path.suffix not in (".html", ".htm"):
        raise OptionError(f"{path}: expected a name that ends in .html")
    if not runs:
        raise OptionError("no run to report; give at least one folder of results")
    text = render("page.html", _page_values(runs, episodes, notes))
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
    """Write the page with episodes of a task per family of teammates, of at most three runs. Returns its path.

    Args:
        runs, path, notes: see `write_page`.
        episodes: False for a page without episodes.
        suite: folder of learned teammates' checkpoints.
        progress: called with (description, tasks drawn, tasks).
    """
    shown = _most_informative(runs)[:_RUNS_WITH_EPISODES] if episodes else []
    left = [run.label for run in runs if run not in shown]
    if shown and left:
        notes = [*notes, f"episodes are of {_RUNS_WITH_EPISODES} runs at most; there is none of: {', '.join(left)}"]
    with TemporaryDirectory() as folder:
        return write_page(runs, path, family_gifs(shown, Path(folder), suite, progress), notes)


def _most_informative(runs: Sequence[EvaluationRun]) -> list[EvaluationRun]:
    """Returns the runs sorted: trained agents first, each agent once before any twice; reference egos last."""
    repeats = [sum(earlier.agent == run.agent for earlier in runs[:number]) for number, run in enumerate(runs)]
    order = sorted(range(len(runs)), key=lambda k: (_REFERENCE_RANK.get(runs[k].agent, 0), repeats[k], k))
    return [runs[number] for number in order]


def _page_values(
    runs: Sequence[EvaluationRun], episodes: Sequence[EpisodePair], notes: Sequence[str]
) -> dict[str, Any]:
    """Returns the values of the template page.html."""
    headlines = [headline for run in runs for headline in find_headlines(run)]
    protocols = dict.fromkeys(run.protocol for run in runs)
    labels = list(dict.fromkeys(run.label for run in runs))  # an agent has one colour under all protocols
    numbered = [
        (protocol, {labels.index(run.label): run for run in runs if run.protocol == protocol}) for protocol in protocols
    ]

    def of_protocols(make: Callable[[str, dict[int, EvaluationRun]], Sequence[_Part]]) -> list[_Part]:
        """Returns what is made of each protocol's runs; titles name the protocol if there are several."""
        made = [(protocol, part) for protocol, of_protocol in numbered for part in make(protocol, of_protocol)]
        if len(numbered) == 1:
            return [part for _, part in made]
        return [part._replace(title=f"{part.title} ({protocol})") for protocol, part in made]

    return {
        "title": _title(runs),
        "version": version("icrl4aht-data"),
        "headlines": headlines,
        "reasons": list(dict.fromkeys(one.why_no_score for one in headlines if one.why_no_score)),
        "several_protocols": len(numbered) > 1,
        "bar_charts": of_protocols(_bar_charts),
        "legend": overlap_legend({name for run in runs for name in run.overlaps(run.cells)}),
        "notes": notes,
        "curves": of_protocols(_curve_charts),
        "smoothing": SMOOTHING,
        "sweeps": of_protocols(_sweeps),
        "episodes": _episodes_by_family(episodes),
        "tables": of_protocols(_returns_tables),
        "references": of_protocols(_reference_table),
        "settings": _settings_table(runs),
        "paper_tables": _paper_tables(runs),
        "paper_conditions": _PAPER_CONDITIONS,
        "published_protocol": PUBLISHED_PROTOCOL,
        "sources": _paper_sources(),
    }


def _episodes_by_family(episodes: Sequence[EpisodePair]) -> dict[str, list[EpisodePair]]:
    """Returns heading -> episodes: of each family, or of all without a heading if there is one pair of each family."""
    ordered = sorted(episodes, key=lambda pair: family_order(pair.family.partition(" ")[0]))
    families = list(dict.fromkeys(pair.family for pair in ordered))
    if len(families) == len(ordered) > 0:
        return {"": ordered}
    names = {family: "Learned teammates" if family == "rl" else family for family in families}
    return {name: [pair for pair in ordered if pair.family == family] for family, name in names.items()}


def _title(runs: Sequence[EvaluationRun]) -> str:
    agents = list(dict.fromkeys(run.agent for run in runs))
    names = ", ".join(agents) if len(agents) <= 4 else f"{', '.join(agents[:3])} and {len(agents) - 3} more"
    protocols = dict.fromkeys(run.protocol for run in runs)
    return f"{names}, {'protocol' if len(protocols) == 1 else 'protocols'} {' and '.join(protocols)}"


def _bar_charts(protocol: str, runs: Mapping[int, EvaluationRun]) -> list[_Chart]:
    """Returns charts of the normalised scores, and of the returns with tasks that have none."""
    agents = reported_series(runs)
    charts: list[_Chart] = []
    scores = score_bars(agents, protocol)
    if scores:
        about = (
            "A bar runs from the return of an ego that stays to that of the agent, relative to the oracle, which knows "
            "everything; next to a family are both egos' returns. *: beyond the chart."
        )
        charts.append(_bar_chart("Normalised score in each cell", scores, agents, "test", about))
    plain = {number: run for number, run in runs.items() if run.variant is None}
    for kind in ("test", *GROUP_TEXTS):
        shown = agents if kind == "test" else plain
        bars = None if kind == "test" and scores else return_bars(shown, kind)
        if bars:
            charts.append(
                _bar_chart(f"Return in each cell, {kind} tasks", bars, shown, kind, GROUP_TEXTS.get(kind, ""))
            )
    return charts


def _bar_chart(title: str, bars: BarChart, runs: Mapping[int, EvaluationRun], kind: str, about: str) -> _Chart:
    """Returns a chart with the legend and the conditions of the runs in it."""
    drawn = [bar for rows in bars.layouts.values() for row in rows for bar in row.bars]
    numbers = {bar.series for bar in drawn}
    lines = " Lines: 95 % intervals over the instances." if any(bar.interval for bar in drawn) else ""
    shown = {number: run for number, run in runs.items() if number in numbers}
    cells = {cell for run in shown.values() for cell in run.cells if group_of(cell) == kind}
    sentences = [f"{_conditions(shown.values(), cells)}.{lines}", about, *bars.left_out]
    caption = " ".join([*filter(None, sentences), _overlap_note(shown.values(), cells)])
    return _Chart(title, bars, _names(shown), caption.strip())


def _curve_charts(protocol: str, runs: Mapping[int, EvaluationRun]) -> list[_Chart]:
    charts = []
    for of_sweep in (False, True):
        some = {number: run for number, run in runs.items() if (run.variant is not None) == of_sweep}
        parts = split_cells({cell for run in some.values() for cell in run.cells}, MOST_PANELS)
        kinds = [group_of(cells[0]) for cells in parts]
        for cells in parts:
            shown = {number: run for number, run in some.items() if not run.cells.keys().isdisjoint(cells)}
            caption = f"{_conditions(shown.values(), cells)}. {_overlap_note(shown.values(), cells)}".strip()
            kind = group_of(cells[0])
            title = f"{kind.capitalize()} tasks{' of the sweeps' if of_sweep else ''}"
            if kinds.count(kind) > 1:
                title += f" on {', '.join(dict.fromkeys(layout for layout, _ in cells))}"
            charts.append(_Chart(title, curve_figure(shown, cells), _names(shown), caption))
    return charts


def _sweeps(protocol: str, runs: Mapping[int, EvaluationRun]) -> list[_Sweep]:
    sweeps = []
    for quantity, title in _SWEEPS.items():
        of_quantity = [run for run in runs.values() if run.variant and run.variant[0] == quantity]
        if of_quantity:
            scores = sweep_scores(of_quantity, quantity)
            agents = list(dict.fromkeys(agent for lines in scores.values() for agent in lines))
            diamonds = "Diamonds: the paper. " if protocol == PUBLISHED_PROTOCOL else ""
            caption = (
                f"{_conditions(of_quantity)}. Mean return over families; bands: std over families' means. {diamonds}"
                f"{_overlap_note(of_quantity)}"
            )
            figure = sweep_figure(sweep_points(of_quantity, quantity), quantity)
            sweeps.append(_Sweep(title, figure, list(enumerate(agents)), caption, _sweep_table(scores, quantity)))
    return sweeps


def _sweep_table(panels: Mapping[str, Mapping[str, Sequence[tuple[Any, TableScore]]]], quantity: str) -> _Table:
    """Returns a table with a column for each value of what is varied."""
    points = [point for lines in panels.values() for of_agent in lines.values() for point in of_agent]
    values = list(dict.fromkeys(value for value, _ in points))
    not_run = TableScore(None, None, None, None, (0, 0), (0, 0))
    rows = [
        _Row([layout, agent], agent, [dict(scores).get(value, not_run) for value in values])
        for layout, lines in panels.items()
        for agent, scores in lines.items()
    ]
    columns = ["layout", "agent", *(f"{quantity} = {value}" for value in values)]
    return _Table("Returns", "Means over the families of teammates.", columns, rows)


def _names(runs: Mapping[int, EvaluationRun]) -> list[tuple[int, str]]:
    return [(number, run.label) for number, run in runs.items()]


def _returns_tables(protocol: str, runs: Mapping[int, EvaluationRun]) -> list[_Table]:
    """Returns a table for each kind of tasks that was played, without sweeps."""
    plain = [run for run in runs.values() if run.variant is None]
    tables = []
    for kind in ("test", *GROUP_TEXTS):
        cells = sorted({cell for run in plain for cell in run.cells if group_of(cell) == kind}, key=cell_order)
        if cells:
            columns, rows = returns_table(plain, cells, protocol)
            shown = [run for run in plain if not run.cells.keys().isdisjoint(cells)]
            single = len(shown) == 1
            caption = f"{_conditions(shown, cells)}."
            title = f"{kind.capitalize()} tasks{f': {shown[0].label}' if single else ''}"
            headers = ["family"] if single else ["family", "agent"]
            tables.append(_Table(title, caption, [*headers, *columns], _table_rows(rows, len(headers))))
    return tables


def _table_rows(rows: Sequence[TableRow], headers: int) -> list[_Row]:
    found, before = [], None
    for row in rows:
        labels = [group_title(row.label), row.agent]
        found.append(_Row(labels[:headers], row.agent, row.scores, row.label != before))
        before = row.label
    return found


def _paper_tables(runs: Sequence[EvaluationRun]) -> list[_Table]:
    """Returns the paper's tables with our results, if there are some of its protocol."""
    ours = [run for run in runs if run.protocol == PUBLISHED_PROTOCOL and run.variant is None]
    tables = []
    for number, table in enumerate(PAPER_TABLES, start=1):
        rows = fill_table(table, ours, PUBLISHED_PROTOCOL) if ours else []
        if rows:
            cells = table_cells(table)
            agents = {row.agent for row in rows}
            shown = [run for run in ours if run.label in agents and not cells.isdisjoint(run.cells)]
            text = f"{_conditions(shown, cells)}." if shown else "Not run."
            text += f" {_PAPER_CONDITIONS}{'' if table.group == 'cell' else ' ± is the std over cells.'}"
            single = [row._replace(scores=[score._replace(gain=None) for score in row.scores]) for row in rows]
            body = _table_rows(single, 2)
            if table.group != "cell":
                body = [row._replace(headers=row.headers[1:]) for row in body]
            headers = ["family", "agent"] if table.group == "cell" else ["agent"]
            tables.append(_Table(f"Table {number}. {table.title}", text, [*headers, *table.columns], body))
    return tables


def _conditions(runs: Iterable[EvaluationRun], cells: Container[Cell] | None = None) -> str:
    """Returns text with protocol, seeds, length and instances of the results of some runs, all or those of `cells`.

    If the conditions differ, it says which agents they are of.
    """
    shown = [(run, cell) for run in runs for cell in run.cells if cells is None or cell in cells]
    labels: dict[str, dict[str, None]] = {}
    for run, cell in shown:
        labels.setdefault(run.source(cell).conditions, {})[run.label] = None
    several = len(labels) > 1
    texts = [f"{' and '.join(names)} under {text}" if several else f"under {text}" for text, names in labels.items()]
    instances = instances_range(len(run.cells[cell]) for run, cell in shown)
    return f"Evaluated {'; '.join(texts)}; {instances} in a cell"


def _overlap_note(runs: Iterable[EvaluationRun], drawn: Container[Cell] | None = None) -> str:
    """Returns a sentence that names the cells of a figure which overlap with training; a figure has no marks."""
    marked = []
    for run in runs:
        shown = [cell for cell in run.cells if drawn is None or cell in drawn]
        cells = [(cell, overlap_marks(run.overlaps([cell]))) for cell in shown]
        named = [f"{layout} {group}{marks}" for (layout, group), marks in cells if marks]
        if named:
            everywhere = len(named) == len(cells) and len({marks for _, marks in cells}) == 1
            marked.append(f"{run.label}: {f'all cells{cells[0][1]}' if everywhere else ', '.join(named)}")
    return f"Overlap with the training data: {'; '.join(marked)}." if marked else ""


def _reference_table(protocol: str, runs: Mapping[int, EvaluationRun]) -> list[_Table]:
    """Returns a table with the returns of the reference egos on the layouts that were tested; none without them."""
    measured = read_headroom(protocol)
    played = {cell[0] for run in runs.values() for cell in run.cells if cell in measured}
    layouts = [layout for layout in dict.fromkeys(layout for layout, _ in measured) if layout in played]
    if not layouts:
        return []
    body = [
        [family, *(" / ".join(f"{measured[layout, family][ego]:z.1f}" for ego in REFERENCES) for layout in layouts)]
        for family in HEURISTICS
    ]
    caption = (
        f"Mean returns of {' / '.join(REFERENCES)} (scripted, full information) with the published test tasks, "
        f"{INSTANCES} instances, 1 seed (0), 100 episodes of 100 steps."
    )
    return [_Table("Reference egos", caption, ["family", *layouts], body)]


def _settings_table(runs: Sequence[EvaluationRun]) -> _Table:
    """Returns a table with a column for each source of results."""
    sources = [(run, source) for run in runs for source in run.sources]
    found = [_source_settings(source) for _, source in sources]
    names = [name for name in found[0] if any(of_source[name] for of_source in found)]
    rows = [[name, *(of_source[name] for of_source in found)] for name in names]
    caption = f"{counted_noun(len(sources), 'source')} of results."
    return _Table("Evaluation and training", caption, ["setting", *(run.label for run, _ in sources)], rows)


def _source_settings(source: ResultSource) -> dict[str, str]:
    settings, trained = source.settings, source.trained or {}
    config = trained.get("config", {})
    histories, train = config.get("histories", {}), config.get("train", {})
    protocol, model = settings["protocol"], config.get("model", {})
    training = {name: train[name] for name in _SHOWN_TRAINING if name in train}
    training |= {name: model[name] for name in _SHOWN_MODEL if name in model}
    training |= {"channels": histories["channels"]} if "channels" in histories else {}
    return {
        "layouts": ", ".join(source.layouts),
        "protocol": protocol["name"],
        "episodes × steps": f"{protocol['episodes']} × {protocol['steps']}",
        "seeds": ", ".join(map(str, settings["seeds"])),
        "acting": source.acting,
        "settings hash": json_hash(settings),
        "package version": settings["code_version"],
        "trained on": describe_training(source.seen),
        "data version": histories.get("data_version", ""),
        "training": ", ".join(f"{name} {value}" for name, value in training.items()),
        "run hash": trained.get("run_hash", ""),
        "data manifest (SHA-256)": trained.get("manifest_sha256") or "",
        "results": source.folder,
    }


def _paper_sources() -> list[str]:
    published = read_published()
    texts = [published["source"], *(published[part]["source"] for part in ("tracks", "contexts", "auxiliary"))]
    return [*texts, f"auxiliary losses: {json.dumps(published['auxiliary']['methods'])}", published["not_stated"]]
