"""Test that numbers in README and documentation equal values computed from the code and the bundled data.

A test fails if the text or the value changes. Tables and printed output are compared in `test_readme` and `test_docs`.
For numbers that take long to compute, the text names the command that prints them.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from functools import cache
from statistics import fmean
from typing import Any, Literal

import pytest
from icrl4aht_baselines import reference
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.methods.ad import dropped_steps
from icrl4aht_baselines.methods.options import SIZES, ModelOptions
from icrl4aht_baselines.report.comparison import mean_best_return
from icrl4aht_baselines.report.scores import cell_scales, cells_with_headroom
from icrl4aht_baselines.training.options import SAVE_MINUTES, HistoryOptions
from icrl4aht_generation.layouts.families import LAYOUT_SPLITS
from icrl4aht_generation.layouts.rooms import MOST_COLUMNS, MOST_ROWS
from icrl4aht_generation.learners.checkpoint import POLICY_CHECKPOINTS
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.teammates.draws import DRAWS_PER_SEED, find_draw
from icrl4aht_generation.teammates.heuristics.territory import TERRITORY
from icrl4aht_generation.teammates.instances import INSTANCES
from icrl4aht_generation.teammates.preference import preference_tasks

from icrl4aht_data.benchmark.adaptation import EGO_KINDS, headroom_text, published_adaptation, read_adaptation
from icrl4aht_data.benchmark.facts import (
    KEPT_STEPS,
    LABEL_EPISODES,
    LEAST_HEADROOM,
    SAME_BEHAVIOUR,
    TRACKS,
)
from icrl4aht_data.benchmark.reference_returns import (
    HEURISTICS,
    read_reference_returns,
    same_behaviour_tasks,
)
from icrl4aht_data.benchmark.tasks import Task, manifest_path, read_tasks
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.schema import READABLE_VERSIONS, Entry
from icrl4aht_data.overcooked.channels import CANONICAL_CHANNELS
from icrl4aht_data.overcooked.layouts import LAYOUTS, Layout
from icrl4aht_data.overcooked.rules import DELIVERY_REWARD
from icrl4aht_data.overcooked.state import BUTTON_STEPS, POT_STEPS, record_size
from tests.helpers.paths import ROOT

TINY_SIZE = SIZES["tiny"]
SEEDED = get_protocol("seeded")

WORDS = {"one": 1.0, "two": 2.0, "three": 3.0, "four": 4.0, "five": 5.0, "six": 6.0, "eight": 8.0}
WORDS |= {"ten": 10.0, "tenth": 0.1, "fifth": 0.2}
NUMBER = rf"(-?\d[\d,]*(?:\.\d+)?(?:e\d+)?|\b(?:{'|'.join(WORDS)})\b)"


@cache
def bundled_entries() -> tuple[Entry, ...]:
    return tuple(read_index(MINI).entries)


def count_rising_returns() -> tuple[float, ...]:
    rising = [entry for entry in bundled_entries() if entry.return_end - entry.return_start >= LEAST_HEADROOM]
    return len(rising), len(bundled_entries()), LEAST_HEADROOM


def count_cells_without_headroom() -> tuple[float, int, int]:
    """Return the least headroom, the number of test cells with less headroom, and the number of test cells."""
    cells = len(read_reference_returns("seeded"))
    return LEAST_HEADROOM, cells - len(cells_with_headroom(cell_scales("seeded"))), cells


def bundled_tasks(split: str, kind: Literal["", "diverse"] = "") -> list[Task]:
    """Return the bundled tasks of one split in both tracks."""
    return [task for track in TRACKS for task in read_tasks(manifest_path(track, split, kind))]


def paper_plan_sizes() -> tuple[float, ...]:
    """Return profile `paper`'s numbers of tasks, environment steps and kept transitions."""
    profile = load_profile("paper")
    ego, count = profile.ego, sum(profile.task_count(name, "ppo") for name in profile.layouts)
    steps = ego.episodes * KEPT_STEPS
    total = count * ego.updates * ego.steps_per_update
    return count, total, count * profile.keep * steps


