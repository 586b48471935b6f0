"""Tables of a dataset card: learning curves, teammates, labels, and what is not in the release."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from rich.console import Console

from icrl4aht_data.benchmark.facts import (
    KEPT_STEPS,
    LABEL_EPISODES,
    LEAST_HEADROOM,
    SAME_BEHAVIOUR,
    SOURCES,
    SPLITS,
    family_order,
)
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.format.info import LeftOutTask
from icrl4aht_data.format.provenance import NearestTest, Provenance, ReferenceEgos
from icrl4aht_data.format.schema import Entry, are_labels_weak
from icrl4aht_data.utils.templates import markdown_table
from icrl4aht_data.utils.text import counted_noun
from icrl4aht_data.writing.card_content import CardContent, share_risen
from icrl4aht_data.writing.card_texts import sentence

LEAST_RISE = 5.0
"""What the end of a history must exceed its start by to count as learning: a quarter of a delivery."""

LONGEST_TABLE = 60
"""Rows from which tables of tasks and teammates are summarized by layout and family."""

_EGOS = ("stay", "random", "oracle", "self-play")
_NAMES = 4  # columns of the table of learning curves that are no numbers


def curves_rows(release: CardContent) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of learning curves, by layout, source and split, and of totals.

    Args:
        release: the release.
    """
    filtered = any(of_task.filter for of_task in release.provenance.values())
    header = [
        "layout",
        "source",
        "split",
        "teammates",
        "tasks",
        "learners",
        "histories",
        "transitions",
        "first",
        "last",
    ]
    header += ["last, before the filter"] if filtered else []
    header.append(f"rise by {LEAST_RISE:g}")
    rows = []
    for (layout, source, split), members in _ordered_groups(release):
        rows.append([layout, source, split, *_curve_cells(release, members, filtered)])
    for title, layouts in _headroom_groups(release).items():
        for (source,), members in sorted(release.groups("source").items(), key=lambda item: _source_order(item[0][0])):
            own = [entry for entry in members if entry.layout in layouts]
            if own:
                rows.append([f"**{title}**", source, "all", *_curve_cells(release, own, filtered)])
    return header, rows


def curves_table(release: CardContent) -> str:
    """Return the table of learning curves."""
    header, rows = curves_rows(release)
    return markdown_table(header, rows, right=len(header) - _NAMES)


def _ordered_groups(release: CardContent) -> list[tuple[tuple[str, ...], list[Entry]]]:
    layouts = list(release.info.layouts)

    def order(item: tuple[tuple[str, ...], list[Entry]]) -> tuple[int, int, int]:
        layout, source, split = item[0]
        return layouts.index(layout), _source_order(source), SPLITS.index(split)

    return sorted(release.groups("layout", "source", "split").items(), key=order)


def _source_order(source: str) -> int:
    return SOURCES.index(source) if source in SOURCES else len(SOURCES)


def _headroom_groups(release: CardContent) -> dict[str, list[str]]:
    """Return title -> layouts of the rows of totals."""
    if len(release.headroom) < len(release.info.layouts):
        return {"all": list(release.info.layouts)}
    groups = {
        "with headroom": [layout for layout, has in release.headroom.items() if has],
        "without headroom": [layout for layout, has in release.headroom.items() if not has],
    }
    return {title: layouts for title, layouts in groups.items() if layouts}


def _curve_cells(release: CardContent, members: Sequence[Entry], filtered: bool) -> list[str]:
    tasks = list(dict.fromkeys(entry.task_id for entry in members))
    families = {entry.teammate_family for entry in members}
    learners = len({(entry.task_id, entry.learner) for entry in members if entry.source == "ppo"})
    cells = [" ".join(sorted(families, key=_learned_last))]
    numbers = len(tasks), learners or None, len(members), sum(entry.T for entry in members)
    cells += ["" if number is None else f"{number:,}" for number in numbers]
    cells += [_mean(entry.return_start for entry in members), _mean(entry.return_end for entry in members)]
    if filtered:
        filters = [release.provenance.get(task, Provenance()).filter for task in tasks]
        cells.append("" if None in filters else _mean(found.before.return_end for found in filters if found))
    return [*cells, f"{share_risen(members, LEAST_RISE):.0%}"]


