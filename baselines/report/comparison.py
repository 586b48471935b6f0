"""The page docs/results.md, which compares reference models with the reference egos and the paper's numbers.

`cards/results.json` has, for each agent and protocol, what each test task and seed earned: the mean return, and those
of the first and the last 20 episodes. The page is computed from it, from the returns of the reference egos and from the
paper's numbers.

Shapes: U pairs of a task and a seed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from baselines.agents.egos import FORGETS
from baselines.evaluate.results import read_result
from baselines.report.overlap import OVERLAPS
from baselines.report.results import (
    PUBLISHED_PROTOCOL,
    EvaluationRun,
    cell_of,
    cell_order,
    family_of,
    group_of,
    normalized_return,
    published_cells,
    published_instances,
    read_run,
)
from baselines.report.summary import bootstrap_interval
from baselines.training.ablations import ABLATIONS, ExperimentEntry
from baselines.training.run_folder import read_config
from icrl4aht_data.benchmark.facts import FAMILIES, TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES, Cell, has_headroom, read_headroom
from icrl4aht_data.errors import IndexFormatError, OptionError, unknown
from icrl4aht_data.plotting import new_figure, save_figure
from icrl4aht_data.utils.files import atomic_write, parse_json, read_text
from icrl4aht_data.utils.templates import card_file, fill_template, markdown_table

ENDS = 20
"""Episodes at each end of a task for the adaptation gain (paper, App. F)."""

RESULTS_BEGINS: dict[str, bytes | None] = {"results.md": b"# Results: reference models\n", "results.png": None}
"""Files of the page -> their first bytes, by which they are recognised before they are replaced."""

_NUMBERS = ("mean", "first", "last", "opening")
_PAPER = ("AD", "DPT")
_RESAMPLES = 10_000
_DIGITS = 3


class CellReturns(NamedTuple):
    """Returns of an agent in one cell, a number for each pair of a task and a seed.

    Attributes:
        mean: float64 (U,), over all episodes.
        first: float64 (U,), over the first `ENDS` episodes.
        last: float64 (U,), over the last `ENDS`.
        opening: float64 (U,), of the very first episode.
        overlaps: overlap of training data and tasks, see `baselines.report.overlap.OVERLAPS`.
    """

    mean: Float[np.ndarray, " U"]
    first: Float[np.ndarray, " U"]
    last: Float[np.ndarray, " U"]
    opening: Float[np.ndarray, " U"]
    overlaps: tuple[str, ...] = ()

    @property
    def gain(self) -> Float[np.ndarray, " U"]:
        """Returns of the last episodes minus those of the first."""
        return self.last - self.first


@dataclass(frozen=True)
class StoredResults:
    """Results of several agents.

    Attributes:
        cells: (agent, protocol) -> cell -> returns. Entries of ablations are stored like agents, with the experiment's
            name instead of a protocol.
        about: agent -> one sentence on how it was made.
    """

    cells: dict[tuple[str, str], dict[Cell, CellReturns]]
    about: dict[str, str]

    def agents(self, protocol: str) -> list[str]:
        """Returns the agents with results under a protocol."""
        return [agent for agent, name in self.cells if name == protocol]


def results_file() -> Path:
    """Returns the path of the stored results."""
    return card_file("published.json").with_name("results.json")


def read_stored(path: Path) -> StoredResults:
    """Returns stored results; none if there is no file.

    Raises:
        OptionError: if the file is damaged.
    """
    if not path.is_file():
        return StoredResults({}, {})
    try:
        content = parse_json(read_text(path))
        cells = {
            (agent, protocol): {
                (layout, family): _stored_cell(found)
                for layout, families in layouts.items()
                for family, found in families.items()
            }
            for agent, protocols in content["agents"].items()
            for protocol, layouts in protocols.items()
        }
        return StoredResults(cells, dict(content["about"]))
    except (IndexFormatError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise OptionError(f"{path}: not stored results: {error!r}; restore the file") from error


def _stored_cell(found: Mapping[str, Any]) -> CellReturns:
    mean, first, last, opening = (np.array(found[name], np.float64) for name in _NUMBERS)
    return CellReturns(mean, first, last, opening, tuple(found["overlaps"]))


def write_stored(path: Path, stored: StoredResults) -> None:
    """Write stored results."""
    agents: dict[str, Any] = {}
    for (agent, protocol), cells in stored.cells.items():
        for (layout, family), found in cells.items():
            of_protocol = agents.setdefault(agent, {}).setdefault(protocol, {})
            numbers = {name: np.round(getattr(found, name), _DIGITS).tolist() for name in _NUMBERS}
            of_protocol.setdefault(layout, {})[family] = numbers | {"overlaps": list(found.overlaps)}
    with atomic_write(path) as partial:
        text = json.dumps({"about": stored.about, "agents": agents}, separators=(",", ":"))
        partial.write_text(text.replace('"mean"', '\n"mean"') + "\n", encoding="utf-8")


def add_results(stored: StoredResults, folder: Path, about: str) -> StoredResults:
    """Returns stored results with those of a folder that `evaluate` made; equal cells are replaced.

    Args:
        stored: the results so far.
        folder: the folder.
        about: one sentence on how the agent was made; empty to keep the stored one.

    Raises:
        OptionError: if the folder has no results, or mixed ones, if a task was played for fewer than 2 x `ENDS`
            episodes, or if nothing says how a new agent was made.
    """
    run = read_run(folder)
    found = _cell_returns(folder, run)
    key = run.agent, run.protocol
    cells = stored.cells | {key: stored.cells.get(key, {}) | found}
    about = about or stored.about.get(run.agent, "")
    if not about:
        raise OptionError(f"{folder}: results of {run.agent}, a new agent: say how it was made by --about")
    return StoredResults(cells, stored.about | {run.agent: about})


def _cell_returns(folder: Path, run: EvaluationRun) -> dict[Cell, CellReturns]:
    tasks = {task.task_id: task for source in run.sources for played in source.tasks.values() for task in played}
    parts: dict[Cell, list[np.ndarray]] = {}
    for path in sorted((folder / "tasks").glob("*.json")):
        result = read_result(path)
        returns = np.array(result.returns, np.float64)
        if returns.shape[1] < 2 * ENDS:
            raise OptionError(f"{path}: {returns.shape[1]} episodes, expected at least {2 * ENDS}; evaluate more")
        ends = returns[:, :ENDS].mean(axis=1), returns[:, -ENDS:].mean(axis=1), returns[:, 0]
        parts.setdefault(cell_of(tasks[result.task_id]), []).append(np.stack([returns.mean(axis=1), *ends]))
    found = {}
    for cell in sorted(parts, key=cell_order):
        mean, first, last, opening = np.concatenate(parts[cell], axis=1)
        found[cell] = CellReturns(mean, first, last, opening, run.overlaps([cell]))
    return found


def cells_with_headroom(protocol: str) -> list[Cell]:
    """Returns the test cells with headroom under a protocol, in the paper's order."""
    return sorted((cell for cell, egos in read_headroom(protocol).items() if has_headroom(egos)), key=cell_order)


