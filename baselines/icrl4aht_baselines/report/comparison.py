"""Stored results of reference models, `cards/results.json`, and docs/results.md, which compares them.

Shapes: U tasks, S seeds with which each was played.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from icrl4aht_baselines.agents.egos import FORGETS
from icrl4aht_baselines.report.results import (
    AGENT_COLUMNS,
    BLOCKS,
    CELL_COLUMNS,
    ENDS,
    ResultCell,
    cell_rows,
    episode_blocks,
    published_cells,
    published_instances,
    read_run,
    results_table,
)
from icrl4aht_baselines.report.scores import AVERAGE, PAPER_METHODS, cell_headroom, normalise, open_cells
from icrl4aht_baselines.report.statistics import mean_interval
from icrl4aht_baselines.training.seen import OVERLAPS, overlap_marks
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, REFERENCES
from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.plotting import new_figure, save_figure
from icrl4aht_data.utils.files import atomic_write, parse_json, read_text
from icrl4aht_data.utils.templates import card_file, fill_template, markdown_table
from icrl4aht_data.utils.text import counted_noun

RESULTS_FILES = ("results.md", "results.png")

AgentCells = dict[ResultCell, dict[str, Any]]
"""Cell -> "overlaps", block or "gain" (last minus first) -> names of overlaps, or returns, float64 (U, S)."""

UNSEEN = "unseen"
"""Protocol name of results on rearranged layouts, see `icrl4aht_baselines.online.unseen`; a task for each version."""


@dataclass(frozen=True)
class StoredResults:
    """Results of several agents, `cards/results.json`.

    Attributes:
        table: the results, see the module's docstring. Entries of ablations are stored like agents, with the
            experiment's name instead of a protocol; results on unseen layouts with `UNSEEN`.
        about: agent -> one sentence on how it was made; agents are shown in this order.
        ablations: ablation -> entry -> what differs.
        commits: agent or ablation -> commit of this repository whose code made it, if later code cannot.
    """

    table: pd.DataFrame = field(default_factory=lambda: results_table([]))
    about: dict[str, str] = field(default_factory=dict)
    ablations: dict[str, dict[str, str]] = field(default_factory=dict)
    commits: dict[str, str] = field(default_factory=dict)

    def protocol(self, name: str) -> dict[str, AgentCells]:
        """Return the results under a protocol by agent, in the order of `about`."""
        of_protocol = self.table[self.table["protocol"] == name]
        order = [*self.about, *(agent for agent in of_protocol["agent"].unique() if agent not in self.about)]
        agents = dict(iter(of_protocol.groupby("agent", sort=False)))
        return {agent: agent_cells(agents[agent]) for agent in order if agent in agents}


def agent_cells(table: pd.DataFrame) -> AgentCells:
    """Return one agent's results under one protocol, cells in order."""
    found: AgentCells = defaultdict(dict)
    for (*key, block), rows in table.groupby([*CELL_COLUMNS, "block"], sort=False):
        blocks = found[ResultCell(*map(str, key))]
        blocks[str(block)] = rows["return"].to_numpy().reshape(rows["task"].nunique(), -1)
        blocks["overlaps"] = tuple(rows["overlap"].iloc[0].split())
    for blocks in found.values():
        blocks["gain"] = blocks["last"] - blocks["first"]
    return {cell: found[cell] for cell in sorted(found, key=lambda cell: cell.order)}


def results_file() -> Path:
    """Return the path of the stored results."""
    return card_file("published.json").with_name("results.json")


