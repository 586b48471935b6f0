"""Sampled heuristic teammates for training and validation tasks.

`draws.jsonl` has one line for each sampled teammate (a draw), measured by `icrl4aht-data research draws`, so tasks need
no simulation. The published training ranges leave out most parameters that decide a heuristic's behaviour. Therefore
many draws behave the same, and on some layouts all draws of a family behave like a test instance of the family. Such
draws are not admissible: no task uses them.

Diverse draws vary all parameters that decide the behaviour (`Heuristic.diverse`), for models that learn by playing.
Diverse draws must have a larger distance to every test instance.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import Struct

from icrl4aht_data.benchmark.facts import LEAST_HEADROOM, SAME_BEHAVIOUR, TESTED_ON, TRACKS, layout_sort_key
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.errors import OptionError, TaskFormatError, check_choice, unknown_name
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import read_lines, write_atomically
from icrl4aht_data.utils.groups import grouped
from icrl4aht_generation.teammates.registry import HEURISTIC_FAMILIES, sample_teammate

DRAWS_TABLE = Path(__file__).with_name("draws.jsonl")
"""Path of the table of all sampled teammates (draws)."""

DRAWS_PER_SEED = {0: 32, 1: 8, 2: 32, 3: 8}
"""Number of draws in the table for each layout and family by base_seed: 0 and 1 are draws from the published training
ranges for training and validation, 2 and 3 are diverse draws for training and validation."""

_OF_SEED = {0: "drawn training", 1: "drawn validation", 2: "diverse training", 3: "diverse validation"}

VALIDATION_SEED, _VALIDATION_TEAMMATES = 1, 4
"""Base seed of drawn validation teammates; training teammates have base seed 0, so the splits share no teammate."""

DIVERSE_SEEDS = {"train": 2, "validation": 3}
"""Base seed of diverse teammates by split."""

_DIVERSE_TEAMMATES = {"train": 12, "validation": 3}  # maximum number of tasks of a family on a layout

DIVERSE_DISTANCE = 0.1
"""Minimum Hamming distance of a diverse teammate to the test instances of all families."""


def ranges_of(base_seed: int) -> str:
    """Return the name of the parameter ranges for a base seed: "train" or "diverse", see `sample_teammate`."""
    return "diverse" if base_seed in DIVERSE_SEEDS.values() else "train"


def _least_distance(base_seed: int) -> float:
    return DIVERSE_DISTANCE if base_seed in DIVERSE_SEEDS.values() else SAME_BEHAVIOUR


class Draw(Struct, frozen=True, forbid_unknown_fields=True):
    """A sampled teammate on one layout: `sample_teammate(family, theta_id, ranges_of(base_seed), base_seed)`.

    Attributes:
        layout: short name of a training layout.
        family: kind of the heuristic, such as "utility_greedy".
        base_seed: seed of the ranges and the split, see `DRAWS_PER_SEED`.
        theta_id: number of the draw, from 0.
        nearest: test instance of the same family with the most similar behaviour, such as "H3/t1".
        distance: Hamming distance to `nearest`, 0..1; see `icrl4aht_generation.teammates.distances`.
        behaviour: number of the behaviour; draws of one family and layout with equal numbers behave the same.
        stay: mean return of the ego `stay` with the teammate in 20 episodes of 100 steps.
        random: mean return of the ego `random` with the teammate.
        oracle: mean return of the ego `oracle` with the teammate.
        other: test instance of another family with the most similar behaviour. Draws of the published ranges that
            behave like `other` stay admissible, but are chosen last.
        other_distance: Hamming distance to `other`.
    """

    layout: str
    family: str
    base_seed: int
    theta_id: int
    nearest: str
    distance: float
    behaviour: int
    stay: float
    random: float
    oracle: float
    other: str = ""
    other_distance: float = 1.0

    @property
    def order(self) -> tuple[Any, ...]:
        """Sort key of the table's rows: layout, family, seed and theta_id."""
        return layout_sort_key(self.layout), list(HEURISTIC_FAMILIES).index(self.family), self.base_seed, self.theta_id

    @property
    def admissible(self) -> bool:
        """Whether the draw behaves differently from all test instances of its family (of all families if diverse)."""
        return self.nearest_test_instance[0] >= _least_distance(self.base_seed)

    @property
    def nearest_test_instance(self) -> tuple[float, str]:
        """Distance and name of the most similar test instance of the family, or of all families for a diverse draw.

        The draw is `admissible` if this distance is large enough.
        """
        own, other = (self.distance, self.nearest), (self.other_distance, self.other)
        diverse = self.base_seed in DIVERSE_SEEDS.values()
        return other if diverse and other[0] < own[0] else own

    @property
    def like_another_family(self) -> bool:
        """Whether the draw behaves like a test instance of another family."""
        return self.other_distance < SAME_BEHAVIOUR

    @property
    def spread(self) -> float:
        """Difference between the best and the worst return of the reference egos."""
        returns = (self.stay, self.random, self.oracle)
        return max(returns) - min(returns)

    @property
    def headroom(self) -> bool:
        """Whether an ego can raise the return with this teammate."""
        return self.spread >= LEAST_HEADROOM


