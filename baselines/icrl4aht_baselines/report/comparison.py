"""The page docs/results.md, which compares reference models with the reference egos and the paper's numbers.

It is computed from the stored results, the returns of the reference egos and the paper's numbers.

Shapes: U tasks, S seeds with which each was played.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from icrl4aht_baselines.agents.egos import FORGETS
from icrl4aht_baselines.report.intervals import MeanInterval, bootstrap_interval, mean_of_cells
from icrl4aht_baselines.report.overlap import OVERLAPS
from icrl4aht_baselines.report.results import (
    cell_order,
    family_of,
    group_of,
    normalise,
    published_cells,
)
from icrl4aht_baselines.report.stored_results import UNSEEN, CellReturns, StoredResults
from icrl4aht_baselines.training.ablations import ABLATIONS
from icrl4aht_data.benchmark.facts import FAMILIES, TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES, Cell, has_headroom, read_headroom
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import new_figure, save_figure
from icrl4aht_data.utils.templates import fill_template, markdown_table
from icrl4aht_data.utils.text import counted_noun

RESULTS_BEGINS: dict[str, bytes | None] = {"results.md": b"# Results: reference models\n", "results.png": None}
"""Files of the page -> their first bytes, by which they are recognised before they are replaced."""

MOST_DRAWN = 5
"""Most agents in the figure: more have bars that are too thin to tell apart."""

_PAPER = ("AD", "DPT")


def cells_with_headroom(protocol: str) -> list[Cell]:
    """Returns the test cells with headroom under a protocol, in the paper's order."""
    return sorted((cell for cell, egos in read_headroom(protocol).items() if has_headroom(egos)), key=cell_order)


def normalised_interval(cells: Mapping[Cell, CellReturns], protocol: str, chosen: Sequence[Cell]) -> MeanInterval:
    """Returns the mean normalised return of some cells with headroom and its 95 % interval.

    The interval is a bootstrap over the tasks, and over the seeds of each, within each cell; cells are not resampled.
    """
    headroom = read_headroom(protocol)
    return mean_of_cells([normalise(cells[cell].mean, headroom[cell]) for cell in chosen])


def rising_cells(cells: Mapping[Cell, CellReturns], protocol: str) -> list[Cell]:
    """Returns the cells with headroom whose gain is positive with its 95 % interval above 0."""
    chosen = [cell for cell in cells_with_headroom(protocol) if cell in cells]
    return [cell for cell in chosen if gain_interval(cells[cell])[0] > 0]


def gain_interval(found: CellReturns) -> tuple[float, float]:
    """Returns the 95 % bootstrap interval of the mean gain in a cell, over the tasks and the seeds of each."""
    return bootstrap_interval(found.gain, np.random.default_rng(0))


def summary_table(stored: StoredResults, protocol: str) -> str:
    """Returns a table with a row for each agent: normalised return by track, cells that rise, seeds of a task.

    A normalised return is left out if the agent has not played all cells of the track that have headroom.
    """
    headroom = cells_with_headroom(protocol)
    groups = {track: [cell for cell in headroom if cell[0] in facts["test"]] for track, facts in TRACKS.items()}
    groups["both"] = headroom
    rows = []
    for agent in stored.agents(protocol):
        cells = stored.cells[agent, protocol]
        played = [cell for cell in headroom if cell in cells]
        seeds = sorted({cells[cell].mean.shape[1] for cell in played})
        rows.append(
            [
                _code(agent) + _marks(one for found in cells.values() for one in found.overlaps),
                *(_score_text(cells, protocol, chosen) for chosen in groups.values()),
                f"{len(rising_cells(cells, protocol))} of {len(played)}",
                _opening_text(cells, protocol),
                ", ".join(layouts_above_paper(cells)) or "none",
                " or ".join(map(str, seeds)),
            ]
        )
    scores = [f"{track} ({counted_noun(len(chosen), 'cell')})" for track, chosen in groups.items()]
    header = ["agent", *scores, "rising", "first episode to last 20", "layouts above the paper's AD and DPT", "seeds"]
    return markdown_table(header, rows)