def normalised_interval(cells: Mapping[Cell, CellReturns], protocol: str) -> tuple[float, float, float, int]:
    """Returns the mean normalised return of the cells with headroom, its 95 % interval, and the number of cells.

    The interval is a bootstrap over the pairs of a task and a seed within each cell; cells are not resampled.
    """
    headroom, rng = read_headroom(protocol), np.random.default_rng(0)
    drawn, means = [], []
    for cell in (cell for cell in cells_with_headroom(protocol) if cell in cells):
        values = np.array([normalized_return(value, headroom[cell]) for value in cells[cell].mean], np.float64)
        means.append(values.mean())
        drawn.append(rng.choice(values, (_RESAMPLES, len(values))).mean(axis=1))
    if not means:
        return float("nan"), float("nan"), float("nan"), 0
    low, high = np.percentile(np.mean(drawn, axis=0), (2.5, 97.5))
    return float(np.mean(means)), float(low), float(high), len(means)


def rising_cells(cells: Mapping[Cell, CellReturns], protocol: str) -> list[Cell]:
    """Returns the cells with headroom whose gain is positive with its 95 % interval above 0."""
    chosen = [cell for cell in cells_with_headroom(protocol) if cell in cells]
    return [cell for cell in chosen if gain_interval(cells[cell])[0] > 0]


def gain_interval(found: CellReturns) -> tuple[float, float]:
    """Returns the 95 % bootstrap interval of the mean gain in a cell, over the pairs of a task and a seed."""
    return bootstrap_interval(found.gain, np.random.default_rng(0))