def read_draws(layout: str, family: str, base_seed: int = 0) -> list[Draw]:
    """Return the sampled teammates (draws) of a heuristic family on a training layout, in the order of theta_id.

    Raises:
        UnknownNameError: if the layout, family or seed does not exist, or the layout has no training tasks.
    """
    name = get_layout(layout).name
    check_choice("training layout", name, TESTED_ON)
    check_choice("teammate family", family, HEURISTIC_FAMILIES)
    if base_seed not in DRAWS_PER_SEED:
        raise unknown_name("base_seed of draws", base_seed, map(str, DRAWS_PER_SEED))
    return list(_bundled_draws().get((name, family, base_seed), ()))


def drawn_teammates(
    layout: str,
    families: Sequence[str],
    count: int,
    base_seed: int = 0,
    without: Collection[tuple[str, int]] = (),
) -> list[tuple[dict[str, Any], Draw]]:
    """Choose sampled teammates of a layout from the table, without simulation.

    The families take turns. Only admissible draws are chosen, and draws without headroom only if no admissible draw on
    the layout has headroom. Each family prefers draws that behave differently from all test instances, then one draw of
    each behaviour, then draws with a large difference between the reference egos' returns, then a small theta_id.

    Args:
        layout: a training layout.
        families: kinds of heuristics, in the order of their turns.
        count: number of teammates.
        base_seed: seed of the draws, see `DRAWS_PER_SEED`.
        without: pairs (family, behaviour) that must not be chosen, such as those of training teammates.

    Returns:
        Teammate entries, as `sample_teammate` returns them, with their draws.

    Raises:
        OptionError: if a family has no admissible draws on the layout, or the families have fewer draws than `count`.
        UnknownNameError: if the layout, family or seed does not exist, or the layout has no training tasks.
    """
    name = get_layout(layout).name
    queues = [_ordered_draws(name, family, base_seed) for family in dict.fromkeys(families)]
    queues = [[draw for draw in queue if (draw.family, draw.behaviour) not in without] for queue in queues]
    available = sum(map(len, queues))
    if count > available:
        unlike = f" that act unlike the {len(without)} behaviours of the training teammates" if without else ""
        raise OptionError(
            f"{name}: {count} {_OF_SEED[base_seed]} teammates requested from {', '.join(families) or 'no family'}, "
            f"but there are only {available} distinct draws{unlike}; request fewer, or name more families "
            f"({_usable_text(name, base_seed)})"
        )
    turns = [queue[turn] for turn in range(max(map(len, queues), default=0)) for queue in queues if turn < len(queue)]
    ranges = ranges_of(base_seed)
    return [(sample_teammate(draw.family, draw.theta_id, ranges, base_seed), draw) for draw in turns[:count]]


def validation_tasks(track: str) -> list[Task]:
    """Return the tasks of split `validation` for model selection: up to four for each training layout.

    The teammates are draws with base_seed 1. A layout has no such tasks if all these draws behave like test instances.
    """
    tasks = []
    for layout in (layout for layout in TRACKS[track]["validation"] if layout in TESTED_ON):
        families = usable_families(layout, VALIDATION_SEED)
        count = min(_VALIDATION_TEAMMATES, sum(len(_usable(layout, family, VALIDATION_SEED)) for family in families))
        chosen = drawn_teammates(layout, families, count, VALIDATION_SEED)
        tasks += [make_task(track, "validation", layout, teammate, seed=0) for teammate, _ in chosen]
    return tasks


def diverse_tasks(track: str, split: str) -> list[Task]:
    """Return tasks with diverse teammates on a track's training layouts, for models that learn by playing.

    Each layout and family has up to twelve tasks for training and three for validation, all with different behaviours.

    Args:
        track: name of the track.
        split: "train" or "validation".
    """
    seed, most = DIVERSE_SEEDS[split], _DIVERSE_TEAMMATES[split]
    tasks = []
    for layout in (layout for layout in TRACKS[track]["train"] if layout in TESTED_ON):
        for family in usable_families(layout, seed):
            behaviours = {draw.behaviour for draw in _usable(layout, family, seed)}
            chosen = drawn_teammates(layout, [family], min(most, len(behaviours)), seed)
            tasks += [make_task(track, split, layout, teammate, seed=0) for teammate, _ in chosen]
    return tasks


