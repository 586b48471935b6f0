"""A release's card: `cards/dataset.md` filled with facts from the release itself."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from icrl4aht_data.benchmark.facts import (
    ALGORITHMS,
    LEAST_HEADROOM,
    PAPER_EGO_STEPS,
    PAPER_TEAMMATE_STEPS,
    PAPER_TEAMMATES,
    SAME_BEHAVIOUR,
    SPLITS,
    TRACKS,
    family_order,
    track_of,
)
from icrl4aht_data.benchmark.reference_returns import headroom_table, read_headroom
from icrl4aht_data.format.provenance import ExpertLabels, Provenance, TeammateSuite
from icrl4aht_data.format.schema import FIELDS, KINDS, PARQUET_EPISODES, Entry, are_labels_weak
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.templates import card_file, fill_template, markdown_table
from icrl4aht_data.utils.text import counted_noun
from icrl4aht_data.writing.card_content import PARQUET_INDEX, CardContent, mean_rise, read_content
from icrl4aht_data.writing.card_tables import (
    curves_table,
    have_weak_labels,
    labels_table,
    left_out_table,
    mean_end,
    range_in_words,
    teammate_name,
    teammates_table,
)
from icrl4aht_data.writing.card_texts import card_texts, episode_texts, sentence
from icrl4aht_data.writing.statistics import layout_statistics, statistics_rows

RELEASE_CARD = "README.md"
"""The card's file name."""

HEADROOM_PROTOCOL = "published"
"""The evaluation protocol whose headroom is shown: that of the paper's numbers."""

CURVES_FIGURE, LAYOUTS_FIGURE, HEADROOM_FIGURE = (
    f"figures/{name}.png" for name in ("learning_curves", "layouts", "headroom")
)
"""Figures of a release that is built for publication."""

SOURCE_CARD = "meta/source_card.md"
"""Cards of the releases that a release was combined from, or its own earlier card if this template did not make it."""

_SIZES = (1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12)
_SIZE_NAMES = ("1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B", "100B", "1T")

_NO_SHARED_ROOM = ("coord_simple", "test_simple")

CLEAR_RISE = 10
"""What the end of a task's histories should exceed their start by where the ego matters: half a delivery."""


def dataset_card(root: Path) -> str:
    """Return the README.md of a release on disk.

    Args:
        root: a release folder; needs no README.md and no manifest yet.

    Raises:
        ReleaseError: if the release cannot be read.
    """
    return render_card(read_content(root))


def render_card(release: CardContent) -> str:
    """Return the README.md of a release."""
    info, parquet = release.info, release.has_parquet
    statistics = info.statistics or layout_statistics(  # releases written before there were any have none
        release.entries, release.tasks, release.provenance, info.environment.kept_steps, info.shards
    )
    headroom = headroom_table(read_headroom(HEADROOM_PROTOCOL), evaluated_on(info.layouts))
    layouts_caption = "The layouts at the start of an episode, ego blue, teammate red"
    return fill_template(
        "dataset.md",
        size=size_category(info.transitions),
        configs=_viewer_configs(release) if parquet else "",
        version=f"data version {info.data_version}",
        facts=_bullets(_facts(release)),
        **_example(release),
        viewer=" The dataset viewer shows the index, one row per history." if parquet else "",
        limits=_bullets(_limits(release)),
        statistics=markdown_table(["property", *statistics], statistics_rows(statistics), right=len(statistics)),
        made=_bullets(_sources(release)),
        curves=_figure(release, CURVES_FIGURE, "Learning curves") + curves_table(release),
        teammates=teammates_table(release),
        left_out=left_out_table(info.left_out),
        labels=_labels(release),
        layouts=_figure(release, LAYOUTS_FIGURE, layouts_caption) + _layouts_table(release),
        protocol=HEADROOM_PROTOCOL,
        headroom=_figure(release, HEADROOM_FIGURE, "Headroom") + headroom,
        splits=_splits_table(release),
        fields=_arrays_table(release),
        twin=f" and `{PARQUET_INDEX}/<layout>/<split>.parquet`" if parquet else "",
        columns=_fields_table(card_texts("index")),
        episodes=_episodes(release),
        provenance=_bullets(_provenance(release)),
        citation=card_file("citation.bib").read_text(encoding="utf-8").strip(),
    )


