"""Test the shipped table of measured teammates with drawn parameters, and the choice of these teammates for tasks."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from icrl4aht_generation.teammates import draws
from icrl4aht_generation.teammates.draws import (
    DRAWS_PER_SEED,
    DRAWS_TABLE,
    Draw,
    diverse_tasks,
    drawn_teammates,
    read_draws,
    read_measured,
    usable_families,
    validation_tasks,
    write_table,
)
from icrl4aht_generation.teammates.registry import HEURISTIC_FAMILIES, sample_teammate
from icrl4aht_generation.teammates.spread import SPREAD_TABLE, LayoutSpread
from msgspec.structs import replace

from icrl4aht_data.benchmark.facts import TESTED_ON, TRACKS
from icrl4aht_data.errors import OptionError, TaskFormatError, UnknownNameError

H1, H2, H3, H4 = HEURISTIC_FAMILIES
UNCACHED = draws._bundled_draws.__wrapped__


def draw(family: str, theta_id: int, behaviour: int = 0, *, base_seed=0, distance=0.5, oracle=30.0) -> Draw:
    """Return a measured teammate on demo_wide; the egos `stay` and `random` earn 1 and 2 with this teammate."""
    return Draw(
        "demo_wide", family, base_seed, theta_id, "H3/t0", distance, behaviour, 1.0, 2.0, oracle, "H1/t1", distance
    )


def replace_draws_table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *found: Draw) -> None:
    write_table(tmp_path / "draws.jsonl", found)
    monkeypatch.setattr(draws, "DRAWS_TABLE", tmp_path / "draws.jsonl")
    monkeypatch.setattr(draws, "_bundled_draws", UNCACHED)


def chosen_draws(*arguments, **options) -> list[tuple[str, int]]:
    return [(found.family, found.theta_id) for _, found in drawn_teammates("demo_wide", *arguments, **options)]


def draw_key(found: Draw) -> tuple[str, str, int, int]:
    return found.layout, found.family, found.base_seed, found.theta_id


def test_draws_table_has_every_draw_once():
    expected = [
        (layout, family, seed, theta_id)
        for layout in TESTED_ON
        for family in HEURISTIC_FAMILIES
        for seed, count in DRAWS_PER_SEED.items()
        for theta_id in range(count)
    ]
    assert [draw_key(found) for found in read_measured(DRAWS_TABLE, Draw)] == expected
    assert [found.theta_id for found in read_draws("demo_wide", H1)] == list(range(DRAWS_PER_SEED[0]))
    assert draw_key(read_draws("demo_cook_wide", H1, 1)[3]) == ("demo_wide", H1, 1, 3)


@pytest.mark.parametrize(("table", "kind"), [(DRAWS_TABLE, Draw), (SPREAD_TABLE, LayoutSpread)])
def test_tables_are_in_canonical_form(table, kind, tmp_path):
    """Reading and writing a table gives the same bytes."""
    write_table(tmp_path / "again.jsonl", reversed(read_measured(table, kind)))
    assert (tmp_path / "again.jsonl").read_bytes() == table.read_bytes()


@pytest.mark.parametrize("layout", TESTED_ON)
def test_chosen_draws_differ_from_test_teammates_of_their_family(layout):
    for seed in DRAWS_PER_SEED:
        families = usable_families(layout, seed)
        usable = [found for family in families for found in read_draws(layout, family, seed) if found.admissible]
        headroom = [found for found in usable if found.headroom]
        teammates = drawn_teammates(layout, families, len(headroom or usable), seed)
        assert {found for _, found in teammates} == {*(headroom or usable)}
        assert all(found.distance >= 0.02 for _, found in teammates)
        with pytest.raises(OptionError, match=r"but there are only \d+ distinct draws; request fewer"):
            drawn_teammates(layout, families, len(teammates) + 1, seed)
        for family in {*HEURISTIC_FAMILIES} - {*families}:
            with pytest.raises(OptionError, match=rf"{layout}: no usable (drawn|diverse) \w+ teammates of {family}: "):
                drawn_teammates(layout, [family], 1, seed)


def test_validation_teammates_are_not_training_teammates():
    for track in TRACKS:
        for task in validation_tasks(track):
            layout, family = task.layout.name, task.teammate["family"]
            assert task.teammate["base_seed"] == 1
            trained = [sample_teammate(family, one.theta_id, "train") for one in read_draws(layout, family)]
            assert task.teammate["theta"] not in [entry["theta"] for entry in trained]


def test_each_layout_has_up_to_four_validation_tasks():
    tasks = [task for track in TRACKS for task in validation_tasks(track)]
    found = Counter(task.layout.name for task in tasks)
    for layout in TESTED_ON:
        usable = [one for family in HEURISTIC_FAMILIES for one in read_draws(layout, family, 1) if one.admissible]
        usable = [one for one in usable if one.headroom] or usable
        assert found[layout] == min(4, len(usable))
        families = Counter(task.teammate["family"] for task in tasks if task.layout.name == layout)
        assert {*families} == {*usable_families(layout, 1)[:4]}
    assert len({task.task_id for task in tasks}) == len(tasks)


@pytest.mark.parametrize("track", TRACKS)
def test_diverse_teammates_differ_from_test_teammates_and_each_other(track):
    thetas = []
    for split, base_seed, most in (("train", 2, 12), ("validation", 3, 3)):
        tasks = diverse_tasks(track, split)
        counts = Counter((task.layout.name, task.teammate["family"]) for task in tasks)
        assert max(counts.values()) <= most and {task.split for task in tasks} == {split}
        assert {layout for layout, _ in counts} == set(TRACKS[track]["train"])
        for task in tasks:
            family, entry = task.teammate["family"], task.teammate
            (found,) = [
                one for one in read_draws(task.layout.name, family, base_seed) if one.theta_id == entry["theta_id"]
            ]
            assert entry == sample_teammate(family, found.theta_id, "diverse", base_seed)
            assert min(found.distance, found.other_distance) >= 0.1
            thetas.append((task.layout.name, family, tuple(entry["theta"].items())))
    assert len(set(thetas)) == len(thetas)  # no draw is in both splits


def test_draws_alternate_between_families_and_start_with_new_behaviours(monkeypatch, tmp_path):
    h1 = [draw(H1, 0), draw(H1, 1), draw(H1, 2, behaviour=4), draw(H1, 3, behaviour=4), draw(H1, 4, behaviour=2)]
    replace_draws_table(monkeypatch, tmp_path, *h1, draw(H3, 5), draw(H3, 6))
    assert chosen_draws([H1], 5) == [(H1, 0), (H1, 2), (H1, 4), (H1, 1), (H1, 3)]
    assert chosen_draws([H3, H1], 6) == [(H3, 5), (H1, 0), (H3, 6), (H1, 2), (H1, 4), (H1, 1)]
    assert chosen_draws([H3, H1, H3], 2) == [(H3, 5), (H1, 0)]
    assert chosen_draws([], 0) == chosen_draws([H1], 0) == []


def test_draws_with_more_headroom_come_first(monkeypatch, tmp_path):
    """The lowest-numbered draws of all behaviours come first, then all other draws; both groups are sorted by headroom.

    Draws that are similar to test teammates of other families come last.
    """
    first = [draw(H1, 0, oracle=20.0), draw(H1, 1, behaviour=1, oracle=50.0), draw(H1, 2, behaviour=2, oracle=-30.0)]
    others = [draw(H1, 3, oracle=25.0), draw(H1, 4, oracle=45.0), draw(H1, 5, behaviour=1, oracle=25.0)]
    like = replace(draw(H1, 6, behaviour=3, oracle=60.0), other="H4/t0", other_distance=0.0199)
    unlike = replace(draw(H1, 7, behaviour=3, oracle=10.0), other="H4/t0", other_distance=0.02)
    replace_draws_table(monkeypatch, tmp_path, *first, *others, like, unlike)
    assert [found.spread for found in first] == [19.0, 49.0, 32.0]
    assert [theta_id for _, theta_id in chosen_draws([H1], 8)] == [1, 2, 0, 7, 4, 3, 5, 6]


def test_draws_similar_to_a_test_teammate_are_left_out(monkeypatch, tmp_path):
    replace_draws_table(
        monkeypatch, tmp_path, draw(H1, 0, distance=0.0199), draw(H1, 1, distance=0.02), draw(H2, 0, distance=0)
    )
    assert usable_families("demo_wide") == [H1]
    assert chosen_draws([H1], 1) == [(H1, 1)]
    with pytest.raises(
        OptionError, match=f"1 draws act like a test teammate .*distance 0.000.*0.02 or more, to H3/t0.*1 of {H1}"
    ):
        drawn_teammates("demo_wide", [H1, H2], 1)


def test_draws_without_headroom_are_left_out_if_other_draws_have_headroom(monkeypatch, tmp_path):
    flat, wide = draw(H1, 0, oracle=5.9), draw(H1, 1, oracle=6.0)
    replace_draws_table(monkeypatch, tmp_path, flat, wide, draw(H3, 0, oracle=5.9))
    assert chosen_draws([H1], 1) == [(H1, 1)]
    with pytest.raises(OptionError, match=f"of {H3}: none of the 1 draws .* differ by 4.9 .*differ by 5 or more"):
        drawn_teammates("demo_wide", [H3], 1)
    replace_draws_table(monkeypatch, tmp_path, flat, replace(wide, distance=0.01), draw(H3, 0, oracle=5.9))
    assert chosen_draws([H1, H3], 2) == [(H1, 0), (H3, 0)]


def test_unknown_family_layout_or_seed_of_draws_raises_error():
    with pytest.raises(UnknownNameError, match=f"unknown teammate family 'H4'; valid: {H1}, "):
        drawn_teammates("demo_wide", ["H4"], 1)
    with pytest.raises(UnknownNameError, match="unknown training layout 'asymm_right'"):
        read_draws("asymm_right", H1)
    with pytest.raises(UnknownNameError, match="unknown layout 'demo'"):
        drawn_teammates("demo", [H1], 1)
    with pytest.raises(UnknownNameError, match="unknown base_seed of draws 4; valid: 0, 1"):
        read_draws("demo_wide", H1, 4)


def test_damaged_draws_table_raises_error_with_line_number(tmp_path):
    path = tmp_path / "draws.jsonl"
    write_table(path, [draw(H1, 0)])
    lines = {"[1]": "Expected `object`, got `array`", "{": "", '{"layout":"demo_wide"}': "required field `family`"}
    for line, message in lines.items():
        path.write_text(path.read_text().splitlines()[0] + f"\n{line}\n")
        with pytest.raises(TaskFormatError, match=rf"draws\.jsonl, line 2: .*{message}"):
            read_measured(path, Draw)
