"""A release's card: `cards/dataset.md` filled with what the release itself says, and nothing else."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark.facts import (
    ALGORITHMS,
    FAMILIES,
    PAPER_EGO_STEPS,
    PAPER_TEAMMATE_STEPS,
    PAPER_TEAMMATES,
    SPLITS,
    TRACKS,
)
from icrl4aht_data.benchmark.reference_returns import headroom_table, read_headroom
from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.info import ReleaseInfo
from icrl4aht_data.format.provenance import Provenance, TeammateSuite, read_provenance
from icrl4aht_data.format.schema import FIELDS, KINDS, PROVENANCE, TASKS, Entry
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.utils.templates import card_file, fill, markdown_table
from icrl4aht_data.writing.field_descriptions import ARRAY_TEXTS, ENTRY_TEXTS
from icrl4aht_data.writing.statistics import layout_statistics, statistics_rows

PROTOCOL = "published"
"""The evaluation protocol whose headroom is shown: that of the paper's numbers."""

CURVES, LAYOUTS, HEADROOM = (f"figures/{name}.png" for name in ("learning_curves", "layouts", "headroom"))
"""Pictures, which a published release has."""

TWIN = "index"
"""The folder of the index as Parquet files, `index/<layout>/<split>.parquet`, which a published release has."""

SOURCE_CARD = "meta/source_card.md"
"""The cards of what a release was made of by `combine`, or that one's own where it was not made of this template."""

_SIZES = (1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12)
_SIZE_NAMES = ("1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B", "100B", "1T")

_NO_SHARED_ROOM = ("coord_simple", "test_simple")


@dataclass(frozen=True)
class _Release:
    """What a card is made of."""

    root: Path
    info: ReleaseInfo
    entries: list[Entry]
    tasks: list[Task]
    provenance: dict[str, Provenance]

    @cached_property
    def layouts(self) -> list[Layout]:
        return [get_layout(name) for name in self.info.layouts]

    def distinct(self, name: str) -> list[Any]:
        """The values that the tasks' provenances give for a name, each once."""
        values = [getattr(of_task, name) for of_task in self.provenance.values()]
        found = {json.dumps(value, default=asdict): value for value in values if value is not None}
        return [found[text] for text in sorted(found)]

    def has(self, name: str) -> bool:
        return (self.root / name).exists()

    def mean(self, entries: Iterable[Entry], name: str) -> float:
        return float(np.mean([getattr(entry, name) for entry in entries]))


def dataset_card(root: Path) -> str:
    """README.md of a release. Pictures and configurations of the viewer are named where the folder has them.

    Args:
        root: a release folder, which needs no README.md and no manifest yet.

    Raises:
        ReleaseError: if the release cannot be read.
    """
    index = read_index(root)
    provenance = read_provenance(root / PROVENANCE)
    return _card(_Release(root, index.info, list(index.entries), read_tasks(root / TASKS), provenance))


def _card(release: _Release) -> str:
    info, root, provenance = release.info, release.root, release.provenance
    statistics = info.statistics or layout_statistics(
        root, release.entries, release.tasks, provenance, info.environment.kept_steps
    )
    return fill(
        "dataset.md",
        size=size_category(info.transitions),
        configs=_configs(release),
        version=f"data version {info.data_version}",
        facts=_bullets(_facts(release)),
        layout=release.layouts[0].name,
        length=str(min(500, *(entry.T for entry in release.entries))),
        viewer=" The dataset viewer shows the index, a row a history." if release.has(TWIN) else "",
        limits=_bullets(_limits(release)),
        statistics=markdown_table(["property", *statistics], statistics_rows(statistics), right=len(statistics)),
        curves=_picture(release, CURVES, "Learning curves") + _curves(release),
        layouts=_picture(release, LAYOUTS, "The layouts at an episode's start, ego blue, teammate red")
        + _layouts(release),
        protocol=PROTOCOL,
        headroom=_picture(release, HEADROOM, "Headroom")
        + headroom_table(read_headroom(PROTOCOL), evaluated_on(info.layouts)),
        splits=_splits(release),
        fields=_fields(release),
        twin=f" and `{TWIN}/<layout>/<split>.parquet`" if release.has(TWIN) else "",
        columns=markdown_table(["field", "what"], [[f"`{name}`", text] for name, text in ENTRY_TEXTS.items()]),
        provenance=_bullets(_provenance(release)),
        citation=card_file("citation.bib").read_text(encoding="utf-8").strip(),
    )