def summary_table(stored: StoredResults, protocol: str) -> str:
    """Returns a table with a row for each agent: normalised return, cells that rise.

    Under the paper's protocol it also has the layouts where the agent earns more than the paper's methods.
    """
    rows = []
    for agent in stored.agents(protocol):
        cells = stored.cells[agent, protocol]
        mean, low, high, count = normalised_interval(cells, protocol)
        rising = rising_cells(cells, protocol)
        rows.append(
            [
                _code(agent) + _marks(one for found in cells.values() for one in found.overlaps),
                f"{mean:.2f} ({low:.2f} to {high:.2f})",
                str(count),
                f"{len(rising)} of {count}",
                _opening_text(cells, protocol),
            ]
        )
        if protocol == PUBLISHED_PROTOCOL:
            rows[-1].append(", ".join(layouts_above_paper(cells)) or "none")
    header = ["agent", "normalised return", "cells", "rising", "first episode to last 20"]
    paper = ["layouts above the paper's AD and DPT"] if protocol == PUBLISHED_PROTOCOL else []
    return markdown_table([*header, *paper], rows)


def _opening_text(cells: Mapping[Cell, CellReturns], protocol: str) -> str:
    """Returns the mean return of the first episode and of the last ones over the cells with headroom, and the 95 %
    interval of their difference, a bootstrap over the pairs of a task and a seed within each cell."""
    chosen = [cells[cell] for cell in cells_with_headroom(protocol) if cell in cells]
    if not chosen:
        return ""
    opening, last = (np.mean([getattr(found, name).mean() for found in chosen]) for name in ("opening", "last"))
    rng = np.random.default_rng(0)
    rises = [found.last - found.opening for found in chosen]
    drawn = np.mean([rng.choice(values, (_RESAMPLES, len(values))).mean(axis=1) for values in rises], axis=0)
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{opening:z.1f} to {last:z.1f}, {last - opening:+z.1f} ({low:+z.1f} to {high:+z.1f})"


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
    """Returns a table with a row for each cell of a track with headroom, and a column for each agent.

    The paper's methods have columns under its own protocol only.
    """
    headroom = read_headroom(protocol)
    paper = _PAPER if protocol == PUBLISHED_PROTOCOL else ()
    chosen = [cell for cell in cells_with_headroom(protocol) if cell[0] in TRACKS[track]["test"]]
    rows = []
    for cell in chosen:
        egos = [f"{headroom[cell][name]:z.1f}" for name in ("stay", "random")]
        published = [f"{published_cells(name)[cell[0]][cell[1]][0]:z.1f}" for name in paper]
        own = [_cell_text(stored.cells.get((agent, protocol), {}).get(cell)) for agent in agents]
        rows.append([*cell, *egos, *published, *own, f"{headroom[cell]['oracle']:z.1f}"])
    header = [
        "layout",
        "family",
        "stay",
        "random",
        *(f"{name} (paper)" for name in paper),
        *map(_code, agents),
        "oracle",
    ]
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
            text = f"{ends}, {found.gain.mean():+.1f} ({low:+.1f}, {high:+.1f})"
            row.append(f"**{text}**" if low > 0 else text)
        rows.append(row)
    return markdown_table(["layout", "family", *map(_code, agents)], rows)


def add_ablation(stored: StoredResults, name: str, folder: Path) -> StoredResults:
    """Returns stored results with those of an ablation, which replace what is stored of it.

    Args:
        stored: the results so far.
        name: one of `ABLATIONS`.
        folder: the experiment's.

    Raises:
        UnknownNameError: for an unknown ablation.
        OptionError: if the folder has no results of the first entry, a run whose settings are not the entry's, results
            with other teammates than diverse validation ones, or too few episodes, see `add_results`.
    """
    if name not in ABLATIONS:
        raise unknown("ablation", name, ABLATIONS)
    ablation = ABLATIONS[name]
    cells = {key: found for key, found in stored.cells.items() if key[1] != name}
    for entry in ablation.entries:
        found: dict[Cell, CellReturns] = {}
        for results in sorted(folder.glob(f"{ablation.method}-{entry.name}/*/results")):
            run = results.parents[1].with_name(f"{ablation.method}-{entry.run_of or entry.name}") / results.parent.name
            _check_entry(entry, run / "run")
            found |= _cell_returns(results, read_run(results))
        others = sorted({group_of(cell) for cell in found} - {"diverse"})
        if others:
            raise OptionError(f"{folder}: {entry.name} has results of {', '.join(others)} tasks, expected diverse ones")
        if found:
            cells[entry.name, name] = found
    first = ablation.entries[0].name
    if (first, name) not in cells:
        raise OptionError(f"{folder}: no results of {first}; expected a folder that `python -m baselines {name}` made")
    return StoredResults(cells, stored.about)