def _learned_last(family: str) -> tuple[bool, tuple[int, str]]:
    return family == "rl", family_order(family)


def _mean(values: Iterable[float]) -> str:
    return f"{float(np.mean(list(values))):z.1f}"


class CardTeammate(NamedTuple):
    """One teammate of a release on one layout.

    Attributes:
        layout: short name of the layout.
        split: the split of its tasks.
        family: of `all_families`.
        name: family or algorithm and number, such as "H3/t12".
        seed: the seed that its parameters were drawn with, or of its population.
        sources: how the histories with it were made.
        references: returns of the reference egos with it, if they were measured.
        nearest: the test teammate that acts most like it, if that was determined.
    """

    layout: str
    split: str
    family: str
    name: str
    seed: int | None
    sources: tuple[str, ...]
    references: ReferenceEgos | None
    nearest: NearestTest | None


def card_teammates(release: CardContent) -> list[CardTeammate]:
    """Return the teammates of a release, each once, by layout, split and family."""
    found: dict[tuple[str, str, str], tuple[Task, list[str]]] = {}
    for task in release.tasks:
        found.setdefault((*task.teammate_key, task.split), (task, []))[1].append(task.task_id)
    teammates = []
    for (layout, _, split), (task, ids) in found.items():
        sources = {entry.source for task_id in ids for entry in release.histories.get(task_id, ())}
        provenance = [release.provenance.get(task_id, Provenance()) for task_id in ids]
        teammates.append(
            CardTeammate(
                layout=layout,
                split=split,
                family=task.teammate_family,
                name=teammate_name(task),
                seed=task.teammate.get("base_seed"),
                sources=tuple(sorted(sources, key=_source_order)),
                references=next((of_task.references for of_task in provenance if of_task.references), None),
                nearest=next((of_task.nearest_test for of_task in provenance if of_task.nearest_test), None),
            )
        )
    layouts = list(release.info.layouts)
    return sorted(
        (mate for mate in teammates if mate.layout in layouts),
        key=lambda mate: (layouts.index(mate.layout), SPLITS.index(mate.split), _learned_last(mate.family)),
    )


def teammate_name(task: Task) -> str:
    """Family of a task's heuristic, or its algorithm, and number of the parameters, such as "H3/t12"."""
    family = task.teammate_kind if task.teammate_family == "rl" else task.teammate_family
    return f"{family}/t{task.teammate.get('theta_id', 0)}"


def teammates_table(release: CardContent) -> str:
    """Return a table of the teammates, by layout and family if it would be long, with an explanation.

    It is empty if nothing is known about how they act.
    """
    mates = card_teammates(release)
    if not any(mate.references or mate.nearest for mate in mates):
        return sentence("unmeasured_teammates")
    least = {"least": f"{LEAST_HEADROOM:g}", "same": f"{SAME_BEHAVIOUR:g}"}
    parts = [sentence("teammates_table", **_reference_episodes(mates), **least), behaviours_in_words(mates)]
    table = _long_teammates(mates) if len(mates) <= LONGEST_TABLE else _summarized_teammates(mates)
    return f"{' '.join(filter(None, parts))}\n\n{table}"


def _reference_episodes(mates: Sequence[CardTeammate]) -> dict[str, str]:
    episodes = sorted({mate.references.episodes for mate in mates if mate.references})
    return {"episodes": " or ".join(map(str, episodes)) or "0", "steps": str(KEPT_STEPS)}