def read_stored(path: Path) -> StoredResults:
    """Return stored results; none if there is no file.

    Raises:
        OptionError: if the file is damaged.
    """
    if not path.is_file():
        return StoredResults()
    rows = []
    try:
        content = parse_json(read_text(path))
        for agent, protocols in content["agents"].items():
            for protocol, layouts in protocols.items():
                for layout, groups in layouts.items():
                    for group, stored in groups.items():
                        family, _, kind = group.removesuffix(")").partition(" (")
                        cell = ResultCell(layout, family, kind or "test")
                        blocks = {name: np.array(stored[name], np.float64) for name in BLOCKS}
                        if any(values.ndim != 2 for values in blocks.values()):
                            raise ValueError(f"{agent}, {group} on {layout}: expected a list for each task")
                        rows += cell_rows((agent, protocol), cell, blocks, stored["overlaps"])
        texts = [dict(content.get(name, {})) for name in ("ablations", "commits")]
        return StoredResults(results_table(rows), dict(content["about"]), *texts)
    except (IndexFormatError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise OptionError(f"{path}: not stored results: {error!r}; restore the file") from error


def write_stored(path: Path, stored: StoredResults) -> None:
    """Write stored results, rounded to three digits."""
    agents: dict[str, Any] = defaultdict(dict)
    for (agent, protocol), table in stored.table.groupby(AGENT_COLUMNS, sort=False):
        layouts: dict[str, Any] = defaultdict(dict)
        for cell, blocks in agent_cells(table).items():
            numbers = {name: np.round(blocks[name], 3).tolist() for name in BLOCKS}
            layouts[cell.layout][cell.group] = numbers | {"overlaps": blocks["overlaps"]}
        agents[str(agent)][protocol] = layouts
    content = {"about": stored.about, "ablations": stored.ablations, "commits": stored.commits, "agents": agents}
    with atomic_write(path) as partial:
        text = json.dumps(content, separators=(",", ":"))
        partial.write_text(text.replace('"mean"', '\n"mean"') + "\n", encoding="utf-8")


def add_results(stored: StoredResults, folder: Path, about: str) -> StoredResults:
    """Return stored results with those of a folder that `evaluate` made; equal cells are replaced.

    Args:
        stored: the results so far.
        folder: the folder.
        about: one sentence on how the agent was made; empty to keep the stored one.

    Raises:
        OptionError: if the folder has no results, or mixed ones, if a task was played for fewer than 2 x `ENDS`
            episodes or a published one is missing, or if `about` is empty for a new agent.
    """
    run = read_run(folder)
    for cell, returns in run.cells.items():
        if returns.shape[1] < 2 * ENDS:
            raise OptionError(f"{folder}: {returns.shape[1]} episodes, expected at least {2 * ENDS}; evaluate more")
        if cell.kind == "test" and not run.is_complete(cell):
            raise OptionError(
                f"{folder}: {len(returns)} of the {published_instances(cell)} published tasks of {cell.layout} "
                f"{cell.family}; evaluate all of them"
            )
    about = about or stored.about.get(run.agent, "")
    if not about:
        raise OptionError(f"{folder}: results of {run.agent}, a new agent: say how it was made by --about")
    return _replace_rows(replace(stored, about=stored.about | {run.agent: about}), run.table)


def add_unseen(stored: StoredResults, returns: Mapping[str, Mapping[tuple[str, str], np.ndarray]]) -> StoredResults:
    """Return stored results with those on unseen layouts, (versions, episodes); equal cells are replaced."""
    rows = []
    for agent, cells in returns.items():
        for cell, values in cells.items():
            rows += cell_rows((agent, UNSEEN), ResultCell(*cell), episode_blocks(values[:, None]))
    return _replace_rows(stored, results_table(rows))


def _replace_rows(stored: StoredResults, table: pd.DataFrame) -> StoredResults:
    keys = [*AGENT_COLUMNS, *CELL_COLUMNS]
    known = pd.MultiIndex.from_frame(stored.table[keys]).isin(pd.MultiIndex.from_frame(table[keys]))
    parts = [part for part in (stored.table[~known], table) if len(part)]
    return replace(stored, table=pd.concat(parts, ignore_index=True))


def write_comparison(stored: StoredResults, folder: Path) -> list[Path]:
    """Write docs/results.md and its figure into a folder. Return their paths.

    Raises:
        OptionError: if there are no results.
    """
    if not len(stored.table):
        raise OptionError("no stored results: give folders that `icrl4aht-data evaluate` made")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in RESULTS_FILES]
    paths[0].write_text(render_comparison(stored), encoding="utf-8")
    plot_comparison(stored, "seeded", paths[1])
    return paths