def size_category(rows: int) -> str:
    """Return the Hub's name for a number of rows, here transitions: n<1K, 1K<n<10K, ..., n>1T."""
    number = int(np.searchsorted(_SIZES, rows, side="right"))
    if number == 0:
        return f"n<{_SIZE_NAMES[0]}"
    return f"n>{_SIZE_NAMES[-1]}" if number == len(_SIZES) else f"{_SIZE_NAMES[number - 1]}<n<{_SIZE_NAMES[number]}"


def evaluated_on(layouts: Iterable[str]) -> list[str]:
    """Return the layouts on which the benchmark tests models that were trained on `layouts`."""
    names = list(layouts)
    tested: list[str] = []
    for track, splits in TRACKS.items():
        own = [name for name in names if track_of(name) == track]
        tested += [name for name in own if name in splits["test"]] or (list(splits["test"]) if own else [])
    return tested


def _viewer_configs(release: CardContent) -> str:
    """Return YAML for the Hub: configurations of all histories, the default, of each layout's, and of all episodes."""
    splits = {"*": {entry.split for entry in release.entries}}
    for entry in release.entries:
        splits.setdefault(entry.layout, set()).add(entry.split)
    lines = ["configs:"]
    for folder, found in splits.items():
        lines += [f"- config_name: {'default' if folder == '*' else folder}", "  data_files:"]
        for split in (split for split in SPLITS if split in found):
            lines += [f"  - split: {split}", f"    path: {PARQUET_INDEX}/{folder}/{split}.parquet"]
        lines += ["  default: true"] if folder == "*" else []
    if release.has_parquet_episodes:
        lines += [f"- config_name: {PARQUET_EPISODES}", "  data_files:"]
        for split in (split for split in SPLITS if split in splits["*"]):
            lines += [f"  - split: {split}", f"    path: {PARQUET_EPISODES}/*/{split}-*.parquet"]
    return "\n".join(lines) + "\n"


def _fields_table(texts: Mapping[str, str]) -> str:
    return markdown_table(["field", "what"], [[f"`{name}`", text] for name, text in texts.items()])


def _episodes(release: CardContent) -> str:
    """Return the card's section on the episodes as Parquet files; empty if there are none."""
    if not release.has_parquet_episodes:
        return ""
    return fill_template(
        "episodes.md",
        folder=PARQUET_EPISODES,
        split=_example(release)["split"],
        steps=str(release.info.environment.kept_steps),
        columns=_fields_table(episode_texts()),
    )


def _example(release: CardContent) -> dict[str, str]:
    """Return split, layout and length of windows of the example of loading: the training split if there is one."""
    first = min(release.entries, key=lambda entry: (entry.split != "train", entry.history_id))
    chosen = release.groups("split", "layout")[first.split, first.layout]
    return {"split": first.split, "layout": first.layout, "length": str(min(500, *(entry.T for entry in chosen)))}


def _facts(release: CardContent) -> list[str]:
    info, entries = release.info, release.entries
    shortest, longest = min(entry.T for entry in entries), max(entry.T for entry in entries)
    found: dict[str, set[str]] = {}
    for entry in entries:
        found.setdefault(entry.teammate_family, set()).add(entry.teammate_kind)
    heuristics = sorted(found.keys() - {"rl"}, key=family_order)
    teammates = [f"the heuristic {family} (`{min(found[family])}`)" for family in heuristics]
    if algorithms := [name for name in ALGORITHMS if name in found.get("rl", ())]:
        teammates.append(f"policies learned by {', '.join(algorithms)}, which act greedily")
    sources = [f"`{source}` ({len(members):,} histories)" for (source,), members in release.groups("source").items()]
    return [
        sentence(
            "size",
            histories=f"{len(entries):,}",
            tasks=f"{len(release.histories):,}",
            transitions=f"{info.transitions:,}",
            length=f"{shortest:,}" if shortest == longest else f"{shortest:,} to {longest:,}",
        ),
        sentence("sources_found", names=", ".join(sources)),
        sentence("layouts", names=", ".join(info.layouts)),
        sentence("teammates", names="; ".join(teammates)),
        sentence("episodes", max_steps=info.environment.max_steps, kept_steps=info.environment.kept_steps),
        sentence(
            "labels_found",
            expert=_share_in_words(sum(entry.has_expert_actions for entry in entries), len(entries)),
            oracle=_share_in_words(sum(entry.has(FIELDS["oracle_actions"]) for entry in entries), len(entries)),
        ),
        sentence("kind", kind=info.kind, stored=card_texts("kinds")[info.kind], format_version=info.format_version),
    ]