def size_category(rows: int) -> str:
    """The Hub's name for a number of rows, here transitions: n<1K, 1K<n<10K, ..., n>1T."""
    place = int(np.searchsorted(_SIZES, rows, side="right"))
    if place == 0:
        return f"n<{_SIZE_NAMES[0]}"
    return f"n>{_SIZE_NAMES[-1]}" if place == len(_SIZES) else f"{_SIZE_NAMES[place - 1]}<n<{_SIZE_NAMES[place]}"


def evaluated_on(layouts: Iterable[str]) -> list[str]:
    """The layouts on which those who learned on `layouts` are tested."""
    names = list(layouts)
    tested: list[str] = []
    for track in TRACKS.values():
        own = [name for name in names if any(name in members for members in track.values())]
        tested += [name for name in own if name in track["test"]] or (list(track["test"]) if own else [])
    return tested


def _configs(release: _Release) -> str:
    """YAML: what the Hub's viewer shows, all histories by default or those of one layout."""
    if not release.has(TWIN):
        return ""
    lines = ["configs:", *_config("default", "*", _in_order(e.split for e in release.entries)), "  default: true"]
    for layout in release.info.layouts:
        own = _in_order(entry.split for entry in release.entries if entry.layout == layout)
        lines += _config(layout, layout, own)
    return "\n".join(lines) + "\n"


def _config(name: str, folder: str, splits: list[str]) -> list[str]:
    files = [(f"  - split: {split}", f"    path: {TWIN}/{folder}/{split}.parquet") for split in splits]
    return [f"- config_name: {name}", "  data_files:", *(line for pair in files for line in pair)]


def _in_order(splits: Iterable[str]) -> list[str]:
    found = set(splits)
    return [split for split in SPLITS if split in found]


def _facts(release: _Release) -> list[str]:
    info, entries = release.info, release.entries
    kinds = {
        "full": "observations and state records are stored",
        "lite": "state records are stored, and observations are rendered from them as they are read",
        "observations": "observations are stored, state records are not",
    }
    lengths = [entry.T for entry in entries]
    length = f"{min(lengths):,}" if min(lengths) == max(lengths) else f"{min(lengths):,} to {max(lengths):,}"
    steps = info.environment
    labelled = sum(entry.has_expert_actions for entry in entries)
    return [
        f"{len(entries):,} histories of {len({entry.task_id for entry in entries}):,} tasks, "
        f"{info.transitions:,} transitions; each history has {length} steps.",
        f"Layouts: {', '.join(layout.name for layout in release.layouts)}.",
        f"Teammates: {'; '.join(_teammates(release))}.",
        f"Of every episode of {steps.max_steps} steps the first {steps.kept_steps} are kept.",
        f"Expert actions: {'on every history' if labelled == len(entries) else f'on {labelled:,} histories'}.",
        f"Kind `{info.kind}`: {kinds[info.kind]}. Format version {info.format_version}.",
    ]


def _teammates(release: _Release) -> list[str]:
    found: dict[str, set[str]] = {}
    for entry in release.entries:
        found.setdefault(entry.teammate_family, set()).add(entry.teammate_kind)
    parts = [f"the heuristic {family} (`{min(found[family])}`)" for family in FAMILIES[1:] if family in found]
    algorithms = [name for name in ALGORITHMS if name in found.get("rl", ())]
    if algorithms:
        parts.append(f"policies learned by {', '.join(algorithms)}, which act greedily")
    return parts