def _score_text(cells: Mapping[Cell, CellReturns], protocol: str, chosen: Sequence[Cell]) -> str:
    """Returns the normalised return of some cells with its interval as text; empty if one was not played."""
    if not all(cell in cells for cell in chosen):
        return ""
    mean, low, high = normalised_interval(cells, protocol, chosen)
    return f"{mean:z.2f} ({low:z.2f} to {high:z.2f})"


def _opening_text(cells: Mapping[Cell, CellReturns], protocol: str) -> str:
    """Returns the mean return of the first episode and of the last ones over the cells with headroom, and the 95 %
    interval of their difference, as text."""
    chosen = [cells[cell] for cell in cells_with_headroom(protocol) if cell in cells]
    if not chosen:
        return ""
    opening, last = (np.mean([getattr(found, name).mean() for found in chosen]) for name in ("opening", "last"))
    mean, low, high = mean_of_cells([found.last - found.opening for found in chosen])
    return f"{opening:z.1f} to {last:z.1f}, {mean:+z.1f} ({low:+z.1f} to {high:+z.1f})"


def layouts_above_paper(cells: Mapping[Cell, CellReturns]) -> list[str]:
    """Returns the layouts with headroom where an agent's mean over the families exceeds both published methods."""
    above = []
    for layout in dict.fromkeys(layout for layout, _ in cells_with_headroom("published")):
        own = [cells[layout, family].mean.mean() for family in FAMILIES[1:] if (layout, family) in cells]
        paper = [published_cells(name)[layout]["Average"][0] for name in _PAPER]
        if len(own) == len(FAMILIES) - 1 and np.mean(own) > max(paper):
            above.append(layout)
    return above


def cells_table(stored: StoredResults, protocol: str, track: str, agents: Sequence[str]) -> str:
    """Returns a table with a row for each cell of a track with headroom, and a column for each agent that played one.

    The columns of the paper's methods have its numbers, which are of protocol `published`.
    """
    headroom = read_headroom(protocol)
    chosen = [cell for cell in cells_with_headroom(protocol) if cell[0] in TRACKS[track]["test"]]
    agents = [one for one in agents if any(cell in stored.cells.get((one, protocol), {}) for cell in chosen)]
    rows = []
    for cell in chosen:
        egos = [f"{headroom[cell][name]:z.1f}" for name in ("stay", "random")]
        published = [f"{published_cells(name)[cell[0]][cell[1]][0]:z.1f}" for name in _PAPER]
        own = [_cell_text(stored.cells[agent, protocol].get(cell)) for agent in agents]
        rows.append([*cell, *egos, *published, *own, f"{headroom[cell]['oracle']:z.1f}"])
    paper = [f"{name} (paper)" for name in _PAPER]
    header = ["layout", "family", "stay", "random", *paper, *map(_code, agents), "oracle"]
    return markdown_table(header, rows, right=len(header) - 2)


def validation_table(stored: StoredResults, agents: Sequence[str], group: str) -> str:
    """Returns a table of mean returns with validation teammates, by which models are chosen.

    Args:
        stored: the results.
        agents: the agents of the columns.
        group: "validation" for teammates of the published training ranges, or "diverse".
    """
    found = {agent: stored.cells.get((agent, "seeded"), {}) for agent in agents}
    cells = {cell for of_agent in found.values() for cell in of_agent if group_of(cell) == group}
    rows = [
        [cell[0], family_of(cell), *(_cell_text(found[agent].get(cell)) for agent in agents)]
        for cell in sorted(cells, key=cell_order)
    ]
    return markdown_table(["layout", "family", *map(_code, agents)], rows, right=len(agents))


def gains_table(stored: StoredResults, protocol: str, agents: Sequence[str]) -> str:
    """Returns a table of the first and the last episodes of each cell with headroom, and the interval of the gain."""
    rows = []
    for cell in cells_with_headroom(protocol):
        row = [*cell]
        for agent in agents:
            found = stored.cells.get((agent, protocol), {}).get(cell)
            if found is None:
                row.append("")
                continue
            low, high = gain_interval(found)
            ends = f"{found.first.mean():z.1f} to {found.last.mean():z.1f}"
            text = f"{ends}, {found.gain.mean():+.1f} ({low:+.1f}, {high:+.1f}){_marks(found.overlaps)}"
            row.append(f"**{text}**" if low > 0 else text)
        rows.append(row)
    return markdown_table(["layout", "family", *map(_code, agents)], rows)