def range_over_layouts(count: Callable[[Layout], int]) -> tuple[int, int]:
    """Return the smallest and the largest value of `count` over all published layouts."""
    counts = [count(layout) for layout in LAYOUTS.values()]
    return min(counts), max(counts)


def max_validation_tasks_per_layout() -> int:
    return max(Counter(task.layout.name for task in bundled_tasks("validation")).values())


def tiny_model_size() -> tuple[int, int, int]:
    assert (TINY_SIZE.model["encoder"], TINY_SIZE.model["positions"]) == ("mlp", "rope")
    return TINY_SIZE.model["layers"], TINY_SIZE.model["width"], TINY_SIZE.train["context"]


def count_test_behaviours() -> tuple[int, ...]:
    """Return the numbers of test behaviours and test tasks, and three numbers of behaviours of a family on a layout.

    The last three are for H1 on cramped_down, for H2 on test_wide, and for every other pair without H4.
    """
    by_id = {task.task_id: task for task in bundled_tasks("test")}
    counts = Counter((task.layout.name, task.teammate_family) for task in by_id.values())
    for first, *others in same_behaviour_tasks():
        counts[by_id[first].layout.name, by_id[first].teammate_family] -= len(others)
    total = sum(counts.values())
    assert {counts.pop(cell) for cell in list(counts) if cell[1] == "H4"} == {1}
    named = counts.pop(("cramped_down", "H1")), counts.pop(("test_wide", "H2"))
    (rest,) = set(counts.values())
    return total, len(by_id), *named, rest


def bundled_release_size() -> tuple[int, ...]:
    size = sum(path.stat().st_size for path in MINI.rglob("*") if path.is_file())
    entries = bundled_entries()
    layouts, tasks = {entry.layout for entry in entries}, {entry.task_id for entry in entries}
    return len(entries), len(tasks), len(layouts), sum(entry.T for entry in entries), round(size / 1e6)


def adaptation_on_demo_wide() -> tuple[float, ...]:
    """Return the returns of the informed and the episodic ego on demo_wide."""
    returns = published_adaptation()["demo_wide"]["returns"]
    assert all(len(returns[kind]) == 3 for kind in EGO_KINDS), "three training runs of each"
    return tuple(fmean(returns[kind].values()) for kind in EGO_KINDS)


def adaptation_headroom() -> tuple[float, ...]:
    """Return the least and the greatest headroom and the number of published layouts, and those of `preference`."""
    published = [*published_adaptation().values()]
    assert all(low < 0 < high for low, high in (entry["interval"] for entry in published)), "intervals that contain 0"
    preference = [entry for entry in read_adaptation(ROOT / "cards") if entry["tasks"].startswith("preference-test-")]
    of = [[float(headroom_text(entry).split()[0]) for entry in entries] for entries in (published, preference)]
    return min(of[0]), max(of[0]), len(of[0]), min(of[1]), max(of[1]), len(of[1])


@cache
def read_stored_proof() -> dict[str, Any]:
    return json.loads((ROOT / "cards" / "proof.json").read_text(encoding="utf-8"))


def proof_mean(histories: str, method: str, labels: str, name: str) -> float:
    """Return the mean of a value over the three training runs of a model in the proof of the bundled release."""
    key = (histories, method, labels)
    runs = [one for one in read_stored_proof()["runs"] if (one["histories"], one["method"], one["labels"]) == key]
    assert len(runs) == 3
    return fmean(one[name] for one in runs)


def search_proof() -> tuple[float, ...]:
    """Return the number of tasks, and returns of AD on `search` histories in episodes 1 and 6 to 20, also cleared."""
    return read_stored_proof()["tasks"]["preference"], *(
        proof_mean("search", "AD", "expert", name) for name in ("first", "late", "late_cleared")
    )


