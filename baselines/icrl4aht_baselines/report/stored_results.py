"""Results of agents that are stored in cards/results.csv.xz, for the page docs/results.md."""

from __future__ import annotations

import lzma
from collections import defaultdict
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from icrl4aht_baselines.agents.egos import OTHER_WAYS
from icrl4aht_baselines.evaluate.protocols import CONTROLS
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.report.results import (
    TABLE_COLUMNS,
    TEST_LAYOUTS,
    AgentReturns,
    as_run,
    bundled_tasks_by_id,
    returns_by_cell,
)
from icrl4aht_baselines.report.submission import SUBMITTED_PROTOCOL, AgentFacts, Submission
from icrl4aht_data.benchmark.facts import PREFERENCE
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write, write_json
from icrl4aht_data.utils.text import card_file, counted_noun

CURVE_COLUMNS = ["agent", "protocol", "control", "layout", "episode", "return"]


@dataclass(frozen=True)
class StoredResults:
    """Stored results of several agents: the content of the files results*.csv.xz and results.json in cards/.

    Attributes:
        table: table of results, see `results`.
        curves: mean return in each episode on a published layout's test tasks, over tasks, seeds and training runs,
            with the columns `CURVE_COLUMNS`.
        agents: name of an agent -> facts that tables state; agents are shown in this order.
    """

    table: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=TABLE_COLUMNS))
    curves: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=CURVE_COLUMNS))
    agents: dict[str, AgentFacts] = field(default_factory=dict)

    def returns(self, control: str = "") -> dict[str, AgentReturns]:
        """Return agents' results on the test tasks under the protocol of docs/results.md, in the order of `agents`.

        Args:
            control: "cleared" or "swapped", see `protocols.CONTROLS`, or another play mode, see `OTHER_WAYS`; empty for
                the agent's main results.
        """
        table = self.table
        chosen = (table["protocol"] == SUBMITTED_PROTOCOL) & (table["control"] == control)
        chosen &= table["kind"].isin(("test", PREFERENCE))
        found = dict(iter(table[chosen].groupby("agent", sort=False)))
        return {agent: returns_by_cell(found[agent]) for agent in [*self.agents] if agent in found}

    def with_other_play_modes(self, results: Mapping[str, AgentReturns]) -> dict[str, AgentReturns]:
        """Return `results` with each agent's other way to act, such as "rl2 (greedy)", after the agent."""
        others, found = {way: self.returns(way) for way in OTHER_WAYS}, {}
        for agent, own in results.items():
            found[agent] = own
            found |= {f"{agent} ({way})": of[agent] for way, of in others.items() if agent in of}
        return found


def results_file() -> Path:
    """Return the path of results.json among the package's cards; the tables are stored next to this file."""
    return card_file("best_responses.json").with_name("results.json")


def _table_paths(path: Path) -> tuple[Path, Path]:
    return path.with_suffix(".csv.xz"), path.with_name(f"{path.stem}_curves.csv.xz")


def read_stored(path: Path) -> StoredResults:
    """Return the results that are stored in a JSON file and in tables next to it.

    Raises:
        OptionError: if a file is missing or damaged.
    """
    table, curves = _table_paths(path)
    try:
        agents = msgspec.json.decode(path.read_bytes(), type=dict[str, AgentFacts])
        kinds = {"task": str, "block": str}
        frames = [pd.read_csv(file, keep_default_na=False, dtype=kinds) for file in (table, curves)]
        return StoredResults(frames[0][TABLE_COLUMNS], frames[1][CURVE_COLUMNS], agents)
    except (OSError, EOFError, lzma.LZMAError, ValueError, KeyError) as error:
        raise OptionError(
            f"{path}: not stored results: {error!r}; restore this file, {table.name} and {curves.name}"
        ) from error


def write_stored(path: Path, stored: StoredResults) -> None:
    """Write results to a JSON file and two tables next to it. Results have three decimals, curves have two."""
    for file, frame, digits in zip(_table_paths(path), (stored.table, stored.curves), (3, 2), strict=True):
        with atomic_write(file) as partial:
            text = frame.round(digits).to_csv(index=False, lineterminator="\n")
            # LZMA's output has half the size of gzip's.
            partial.write_bytes(lzma.compress(text.encode(), preset=lzma.PRESET_EXTREME | 9))
    write_json(path, msgspec.to_builtins(stored.agents))