def ablation_table(stored: StoredResults, name: str) -> str:
    """Returns a table with a row for each entry of an ablation.

    Returns, their differences to the first entry, and gains are means over tasks and seeds, with 95 % bootstrap
    intervals.
    """
    rows = []
    first: Float[np.ndarray, "U S"] | None = None
    for entry in ABLATIONS[name].entries:
        cells = stored.cells.get((entry.name, name))
        if cells is None:
            continue
        mean = np.concatenate([cells[cell].mean for cell in sorted(cells, key=cell_order)])
        gain = np.concatenate([cells[cell].gain for cell in sorted(cells, key=cell_order)])
        first = mean if first is None else first
        comparable = entry is not ABLATIONS[name].entries[0] and mean.shape == first.shape
        difference = _with_interval(mean - first, "+") if comparable else ""
        rows.append([_code(entry.name), entry.about, _with_interval(mean), difference, _with_interval(gain, "+")])
    if not rows:
        return ""
    return markdown_table(["entry", "difference", "mean return", "to the first", "last 20 - first 20"], rows)


def unseen_table(stored: StoredResults) -> str:
    """Returns a table with a row for each agent that played on unseen layouts, and a column for each layout's versions.

    Returns are means over versions and families; normalised ones (return - `stay`) / (`oracle` - `stay`), mean over
    layouts. Intervals are over the versions. Without `stay` and `oracle` there are no normalised ones.
    """
    found = {agent: stored.cells[agent, UNSEEN] for agent in stored.agents(UNSEEN)}
    layouts = sorted({layout for cells in found.values() for layout, _ in cells})
    versions = {  # agent -> layout -> (V,)
        agent: {
            layout: np.mean([cells[cell].mean.mean(axis=1) for cell in cells if cell[0] == layout], axis=0)
            for layout in layouts
            if layout in {name for name, _ in cells}
        }
        for agent, cells in found.items()
    }
    rows = []
    for agent, own in versions.items():
        texts = [_with_interval(own[layout][:, None]) if layout in own else "" for layout in layouts]
        rows.append([_code(agent), *texts, _unseen_score(versions, agent, layouts)])
    return markdown_table(["agent", *layouts, "normalised"], rows)


def _unseen_score(versions: Mapping[str, Mapping[str, np.ndarray]], agent: str, layouts: Sequence[str]) -> str:
    """Returns the normalised return of an agent on the versions of all layouts as text; empty if it has none."""
    egos = [versions.get(name, {}) for name in ("stay", agent, "oracle")]
    if agent in REFERENCES or not all(layout in ego for ego in egos for layout in layouts):
        return ""
    cells = []
    for layout in layouts:
        stay, own, oracle = (ego[layout] for ego in egos)
        cells.append((own - stay) / (oracle.mean() - stay.mean()))
    mean, low, high = mean_of_cells(cells)
    return f"{mean:z.2f} ({low:z.2f} to {high:z.2f})"


def _with_interval(values: Float[np.ndarray, "U S"], sign: str = "") -> str:
    low, high = bootstrap_interval(values, np.random.default_rng(0))
    return f"{values.mean():{sign}z.1f} ({low:{sign}z.1f} to {high:{sign}z.1f})"


def _code(name: str) -> str:
    return f"`{name}`"


def _cell_text(found: CellReturns | None) -> str:
    if found is None:
        return ""
    return f"{found.mean.mean():z.1f}{_marks(found.overlaps)}"


def _marks(overlaps: Iterable[str]) -> str:
    """Returns the marks of overlaps, each once, in the order of their legend."""
    found = set(overlaps)
    return "".join(kind.mark for name, kind in OVERLAPS.items() if name in found)