def _limits(release: _Release) -> list[str]:
    entries, names = release.entries, release.info.layouts
    taught = {entry.teammate_family for entry in entries if entry.split != "test"} - {"rl"}
    limits = []
    if taught:
        limits.append(
            f"Its training teammates of {', '.join(sorted(taught))} stand in for the learned ones of the paper's "
            "training split. The heuristics are the benchmark's test side: do not report teammate generalisation from "
            "a model trained on them."
        )
    limits += [*_missing(release), *_smaller(release)]
    if release.info.kind not in KINDS:
        limits.append(
            "Replayable: without state records nothing can be replayed or drawn. Published files, if it was made of "
            "such, do not name the recipes that were cooked; those in `meta/info.json` are the layouts' usual ones."
        )
    rooms = [name for name in _NO_SHARED_ROOM if name in names]
    if rooms:
        button = " On coord_simple it can lower it, by pressing the button." if "coord_simple" in rooms else ""
        limits.append(
            f"On {' and '.join(rooms)} the ego's room shares nothing with the teammate's: the ego cannot raise the "
            f"return. A flat, high curve there is the teammate's work.{button}"
        )
    limits.append("Streams of one task come from one learner: they are not independent runs.")
    if release.distinct("filter"):
        limits.append("The filter keeps the streams that ended best; the mean over all streams is lower.")
    return limits


def _missing(release: _Release) -> Iterable[str]:
    """Which learned teammates are fewer than was wanted."""
    found = Counter((task.layout.name, task.teammate_kind) for task in release.tasks if task.split == "train")
    wanted: Counter[tuple[str, str]] = Counter()
    for suite in release.distinct("suite"):
        for layout, names in _populations(release, suite).items():
            wanted |= Counter({(layout, name): suite.train for name in names})
    learned_on = {layout for layout, _ in wanted}
    without = [layout for layout in release.info.layouts if layout not in learned_on]
    if wanted and without:
        yield f"Learned on {', '.join(without)}: its profile has no learned teammates there, only presets of H4."
    few = [
        f"{algorithm} on {layout} ({found[layout, algorithm]} of {count})"
        for (layout, algorithm), count in wanted.items()
        if layout in release.info.layouts and found[layout, algorithm] < count
    ]
    if few:
        yield (
            f"Complete: it has fewer training teammates than its profile wanted of {', '.join(few)}. Too few "
            "checkpoints passed the quality filter, or this is a part of a release."
        )


def _populations(release: _Release, suite: TeammateSuite) -> dict[str, list[str]]:
    """A suite's algorithms by layout. Older provenance has one list, and perhaps its layouts."""
    if isinstance(suite.algorithms, dict):
        return suite.algorithms
    return dict.fromkeys(release.info.layouts if suite.layouts is None else suite.layouts, suite.algorithms)


def _smaller(release: _Release) -> Iterable[str]:
    """Where it falls short of the paper's scale, if it does."""
    egos = [ego["total_steps"] for ego in release.distinct("ego")]
    suites = release.distinct("suite")
    teammates = [suite.total_steps for suite in suites]
    short = min(egos, default=PAPER_EGO_STEPS) < PAPER_EGO_STEPS
    if short or min(teammates, default=PAPER_TEAMMATE_STEPS) < PAPER_TEAMMATE_STEPS:
        own = [f"egos for {steps:,}" for steps in sorted(set(egos))]
        own += [f"teammates for {steps:,}" for steps in sorted(set(teammates))]
        yield (
            f"The paper's scale: there egos learn for {PAPER_EGO_STEPS:,} steps beside "
            f"{PAPER_TEAMMATES * len(ALGORITHMS)} teammates a layout, each of which learned for "
            f"{PAPER_TEAMMATE_STEPS:,}. Here {', '.join(own)}."
        )


def _picture(release: _Release, path: str, text: str) -> str:
    return f"![{text}]({path})\n\n" if release.has(path) else ""


def _curves(release: _Release) -> str:
    groups: dict[tuple[str, str, str], list[Entry]] = {}
    for entry in release.entries:
        groups.setdefault((entry.layout, entry.split, entry.teammate_kind), []).append(entry)
    filters = {task_id: of_task.filter for task_id, of_task in release.provenance.items() if of_task.filter}
    filtered = all(entry.task_id in filters for entry in release.entries)
    rows = []
    for names, members in groups.items():
        tasks = {entry.task_id for entry in members}
        row = [*names, f"{len(tasks):,}", f"{len(members):,}"]
        row += [f"{release.mean(members, name):z.1f}" for name in ("return_start", "return_end")]
        if filtered:
            before = [filters[task].before.return_end for task in tasks]
            row.append(f"{np.mean(before):z.1f}")
        rows.append(row)
    header = ["layout", "split", "teammate", "tasks", "histories", "first", "last"]
    header += ["last, before the stream filter"] if filtered else []
    return markdown_table(header, rows, right=len(header) - 3)