def _check_update(stored: StoredResults, found: Submission, where: str) -> None:
    """Check that `Submission.update` is set if the submission's agent is already stored, and only then."""
    known = {agent.casefold(): agent for agent in stored.agents}.get(found.agent.casefold())
    if known and not found.update:
        raise OptionError(
            f"{where}: the page already has results of an agent {known}; give `icrl4aht-data submit` another --name, "
            f"or --update if these are new results of the same agent"
        )
    if found.update and found.agent != known:
        raise OptionError(f"{where}: updates the agent {found.agent}, which is not on the page; leave out --update")


def _check_training_runs(table: pd.DataFrame, agent: str, where: str) -> None:
    """Check that an agent has the same training runs on all layouts of a kind.

    Controls must have all of these runs, because M and P are compared with the agent's main results. Results of another
    play mode may have some of the runs.
    """
    own = table[(table["agent"] == agent) & (table["protocol"] == SUBMITTED_PROTOCOL)]
    runs = {key: {*of["training"]} for key, of in own.groupby(["kind", "control", "layout"])}
    first: dict[tuple[Hashable, Hashable], set[int]] = {}
    for (kind, control, layout), trainings in runs.items():
        elsewhere = first.setdefault((kind, control), trainings)
        main = runs.get((kind, "", layout), trainings)
        if trainings != elsewhere or not (trainings == main if control in CONTROLS else trainings <= main):
            expected = elsewhere if trainings != elsewhere else main
            named = f" with control `{control}`" if control in CONTROLS else ""
            raise OptionError(
                f"{where}: with the stored results, {agent} would have training runs {sorted(trainings)} on "
                f"{layout}{named}, but {sorted(expected)} in its other results; give results of the same runs"
            )


def describe_removed(before: StoredResults, after: StoredResults, agent: str) -> list[str]:
    """Describe the stored results that an agent loses by an update, one line for each protocol, kind and control.

    Args:
        before: stored results before the update.
        after: stored results after the update.
        agent: name of the agent.
    """

    def runs(stored: StoredResults) -> dict[Any, set[tuple[int, str]]]:
        table = stored.table[stored.table["agent"] == agent]
        return {
            key: {*zip(of["training"], of["layout"], strict=True)}
            for key, of in table.groupby(["protocol", "kind", "control"])
        }

    kept, lines = runs(after), []
    for (protocol, kind, control), had in runs(before).items():
        if lost := had - kept.get((protocol, kind, control), set()):
            numbers, layouts = ({*values} for values in zip(*lost, strict=True))
            named = f"`{control}`, " if control else ""
            lines.append(
                f"{named}protocol {protocol}, {kind} tasks: training runs {', '.join(map(str, sorted(numbers)))} on "
                f"{counted_noun(len(layouts), 'layout')}"
            )
    return lines


def add_submission(stored: StoredResults, found: Submission, where: str = "submission") -> StoredResults:
    """Return stored results plus submitted ones.

    If `Submission.update` is set, they replace the agent's stored results on the same layouts.

    Args:
        stored: stored results.
        found: submitted results.
        where: name of the submission in messages.

    Raises:
        OptionError: if `Submission.update` is set for an agent that is not stored, or not set for a stored agent, or if
            the agent would have different training runs on the layouts of a kind of tasks.
    """
    _check_update(stored, found, where)
    controls = {one.control for one in found.evaluations}
    tables, curves, tasks = [], defaultdict(list), [*bundled_tasks_by_id("test", tuple(found.tracks)).values()]
    for one in found.evaluations:
        run = as_run([Result(task, one.settings, returns) for task, returns in one.returns.items()], found.agent, tasks)
        tables.append(run.table.assign(agent=found.agent, training=one.training, control=one.control))
        for cell, returns in run.cells.items():
            if cell.layout in TEST_LAYOUTS:  # `plot_comparison` draws no others
                curves[one.control, cell.layout].append(returns)
    rows = [
        (found.agent, SUBMITTED_PROTOCOL, control, layout, episode, value)
        for (control, layout), parts in curves.items()
        for episode, value in enumerate(np.concatenate(parts).mean(axis=0).tolist(), start=1)
    ]

    def replace_rows(old: pd.DataFrame, new: pd.DataFrame) -> pd.DataFrame:
        is_replaced = (old["agent"] == found.agent) & (old["control"].isin(controls) | ("" in controls))
        is_replaced &= old["layout"].isin(new["layout"].unique())
        return pd.concat([part for part in (old[~is_replaced], new) if len(part)], ignore_index=True)

    table = replace_rows(stored.table, pd.concat(tables, ignore_index=True))
    _check_training_runs(table, found.agent, where)
    facts = found.facts if "" in controls else stored.agents[found.agent]
    return StoredResults(
        table,
        replace_rows(stored.curves, pd.DataFrame(rows, columns=CURVE_COLUMNS)),
        stored.agents | {found.agent: facts},
    )