def render_comparison(stored: StoredResults) -> str:
    """Return docs/results.md. Tables of single cells leave out agents that the present code does not make."""
    seeded, published = (stored.protocol(name) for name in ("seeded", "published"))
    shown = [agent for agent in stored.about if agent not in stored.commits and not agent.endswith(FORGETS)]
    texts = {
        agent: f"{about} (made by commit {stored.commits[agent]})" if agent in stored.commits else about
        for agent, about in stored.about.items()
    }
    return fill_template(
        "results.md",
        about="\n".join(f"* `{agent}`: {text}" for agent, text in texts.items()),
        summary=summary_table(seeded, "seeded"),
        teammate=cells_table(seeded, "seeded", "teammate", shown),
        layout=cells_table(seeded, "seeded", "layout", shown),
        published_teammate=cells_table(published, "published", "teammate", shown),
        published_layout=cells_table(published, "published", "layout", shown),
        published_summary=summary_table(published, "published"),
        gains=gains_table(seeded, "seeded", [agent for agent in stored.about if agent not in stored.commits]),
        validation=validation_table(seeded, shown, "validation"),
        diverse=validation_table(seeded, shown, "diverse"),
        windows=ablation_table(stored, "ablate windows"),
        contexts=ablation_table(stored, "ablate contexts"),
        unseen=unseen_table(stored),
        marks="\n".join(f"* {kind.mark}: {kind.meaning}" for kind in OVERLAPS.values()),
        references=", ".join(f"`{name}`" for name in REFERENCES),
        forgets=f"`NAME{FORGETS}`",
        cells=str(len(open_cells("seeded"))),
    )


def summary_table(results: Mapping[str, AgentCells], protocol: str) -> str:
    """Return a table with a row for each agent: normalised return by track, cells that rise, seeds of a task.

    A normalised return is left out if the agent has not played all cells of the track that have headroom.
    """
    headroom, chosen = cell_headroom(protocol), open_cells(protocol)
    groups = {track: [cell for cell in chosen if cell.layout in TRACKS[track]["test"]] for track in TRACKS}
    groups["both"] = chosen
    body = []
    for agent, cells in results.items():
        played = [cell for cell in chosen if cell in cells]
        scores = {cell: normalise(cells[cell]["mean"], headroom[cell]) for cell in played}
        rising = [cell for cell in played if mean_interval(cells[cell]["gain"]).low > 0]
        rise = ""
        if played:
            ends = [np.mean([cells[cell][block].mean() for cell in played]) for block in ("opening", "last")]
            rise = _with_interval(*(cells[cell]["last"] - cells[cell]["opening"] for cell in played), sign="+")
            rise = f"{ends[0]:z.1f} to {ends[1]:z.1f}, {rise}"
        body.append(
            [
                f"`{agent}`" + _marks(*cells.values()),
                *(
                    _with_interval(*map(scores.__getitem__, of), digits=2) if set(of) <= scores.keys() else ""
                    for of in groups.values()
                ),
                f"{len(rising)} of {len(played)}",
                rise,
                ", ".join(layouts_above_paper(cells)) or "none",
                " or ".join(map(str, sorted({cells[cell]["mean"].shape[1] for cell in played}))),
            ]
        )
    scored = [f"{track} ({counted_noun(len(of), 'cell')})" for track, of in groups.items()]
    header = ["agent", *scored, "rising", "first episode to last 20", "layouts above the paper's AD and DPT", "seeds"]
    return markdown_table(header, body)


def layouts_above_paper(cells: AgentCells) -> list[str]:
    """Return the layouts with headroom where an agent's mean over the families exceeds both published methods."""
    above = []
    for layout in dict.fromkeys(cell.layout for cell in open_cells("published")):
        own = [cells[cell]["mean"].mean() for cell in cells if cell in [ResultCell(layout, one) for one in HEURISTICS]]
        paper = [published_cells(name)[layout][AVERAGE][0] for name in PAPER_METHODS]
        above += [layout] if len(own) == len(HEURISTICS) and np.mean(own) > max(paper) else []
    return above