def behaviours_in_words(mates: Sequence[CardTeammate]) -> str:
    """Return how many different behaviours the training teammates have, and how many of validation they share."""
    own: dict[str, set[tuple[str, str, int]]] = {}
    counts: dict[str, int] = {}
    for mate in mates:
        if mate.nearest is not None and mate.nearest.behaviour is not None:
            own.setdefault(mate.split, set()).add((mate.layout, mate.family, mate.nearest.behaviour))
            counts[mate.split] = counts.get(mate.split, 0) + 1
    texts = [
        sentence(
            "behaviours",
            split=split,
            teammates=counted_noun(counts[split], "teammate"),
            behaviours=counted_noun(len(own[split]), "different behaviour"),
        )
        for split in SPLITS
        if split in own
    ]
    if "train" in own and "validation" in own:
        shared = len(own["validation"] & own["train"])
        texts.append(sentence("shared_behaviours", shared=shared, behaviours=len(own["validation"])))
    return " ".join(texts)


def _long_teammates(mates: Sequence[CardTeammate]) -> str:
    header = ["layout", "split", "teammate", "seed", "sources", *_EGOS, "headroom"]
    header += ["nearest test", "distance", "behaviour"]
    rows = []
    for mate in mates:
        returns, near = mate.references, mate.nearest
        row = [mate.layout, mate.split, mate.name, "" if mate.seed is None else str(mate.seed), ", ".join(mate.sources)]
        row += [range_in_words(values) for values in _returns([returns] if returns else [])]
        row.append("" if returns is None else "yes" if returns.matters else "no")
        row += ["", ""] if near is None else [near.teammate, f"{near.distance:.3f}"]
        rows.append([*row, "" if near is None or near.behaviour is None else str(near.behaviour)])
    return markdown_table(header, rows)


def _summarized_teammates(mates: Sequence[CardTeammate]) -> str:
    header = ["layout", "split", "family", "teammates", "behaviours", "headroom", *_EGOS, "nearest tests", "distance"]
    groups: dict[tuple[str, str, str], list[CardTeammate]] = {}
    for mate in mates:
        groups.setdefault((mate.layout, mate.split, mate.family), []).append(mate)
    rows = []
    for names, members in groups.items():
        known = [mate.references for mate in members if mate.references]
        nearest = [mate.nearest for mate in members if mate.nearest]
        behaviours = {near.behaviour for near in nearest} - {None}
        row = [*names, str(len(members)), str(len(behaviours)) if behaviours else ""]
        row += [f"{sum(found.matters for found in known)} of {len(known)}" if known else ""]
        row += [range_in_words(values) for values in _returns(known)]
        row += [", ".join(sorted({near.teammate for near in nearest}))]
        rows.append([*row, range_in_words([near.distance for near in nearest], 3)])
    return markdown_table(header, rows)


def _returns(known: Sequence[ReferenceEgos]) -> list[list[float]]:
    """What each of `_EGOS` earns with some teammates, as far as it is known."""
    return [[found.returns[ego] for found in known if ego in found.returns] for ego in _EGOS]


def range_in_words(values: Sequence[float], digits: int = 1) -> str:
    """Return a number, "least to most" of several that differ, or nothing for none."""
    ends = [f"{end:z.{digits}f}" for end in (min(values), max(values))] if values else []
    return " to ".join(dict.fromkeys(ends))


def labels_table(release: CardContent) -> str:
    """Return a table of what the policy behind each task's expert actions earns, with an explanation."""
    tasks = [members for members in release.histories.values() if members[0].expert_return is not None]
    if not tasks:
        return sentence("unmeasured_labels")
    weak = sum(map(have_weak_labels, tasks))
    explained = sentence("labels", episodes=LABEL_EPISODES, steps=KEPT_STEPS)
    verdict = sentence("weak_labels", weak=counted_noun(weak, "task")) if weak else sentence("no_weak_labels")
    table = _long_labels(release, tasks) if len(tasks) <= LONGEST_TABLE else _summarized_labels(tasks)
    return f"{explained} {verdict}\n\n{table}"


