"""Dataset card of a release: README.md, and card.json with tables that are too long for README.md."""

from __future__ import annotations

import json
import math
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from rich.console import Console

from icrl4aht_data.benchmark.adaptation import headroom_text, published_adaptation
from icrl4aht_data.benchmark.facts import (
    ALGORITHMS,
    HEURISTIC_KINDS,
    LAYOUT_NAMES,
    LEAST_HEADROOM,
    PAPER_EGO_STEPS,
    PAPER_TEAMMATE_STEPS,
    PAPER_TEAMMATES,
    SAME_BEHAVIOUR,
    SCRIPTED_SOURCES,
    SOURCES,
    SPLITS,
    SPREAD_SEED,
    TESTED_ON,
    TRACKS,
    family_sort_key,
    layout_track,
)
from icrl4aht_data.benchmark.reference_returns import cells_without_headroom, read_reference_returns
from icrl4aht_data.benchmark.tasks import Task, read_tasks
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.info import ReleaseInfo
from icrl4aht_data.format.layouts_file import layout_title
from icrl4aht_data.format.provenance import Provenance, read_provenance
from icrl4aht_data.format.schema import (
    CARD_TABLES,
    FIELDS,
    KINDS,
    PARQUET_EPISODES,
    PARQUET_INDEX,
    PROVENANCE,
    RELEASE_CARD,
    TASKS,
    Entry,
    are_labels_weak,
)
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.reading.arrow_tables import EPISODE_COLUMNS
from icrl4aht_data.utils.files import files_below, write_json
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.install_hints import project_url
from icrl4aht_data.utils.text import card_file, counted_noun, markdown_table
from icrl4aht_data.writing.proof import proof_table, read_proof
from icrl4aht_data.writing.splits import SplitDistance, played_teammates, read_distances

if TYPE_CHECKING:
    from jinja2 import Template

HEADROOM_PROTOCOL = "published"
"""Evaluation protocol of the returns in dataset cards, which is the paper's protocol."""

CURVES_FIGURE, LAYOUTS_FIGURE = (f"figures/{name}.png" for name in ("learning_curves", "layouts"))
"""Paths of the figures of a release built for publication."""

_LEAST_RISE = 5.0  # a history counts as rising if its return rises by this much, a quarter of the reward for a delivery
_MIXED, _WATCHING = "heuristic mixed with random actions", "heuristic that never acts"
_SCHEDULE = {"histories", "episodes", "start", "end", "begin", "finish", "power"}


def card_texts(section: str) -> dict[str, str]:
    """Return the texts of a section of `cards/dataset_texts.toml` by name.

    Args:
        section: "sources" (of histories), "kinds" (of release), "arrays" (`schema.FIELDS`), "index" (fields of
            `schema.Entry`), "episodes" (other columns of `EPISODE_COLUMNS`) or "rai" (templates, see `rai_texts`).
    """
    return tomllib.loads(card_file("dataset_texts.toml").read_text(encoding="utf-8"))[section]


def episode_texts() -> dict[str, str]:
    """Return the descriptions of the columns `EPISODE_COLUMNS` by name."""
    texts = card_texts("index") | card_texts("arrays") | card_texts("episodes")
    return {name: texts[name] for name in EPISODE_COLUMNS}


def write_card(root: Path) -> None:
    """Write README.md and card.json of a release folder; the folder need not have a manifest yet.

    Raises:
        ReleaseError: if the release cannot be read.
    """
    content = card_facts(root)
    (root / RELEASE_CARD).write_text(render_card(content), encoding="utf-8")
    write_json(root / CARD_TABLES, {name: content[name] for name in ("learning", "teammates", "left_out")}, indent=None)


def render_card(content: Mapping[str, Any]) -> str:
    """Return the content of README.md for a release with these `card_facts`."""
    return _card_template().render(content, rai=rai_texts(content))


def rai_texts(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the texts on responsible AI for a release with these `card_facts`, by field name in mlcroissant.

    `data_limitations` is the list in the card's section Limits.
    """
    card = _card_template()
    fill = card.environment.from_string
    texts = {name: fill(text).render(content).strip() for name, text in card_texts("rai").items()}
    limits = "".join(card.blocks["limits"](card.new_context(dict(content)))).splitlines()
    return texts | {"data_limitations": [line.removeprefix("* ") for line in limits if line]}


def _card_template() -> Template:
    """Return the template of README.md."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined, keep_trailing_newline=True
    )
    environment.filters |= {
        "table": markdown_table,
        "counted": counted_noun,
        "span": _range_text,
        "proof_table": proof_table,
    }
    return environment.from_string(card_file("dataset.md").read_text(encoding="utf-8"))


