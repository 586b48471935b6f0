"""Summaries of selections and tasks, which the commands `list` and `show` print."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np
from rich.table import Table

from icrl4aht_data.dataset import Dataset
from icrl4aht_data.fetch import Remote
from icrl4aht_data.format.info import make_info
from icrl4aht_data.format.schema import FIELDS, Entry
from icrl4aht_data.reading.history import LABELS
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.text import counted_noun

_IDS_SHOWN = 11  # maximum number of characters of a task's history ids in the table


def summarize_tasks(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return a JSON object for each task of `entries`, with names, counts, returns and labels."""
    return [
        {
            "task_id": task_id,
            "layout": some[0].layout,
            "track": some[0].track,
            "split": some[0].split,
            "teammate": f"{some[0].teammate_family}/{some[0].teammate_kind}",
            "histories": len(some),
            "learners": len({entry.learner for entry in some}),
            "transitions": sum(entry.T for entry in some),
            "return_start": fmean(entry.return_start for entry in some),
            "return_end": fmean(entry.return_end for entry in some),
            "source": some[0].source,
            "labels": [kind for kind in LABELS if all(entry.has(FIELDS[f"{kind}_actions"]) for entry in some)],
            "label_view": some[0].label_view,
            "expert_return": some[0].expert_return,
            "expert_return_sampled": some[0].expert_return_sampled,
            "history_ids": [entry.history_id for entry in some],
        }
        for task_id, some in grouped(entries, lambda entry: entry.task_id).items()
    ]


def task_table(tasks: Sequence[dict[str, Any]]) -> Table:
    """Return a table of the result of `summarize_tasks`, with two lines per task and a last row with totals.

    The table fits 80 columns: names of teammates wrap, only the end of a task's id is shown, and long lists of
    history ids are omitted. `list | cat` prints the complete ids.
    """
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), show_footer=True, row_styles=("", "dim"))
    steps, histories = (sum(task[name] for task in tasks) for name in ("transitions", "histories"))
    table.add_column("layout\nsplit", footer=counted_noun(len(tasks), "task"), no_wrap=True)
    table.add_column("teammate", overflow="fold")
    table.add_column("source", no_wrap=True)
    table.add_column("hist.\nsteps", footer=f"{histories:,}\n{steps:,}", justify="right", no_wrap=True)
    table.add_column("return", no_wrap=True)
    table.add_column("labels", no_wrap=True)
    table.add_column("task\nhist. ids", no_wrap=True)
    for task in tasks:
        earned = "" if task["expert_return"] is None else f" {task['expert_return']:.1f}"
        seen = "" if task["label_view"] is None else f"\n of {task['label_view']}"  # a new line keeps the column narrow
        ids = id_ranges(task["history_ids"])
        table.add_row(
            f"{task['layout']}\n{task['split']}",
            task["teammate"].replace("/", " "),
            task["source"],
            f"{task['histories']:,}\n{task['transitions']:,}",
            f"{task['return_start']:.1f}→{task['return_end']:.1f}",
            "\n".join(kind + (earned + seen) * (kind == "expert") for kind in task["labels"]) or "none",
            f"{task['task_id'][-8:]}\n{ids if len(ids) <= _IDS_SHOWN else '…'}",
        )
    return table


def id_ranges(ids: Sequence[int]) -> str:
    """Return ids as a string of ranges in ascending order, such as "3,158-163"."""
    numbers = set(ids)
    firsts = sorted(number for number in numbers if number - 1 not in numbers)
    lasts = sorted(number for number in numbers if number + 1 not in numbers)
    pairs = zip(firsts, lasts, strict=True)
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in pairs)


def layout_table(dataset: Dataset) -> Table:
    """Return a table of a selection that fits 80 columns, with one row per layout and a last row with totals."""
    table = Table(box=None, pad_edge=False, show_footer=True)
    columns = [dataset.column(name) for name in ("return_start", "return_end", "T", "episodes")]
    numbers, tasks = dataset.layout_numbers, dataset.column_codes("task_id")

    def row(name: str, members: np.ndarray) -> list[str]:
        start, end, steps, episodes = (column[members] for column in columns)
        counts = [len(np.unique(tasks[members])), int(members.sum()), int(episodes.sum()), int(steps.sum())]
        return [name, *(f"{count:,}" for count in counts), f"{start.mean():.1f}", f"{end.mean():.1f}"]

    headings = ("layout", "tasks", "histories", "episodes", "steps", "return at start", "at end")
    for heading, total in zip(headings, row("total", np.ones(len(dataset), bool)), strict=True):
        table.add_column(heading, footer=total, justify="left" if heading == "layout" else "right", overflow="fold")
    for number, layout in enumerate(dataset.layouts):
        table.add_row(*row(layout.name, numbers == number))
    return table


def fact_lines(facts: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    """Yield a mapping as lines of text for a terminal; nested mappings are indented."""
    for name, value in facts.items():
        label = indent + name.replace("_", " ")
        if isinstance(value, dict):
            yield label
            yield from fact_lines(value, indent + "  ")
        elif name == "map":
            yield label
            yield from (f"{indent}  {row}" for row in value)
        else:
            words = value if isinstance(value, list) else ["unknown" if value is None else value]
            yield f"{label}: {', '.join(map(str, words))}"


def tab_separated(rows: Iterable[Iterable[Any]]) -> str:
    """Return rows as lines of tab-separated values; values other than strings and numbers are printed as JSON."""
    texts = (["" if one is None else one if isinstance(one, str) else json.dumps(one) for one in row] for row in rows)
    return "\n".join("\t".join(row) for row in texts)


def summarize_selection(dataset: Dataset) -> dict[str, Any]:
    """Return a JSON object with the location, kind, versions and counts of a selection."""
    info, origin = dataset.info, dataset.origin
    content = make_info(
        info.kind, info.data_version, info.environment.kept_steps, dataset.entries, info.format_version
    ).to_json()
    return {
        "summary": repr(dataset),
        "root": str(origin),
        **({"revision": origin.revision, "folder": str(origin.folder)} if isinstance(origin, Remote) else {}),
        **content,
        "splits": dataset.counts("split"),
        "sources": dataset.counts("source"),
        "learners": len(np.unique(dataset.column("learner"))),
        "labels": dataset.counts("labels"),
        "label_views": dataset.counts("label_view"),
        "cache": f"{dataset.cache.cache}: {dataset.cache.reason}",
    }