def agent_proof() -> tuple[float, float, float]:
    """Return the shares that AD earns on `agent` histories with `expert` labels, with own actions, and on all."""
    models = (("agent", "AD", "expert"), ("agent", "AD", "own"), ("all", "AD", "expert"))
    first, second, third = (proof_mean(*model, "share") for model in models)
    return first, second, third


def training_teammates_like_tests() -> tuple[int, ...]:
    """Return two numbers for each of two layouts: training tasks with a teammate like a test instance, and all tasks.

    Distances are measured on test_wide and asymm_both, with their indicators.
    """
    found = []
    for layout in ("test_wide", "asymm_both"):
        tasks = [task for task in preference_tasks("train") if task.layout.name == f"{layout}_plain"]
        draws = [one for task in tasks if (one := find_draw(layout, task.teammate))]
        assert len(draws) == len(tasks)
        found += [sum(min(one.distance, one.other_distance) < SAME_BEHAVIOUR for one in draws), len(tasks)]
    return tuple(found)


def gains_of_best_responses() -> dict[str, float]:
    """Return layout -> mean return of best responses minus the episodic ego's return."""
    scales, found = cell_scales("seeded"), {}
    for layout, entry in published_adaptation().items():
        best = mean_best_return(layout, scales)
        assert best is not None
        found[layout] = best - fmean(entry["returns"]["episodic"].values())
    return found