def teammate_name(task: Task) -> str:
    """Return the name of a task's teammate, with family or algorithm and number, such as "H3/t12" or "fcp/t1"."""
    family = task.teammate_kind if task.teammate_family == "rl" else task.teammate_family
    return f"{family}/t{task.teammate.get('theta_id', 0)}"


def benchmark_test_layouts(layouts: Iterable[str]) -> list[str]:
    """Return the benchmark's test layouts for models that were trained on `layouts`."""
    names, tested = list(layouts), list[str]()
    for track, splits in TRACKS.items():
        own = [name for name in names if layout_track(name) == track]
        tested += [name for name in own if name in splits["test"]] or (list(splits["test"]) if own else [])
    return tested


@dataclass(frozen=True)
class _TaskFacts:
    """A task of a release, with the task's histories and provenance."""

    first: Entry
    histories: Sequence[Entry]
    task: Task | None
    made: Provenance

    @property
    def has_weak_labels(self) -> bool:
        last = _mean(entry.return_end for entry in self.histories)
        return bool(are_labels_weak(self.first.expert_return, last))


def card_facts(root: Path) -> dict[str, Any]:
    """Return the values that the dataset card of a release shows, and lists of rows for its tables.

    Args:
        root: a release folder; the card and the manifest need not exist yet.

    Raises:
        ReleaseError: if the release cannot be read.
    """
    index, provenance, files = read_index(root), read_provenance(root / PROVENANCE), set(files_below(root))
    info, entries = index.info, list(index.entries)
    by_id = {task.task_id: task for task in read_tasks(root / TASKS)}
    tasks = [
        _TaskFacts(own[0], own, by_id.get(name), provenance.of(name))
        for name, own in grouped(entries, lambda entry: entry.task_id).items()
    ]
    teammates = _teammate_rows(tasks, list(info.layouts))
    titles = {layout: layout_title(layout) for layout in info.layouts}
    compared = [row for row in teammates if row["matters"] is not None]
    of_title = grouped(compared, lambda row: titles[row["layout"]])
    headroom = {title: any(row["matters"] for row in own) for title, own in of_title.items()}
    first = min(entries, key=lambda entry: (entry.split != "train", entry.history_id))
    length = min(500, *(entry.T for entry in entries if (entry.split, entry.layout) == (first.split, first.layout)))
    tested, learning = benchmark_test_layouts(info.layouts), _learning_rows(tasks, titles)
    sources = Counter(entry.source for entry in entries)
    distances = read_distances(played_teammates(by_id.values(), provenance))
    labelled = {name: sum(e.has(FIELDS[f"{name}_actions"]) for e in entries) for name in ("expert", "oracle")}
    absent = {f"{name}_actions" for name, number in labelled.items() if not number}
    return {
        "info": info,
        "url": project_url(),
        "files": files,
        "configs": _viewer_configs(entries, files),
        "has_states": info.kind in KINDS,
        "tasks": len(tasks),
        "lengths": [entry.T for entry in entries],
        "sources": sources,
        "splits": Counter(entry.split for entry in entries),
        "kinds": dict(sorted({(e.teammate_family, e.teammate_kind) for e in entries if e.teammate_family != "rl"})),
        "algorithms": [name for name in ALGORITHMS if name in {entry.teammate_kind for entry in entries}],
        "labelled": labelled,
        "views": {
            view: Counter(entry.source for entry in entries if entry.label_view == view)
            for view in dict.fromkeys(entry.label_view for entry in entries if entry.label_view)
        },
        "swapped": sum(entry.teammate_of_episode is not None for entry in entries),
        "example": {"split": first.split, "layout": first.layout, "length": length},
        "layouts": _layout_rows(info, titles, teammates, distances),
        "compared": [row["matters"] for row in compared],
        "learning": learning,
        "curves": _curve_rows(learning, sources),
        "teammates": teammates,
        "teammate_kinds": _kind_rows(tasks),
        **_behaviour_counts(teammates),
        "split_distances": distances,
        "weak": Counter((titles[task.first.layout], task.first.source) for task in tasks if task.has_weak_labels),
        "left_out": [asdict(task) for task in info.left_out],
        "headroom": headroom,
        "scripted": (None, *SCRIPTED_SOURCES),  # None: noise histories of earlier versions
        "proof": read_proof(root),
        "flat_cells": [
            "/".join(cell) for cell in cells_without_headroom(read_reference_returns(HEADROOM_PROTOCOL), tested)
        ],
        "adaptation": {
            layout: headroom_text(entry) for layout, entry in published_adaptation().items() if layout in tested
        },
        "arrays": [name for name, array in FIELDS.items() if info.kind not in array.absent and name not in absent],
        **_known_families(tasks),
        "suites": _distinct_values(tasks, "suite"),
        **_generation_facts(tasks),
        "least": {"rise": _LEAST_RISE, "headroom": LEAST_HEADROOM, "same": SAME_BEHAVIOUR},
        "texts": {section: card_texts(section) for section in ("sources", "kinds", "arrays")},
        "paper": {"ego": PAPER_EGO_STEPS, "teammate": PAPER_TEAMMATE_STEPS, "teammates": PAPER_TEAMMATES * 4},
        "citation": card_file("citation.bib").read_text(encoding="utf-8").strip(),
    }


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _range_text(values: Iterable[float]) -> str:
    """Return the range of values as text, such as "3" or "3 to 5"; an empty string for no values."""
    found = list(values)
    ends = [f"{end:z,.0f}" for end in (min(found), max(found))] if found else []
    return " to ".join(dict.fromkeys(ends))