def _share_in_words(number: int, total: int) -> str:
    return "every history" if number == total else f"{number:,} histories" if number else "none"


def _sources(release: CardContent) -> Iterable[str]:
    """Yield for each source what its histories are, and what they are not."""
    texts = card_texts("sources")
    for (source,), _ in release.groups("source").items():
        yield f"`{source}`: " + texts.get(source, texts["other"]).strip("\n")


def _limits(release: CardContent) -> list[str]:
    limits = [*_heuristics_in_training(release), *_missing_teammates(release), *_smaller_scale(release)]
    if release.info.kind not in KINDS:
        limits.append(sentence("not_replayable"))
        limits += [sentence("no_episodes")] if release.has_parquet else []
    if flat := [layout for layout, has in release.headroom.items() if not has]:
        limits.append(sentence("no_headroom", layouts=", ".join(flat), least=f"{LEAST_HEADROOM:g}"))
    if rooms := [name for name in _NO_SHARED_ROOM if name in release.info.layouts]:
        button = sentence("button") if "coord_simple" in rooms else ""
        limits.append(sentence("no_shared_room", layouts=" and ".join(rooms), button=button))
    sources = {source for (source,) in release.groups("source")}
    if "ppo" in sources:
        limits.append(sentence("dependent_streams"))
    if "noise" in sources:
        limits.append(sentence("noise_is_no_learning"))
    if "student" in sources:
        limits.append(sentence("student_is_no_learning"))
    if release.distinct("filter"):
        limits.append(sentence("filtered"))
    limits += _flat_tasks(release)
    if weak := sum(map(have_weak_labels, release.histories.values())):
        limits.append(sentence("weak_limit", weak=counted_noun(weak, "task")))
    return limits


def _heuristics_in_training(release: CardContent) -> Iterable[str]:
    """Yield limits about heuristics among the teammates of histories that models are trained on."""
    tested, drawn, alike = set(), set(), set()
    for members in release.histories.values():
        first, of_task = members[0], release.provenance.get(members[0].task_id, Provenance())
        if first.split == "test" or first.teammate_family == "rl":
            continue
        family, near = first.teammate_family, of_task.nearest_test
        same = near is not None and near.distance < SAME_BEHAVIOUR
        if near is None or (same and near.teammate.split("/")[0] == family):
            tested.add(family)
            continue
        drawn.add(family)
        if same:
            alike.add(f"{family} on {first.layout} like {near.teammate}")
    least = f"{SAME_BEHAVIOUR:g}"
    if drawn:
        yield sentence("drawn_in_training", families=", ".join(sorted(drawn)), least=least)
    if alike:
        yield sentence("drawn_like_others", names=", ".join(sorted(alike)), least=least)
    if tested:
        yield sentence("heuristics_in_training", families=", ".join(sorted(tested)))


def _flat_tasks(release: CardContent) -> Iterable[str]:
    """Yield a limit that names the tasks on layouts with headroom whose histories hardly rise."""
    names = {task.task_id: teammate_name(task) for task in release.tasks}
    flat = [
        f"{members[0].layout} with {names.get(task_id, members[0].teammate_kind)} ({members[0].source}, "
        f"{mean_rise(members):z.1f})"
        for task_id, members in release.histories.items()
        if release.headroom.get(members[0].layout) and mean_rise(members) < CLEAR_RISE
    ]
    if flat:
        yield sentence("flat_tasks", tasks=counted_noun(len(flat), "task"), names=", ".join(flat), rise=CLEAR_RISE)


def _missing_teammates(release: CardContent) -> Iterable[str]:
    """Yield limits about populations with fewer training teammates than their profile wanted."""
    teammates = {task.teammate_key: task for task in release.tasks if task.split == "train"}  # in a task of each source
    found = Counter((task.layout.name, task.teammate_kind) for task in teammates.values())
    wanted: Counter[tuple[str, str]] = Counter()
    for suite in release.distinct("suite"):
        for layout, names in _algorithms(release, suite).items():
            wanted |= Counter({(layout, name): suite.train for name in names})
    without = [layout for layout in release.info.layouts if layout not in {layout for layout, _ in wanted}]
    if wanted and without:
        yield sentence("no_learned", layouts=", ".join(without))
    few = [
        f"{algorithm} on {layout} ({found[layout, algorithm]} of {count})"
        for (layout, algorithm), count in wanted.items()
        if layout in release.info.layouts and found[layout, algorithm] < count
    ]
    if few:
        yield sentence("few_learned", populations=", ".join(few))