def find_draw(layout: str, teammate: Mapping[str, Any]) -> Draw | None:
    """Return the draw that a teammate entry describes, or None if the table has no such draw."""
    for draw in _bundled_draws().get((layout, teammate["family"], teammate.get("base_seed", -1)), ()):
        if draw.theta_id == teammate["theta_id"]:
            sampled = sample_teammate(draw.family, draw.theta_id, ranges_of(draw.base_seed), draw.base_seed)
            return draw if equal_parameters(sampled["theta"], teammate["theta"]) else None
    return None


def equal_parameters(theta: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Return whether parameters are equal up to rounding errors, which may differ between compilations."""
    return theta.keys() == other.keys() and all(math.isclose(theta[name], other[name], rel_tol=1e-6) for name in theta)


def usable_families(layout: str, base_seed: int = 0) -> list[str]:
    """Return the families with sampled teammates that tasks on a training layout may use, in the paper's order."""
    return [family for family in HEURISTIC_FAMILIES if _usable(get_layout(layout).name, family, base_seed)]


def _ordered_draws(layout: str, family: str, base_seed: int) -> list[Draw]:
    """Return the usable draws of a family in order of preference, or raise an error if the family has none.

    Draws that behave like a test instance of another family come last.
    """
    draws = _usable(layout, family, base_seed)
    if not draws:
        farthest = max((draw.nearest_test_instance for draw in read_draws(layout, family, base_seed)), default=None)
        near = f", to {farthest[1]}" if farthest else ""
        raise OptionError(
            f"{layout}: no usable {_OF_SEED[base_seed]} teammates of {family}: "
            f"{unusable_reason(layout, family, base_seed)}; expected a distance of {_least_distance(base_seed)} or "
            f"more{near}, and returns that differ by {LEAST_HEADROOM:g} or more; name other families "
            f"({_usable_text(layout, base_seed)})"
        )
    first = {(draw.like_another_family, draw.behaviour): draw for draw in reversed(draws)}

    def order(draw: Draw) -> tuple[bool, bool, float, int]:
        like = draw.like_another_family
        return like, first[like, draw.behaviour] != draw, -draw.spread, draw.theta_id

    return sorted(draws, key=order)


def _usable(layout: str, family: str, base_seed: int) -> list[Draw]:
    draws = [draw for draw in read_draws(layout, family, base_seed) if draw.admissible]
    return [draw for draw in draws if draw.headroom] if _has_headroom(layout, base_seed) else draws


def _has_headroom(layout: str, base_seed: int) -> bool:
    """Return whether any admissible draw of the layout has headroom."""
    draws = (draw for family in HEURISTIC_FAMILIES for draw in read_draws(layout, family, base_seed))
    return any(draw.admissible and draw.headroom for draw in draws)


def unusable_reason(layout: str, family: str, base_seed: int = 0) -> str:
    """Return the reason why no draw of a family is usable on a layout."""
    draws = read_draws(layout, family, base_seed)
    if not draws:
        return "no draws were measured; `icrl4aht-data research draws` measures them"
    admissible = [draw for draw in draws if draw.admissible]
    if not admissible:
        farthest = max(draw.nearest_test_instance[0] for draw in draws)
        tests = "a test teammate" if base_seed in DIVERSE_SEEDS.values() else "a test teammate of the family"
        return f"all {len(draws)} draws act like {tests} (distance {farthest:.3f} at most)"
    widest = max(draw.spread for draw in admissible)
    return (
        f"none of the {len(admissible)} draws that act unlike the test teammates has headroom (returns differ by "
        f"{widest:.1f} at most)"
    )


def _usable_text(layout: str, base_seed: int) -> str:
    counts = {family: len(_usable(layout, family, base_seed)) for family in usable_families(layout, base_seed)}
    return "available: " + (", ".join(f"{count} of {family}" for family, count in counts.items()) or "none")


@lru_cache(maxsize=1)
def _bundled_draws() -> dict[tuple[str, str, int], list[Draw]]:
    return grouped(read_measured(DRAWS_TABLE, Draw), lambda draw: (draw.layout, draw.family, draw.base_seed))


AnyRow = TypeVar("AnyRow", bound=Struct)
"""Type of the lines in a table of measured teammates."""


def read_measured(path: Path, kind: type[AnyRow]) -> list[AnyRow]:
    """Return the lines of a table of measured teammates, in the order of the file.

    Raises:
        TaskFormatError: if a line is invalid; the message names the file and the line.
    """
    found = []
    for number, line in enumerate(read_lines(path), start=1):
        try:
            found.append(msgspec.json.decode(line, type=kind))
        except msgspec.DecodeError as error:
            raise TaskFormatError(f"{path}, line {number}: {error}") from error
    return found


def write_table(path: Path, rows: Iterable[Any]) -> None:
    """Write one JSON line for each row, sorted by the rows' `order`."""
    lines = [msgspec.json.encode(row) + b"\n" for row in sorted(rows, key=lambda row: row.order)]
    write_atomically(path, b"".join(lines))
