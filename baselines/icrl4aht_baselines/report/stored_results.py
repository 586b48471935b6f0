"""The stored results of reference models, `cards/results.json`.

For each agent and protocol, it has what each test task and seed earned: the mean return, and those of the first and the
last 20 episodes. Ablations are stored in the same way, with the ablation's name in place of the protocol, and so are
returns on unseen layouts.

Shapes: U tasks, S seeds with which each was played.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from icrl4aht_baselines.evaluate.results import read_result
from icrl4aht_baselines.report.results import (
    EvaluationRun,
    cell_of,
    cell_order,
    group_of,
    published_instances,
    read_run,
)
from icrl4aht_baselines.training.ablations import ABLATIONS, ExperimentEntry
from icrl4aht_baselines.training.run_folder import CONFIG, read_config
from icrl4aht_data.benchmark.reference_returns import Cell
from icrl4aht_data.errors import IndexFormatError, OptionError, unknown
from icrl4aht_data.utils.files import atomic_write, parse_json, read_text
from icrl4aht_data.utils.templates import card_file

ENDS = 20
"""Episodes at each end of a task for the adaptation gain (paper, App. F)."""

UNSEEN = "unseen"
"""In place of a protocol: results on rearranged layouts, see `icrl4aht_baselines.online.unseen`; a task for each of them."""

_NUMBERS = ("mean", "first", "last", "opening")
_DIGITS = 3


class CellReturns(NamedTuple):
    """Returns of an agent in one cell, a number for each task and seed.

    Attributes:
        mean: float64 (U, S), over all episodes.
        first: float64 (U, S), over the first `ENDS` episodes.
        last: float64 (U, S), over the last `ENDS`.
        opening: float64 (U, S), of the very first episode.
        overlaps: overlap of training data and tasks, see `icrl4aht_baselines.report.overlap.OVERLAPS`.
    """

    mean: Float[np.ndarray, "U S"]
    first: Float[np.ndarray, "U S"]
    last: Float[np.ndarray, "U S"]
    opening: Float[np.ndarray, "U S"]
    overlaps: tuple[str, ...] = ()

    @property
    def gain(self) -> Float[np.ndarray, "U S"]:
        """Returns of the last episodes minus those of the first."""
        return self.last - self.first


@dataclass(frozen=True)
class StoredResults:
    """Results of several agents.

    Attributes:
        cells: (agent, protocol) -> cell -> returns. Entries of ablations are stored like agents, with the experiment's
            name instead of a protocol; results on unseen layouts with `UNSEEN`.
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
    if mean.ndim != 2:
        raise ValueError(f"mean of shape {mean.shape}, expected tasks and seeds")
    return CellReturns(mean, first, last, opening, tuple(found["overlaps"]))


def write_stored(path: Path, stored: StoredResults) -> None:
    """Write stored results."""
    agents: dict[str, Any] = {}
    for (agent, protocol), cells in stored.cells.items():
        for (layout, family), numbers in _numbers(cells).items():
            of_protocol = agents.setdefault(agent, {}).setdefault(protocol, {})
            overlaps = list(cells[layout, family].overlaps)
            of_protocol.setdefault(layout, {})[family] = numbers | {"overlaps": overlaps}
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
            episodes or a published one is missing, or if nothing says how a new agent was made.
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
        parts.setdefault(cell_of(tasks[result.task_id]), []).append(returns)
    found = {}
    for cell in sorted(parts, key=cell_order):
        if group_of(cell) == "test" and not run.is_complete(cell):
            raise OptionError(
                f"{folder}: {len(parts[cell])} of the {published_instances(cell)} published tasks of {' '.join(cell)}; "
                f"evaluate all of them"
            )
        found[cell] = _parts(np.stack(parts[cell]))._replace(overlaps=run.overlaps([cell]))
    return found


def _parts(returns: Float[np.ndarray, "U S E"]) -> CellReturns:
    """Returns the parts of the returns of all episodes."""
    first, last = returns[..., :ENDS], returns[..., -ENDS:]
    return CellReturns(returns.mean(axis=-1), first.mean(axis=-1), last.mean(axis=-1), returns[..., 0])


def add_unseen(stored: StoredResults, returns: Mapping[str, Mapping[Cell, Float[np.ndarray, "V E"]]]) -> StoredResults:
    """Returns stored results with those on unseen layouts, V of each cell; equal cells are replaced."""
    cells = dict(stored.cells)
    for agent, found in returns.items():
        key = agent, UNSEEN
        cells[key] = cells.get(key, {}) | {cell: _parts(values[:, None]) for cell, values in found.items()}
    return StoredResults(cells, stored.about)


def add_ablation(stored: StoredResults, name: str, folder: Path) -> StoredResults:
    """Returns stored results with those of an ablation.

    Entries that the folder does not have stay as they are stored if the first entry, to which all are compared, has
    equal returns in both; otherwise they are of other data or another version, and go.

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
    first = ablation.entries[0].name, name
    cells: dict[tuple[str, str], dict[Cell, CellReturns]] = {}
    for entry in ablation.entries:
        found: dict[Cell, CellReturns] = {}
        for results in sorted(folder.glob(f"{ablation.method}-{entry.name}/*/results")):
            run = results.parents[1].with_name(f"{ablation.method}-{entry.run_of or entry.name}") / results.parent.name
            _check_entry(entry, run / "run", folder / f"{ablation.method}-{first[0]}" / results.parent.name / "run")
            found |= _cell_returns(results, read_run(results))
        others = sorted({group_of(cell) for cell in found} - {"diverse"})
        if others:
            raise OptionError(f"{folder}: {entry.name} has results of {', '.join(others)} tasks, expected diverse ones")
        if found:
            cells[entry.name, name] = found
    if first not in cells:
        raise OptionError(
            f"{folder}: no results of {first[0]}; expected a folder that `icrl4aht-data research {name}` made"
        )
    same = first in stored.cells and _numbers(stored.cells[first]) == _numbers(cells[first])
    kept = {key: found for key, found in stored.cells.items() if key[1] != name or same}
    return StoredResults(kept | cells, stored.about)


def _numbers(cells: Mapping[Cell, CellReturns]) -> dict[Cell, dict[str, list[float]]]:
    """Returns the numbers of cells as they are stored."""
    return {
        cell: {name: np.round(getattr(found, name), _DIGITS).tolist() for name in _NUMBERS}
        for cell, found in cells.items()
    }


_SHARED = (("train", "steps"), ("train", "seed"), ("histories", "manifest_sha256"))
"""Settings that all entries of an ablation share."""


def _check_entry(entry: ExperimentEntry, run: Path, first: Path) -> None:
    """Check that a run has the settings of an entry, and shares the others with the run of the first entry."""
    config = read_config(run)
    given: dict[str, dict[str, Any]] = {"model": entry.model, "train": entry.train, "histories": entry.histories}
    expected = {(part, name): value for part, values in given.items() for name, value in values.items()}
    if (first / CONFIG).is_file():
        of_first = read_config(first)
        expected |= {(part, name): of_first[part].get(name) for part, name in _SHARED}
    for (part, name), value in expected.items():
        if config[part].get(name) != value:
            raise OptionError(
                f"{run}: {name} = {config[part].get(name)!r}, expected {value!r}, as "
                f"{first.parents[1].name if (part, name) in _SHARED else entry.name} has it; train it again with this "
                f"version"
            )