def cells_table(results: Mapping[str, AgentCells], protocol: str, track: str, agents: Sequence[str]) -> str:
    """Return a table with a row for each cell of a track with headroom, and a column for each agent that played one.

    The columns of the paper's methods have its numbers, which are of protocol `published`.
    """
    chosen = [cell for cell in open_cells(protocol) if cell.layout in TRACKS[track]["test"]]
    agents = [agent for agent in agents if any(cell in results.get(agent, {}) for cell in chosen)]
    body = []
    for cell, (layout, family, *own) in zip(chosen, _cell_rows(chosen, results, agents), strict=True):
        stay, random, oracle = (f"{cell_headroom(protocol)[cell][name]:z.1f}" for name in ("stay", "random", "oracle"))
        published = [f"{published_cells(name)[cell.layout][cell.family][0]:z.1f}" for name in PAPER_METHODS]
        body.append([layout, family, stay, random, *published, *own, oracle])
    paper = [f"{name} (paper)" for name in PAPER_METHODS]
    header = ["layout", "family", "stay", "random", *paper, *(f"`{agent}`" for agent in agents), "oracle"]
    return markdown_table(header, body, right=len(header) - 2)


def validation_table(results: Mapping[str, AgentCells], agents: Sequence[str], kind: str) -> str:
    """Return a table of mean returns with validation teammates, by which models are chosen.

    Args:
        results: agent -> its results.
        agents: the agents of the columns.
        kind: "validation" for teammates of the published training ranges, or "diverse".
    """
    found = {cell for agent in agents for cell in results.get(agent, {}) if cell.kind == kind}
    body = _cell_rows(sorted(found, key=lambda cell: cell.order), results, agents)
    return markdown_table(["layout", "family", *(f"`{agent}`" for agent in agents)], body, right=len(agents))


def gains_table(results: Mapping[str, AgentCells], protocol: str, agents: Sequence[str]) -> str:
    """Return a table of the first and the last episodes of each cell with headroom, and the interval of the gain."""

    def text(found: Mapping[str, Any]) -> str:
        gain, low, high = mean_interval(found["gain"])
        ends = f"{found['first'].mean():z.1f} to {found['last'].mean():z.1f}"
        shown = f"{ends}, {gain:+.1f} ({low:+.1f}, {high:+.1f}){_marks(found)}"
        return f"**{shown}**" if low > 0 else shown

    body = _cell_rows(open_cells(protocol), results, agents, text)
    return markdown_table(["layout", "family", *(f"`{agent}`" for agent in agents)], body)


def ablation_table(stored: StoredResults, name: str) -> str:
    """Return a table with a row for each stored entry of an ablation.

    Returns, their differences to the first entry, and gains are means over tasks and seeds, with 95 % bootstrap
    intervals.
    """
    results, body = stored.protocol(name), []
    first: np.ndarray | None = None
    for entry, about in stored.ablations.get(name, {}).items():
        cells = results[entry].values()
        mean, gain = (np.concatenate([blocks[name] for blocks in cells]) for name in ("mean", "gain"))
        difference = "" if first is None or mean.shape != first.shape else _with_interval(mean - first, sign="+")
        first = mean if first is None else first
        body.append([f"`{entry}`", about, _with_interval(mean), difference, _with_interval(gain, sign="+")])
    return markdown_table(["entry", "difference", "mean return", "to the first", "last 20 - first 20"], body)