def _check_entry(entry: ExperimentEntry, run: Path) -> None:
    """Check that a run has the settings of an entry."""
    config = read_config(run)
    given = {"model": entry.model, "train": entry.train, "histories": entry.histories}
    for part, values in given.items():
        for name, expected in values.items():
            if config[part].get(name) != expected:
                raise OptionError(
                    f"{run}: {name} = {config[part].get(name)!r}, expected {expected!r}, as {entry.name} has it; "
                    f"train it again with this version"
                )


def ablation_table(stored: StoredResults, name: str) -> str:
    """Returns a table with a row for each entry of an ablation.

    Returns, their differences to the first entry, and gains are means over tasks and seeds, with 95 % bootstrap
    intervals.
    """
    rows = []
    first: Float[np.ndarray, " U"] | None = None
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
        return f"No results of `{name}` are stored."
    return markdown_table(["entry", "difference", "mean return", "to the first", "last 20 - first 20"], rows)


def _with_interval(values: Float[np.ndarray, " U"], sign: str = "") -> str:
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
    """Plot the mean returns of agents in the cells with headroom as bars, with `stay` and the oracle as marks."""
    headroom, chosen = read_headroom(protocol), cells_with_headroom(protocol)
    figure = new_figure(11, 4.2)
    axes, numbers = figure.subplots(), np.arange(len(chosen))
    width = 0.8 / max(1, len(agents))
    for number, agent in enumerate(agents):
        cells = stored.cells.get((agent, protocol), {})
        heights = [cells[cell].mean.mean() if cell in cells else np.nan for cell in chosen]
        met = _marks(one for found in cells.values() for one in found.overlaps if one != "family")
        label = f"{agent}{met} (see the marks)" if met else agent
        axes.bar(numbers - 0.4 + (number + 0.5) * width, heights, width, label=label)
    for name, style in (("oracle", "k_"), ("stay", "rx")):
        axes.plot(numbers, [headroom[cell][name] for cell in chosen], style, markersize=9, label=name)
    axes.set_xticks(numbers, [f"{layout}\n{family}" for layout, family in chosen], rotation=60, fontsize=8)
    axes.set_ylabel("mean return of an episode")
    axes.axhline(0, color="gray", linewidth=0.6)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(agents) + 2, fontsize=8, loc="outside lower center", frameon=False)
    axes.set_title(f"Test tasks with headroom, protocol {protocol}", fontsize=10)
    save_figure(figure, path)


def render_page(stored: StoredResults, agents: Sequence[str]) -> str:
    """Returns docs/results.md.

    Args:
        stored: the results.
        agents: the agents of the tables of cells, in their order.
    """
    rising = [agent for agent in agents if not agent.endswith(FORGETS)]
    about = "\n".join(f"* `{agent}`: {text}" for agent, text in stored.about.items())
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
        marks="\n".join(f"* {kind.mark}: {kind.meaning}" for kind in OVERLAPS.values()),
        references=", ".join(map(_code, REFERENCES)),
        forgets=f"`NAME{FORGETS}`",
        seeds=_seeds_text(stored),
        cells=str(len(cells_with_headroom("seeded"))),
    )


def write_comparison(stored: StoredResults, folder: Path) -> list[Path]:
    """Write the page and its figure into a folder. Returns their paths.

    Raises:
        OptionError: if there are no results.
    """
    agents = shown_agents(stored)
    if not agents:
        raise OptionError("no stored results: give folders that `python -m baselines evaluate` made")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in RESULTS_BEGINS]
    paths[0].write_text(render_page(stored, agents), encoding="utf-8")
    plot_comparison(stored, "seeded", [agent for agent in agents if not agent.endswith(FORGETS)], paths[1])
    return paths


def _seeds_text(stored: StoredResults) -> str:
    """Returns how often each agent played a test task under each protocol, as text."""
    texts = []
    for (agent, protocol), cells in stored.cells.items():
        if protocol in ABLATIONS:
            continue
        played = {
            len(found.mean) // published_instances(cell) for cell, found in cells.items() if published_instances(cell)
        }
        texts += [f"`{agent}`, {protocol} {' or '.join(map(str, sorted(played)))}"] if played else []
    return "; ".join(texts)


def shown_agents(stored: StoredResults) -> list[str]:
    """Returns the agents that have results, in the order in which they were stored."""
    return list(dict.fromkeys(agent for agent, protocol in stored.cells if protocol not in ABLATIONS))