def _algorithms(release: CardContent, suite: TeammateSuite) -> Mapping[str, list[str]]:
    """Return a suite's algorithms by layout; older provenance has one list, and perhaps its layouts."""
    if isinstance(suite.algorithms, dict):
        return suite.algorithms
    return dict.fromkeys(release.info.layouts if suite.layouts is None else suite.layouts, suite.algorithms)


def _smaller_scale(release: CardContent) -> Iterable[str]:
    """Yield a limit if egos or teammates learned for fewer steps than in the paper."""
    egos = sorted({ego["total_steps"] for ego in release.distinct("ego")})
    teammates = sorted({suite.total_steps for suite in release.distinct("suite")})
    if (egos or [PAPER_EGO_STEPS])[0] < PAPER_EGO_STEPS or (
        (teammates or [PAPER_TEAMMATE_STEPS])[0] < PAPER_TEAMMATE_STEPS
    ):
        own = [f"egos for {steps:,}" for steps in egos] + [f"teammates for {steps:,}" for steps in teammates]
        yield sentence(
            "smaller",
            ego_steps=f"{PAPER_EGO_STEPS:,}",
            teammates=PAPER_TEAMMATES * len(ALGORITHMS),
            teammate_steps=f"{PAPER_TEAMMATE_STEPS:,}",
            own=", ".join(own),
        )


def _figure(release: CardContent, path: str, caption: str) -> str:
    return f"![{caption}]({path})\n\n" if path in release.files else ""


def _labels(release: CardContent) -> str:
    text = labels_table(release)
    tasks = [members for members in release.histories.values() if members[0].has(FIELDS["oracle_actions"])]
    if not tasks:
        return text
    weak = [members for members in tasks if _have_weak_oracle_labels(release, members)]
    found = f" {sentence('weak_oracle', weak=_tasks_by_layout(weak))}" if weak else ""
    return f"{text}\n\n{sentence('oracle_labels')}{found}"


def _have_weak_oracle_labels(release: CardContent, histories: list[Entry]) -> bool:
    references = release.provenance.get(histories[0].task_id, Provenance()).references
    return references is not None and bool(are_labels_weak(references.oracle, mean_end(histories)))


def _tasks_by_layout(tasks: Iterable[list[Entry]]) -> str:
    counts = Counter((members[0].layout, members[0].source) for members in tasks)
    return ", ".join(f"{counted_noun(n, 'task')} of {source} on {layout}" for (layout, source), n in counts.items())


def _policy_labellers(release: CardContent) -> list[ExpertLabels]:
    """Return for each task whose expert actions come from a policy, not from a script, what is known of it."""
    experts = [of_task.expert for of_task in release.provenance.values() if of_task.expert is not None]
    return [expert for expert in experts if expert.policy_sha256 is not None]


def _labellers(release: CardContent) -> str:
    """Return a sentence on which checkpoints label; empty if they were not measured."""
    measured = [
        expert
        for expert in _policy_labellers(release)
        if expert.return_greedy is not None and expert.last_return_greedy is not None
    ]
    earlier = sum(expert.return_greedy != expert.last_return_greedy for expert in measured)
    if earlier:
        return sentence("earlier_labels", earlier=earlier, tasks=len(measured))
    return sentence("last_labels") if measured else ""


def _layouts_table(release: CardContent) -> str:
    rows = []
    for layout in map(get_layout, release.info.layouts):
        size, channels = f"{layout.width} x {layout.height}", str(layout.obs_shape[-1])
        rows.append([layout.name, f"`{layout.alias}`", size, str(len(layout.recipes)), channels])
    return markdown_table(["layout", "environment name", "cells", "recipes", "channels C"], rows, right=2)


