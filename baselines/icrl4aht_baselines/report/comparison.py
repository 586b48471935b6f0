"""Stored results of reference models, `cards/results.csv`, and docs/results.md, which compares them.

Shapes: U tasks, S seeds with which each was played.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
import numpy as np
import pandas as pd

from icrl4aht_baselines.evaluate.segments import FORGETS
from icrl4aht_baselines.report.results import (
    AGENT_COLUMNS,
    CELL_COLUMNS,
    ENDS,
    TABLE_COLUMNS,
    CellReturns,
    ResultCell,
    cell_rows,
    episode_blocks,
    in_order,
    published_cells,
    published_instances,
    read_run,
    returns_by_cell,
)
from icrl4aht_baselines.report.scores import PAPER_METHODS, cell_headroom, mean_of, normalise, open_cells
from icrl4aht_baselines.report.statistics import mean_interval
from icrl4aht_baselines.training.seen import OVERLAPS, overlap_marks
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import new_figure, save_figure
from icrl4aht_data.utils.files import atomic_write, write_json
from icrl4aht_data.utils.templates import card_file, fill_template, markdown_table
from icrl4aht_data.utils.text import counted_noun

RESULTS_FILES = ("results.md", "results.png")

AgentReturns = Mapping[ResultCell, CellReturns]
"""Returns of an agent under one protocol."""

UNSEEN = "unseen"
"""Protocol name of results on rearranged layouts, see `icrl4aht_baselines.online.unseen`; a task for each version."""


_Text = Literal["about", "ablations", "commits"]


@dataclass(frozen=True)
class StoredResults:
    """Results of several agents, `cards/results.csv` and the texts of `cards/results.json`.

    Attributes:
        table: the results, see `results`. Entries of ablations are stored like agents, with the experiment's name
            instead of a protocol; results on unseen layouts with `UNSEEN`.
        about: agent -> one sentence on how it was made; agents are shown in this order.
        ablations: ablation -> entry -> what differs.
        commits: agent or ablation -> commit of this repository whose code made it, if later code cannot.
    """

    table: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=TABLE_COLUMNS))
    about: dict[str, str] = field(default_factory=dict)
    ablations: dict[str, dict[str, str]] = field(default_factory=dict)
    commits: dict[str, str] = field(default_factory=dict)

    def protocol(self, name: str) -> dict[str, AgentReturns]:
        """Return the results under a protocol by agent, in the order of `about`."""
        agents = dict(iter(self.table[self.table["protocol"] == name].groupby("agent", sort=False)))
        return {str(agent): returns_by_cell(agents[agent]) for agent in [*self.about, *agents] if agent in agents}


def results_file() -> Path:
    """Return the path of the stored results: the texts; the table is next to it, in results.csv."""
    return card_file("published.json").with_name("results.json")


def read_stored(path: Path) -> StoredResults:
    """Return stored results, texts in a JSON file and a table of the same name; none if there is no such file.

    Raises:
        OptionError: if a file is damaged.
    """
    if not path.is_file():
        return StoredResults()
    try:
        texts = msgspec.json.decode(path.read_bytes(), type=dict[_Text, dict[str, Any]])
        return StoredResults(pd.read_csv(path.with_suffix(".csv"), keep_default_na=False)[TABLE_COLUMNS], **texts)
    except (OSError, ValueError, KeyError) as error:
        raise OptionError(f"{path}: not stored results: {error!r}; restore it and {path.stem}.csv") from error


def write_stored(path: Path, stored: StoredResults) -> None:
    """Write stored results, rounded to three digits."""
    with atomic_write(path.with_suffix(".csv")) as partial:
        stored.table.round(3).to_csv(partial, index=False, lineterminator="\n")
    with atomic_write(path) as partial:
        write_json(partial, {name: getattr(stored, name) for name in get_args(_Text)})


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
    return _replace_rows(stored, pd.DataFrame(rows, columns=TABLE_COLUMNS))


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
    current = [agent for agent in stored.about if agent not in stored.commits]
    shown = [agent for agent in current if not agent.endswith(FORGETS)]
    made = {agent: f" (made by commit {commit})" for agent, commit in stored.commits.items()}
    played = in_order(cell for own in seeded.values() for cell in own)
    validation = {kind: [cell for cell in played if cell.kind == kind] for kind in ("validation", "diverse")}
    tracks = {
        f"{prefix}{track}": cells_table(results, track_cells(protocol, track), shown, protocol=protocol)
        for prefix, protocol, results in (("", "seeded", seeded), ("published_", "published", published))
        for track in TRACKS
    }
    return fill_template(
        "results.md",
        about="\n".join(f"* `{agent}`: {about}{made.get(agent, '')}" for agent, about in stored.about.items()),
        summary=summary_table(seeded, "seeded"),
        published_summary=summary_table(published, "published"),
        **tracks,
        gains=cells_table(seeded, open_cells("seeded"), current, _gain_text),
        **{kind: cells_table(seeded, cells, shown) for kind, cells in validation.items()},
        windows=ablation_table(stored, "ablate windows"),
        contexts=ablation_table(stored, "ablate contexts"),
        unseen=unseen_table(stored),
        marks="\n".join(f"* {kind.mark}: {kind.meaning}" for kind in OVERLAPS.values()),
        references=", ".join(f"`{name}`" for name in REFERENCES),
        forgets=f"`NAME{FORGETS}`",
        cells=str(len(open_cells("seeded"))),
    )


def track_cells(protocol: str, track: str) -> list[ResultCell]:
    """Return the test cells of a track with headroom under a protocol."""
    return [cell for cell in open_cells(protocol) if cell.layout in TRACKS[track]["test"]]


def summary_table(results: Mapping[str, AgentReturns], protocol: str) -> str:
    """Return a table with a row for each agent: normalised return by track, cells that rise, seeds of a task.

    A normalised return is left out if the agent has not played all cells of the track that have headroom.
    """
    headroom = cell_headroom(protocol)
    groups = {**{track: track_cells(protocol, track) for track in TRACKS}, "both": open_cells(protocol)}
    body = []
    for agent, cells in results.items():
        played = {cell: cells[cell] for cell in groups["both"] if cell in cells}
        scores = {cell: normalise(returns.mean, headroom[cell]) for cell, returns in played.items()}
        rising = [returns for returns in played.values() if mean_interval(returns.gain).low > 0]
        rise = ""
        if played:
            opening, last = (mean_of(getattr(of, name) for of in played.values()) for name in ("opening", "last"))
            gain = mean_interval(*(returns.last - returns.opening for returns in played.values()))
            rise = f"{opening:z.1f} to {last:z.1f}, {gain.text(sign='+')}"
        texts = [
            mean_interval(*map(scores.__getitem__, of)).text(2) if set(of) <= scores.keys() else ""
            for of in groups.values()
        ]
        seeds = " or ".join(map(str, sorted({returns.mean.shape[1] for returns in played.values()})))
        marks = overlap_marks({name for returns in cells.values() for name in returns.overlaps}).strip()
        body.append([f"`{agent}`{marks}", *texts, f"{len(rising)} of {len(played)}", rise, seeds])
    scored = [f"{track} ({counted_noun(len(of), 'cell')})" for track, of in groups.items()]
    return markdown_table(["agent", *scored, "rising", "first episode to last 20", "seeds"], body)


def _mean_text(returns: CellReturns) -> str:
    return f"{returns.mean.mean():z.1f}{overlap_marks(returns.overlaps).strip()}"


def _gain_text(returns: CellReturns) -> str:
    gain = mean_interval(returns.gain)
    text = f"{returns.first.mean():z.1f} to {returns.last.mean():z.1f}, {gain.text(sign='+')}"
    text += overlap_marks(returns.overlaps).strip()
    return f"**{text}**" if gain.low > 0 else text


def cells_table(
    results: Mapping[str, AgentReturns],
    cells: Sequence[ResultCell],
    agents: Sequence[str],
    text: Callable[[CellReturns], str] = _mean_text,
    protocol: str = "",
) -> str:
    """Return a table with a row for each cell, and a column for each agent that played one.

    Args:
        results: agent -> its results.
        cells: the cells.
        agents: the agents.
        text: returns the text on an agent's results in a cell, by default their mean.
        protocol: if given, there are also columns of the reference egos' returns under it, and of the paper's numbers,
            which are of protocol `published`.
    """
    headroom = cell_headroom(protocol)
    body = []
    for cell in cells:
        row = {"layout": cell.layout, "family": cell.family}
        if protocol:
            paper = {f"{name} (paper)": published_cells(name)[cell.layout][cell.family][0] for name in PAPER_METHODS}
            egos = {name: headroom[cell][name] for name in ("stay", "random")}
            row |= {name: f"{value:z.1f}" for name, value in (egos | paper).items()}
        for agent in (agent for agent in agents if not results.get(agent, {}).keys().isdisjoint(cells)):
            row[f"`{agent}`"] = text(results[agent][cell]) if cell in results[agent] else ""
        body.append(row | ({"oracle": f"{headroom[cell]['oracle']:z.1f}"} if protocol else {}))
    header = [*body[0]] if body else ["layout", "family"]
    return markdown_table(header, [[*row.values()] for row in body], right=len(header) - 2)


def ablation_table(stored: StoredResults, name: str) -> str:
    """Return a table with a row for each stored entry of an ablation.

    Returns, their differences to the first entry, and gains are means over tasks and seeds, with 95 % bootstrap
    intervals.
    """
    results, body = stored.protocol(name), []
    first: np.ndarray | None = None
    for entry, about in stored.ablations.get(name, {}).items():
        cells = results[entry].values()
        mean, gain = np.concatenate([of.mean for of in cells]), np.concatenate([of.gain for of in cells])
        known = first is not None and mean.shape == first.shape
        difference = mean_interval(mean - first).text(sign="+") if known else ""
        first = mean if first is None else first
        body.append([f"`{entry}`", about, mean_interval(mean).text(), difference, mean_interval(gain).text(sign="+")])
    return markdown_table(["entry", "difference", "mean return", "to the first", "last 20 - first 20"], body)


def unseen_table(stored: StoredResults) -> str:
    """Return a table with a row for each agent that played on unseen layouts, and a column for each layout's versions.

    Returns are means over versions and families; normalised ones (return - `stay`) / (`oracle` - `stay`), mean over
    layouts. Intervals are over the versions. Without `stay` and `oracle` there are no normalised ones.
    """
    rows = stored.table[stored.table["protocol"] == UNSEEN]
    families = rows.groupby(["agent", "layout", "task"], sort=False)["mean"].mean()
    versions: Any = {key: of.to_numpy() for key, of in families.groupby(level=["agent", "layout"], sort=False)}
    layouts, body = sorted(rows["layout"].unique()), []
    for agent in rows["agent"].unique():
        own, stay, oracle = ([versions.get((name, one)) for one in layouts] for name in (agent, "stay", "oracle"))
        scored = agent not in REFERENCES and all(values is not None for values in (*own, *stay, *oracle))
        texts = ["" if of is None else mean_interval(of).text() for of in own]
        ends = zip(own, stay, oracle, strict=True) if scored else ()
        scaled = [(values - low) / (high.mean() - low.mean()) for values, low, high in ends]
        body.append([f"`{agent}`", *texts, mean_interval(*scaled).text(2) if scored else ""])
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
        heights = [cells[cell].mean.mean() if cell in cells else np.nan for cell in chosen]
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