def _layouts(release: _Release) -> str:
    rows = [
        [
            layout.name,
            f"`{layout.alias}`",
            f"{layout.width} x {layout.height}",
            str(len(layout.recipes)),
            str(layout.obs_shape[-1]),
        ]
        for layout in release.layouts
    ]
    return markdown_table(["layout", "environment name", "cells", "recipes", "channels C"], rows, right=2)


def _splits(release: _Release) -> str:
    groups: dict[tuple[str, str], list[Entry]] = {}
    for entry in release.entries:
        groups.setdefault((entry.track, entry.split), []).append(entry)
    rows = [
        [
            track,
            split,
            ", ".join(dict.fromkeys(entry.layout for entry in members)),
            f"{len({entry.task_id for entry in members}):,}",
            f"{len(members):,}",
            f"{sum(entry.T for entry in members):,}",
        ]
        for (track, split), members in groups.items()
    ]
    return markdown_table(["track", "split", "layouts", "tasks", "histories", "transitions"], rows, right=3)


def _fields(release: _Release) -> str:
    kind = release.info.kind
    shapes = {"scalar": "", "state": ", S", "obs": ", 5, 5, C"}
    rows = []
    for field in FIELDS.values():
        if field.row == "state" and kind in field.absent:
            continue
        stored = str(field.element(release.layouts[0], kind).base) if kind not in field.absent else "rendered"
        shape = f"({field.axis}{shapes[field.row]}{',' if field.row == 'scalar' else ''})"
        rows.append([f"`{field.name}`", shape, field.dtype, stored, ARRAY_TEXTS[field.name]])
    actions = ", ".join(f"{number} {name}" for number, name in enumerate(release.info.actions))
    return markdown_table(["array", "shape", "as read", "as stored", "what"], rows) + f"\n\nActions: {actions}."


def _provenance(release: _Release) -> list[str]:
    lines = []
    if egos := release.distinct("ego"):
        sizes = [f"{ego['total_steps']:,} steps over {ego['environments']:,} environments" for ego in egos]
        lines.append(f"Egos: recurrent PPO from scratch, one learner a task, {' or '.join(sizes)}.")
    counts = {(p.streams_recorded or 0, p.streams_kept) for p in release.provenance.values() if p.streams_kept}
    for recorded, kept in sorted(counts):
        lines.append(f"Of a task's {recorded:,} streams the best {kept:,} by end + improvement are kept.")
    for suite in release.distinct("suite"):
        alike: dict[str, list[str]] = {}
        for layout, names in _populations(release, suite).items():
            alike.setdefault(", ".join(names), []).append(layout)
        lines += [
            f"Learned teammates on {', '.join(layouts)}: populations of {suite.members} by {names}, "
            f"{suite.total_steps:,} steps a member; training teammates are drawn from the checkpoints whose return "
            f"beside their own partner, greedy, in 400 steps exceeds {suite.threshold:g}."
            for names, layouts in alike.items()
        ]
    if release.distinct("expert"):
        lines.append("Expert actions: the final ego's, greedy, its recurrent state carried through the episode.")
    names = {"profile": "profile", "code_version": "icrl4aht-data", "jax_version": "JAX", "platform": "on"}
    found = {label: ", ".join(map(str, release.distinct(name))) for name, label in names.items()}
    made = [f"{label} {values}" for label, values in found.items() if values]
    if made:
        lines.append(f"Made with {'; '.join(made)}.")
    if release.has(SOURCE_CARD):
        lines.append(f"What this release was made of, and the cards of that, stand in `{SOURCE_CARD}`.")
    return lines or ["Not recorded: the files that this release was made of do not say."]


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"* {line}" for line in lines)
