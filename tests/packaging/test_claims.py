"""Numbers that README and documentation state, computed again from the code and the bundled data.

A test fails if the text or the value changes. Tables and printed output are compared in `test_readme` and `test_docs`.
Numbers that take long name the command that prints them in the text.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Literal

import pytest
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.methods.options import SIZES
from icrl4aht_baselines.training.options import HistoryOptions
from icrl4aht_generation.layouts.families import LAYOUT_SPLITS
from icrl4aht_generation.layouts.rooms import MOST_COLUMNS, MOST_ROWS
from icrl4aht_generation.teammates.distances import common_states, group_behaviours
from icrl4aht_generation.teammates.draws import DRAWS_PER_SEED
from icrl4aht_generation.teammates.instances import INSTANCES

from icrl4aht_data.benchmark.facts import (
    KEPT_STEPS,
    LABEL_EPISODES,
    LEAST_HEADROOM,
    SAME_BEHAVIOUR,
    TRACKS,
)
from icrl4aht_data.benchmark.reference_returns import HEURISTICS, has_headroom, read_headroom
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.schema import READABLE_VERSIONS, Entry
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.rules import DELIVERY_REWARD
from icrl4aht_data.overcooked.state import BUTTON_STEPS, POT_STEPS, record_size
from tests.helpers.paths import ROOT
from tests.packaging.test_docs import rows

TINY_SIZE = SIZES["tiny"]
SEEDED = get_protocol("seeded")

WORDS = {"one": 1.0, "two": 2.0, "three": 3.0, "four": 4.0, "five": 5.0, "six": 6.0, "eight": 8.0}
WORDS |= {"ten": 10.0, "tenth": 0.1, "fifth": 0.2}
NUMBER = rf"(-?\d[\d,]*(?:\.\d+)?(?:e\d+)?|\b(?:{'|'.join(WORDS)})\b)"


@cache
def histories() -> tuple[Entry, ...]:
    return tuple(read_index(MINI).entries)


def rising_histories() -> tuple[float, ...]:
    rising = [entry for entry in histories() if entry.return_end - entry.return_start >= LEAST_HEADROOM]
    return len(histories()), len(rising), LEAST_HEADROOM


def cells_without_headroom() -> tuple[int, int]:
    cells = read_headroom("published").values()
    return sum(not has_headroom(cell) for cell in cells), len(cells)


def oracle_on_test_wide() -> tuple[float, float]:
    returns = [cell["oracle"] for (layout, _), cell in read_headroom("published").items() if layout == "test_wide"]
    return min(returns), max(returns)


def tasks(split: str, kind: Literal["", "diverse"] = "") -> list[Task]:
    """Return the bundled tasks of a split of both tracks."""
    return [task for track in TRACKS for task in read_tasks(manifest_path(track, split, kind))]


def bytes_of_records() -> tuple[int, int]:
    sizes = [record_size(layout) for layout in LAYOUTS.values()]
    return min(sizes), max(sizes)


def channels_of_layouts() -> tuple[int, int]:
    channels = [layout.channels for layout in LAYOUTS.values()]
    return min(channels), max(channels)


def validation_by_layout() -> int:
    return max(Counter(task.layout.name for task in tasks("validation")).values())


def tiny_size() -> tuple[int, int, int]:
    assert (TINY_SIZE.encoder, TINY_SIZE.positions) == ("mlp", "rope")
    return TINY_SIZE.layers, TINY_SIZE.width, TINY_SIZE.context


CLAIMS: list[tuple[str, str, Callable[[], float | tuple[float, ...]]]] = [
    ("README", "Of the {} bundled histories, {} earn at least {} more", rising_histories),
    ("README", "a delivery is worth {}.", lambda: DELIVERY_REWARD),
    ("README", "more than `stay` in {} of the {} cells", cells_without_headroom),
    ("docs/index", "the benchmark's {} test tasks", lambda: len(tasks("test"))),
    ("docs/evaluating", "of {} episodes with {} steps each", lambda: (SEEDED.episodes, SEEDED.steps)),
    ("docs/evaluating", "more than `stay` in {} of the {} cells", cells_without_headroom),
    ("docs/protocol", "--split validation`): up to {} [drawn", validation_by_layout),
    ("docs/protocol", "scripts of {} families with {} parameter sets", lambda: (len(HEURISTICS), INSTANCES)),
    ("docs/protocol", "*No headroom*: {} of the {} cells", cells_without_headroom),
    ("docs/protocol", "The oracle earns {} to {} with each", oracle_on_test_wide),
    ("docs/protocol", "`tiny`: {} layers of width {}, a dense encoder, K = {}", tiny_size),
    (
        "docs/protocol",
        "the same, but {} on a CPU, or {} of size",
        lambda: (SIZES["small"].cpu_batch, TINY_SIZE.cpu_batch),
    ),
    ("docs/protocol", "a {} of the histories is held out", lambda: HistoryOptions(("demo_wide",)).held_out),
    ("docs/generating", "lists {} and {} draws of each family", lambda: (DRAWS_PER_SEED[0], DRAWS_PER_SEED[1])),
    ("docs/generating", "A draw closer than {} acts like a test instance", lambda: SAME_BEHAVIOUR),
    ("docs/generating", "has headroom if they differ by {} or more", lambda: LEAST_HEADROOM),
    ("docs/generating", "each plays {} episodes of {} steps", lambda: (LABEL_EPISODES, KEPT_STEPS)),
    ("docs/generating", "grids of up to {} rows and {} columns", lambda: (MOST_ROWS, MOST_COLUMNS)),
    (
        "docs/generating",
        "{} % `train`, {} % `validation`, {} % `test`",
        lambda: tuple(100 * share for share in LAYOUT_SPLITS.values()),
    ),
    ("docs/publishing", "every step ({} to {} bytes)", bytes_of_records),
    ("docs/faq", "Layouts have {} to {} channels", channels_of_layouts),
    ("docs/training", "`--size tiny`: {} layers of width {}, one dense layer as the encoder, K = {}", tiny_size),
    ("docs/format", "{}, the version of this format, or {}", lambda: READABLE_VERSIONS[::-1]),
    ("docs/format", "steps until cooked, 0 to {};", lambda: POT_STEPS),
    ("docs/format", "a button's light stays on, 0 to {};", lambda: BUTTON_STEPS),
]
"""Page, text with {} for each number, and what computes these numbers."""


def stated_numbers(page: str, claim: str) -> list[str]:
    """Return the numbers of a page at the places {} of a claim, whose words stand there once."""
    pattern = r"\s+".join(re.escape(word).replace(r"\{\}", NUMBER) for word in claim.split())
    found = list(re.finditer(pattern, (ROOT / f"{page}.md").read_text(encoding="utf-8")))
    assert len(found) == 1, f"{page}.md has {claim!r} {len(found)} times"
    return list(found[0].groups())


@pytest.mark.parametrize(("page", "claim", "compute"), CLAIMS, ids=[f"{page}: {claim}" for page, claim, _ in CLAIMS])
def test_stated_numbers_are_those_of_code_and_data(page, claim, compute):
    stated, computed = stated_numbers(page, claim), compute()
    computed = computed if isinstance(computed, tuple) else (computed,)
    assert len(stated) == len(computed)
    for text, value in zip(stated, computed, strict=True):
        decimals = len(text.partition(".")[2]) if text not in WORDS else 3
        number = WORDS[text] if text in WORDS else float(text.replace(",", ""))
        assert number == pytest.approx(round(value, decimals)), f"{page}.md: {claim!r}: {text}, computed {value}"


def behaviours_of_tests() -> dict[str, dict[str, int]]:
    """Return family -> test layout -> number of behaviours, as docs/protocol.md states them."""
    layouts = [name for splits in TRACKS.values() for name in splits["test"]]
    return {
        family: dict(zip(layouts, map(int, counts), strict=True)) for family, *counts in rows("protocol", "behaviours")
    }


def test_behaviours_of_the_test_tasks_are_added_up():
    counts = behaviours_of_tests()
    total = sum(sum(row.values()) for row in counts.values())
    assert stated_numbers("docs/protocol", "{} behaviours of {} tasks") == [str(total), str(len(tasks("test")))]
    assert list(counts) == list(HEURISTICS)


@pytest.mark.slow
def test_behaviours_of_the_test_tasks():
    states = common_states(LAYOUTS["demo_wide"])
    for number, family in enumerate(HEURISTICS):
        own = states.actions[number * INSTANCES : (number + 1) * INSTANCES]
        assert len(set(group_behaviours(own))) == behaviours_of_tests()[family]["demo_wide"]
