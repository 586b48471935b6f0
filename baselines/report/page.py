"""The report as one self-contained HTML page: inline CSS, pictures as data URIs, no script, no external files."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from baselines.plotting import plot_adaptation_gain, plot_return_curves, plot_sweep
from baselines.report.episode_gifs import EpisodeGif, family_gifs
from baselines.report.overlap import describe_training, overlap_legend, overlap_marks
from baselines.report.results import (
    GROUP_TEXTS,
    PUBLISHED_PROTOCOL,
    TEST_LAYOUTS,
    EvaluationRun,
    cell_order,
    count_text,
    group_of,
    instances_range,
    read_published,
)
from baselines.report.tables import (
    AVERAGE,
    PAPER_TABLES,
    PaperTable,
    TableRow,
    TableScore,
    fill_table,
    score_cells,
    sweep_points,
    sweep_scores,
    table_cells,
)
from generation.teammates.instances import INSTANCES
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, REFERENCES, Cell, has_headroom, read_headroom
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, json_hash

_RUNS_WITH_EPISODES = 3  # a GIF takes up to 110 kB of the page
_REFERENCE_RANK = {"oracle": 1, "random": 2, "stay": 3}
_SHOWN_TRAINING = ("steps", "batch_size", "context", "learning_rate", "seed")
_SHOWN_MODEL = ("layers", "width", "encoder", "positions")
_PAPER_CONDITIONS = f"Paper: protocol {PUBLISHED_PROTOCOL}, {INSTANCES} instances, 100 episodes of 100 steps."
_SWEEPS = {"K": "Context length", "size": "Model scale and training budget"}
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1d2129; max-width: 1250px; margin: 2em auto; padding: 0 1.2em }
h1 { font-size: 1.6em } h2 { margin-top: 2em; border-bottom: 1px solid #ccc } h3 { margin-bottom: .3em }
.wide { overflow-x: auto } table { border-collapse: collapse; font-size: 13px; margin: .6em 0 1.2em }
th, td { border: 1px solid #d5d8dd; padding: .25em .55em; text-align: left; vertical-align: top }
th { background: #f1f3f6 } td.flat { background: #e8e8e8 } td.none { color: #999 }
tr.first td, tr.first th { border-top: 2px solid #8a9099 }
small, .caption { color: #5a6472 } small { display: block } .caption { max-width: 75em } .norm { color: #1f5fa8 }
figure { display: inline-block; margin: .5em 1em .5em 0; vertical-align: top } figure.episode { width: 22em }
td.long { min-width: 11em; max-width: 22em } td.long, figcaption { overflow-wrap: anywhere }
img { max-width: 100%; height: auto } figcaption { font-size: 13px; color: #444 } code { font-size: 12px }
"""