def _long_labels(release: CardContent, tasks: Sequence[Sequence[Entry]]) -> str:
    names = {task.task_id: teammate_name(task) for task in release.tasks}
    rows = []
    for members in tasks:
        first = members[0]
        row = [first.layout, first.source, first.split, names.get(first.task_id, first.teammate_kind)]
        scripted = first.source == "noise" and first.expert_step is None
        row += ["script" if scripted else _number(first.expert_step), f"{first.expert_return:z.1f}"]
        row += ["" if scripted else _return(first.expert_return_sampled), f"{mean_end(members):z.1f}"]
        rows.append(_bold(row) if have_weak_labels(members) else row)
    header = ["layout", "source", "split", "teammate", "step", "greedy", "sampled", "last"]
    return markdown_table(header, rows, right=4)


def _summarized_labels(tasks: Sequence[Sequence[Entry]]) -> str:
    groups: dict[tuple[str, str, str], list[Sequence[Entry]]] = {}
    for members in tasks:
        first = members[0]
        groups.setdefault((first.layout, first.source, first.split), []).append(members)
    rows = []
    for names, own in groups.items():
        sampled = [m[0].expert_return_sampled for m in own if m[0].expert_return_sampled is not None]
        greedy = [m[0].expert_return for m in own if m[0].expert_return is not None]
        last, weak = [mean_end(members) for members in own], sum(map(have_weak_labels, own))
        ranges = [range_in_words(greedy), range_in_words(sampled), range_in_words(last)]
        row = [*names, str(len(own)), *ranges, str(weak)]
        rows.append(_bold(row) if weak else row)
    header = ["layout", "source", "split", "tasks", "greedy", "sampled", "last", "weak"]
    return markdown_table(header, rows, right=5)


def _bold(row: Sequence[str]) -> list[str]:
    return [cell and f"**{cell}**" for cell in row]


def _number(value: int | None) -> str:
    return "unknown" if value is None else f"{value:,}"


def _return(value: float | None) -> str:
    return "unknown" if value is None else f"{value:z.1f}"


def have_weak_labels(histories: Sequence[Entry]) -> bool:
    """Whether the labels of a task's histories earn less than half of the histories' end."""
    return bool(are_labels_weak(histories[0].expert_return, mean_end(histories)))


def mean_end(histories: Sequence[Entry]) -> float:
    """Mean of the last episodes' returns."""
    return float(np.mean([entry.return_end for entry in histories]))


def left_out_table(left_out: Sequence[LeftOutTask]) -> str:
    """Return a table of what is not in the release, with the reasons."""
    if not left_out:
        return sentence("nothing_left_out")
    rows = []
    for task in left_out:
        counts = [str(number) if number else "" for number in (task.learners, task.streams)]
        returns = ["" if value is None else f"{value:z.1f}" for value in (task.return_start, task.return_end)]
        rows.append([task.layout, task.teammate, task.source, *counts, *returns, task.reason])
    header = ["layout", "teammate", "source", "learners", "streams", "first", "last", "reason"]
    return f"{sentence('left_out')}\n\n{markdown_table(header, rows)}"


def print_learning(release: CardContent, console: Console) -> None:
    """Print how much the histories of a release rise, by layout and source, and what is not in the release."""
    header, rows = curves_rows(release)
    lines = [header, *([cell.replace("*", "") for cell in row] for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    console.print("Learning, by layout and source:")
    for line in lines:
        names = [cell.ljust(width) for cell, width in zip(line[:_NAMES], widths, strict=False)]
        numbers = [cell.rjust(width) for cell, width in zip(line[_NAMES:], widths[_NAMES:], strict=True)]
        console.print("  ".join([*names, *numbers]), markup=False, highlight=False, soft_wrap=True)
    for task in release.info.left_out:
        source = f" ({task.source})" if task.source else ""
        text = f"left out: {task.layout} with {task.teammate}{source}: {task.reason}"
        console.print(text, markup=False, highlight=False, soft_wrap=True)