def plot_comparison(stored: StoredResults, protocol: str, agents: Sequence[str], path: Path) -> None:
    """Plot mean returns in the cells with headroom: of agents as bars, of reference egos and the paper as marks."""
    headroom, chosen = read_headroom(protocol), cells_with_headroom(protocol)
    figure = new_figure(11, 4.2)
    axes, numbers = figure.subplots(), np.arange(len(chosen))
    width = 0.8 / max(1, len(agents))
    for number, agent in enumerate(agents):
        cells = stored.cells.get((agent, protocol), {})
        heights = [cells[cell].mean.mean() if cell in cells else np.nan for cell in chosen]
        axes.bar(numbers - 0.4 + (number + 0.5) * width, heights, width, label=agent)
    for name, style in (("oracle", "k_"), ("stay", "rx"), ("random", "g+")):
        axes.plot(numbers, [headroom[cell][name] for cell in chosen], style, markersize=9, label=name)
    for name, style in zip(_PAPER, ("ms", "cD"), strict=True):
        returns = [published_cells(name)[layout][family][0] for layout, family in chosen]
        axes.plot(numbers, returns, style, markersize=4, fillstyle="none", label=f"{name} (paper)")
    axes.set_xticks(numbers, [f"{layout}\n{family}" for layout, family in chosen], rotation=60, fontsize=8)
    axes.set_ylabel("mean return of an episode")
    axes.axhline(0, color="gray", linewidth=0.6)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, ncols=6, fontsize=8, loc="outside lower center", frameon=False)
    axes.set_title(f"Test tasks with headroom, protocol {protocol}; the paper's numbers are of published", fontsize=10)
    save_figure(figure, path)


def render_page(stored: StoredResults, agents: Sequence[str]) -> str:
    """Returns docs/results.md.

    Args:
        stored: the results.
        agents: the agents of the tables of cells, in their order.
    """
    rising = [agent for agent in agents if not agent.endswith(FORGETS)]
    cleared = {one: f"`{one.removesuffix(FORGETS)}`, its memory cleared at the start of each episode" for one in agents}
    texts = stored.about | {one: text for one, text in cleared.items() if one.endswith(FORGETS)}
    about = "\n".join(f"* `{agent}`: {text}" for agent, text in texts.items())
    return fill_template(
        "results.md",
        about=about,
        summary=summary_table(stored, "seeded"),
        teammate=cells_table(stored, "seeded", "teammate", rising),
        layout=cells_table(stored, "seeded", "layout", rising),
        published_teammate=cells_table(stored, "published", "teammate", rising),
        published_layout=cells_table(stored, "published", "layout", rising),
        published_summary=summary_table(stored, "published"),
        gains=gains_table(stored, "seeded", agents),
        validation=validation_table(stored, rising, "validation"),
        diverse=validation_table(stored, rising, "diverse"),
        windows=ablation_table(stored, "ablate windows"),
        contexts=ablation_table(stored, "ablate contexts"),
        unseen=unseen_table(stored),
        marks="\n".join(f"* {kind.mark}: {kind.meaning}" for kind in OVERLAPS.values()),
        references=", ".join(map(_code, REFERENCES)),
        forgets=f"`NAME{FORGETS}`",
        drawn=str(MOST_DRAWN),
        cells=str(len(cells_with_headroom("seeded"))),
    )


def write_comparison(stored: StoredResults, folder: Path) -> list[Path]:
    """Write the page and its figure into a folder. Returns their paths.

    Raises:
        OptionError: if there are no results.
    """
    agents = shown_agents(stored)
    if not agents:
        raise OptionError("no stored results: give folders that `icrl4aht-data evaluate` made")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in RESULTS_BEGINS]
    paths[0].write_text(render_page(stored, agents), encoding="utf-8")
    plot_comparison(stored, "seeded", drawn_agents(stored), paths[1])
    return paths


def drawn_agents(stored: StoredResults) -> list[str]:
    """Returns the agents of the figure, in the order in which they were stored.

    They are the `MOST_DRAWN` with the highest normalised return of those with all cells, none of which they have met
    the teammates of.
    """
    chosen = cells_with_headroom("seeded")
    scores = {
        agent: normalised_interval(stored.cells[agent, "seeded"], "seeded", chosen)[0]
        for agent in stored.agents("seeded")
        if not agent.endswith(FORGETS)
        and all(cell in stored.cells[agent, "seeded"] for cell in chosen)
        and all(one == "family" for cell in chosen for one in stored.cells[agent, "seeded"][cell].overlaps)
    }
    best = sorted(scores, key=scores.__getitem__, reverse=True)[:MOST_DRAWN]
    return [agent for agent in scores if agent in best]


def shown_agents(stored: StoredResults) -> list[str]:
    """Returns the agents that have results, in the order in which they were stored."""
    return list(dict.fromkeys(agent for agent, protocol in stored.cells if protocol not in (*ABLATIONS, UNSEEN)))