def write_page(
    runs: Sequence[EvaluationRun], path: Path, gifs: Sequence[EpisodeGif] = (), notes: Sequence[str] = ()
) -> Path:
    """Write the page. Returns its path.

    Args:
        runs: merged, see `results.merge`; of any protocols, sweeps among them.
        path: ends in .html; replaced atomically.
        gifs: episodes, see `episode_gifs.family_gifs`.
        notes: facts about these runs for the reader, such as layouts that were left out.

    Raises:
        OptionError: if the path does not end in .html, or there is no run.
    """
    if path.suffix not in (".html", ".htm"):
        raise OptionError(f"{path}: expected a name that ends in .html")
    if not runs:
        raise OptionError("no run to report; give at least one folder of results")
    parts = [_introduction(runs, notes)]
    with TemporaryDirectory() as folder:
        for protocol in dict.fromkeys(run.protocol for run in runs):
            parts += _protocol_section(protocol, [run for run in runs if run.protocol == protocol], Path(folder))
    if gifs:
        parts += _episode_section(gifs)
    parts += [_settings_section(runs), _sources_section()]
    head = f'<meta charset="utf-8"><title>ICRL4AHT report</title><style>{_STYLE}</style>'
    body = "\n".join(parts)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        text = f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'
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
    """Write the page with an episode per family of teammates, of at most three runs. Returns its path.

    Args:
        runs, path, notes: see `write_page`.
        episodes: False for a page without episodes.
        suite: folder of learned teammates' checkpoints.
        progress: called with (description, episodes drawn, episodes).
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


def _introduction(runs: Sequence[EvaluationRun], notes: Sequence[str]) -> str:
    overlaps = {name for run in runs for name in run.overlaps(run.cells)}
    marks = "".join(f"<li>{escape(text)}</li>" for text in overlap_legend(overlaps))
    if marks:
        marks = (
            f"<p>Marks behind a score say how training data and tasks overlap; the tooltip has details:</p>"
            f"<ul>{marks}</ul>"
        )
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f"""<h1>ICRL4AHT report</h1>
<p>{count_text(len(runs), "run")}, package version {escape(version("icrl4aht-data"))}. Large: ours, mean ± std over the
teammate instances of a cell; over the cells' means if several are averaged; without ± if there is only one. Small: the
paper's number, which is shown only next to results of its protocol <code>{PUBLISHED_PROTOCOL}</code>; the number of
instances if it is not the benchmark's; and the headroom-normalised score, (return − stay) / (oracle − stay), if the
cell has headroom and all its instances were played. <b>Grey</b>: no reference ego earns more in this cell than one that
only stays, so it says nothing about adaptation. A dash: not run. Every score has a tooltip with its instances, seeds,
episodes and protocol, and with what the agent was trained on.</p>
{marks}
<ul>{items}</ul>"""


def _protocol_section(protocol: str, runs: list[EvaluationRun], folder: Path) -> list[str]:
    plain = [run for run in runs if run.variant is None]
    parts = [f"<h2>Protocol <code>{escape(protocol)}</code></h2>"]
    if protocol != PUBLISHED_PROTOCOL:
        parts.append(
            f"<p>The paper's numbers belong to protocol <code>{PUBLISHED_PROTOCOL}</code>, so none are in this "
            f"section; evaluate with <code>--protocol {PUBLISHED_PROTOCOL}</code> to compare with them.</p>"
        )
    for number, table in enumerate(PAPER_TABLES, start=1):
        filled = fill_table(table, plain, protocol) if plain else []
        if filled:
            parts.append(f"<h3>Table {number}. {table.title}</h3>")
            parts += [_table_caption(table, filled, plain, protocol), _paper_table(table, filled)]
    parts += _other_cells(plain)
    for quantity, title in _SWEEPS.items():
        panels = sweep_scores(runs, quantity)
        if panels:
            path = folder / f"{protocol}-{quantity}.png"
            plot_sweep(sweep_points(runs, quantity), quantity, path)
            swept = [run for run in runs if run.variant and run.variant[0] == quantity]
            diamonds = "Hollow diamonds: the paper. " if protocol == PUBLISHED_PROTOCOL else ""
            caption = f"{_conditions(swept)}. Bars: std over families' means. {diamonds}{_overlap_note(swept)}"
            parts += [f"<h3>{title}</h3>", _figure(path, caption), _sweep_table(panels, quantity)]
    for name, some in (("of the agents", plain), ("of the sweeps", [run for run in runs if run.variant])):
        if some:
            path = folder / f"{protocol}-curves.png"
            plot_return_curves([(run.name, run.cells) for run in some], path)
            caption = (
                f"{_conditions(some)}. Return per episode, running mean over 10; mean over a cell's instances, and "
                f"their range if there are several. {_overlap_note(some)}"
            )
            parts += [f"<h3>Adaptation curves {name}</h3>", _figure(path, caption)]
    parts.append("<h3>Adaptation gain</h3>")
    tested = [run for run in runs if any(group_of(cell) == "test" for cell in run.cells)]
    if tested:
        path = folder / f"{protocol}-gain.png"
        plot_adaptation_gain([(run.name, {cell: run.gain(cell) for cell in run.cells}) for run in tested], path)
        caption = (
            f"{_conditions(tested)}. Mean over a track's test cells, a dot per cell; of the halves, if there are fewer "
            f"than 40 episodes. The paper states no numbers: “small on average” (App. F). {_overlap_note(tested)}"
        )
        parts.append(_figure(path, caption))
    return [*parts, _gain_table(runs), "<h3>Headroom</h3>", _headroom_table(protocol)]


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


def _overlap_note(runs: Sequence[EvaluationRun]) -> str:
    """Returns a sentence that names the cells of a figure which overlap with training; a figure has no marks."""
    marked = []
    for run in runs:
        cells = [(cell, overlap_marks(run.overlaps([cell]))) for cell in run.cells]
        named = [f"{layout} {group}{marks}" for (layout, group), marks in cells if marks]
        if named:
            everywhere = len(named) == len(cells) and len({marks for _, marks in cells}) == 1
            marked.append(f"{run.label}: {f'all cells{cells[0][1]}' if everywhere else ', '.join(named)}")
    return f"Overlap with the training data: {'; '.join(marked)}." if marked else ""


def _table_caption(table: PaperTable, rows: Sequence[TableRow], runs: Sequence[EvaluationRun], protocol: str) -> str:
    agents = {row.agent for row in rows}
    cells = table_cells(table)
    shown = [run for run in runs if run.label in agents and not cells.isdisjoint(run.cells)]
    text = f"{_conditions(shown, cells)}." if shown else "Not run."
    if protocol == PUBLISHED_PROTOCOL:
        text += f" {_PAPER_CONDITIONS}"
    if table.group != "cell":
        text += " ± is the std over cells."
    return f"<p class=caption>{escape(text)}</p>"


def _paper_table(table: PaperTable, rows: list[TableRow]) -> str:
    body, before = [], None
    for row in rows:
        cells = [_th(row.label), _th(row.agent), *(_score_cell(score, row.agent) for score in row.scores)]
        body.append((row.label != before, cells[0 if table.group == "cell" else 1 :]))
        before = row.label
    return _html_table([*(["family"] if table.group == "cell" else []), "agent", *table.columns], body)


def _score_cell(score: TableScore, agent: str) -> str:
    lines = []
    with_headroom, measured = score.headroom
    if score.mean is not None:
        spread = "" if score.std is None else f" ± {score.std:.1f}"
        lines.append(f"{score.mean:z.1f}{spread}{escape(overlap_marks(score.overlaps))}")
        if score.played[0] < score.played[1]:
            lines.append(f"<small>{score.played[0]} of {score.played[1]} cells</small>")
        if score.shortfall:
            lines.append(f"<small>{score.shortfall}</small>")
    else:
        lines.append("–")
    if score.published:
        mean, std = score.published
        lines.append(f"<small>paper {mean:z.1f}{'' if std is None else f' ± {std:.1f}'}</small>")
    if score.normalised is not None:
        lines.append(f'<small class="norm">normalised {score.normalised:z.2f}</small>')
    if measured and not with_headroom and score.mean is not None:
        lines.append("<small>no headroom</small>")
    kind = "flat" if measured and not with_headroom else "none" if score.mean is None else ""
    tooltip = f"{agent}. {score.details}" if score.details else ""
    if score.mean is None and score.published:
        tooltip = f"Not run. {_PAPER_CONDITIONS}"
    return f'<td class="{kind}"{_tooltip(tooltip)}>{"".join(lines)}</td>'


def _tooltip(text: str) -> str:
    return f' title="{escape(text)}"' if text else ""


def _other_cells(runs: list[EvaluationRun]) -> list[str]:
    """Returns the tables of cells that no paper table has, those of validation, training, held-out and own tasks."""
    cells = sorted({cell for run in runs for cell in run.cells if group_of(cell) in GROUP_TEXTS}, key=cell_order)
    parts = []
    for group, text in GROUP_TEXTS.items():
        of_group = [cell for cell in cells if group_of(cell) == group]
        if of_group:
            shown = [run for run in runs if any(cell in run.cells for cell in of_group)]
            body = [
                (False, [_th(run.label), *(_score_cell(score_cells([cell], run, {}), run.label) for cell in of_group)])
                for run in shown
            ]
            columns = ["agent", *map(_cell_name, of_group)]
            caption = escape(f"{text} {_conditions(shown, of_group)}.")
            title = f"<h3>{group.capitalize()} tasks</h3>"
            parts += [title, f"<p class=caption>{caption}</p>", _html_table(columns, body)]
    return parts


def _cell_name(cell: Cell) -> str:
    return f"{cell[0]}, {cell[1].replace('rl', 'learned', 1)}"


def _sweep_table(panels: Mapping[str, Mapping[str, Sequence[tuple[Any, TableScore]]]], quantity: str) -> str:
    body = []
    for layout, lines in panels.items():
        for agent, scores in lines.items():
            for value, score in scores:
                named = f"{agent}, {quantity} = {value}"
                row = [_th(layout), _th(agent), f"<td>{escape(str(value))}</td>", _score_cell(score, named)]
                body.append((False, row))
    return _html_table(["layout", "agent", quantity, AVERAGE], body)


def _gain_table(runs: list[EvaluationRun]) -> str:
    cells = list(dict.fromkeys(cell for run in runs for cell in run.cells))
    body = [(False, [_th(run.label), *(_gain_cell(run, cell) for cell in cells)]) for run in runs]
    return _html_table(["agent", *map(_cell_name, cells)], body)


def _gain_cell(run: EvaluationRun, cell: Cell) -> str:
    if cell not in run.cells:
        return "<td></td>"
    tooltip = _tooltip(f"{run.label}. {score_cells([cell], run, {}).details}")
    return f"<td{tooltip}>{run.gain(cell):+z.1f}{escape(overlap_marks(run.overlaps([cell])))}</td>"


def _headroom_table(protocol: str) -> str:
    measured = read_headroom(protocol)
    conditions = f"protocol {protocol}, {INSTANCES} instances, 1 seed (0), 100 episodes of 100 steps"
    body = []
    for family in HEURISTICS:
        row = [_th(family)]
        for layout in TEST_LAYOUTS:
            references = measured.get((layout, family))
            if references is None:
                row.append('<td class="none">not measured</td>')
            else:
                kind = "" if has_headroom(references) else "flat"
                tooltip = _tooltip(f"stay / random / oracle, {layout}, {family}: {conditions}.")
                means = " / ".join(f"{references[agent]:z.1f}" for agent in REFERENCES)
                row.append(f'<td class="{kind}"{tooltip}>{means}</td>')
        body.append((False, row))
    note = (
        f"<p class=caption>Mean return of the reference egos stay / random / oracle (scripted, full information) with "
        f"the published test tasks: {escape(conditions)}.</p>"
    )
    return note + _html_table(["family", *TEST_LAYOUTS], body)


def _episode_section(gifs: Sequence[EpisodeGif]) -> list[str]:
    note = (
        "<p>The first episode of an evaluated task, when the ego remembers nothing yet. Ego blue, teammate red; the "
        "frame is the ego's view.</p>"
    )
    parts = ["<h2>An episode per family</h2>", note]
    for family in dict.fromkeys(gif.family for gif in gifs):
        parts.append(f"<h3>{'Learned teammates' if family == 'rl' else family}</h3>")
        parts += [_figure(gif.path, gif.caption, " class=episode") for gif in gifs if gif.family == family]
    return parts


def _settings_section(runs: Sequence[EvaluationRun]) -> str:
    columns = [
        "agent", "layouts", "protocol", "episodes x steps", "seeds", "settings hash", "version", "trained on",
        "data version", "training", "run hash", "data manifest (SHA-256)", "results",
    ]  # fmt: skip
    body = []
    for run in runs:
        for source in run.sources:
            settings, trained = source.settings, source.trained or {}
            config = trained.get("config", {})
            histories, train = config.get("histories", {}), config.get("train", {})
            protocol, model = settings["protocol"], config.get("model", {})
            training = {name: train[name] for name in _SHOWN_TRAINING if name in train}
            training |= {name: model[name] for name in _SHOWN_MODEL if name in model}
            training |= {"channels": histories["channels"]} if "channels" in histories else {}
            values = [
                run.label,
                ", ".join(source.layouts),
                protocol["name"],
                f"{protocol['episodes']} x {protocol['steps']}",
                ", ".join(map(str, settings["seeds"])),
                json_hash(settings),
                settings["code_version"],
                describe_training(source.seen),
                histories.get("data_version", ""),
                ", ".join(f"{name} {value}" for name, value in training.items()),
                trained.get("run_hash", ""),
                trained.get("manifest_sha256") or "",
                source.folder,
            ]
            body.append((False, [_code(value) for value in values]))
    return "<h2>Settings and hashes</h2>" + _html_table(columns, body)


def _code(text: str) -> str:
    return f"<td{' class=long' if len(text) > 30 else ''}><code>{escape(text)}</code></td>"


def _sources_section() -> str:
    published = read_published()
    texts = [published["source"], *(published[part]["source"] for part in ("tracks", "contexts", "auxiliary"))]
    extra = json.dumps(published["auxiliary"]["methods"])
    items = "".join(
        f"<li>{escape(text)}</li>" for text in [*texts, f"auxiliary losses: {extra}", published["not_stated"]]
    )
    return f"<h2>The paper's numbers</h2><ul>{items}</ul>"


def _th(text: str) -> str:
    return f"<th>{escape(text)}</th>"


def _html_table(columns: Iterable[str], body: Iterable[tuple[bool, Sequence[str]]]) -> str:
    head = "".join(map(_th, columns))
    rows = "".join(f"<tr{' class=first' if first else ''}>{''.join(cells)}</tr>" for first, cells in body)
    return f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>'


def _figure(path: Path | None, caption: str, attributes: str = "") -> str:
    image = ""
    if path is not None:
        content = base64.b64encode(path.read_bytes()).decode()
        image = f'<img alt="{escape(caption)}" src="data:image/{path.suffix.removeprefix(".")};base64,{content}">'
    return f"<figure{attributes}>{image}<figcaption>{escape(caption)}</figcaption></figure>"