CLAIMS: list[tuple[str, str, Callable[[], float | tuple[float, ...]]]] = [
    ("README", "{} of the {} bundled histories rises by at least {}", count_rising_returns),
    ("README", "{} histories of {} tasks on {} layouts: {} steps in {} MB", bundled_release_size),
    ("README", "delivery is worth {}", lambda: DELIVERY_REWARD),
    ("README", "less than {} points more than `stay` in {} of the {} cells", count_cells_without_headroom),
    (
        "README",
        "identity earned {}, and one that forgets each episode {},",
        adaptation_on_demo_wide,
    ),
    (
        "README",
        "Best responses earned {}, maybe",
        lambda: gains_of_best_responses()["demo_wide"] + adaptation_on_demo_wide()[1],
    ),
    (
        "docs/protocol",
        "difference: {} to +{} on [{} published .. and +{} to +{} on {} layouts of the [track",
        adaptation_headroom,
    ),
    ("docs/protocol", "return is larger, up to +{}, but", lambda: max(gains_of_best_responses().values())),
    (
        "docs/preference",
        "return on the {} validation .. was {} in episode 1 and {} in ..; {} with memory",
        search_proof,
    ),
    (
        "docs/preference",
        "test_wide_plain {} of the {} training tasks .. on asymm_both_plain {} of {}.",
        training_teammates_like_tests,
    ),
    ("docs/index", "{} test tasks", lambda: len(bundled_tasks("test"))),
    ("docs/adapters", "{} published test tasks", lambda: len(bundled_tasks("test"))),
    ("docs/protocol", "plays {} episodes of {} steps", lambda: (SEEDED.episodes, SEEDED.steps)),
    ("docs/training", "AD earned {} of .. on track `teammate` ({} without `expert` labels, {} with all", agent_proof),
    ("docs/evaluating", "the same {} on every layout", lambda: len(CANONICAL_CHANNELS)),
    ("docs/protocol", "up to {} [drawn", max_validation_tasks_per_layout),
    ("docs/protocol", "{} families with {} parameter sets", lambda: (len(HEURISTICS), INSTANCES)),
    (
        "docs/protocol",
        "{} of its {} modes",
        lambda: (TERRITORY.choices["behavior_mode"] - 1, TERRITORY.choices["behavior_mode"]),
    ),
    (
        "docs/protocol",
        "{} behaviours in {} tasks .. H1 has {} .. cramped_down, H2 has {} .. test_wide, .. {}.",
        count_test_behaviours,
    ),
    ("docs/protocol", "oldest {}", lambda: dropped_steps(500) / 500),
    ("docs/protocol", "{} steps in profile `paper`", lambda: load_profile("paper").ego.shaping_horizon),
    (
        "docs/protocol",
        "batch size is {}, or {}",
        lambda: (SIZES["small"].cpu_batch, TINY_SIZE.cpu_batch),
    ),
    ("docs/protocol", "{} GRU layers of {}", lambda: (ModelOptions().recurrent_layers, ModelOptions().width)),
    (
        "docs/generating",
        "{} draws for training and {} for validation",
        lambda: (DRAWS_PER_SEED[0], DRAWS_PER_SEED[1]),
    ),
    ("docs/generating", "closer than {} to a test", lambda: SAME_BEHAVIOUR),
    ("docs/generating", "family that are closer than {}", lambda: SAME_BEHAVIOUR),
    ("docs/generating", "differ by {} or more", lambda: LEAST_HEADROOM),
    ("docs/generating", "keeps {} checkpoints", lambda: POLICY_CHECKPOINTS),
    ("docs/generating", "plays {} episodes of {} steps", lambda: (LABEL_EPISODES, KEPT_STEPS)),
    ("docs/generating", "{} rows and {} columns", lambda: (MOST_ROWS, MOST_COLUMNS)),
    (
        "docs/generating",
        "{} % `train`, {} % `validation`, {} % `test`",
        lambda: tuple(100 * share for share in LAYOUT_SPLITS.values()),
    ),
    ("docs/publishing", "({} to {} bytes)", lambda: range_over_layouts(record_size)),
    ("docs/loading", "{} to {} channels", lambda: range_over_layouts(lambda one: one.channels)),
    ("docs/training", "{} layers of width {}, .. K = {}", tiny_model_size),
    ("docs/training", "{} steps take", lambda: TINY_SIZE.train["steps"]),
    ("docs/training", "every {} minutes", lambda: SAVE_MINUTES),
    ("docs/training", "{} of the histories (`--held-out`)", lambda: HistoryOptions(("demo_wide",)).held_out),
    ("docs/format", "`format_version` {}. Version {}", lambda: READABLE_VERSIONS[::-1]),
    ("docs/format", "cooked, 0 to {}", lambda: POT_STEPS),
    ("docs/format", "stays on, 0 to {}", lambda: BUTTON_STEPS),
    (
        "docs/scale",
        "tasks {} environment steps {} kept transitions {}",
        paper_plan_sizes,
    ),
    ("docs/choices", "{} rearranged versions", lambda: reference.TRACK_PLAY["layout"]["rearranged"]),
]
"""Page, the fewest words that find the numbers, with {} for each number and .. for any words, and their computation."""


def numbers_in_page(page: str, claim: str) -> list[str]:
    """Return the numbers that a page has in place of a claim's {}; the page must contain the claim exactly once."""
    words = re.escape(claim).replace(r"\ \.\.", r"[^{}]{0,99}?").replace(r"\{\}", NUMBER)
    pattern = words.replace(r"\ ", r"\s+")
    found = list(re.finditer(pattern, (ROOT / f"{page}.md").read_text(encoding="utf-8")))
    assert len(found) == 1, f"{page}.md has {claim!r} {len(found)} times"
    return list(found[0].groups())


@pytest.mark.parametrize(("page", "claim", "compute"), CLAIMS, ids=[f"{page}: {claim}" for page, claim, _ in CLAIMS])
def test_numbers_in_pages_equal_values_from_code_and_data(page, claim, compute):
    stated, computed = numbers_in_page(page, claim), compute()
    computed = computed if isinstance(computed, tuple) else (computed,)
    assert len(stated) == len(computed)
    for text, value in zip(stated, computed, strict=True):
        decimals = len(text.partition(".")[2]) if text not in WORDS else 3
        number = WORDS[text] if text in WORDS else float(text.replace(",", ""))
        assert number == pytest.approx(round(value, decimals)), f"{page}.md: {claim!r}: {text}, computed {value}"