def _splits_table(release: CardContent) -> str:
    rows = []
    for (track, split), members in release.groups("track", "split").items():
        layouts = ", ".join(dict.fromkeys(entry.layout for entry in members))
        counts = len({entry.task_id for entry in members}), len(members), sum(entry.T for entry in members)
        rows.append([track, split, layouts, *(f"{count:,}" for count in counts)])
    return markdown_table(["track", "split", "layouts", "tasks", "histories", "transitions"], rows, right=3)


def _arrays_table(release: CardContent) -> str:
    kind, layout = release.info.kind, get_layout(next(iter(release.info.layouts)))
    shapes = {"scalar": ",", "state": ", S", "obs": ", 5, 5, C"}
    rows = []
    for name, array in FIELDS.items():
        if array.row == "state" and kind in array.absent:
            continue
        stored = str(array.element(layout, kind).base) if kind not in array.absent else "rendered"
        shape = f"({array.axis}{shapes[array.row]})"
        rows.append([f"`{name}`", shape, array.dtype, stored, card_texts("arrays")[name]])
    actions = ", ".join(f"{number} {name}" for number, name in enumerate(release.info.actions))
    return markdown_table(["array", "shape", "as read", "as stored", "what"], rows) + f"\n\nActions: {actions}."


def _provenance(release: CardContent) -> list[str]:
    lines = [*_egos(release), *_noise(release)]
    for suite in release.distinct("suite"):
        layouts: dict[str, list[str]] = {}
        for layout, names in _algorithms(release, suite).items():
            layouts.setdefault(", ".join(names), []).append(layout)
        lines += [
            sentence(
                "suite",
                layouts=", ".join(members),
                members=suite.members,
                algorithms=names,
                steps=f"{suite.total_steps:,}",
                threshold=f"{suite.threshold:g}",
            )
            for names, members in layouts.items()
        ]
    if _policy_labellers(release):
        lines.append(sentence("expert_source", labellers=_labellers(release)).rstrip())
    labels = {
        "profile": "profile",
        "code_version": "icrl4aht-data",
        "jax_version": "JAX",
        "platform": "platform",
        "xla_threads": "XLA threads of the egos",
    }
    found = {label: ", ".join(map(str, release.distinct(name))) for name, label in labels.items()}
    if versions := [f"{label} {values}" for label, values in found.items() if values]:
        lines.append(sentence("versions", versions="; ".join(versions)))
    if SOURCE_CARD in release.files:
        lines.append(sentence("sources", file=SOURCE_CARD))
    return lines or [sentence("unknown_source")]


def _egos(release: CardContent) -> Iterable[str]:
    """Yield sentences about the learning egos and the streams that are kept."""
    if egos := release.distinct("ego"):
        sizes = [f"{ego['total_steps']:,} steps over {ego['environments']:,} environments" for ego in egos]
        learners = range_in_words([of_task.learners or 1 for of_task in release.provenance.values() if of_task.ego], 0)
        what = "learner" if learners == "1" else "independent learners"
        yield sentence("ego", learners=f"{learners} {what}", sizes=" or ".join(sizes))
    streams: dict[tuple[int, float | None], list[int]] = {}
    for of_task in release.provenance.values():
        if of_task.filter is not None and of_task.streams_kept:
            key = of_task.streams_recorded or 0, of_task.filter.least_improvement
            streams.setdefault(key, []).append(of_task.streams_kept)
    for (recorded, least), kept in streams.items():
        name = "streams" if least is None else "rising_streams"
        yield sentence(name, kept=range_in_words(kept, 0), recorded=f"{recorded:,}", least=f"{least or 0:g}")


def _noise(release: CardContent) -> Iterable[str]:
    """Yield a sentence on each kind of noise schedule, and on the labels of students."""
    made = [of_task for of_task in release.provenance.values() if of_task.noise]
    schedules = {json.dumps([of_task.source, of_task.noise]): of_task for of_task in made}
    labels = dict.fromkeys(of_task.expert.action for of_task in made if of_task.source == "student" and of_task.expert)
    if labels:
        yield sentence("student", labels=", or ".join(labels))
    for of_task in schedules.values():
        noise = of_task.noise or {}
        settings = {
            name: range_in_words(value, 2) if isinstance(value, list | tuple) else f"{value:,}"
            for name, value in noise.items()
        }
        if {"histories", "episodes", "start", "end", "begin", "finish", "power"} <= settings.keys():
            yield sentence("noise", source=of_task.source or "noise", **settings)


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"* {line}" for line in lines)