def _viewer_configs(entries: Sequence[Entry], files: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return patterns of file names by configuration and split, for the dataset viewer of the Hugging Face Hub."""
    patterns = {"default": f"{PARQUET_INDEX}/*/{{}}.parquet"}
    patterns |= {entry.layout: f"{PARQUET_INDEX}/{entry.layout}/{{}}.parquet" for entry in entries}
    patterns |= {PARQUET_EPISODES: f"{PARQUET_EPISODES}/*/{{}}-*.parquet"}
    folders, configs = {name.split("/")[0] for name in files}, {}
    for name, pattern in patterns.items():
        if pattern.split("/")[0] in folders:
            splits = {entry.split for entry in entries if name in ("default", entry.layout, PARQUET_EPISODES)}
            configs[name] = {split: pattern.format(split) for split in SPLITS if split in splits}
    return configs


def _learning_rows(tasks: Sequence[_TaskFacts], titles: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return rows with mean first and last returns: one for each layout title, source and split, in this order."""
    names = ("layout", "source", "split")
    order = [*titles, *SOURCES, *(task.first.source for task in tasks), *SPLITS]  # sources not in SOURCES come last
    ordered = sorted(tasks, key=lambda task: [order.index(getattr(task.first, name)) for name in names])
    groups = grouped(ordered, lambda task: (titles[task.first.layout], task.first.source, task.first.split))
    rows = []
    for key, own in groups.items():
        entries = [entry for task in own for entry in task.histories]
        before = [task.made.filter.before.return_end for task in own if task.made.filter]
        facts = {
            "histories": len(entries),
            "first": _mean(entry.return_start for entry in entries),
            "last": _mean(entry.return_end for entry in entries),
            "last_before_filter": _mean(before) if len(before) == len(own) else None,
            "rising": _mean(entry.return_end - entry.return_start >= _LEAST_RISE for entry in entries),
        }
        rows.append(dict(zip(names, key, strict=True)) | facts)
    return rows


def _curve_rows(learning: Iterable[Mapping[str, Any]], sources: Iterable[str]) -> list[list[str]]:
    """Return the card's table of learning curves as rows: one row per layout and split, one column per source."""
    found = defaultdict[tuple[str, str], dict[str, str]](dict)
    for row in learning:
        text = f"{row['first']:z.1f}→{row['last']:z.1f} ({row['histories']})"
        found[row["layout"], row["split"]][row["source"]] = text
    return [[*key, *(of_key.get(source, "") for source in sources)] for key, of_key in found.items()]


def _teammate_rows(tasks: Iterable[_TaskFacts], layouts: Sequence[str]) -> list[dict[str, Any]]:
    """Return a table row for each teammate of a release, sorted by layout, split and family."""
    known = (one for one in tasks if one.task is not None)
    rows = []
    for own in grouped(known, lambda one: one.task and (*one.task.teammate_key, one.task.split)).values():
        first, task = own[0].first, own[0].task
        references = next((one.made.references for one in own if one.made.references), None)
        nearest = next((one.made.nearest_test for one in own if one.made.nearest_test), None)
        rows.append(
            {
                "layout": first.layout,
                "split": first.split,
                "family": first.teammate_family,
                "teammate": task and teammate_name(task),
                "seed": task and task.teammate.get("base_seed"),
                "sources": sorted({one.first.source for one in own}),
                "references": references and references.returns,
                "matters": references and references.returns_differ,
                "nearest_test": nearest and msgspec.structs.asdict(nearest),
            }
        )
    order = {name: number for number, name in enumerate((*layouts, *SPLITS))}

    def sort_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
        family = row["family"]
        return order[row["layout"]], order[row["split"]], family == "rl", family_sort_key(family)

    return sorted(rows, key=sort_key)


def _behaviour_counts(teammates: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Count teammates with known behaviour and distinct behaviours by split, and behaviours that both splits share.

    The behaviours of spread teammates, which all differ from each other, and of drawn teammates are numbered
    separately, so a spread and a drawn teammate always count as different. With spread teammates, the number of shared
    behaviours is None.
    """
    known = [row for row in teammates if row["nearest_test"] and row["nearest_test"]["behaviour"] is not None]
    found = {
        split: [
            (row["layout"], row["family"], row["seed"] == SPREAD_SEED, row["nearest_test"]["behaviour"]) for row in own
        ]
        for split, own in grouped(known, lambda row: row["split"]).items()
    }
    counts = {split: (len(found[split]), len(set(found[split]))) for split in SPLITS if split in found}
    shared = len({*found.get("train", ())} & {*found.get("validation", ())})
    is_known = all(row["seed"] != SPREAD_SEED for row in known)
    return {"behaviours": counts, "shared_behaviours": shared if is_known else None}


def _layout_rows(
    info: ReleaseInfo, titles: Mapping[str, str], teammates: Iterable[Any], distances: Mapping[str, SplitDistance]
) -> list[list[str]]:
    """Return the rows of the card's table of layouts, one for each layout title.

    Args:
        info: info of the release, with a summary of each layout.
        titles: titles of the layouts by name, see `layout_title`.
        teammates: rows of the teammates, see `_teammate_rows`.
        distances: least distances of validation to training teammates by layout, see `read_distances`.
    """
    rows, of_title = [], grouped(teammates, lambda row: titles[row["layout"]])
    for title in dict.fromkeys(titles.values()):
        own = {name: found for name, found in info.layouts.items() if titles[name] == title}
        layouts, mates = [get_layout(name) for name in own], of_title.get(title, [])
        # A teammate that wants several dishes has several rows.
        distinct = {(row["split"], row["layout"], row["teammate"], row["seed"]) for row in mates}
        splits = Counter(split for split, *_ in distinct)
        to_tests = [row["nearest_test"]["distance"] for row in mates if row["nearest_test"]]
        to_training = [found.least for name, found in distances.items() if name in own]
        histories = [found.histories for found in own.values()]
        final = np.average([found.mean_final_return for found in own.values()], weights=histories)
        rows.append(
            [
                title if title in own else f"{title} ({len(own)} generated layouts)",
                _range_text(one.obs_shape[-1] for one in layouts),
                f"{sum(histories):,}",
                f"{sum(found.transitions for found in own.values()):,}",
                f"{final:z.1f}",
                *(f"{splits[split]}" for split in ("train", "validation")),
                *(f"{min(found):.2f}" if found else "–" for found in (to_tests, to_training)),
            ]
        )
    return rows


def _known_families(tasks: Sequence[_TaskFacts]) -> dict[str, Any]:
    """Group the families of heuristics in training and validation by their similarity to test teammates.

    Returns:
        `tested`: families with a teammate that behaves the same as a test teammate of its family, or that was not
            compared with the test teammates of its layout.
        `drawn`: families with other teammates, whose parameters were drawn at random.
        `drawn_distance`: smallest distance of a drawn teammate to a test teammate, rounded down to two digits.
        `alike`: drawn teammates that behave the same as a test teammate of another family.
        `untested`: whether a teammate plays on a layout that has no test teammates to compare with.
    """
    tested, drawn, alike, distances, untested = set(), set(), set(), [], False
    # A teammate may have tasks of several sources, and only some of the tasks may record the nearest test teammate.
    nearest = {one.task.teammate_key: one.made.nearest_test for one in tasks if one.task and one.made.nearest_test}
    for task in tasks:
        family, layout = task.first.teammate_family, task.first.layout
        near = task.made.nearest_test or (nearest.get(task.task.teammate_key) if task.task else None)
        if task.first.split == "test" or family == "rl":
            continue
        if near is None and layout not in LAYOUT_NAMES:
            untested = True
        elif near is None or (near.distance < SAME_BEHAVIOUR and near.teammate.split("/")[0] == family):
            tested.add(family)
        elif near.distance < SAME_BEHAVIOUR:
            drawn.add(family)
            alike.add(f"{family} on {layout} like {near.teammate}")
        else:
            drawn.add(family)
            distances.append(near.distance)
    return {
        "tested": sorted(tested),
        "drawn": sorted(drawn),
        "drawn_distance": math.floor(100 * min(distances)) / 100 if distances else None,
        "alike": sorted(alike),
        "untested": untested,
    }


def _teammate_kind(task: Task) -> str:
    theta = task.teammate.get("theta", {})
    if task.teammate_family == "rl":
        return f"learned by {task.teammate_kind}"
    if theta.get("action_probability") == 0.0:
        return _WATCHING
    return _MIXED if theta.get("random_actions") else task.teammate_family


def _kind_rows(tasks: Iterable[_TaskFacts]) -> list[list[str]]:
    """Return the rows of the card's table of teammates by kind, including kinds without teammates.

    The columns are the kind; the numbers of different teammates of the kind on the benchmark's training layouts (in
    training, in validation) and on other layouts (the same); and the number of the benchmark's training layouts with a
    training teammate of the kind. A teammate that never acts or mixes in random actions is no member of its family.
    There are no rows if all tasks are of split test.
    """
    found = defaultdict[tuple[str, str, bool], set[tuple[str, str]]](set)
    for task in (one.task for one in tasks if one.task is not None and one.task.split != "test"):
        name = task.layout.name
        key = name, json.dumps(task.teammate, sort_keys=True)  # unlike `teammate_key`, without the recipes
        found[_teammate_kind(task), task.split, name in TESTED_ON].add(key)
    named = [*HEURISTIC_KINDS.values(), _MIXED, _WATCHING, *(f"learned by {name}" for name in ALGORITHMS)]
    if not found:
        return []
    rows, names = [], {family: f"{family} (`{kind}`)" for kind, family in HEURISTIC_KINDS.items()}
    for kind in dict.fromkeys([*named, *(kind for kind, _, _ in found)]):
        counts = [str(len(found[kind, split, known])) for known in (True, False) for split in ("train", "validation")]
        rows.append([names.get(kind, kind), *counts, str(len({layout for layout, _ in found[kind, "train", True]}))])
    return rows


def _distinct_values(tasks: Iterable[_TaskFacts], name: str) -> list[Any]:
    """Return the distinct values of a provenance field over the tasks."""
    values = (getattr(task.made, name) for task in tasks)
    found = {json.dumps(value, default=msgspec.structs.asdict): value for value in values if value is not None}
    return [found[text] for text in sorted(found)]


def _generation_facts(tasks: Sequence[_TaskFacts]) -> dict[str, Any]:
    """Return how the histories were generated: egos, filters of histories, noise schedules, versions."""
    noise = {
        json.dumps([task.made.source, task.made.noise, task.made.expert and task.made.expert.action]): task.made
        for task in tasks
        if task.made.noise
    }
    labels = {"profile": "profile", "code_version": "icrl4aht-data", "jax_version": "JAX", "platform": "platform"}
    versions = {label: ", ".join(map(str, _distinct_values(tasks, name))) for name, label in labels.items()}
    # names of layouts, by settings of the filter that selected their histories
    streams = defaultdict[tuple[int, int, float | None], list[str]](list)
    for task in tasks:
        made = task.made
        if made.filter and made.streams_kept:
            names = streams[made.streams_recorded or 0, made.streams_kept, made.filter.least_improvement]
            names += [task.first.layout] * (task.first.layout not in names)
    return {
        "egos": _distinct_values(tasks, "ego"),
        "learners": [task.made.learners or 1 for task in tasks if task.made.ego],
        "streams": streams,
        "schedules": [made for made in noise.values() if (made.noise or {}).keys() >= _SCHEDULE],
        "versions": "; ".join(f"{label} {values}" for label, values in versions.items() if values),
    }


def print_learning_curves(content: Mapping[str, Any], console: Console) -> None:
    """Print a dataset card's table of learning curves, and the tasks that were left out of the release.

    Args:
        content: result of `card_facts`.
        console: console to print to.
    """
    lines = ["Mean returns of the first and the last tenth of the episodes, and numbers of histories:"]
    lines.append(markdown_table(["layout", "split", *content["sources"]], content["curves"]))
    for task in content["left_out"]:
        source = f" ({task['source']})" if task["source"] else ""
        lines.append(f"left out: {task['layout']} with {task['teammate']}{source}: {task['reason']}")
    console.print(*lines, sep="\n", markup=False, highlight=False, soft_wrap=True)