def unseen_table(stored: StoredResults) -> str:
    """Return a table with a row for each agent that played on unseen layouts, and a column for each layout's versions.

    Returns are means over versions and families; normalised ones (return - `stay`) / (`oracle` - `stay`), mean over
    layouts. Intervals are over the versions. Without `stay` and `oracle` there are no normalised ones.
    """
    versions: dict[str, dict[str, np.ndarray]] = {}  # agent -> layout -> mean over families (versions,)
    for agent, cells in stored.protocol(UNSEEN).items():
        for layout in dict.fromkeys(cell.layout for cell in cells):
            of_layout = [blocks["mean"].mean(axis=1) for cell, blocks in cells.items() if cell.layout == layout]
            versions.setdefault(agent, {})[layout] = np.mean(of_layout, axis=0)
    layouts = sorted({layout for own in versions.values() for layout in own})
    stay, oracle = (versions.get(name, {}) for name in ("stay", "oracle"))
    body = []
    for agent, own in versions.items():
        score = ""
        if agent not in REFERENCES and all(layout in ego for ego in (stay, own, oracle) for layout in layouts):
            scaled = [(own[one] - stay[one]) / (oracle[one].mean() - stay[one].mean()) for one in layouts]
            score = _with_interval(*scaled, digits=2)
        texts = [_with_interval(own[one][:, None]) if one in own else "" for one in layouts]
        body.append([f"`{agent}`", *texts, score])
    return markdown_table(["agent", *layouts, "normalised"], body)


def plot_comparison(stored: StoredResults, protocol: str, path: Path) -> None:
    """Plot mean returns in the cells with headroom: of agents as bars, of reference egos and the paper as marks."""
    headroom, chosen = cell_headroom(protocol), open_cells(protocol)
    results = {
        agent: cells
        for agent, cells in stored.protocol(protocol).items()
        if agent not in stored.commits and not agent.endswith(FORGETS)
    }
    figure = new_figure(11, 4.2)
    axes, numbers, width = figure.subplots(), np.arange(len(chosen)), 0.8 / max(1, len(results))
    for number, (agent, cells) in enumerate(results.items()):
        heights = [cells[cell]["mean"].mean() if cell in cells else np.nan for cell in chosen]
        axes.bar(numbers - 0.4 + (number + 0.5) * width, heights, width, label=agent)
    for name, style in (("oracle", "k_"), ("stay", "rx"), ("random", "g+")):
        axes.plot(numbers, [headroom[cell][name] for cell in chosen], style, markersize=9, label=name)
    for name, style in zip(PAPER_METHODS, ("ms", "cD"), strict=True):
        returns = [published_cells(name)[cell.layout][cell.family][0] for cell in chosen]
        axes.plot(numbers, returns, style, markersize=4, fillstyle="none", label=f"{name} (paper)")
    axes.set_xticks(numbers, [f"{cell.layout}\n{cell.family}" for cell in chosen], rotation=60, fontsize=8)
    axes.set_ylabel("mean return of an episode")
    axes.axhline(0, color="gray", linewidth=0.6)
    figure.legend(ncols=5, fontsize=8, loc="outside lower center", frameon=False)
    axes.set_title(f"Test tasks with headroom, protocol {protocol}; the paper's numbers are of published", fontsize=10)
    save_figure(figure, path)


def _with_interval(*cells: np.ndarray, digits: int = 1, sign: str = "") -> str:
    mean, low, high = (f"{value:{sign}z.{digits}f}" for value in mean_interval(*cells))
    return f"{mean} ({low} to {high})"


def _mean_text(found: Mapping[str, Any]) -> str:
    return f"{found['mean'].mean():z.1f}{_marks(found)}"


def _cell_rows(
    cells: Iterable[ResultCell],
    results: Mapping[str, AgentCells],
    agents: Sequence[str],
    text: Callable[[Mapping[str, Any]], str] = _mean_text,
) -> list[list[str]]:
    """Return rows with layout, family, and the text on each agent's results, empty if it has not played the cell."""
    played = [results.get(agent, {}) for agent in agents]
    return [[*cell[:2], *(text(own[cell]) if cell in own else "" for own in played)] for cell in cells]


def _marks(*cells: Mapping[str, Any]) -> str:
    return overlap_marks(name for blocks in cells for name in blocks["overlaps"]).strip()
