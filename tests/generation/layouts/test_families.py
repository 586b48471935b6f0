"""Test generated layouts: family, seed and number determine a layout, and all layouts are distinct up to symmetry."""

from __future__ import annotations

import hashlib
import json
from itertools import cycle

import numpy as np
import pytest
from icrl4aht_generation.layouts import (
    canonical_map,
    check_solvable,
    families,
    find_generated,
    generate_layouts,
    playable,
    split_of,
)
from icrl4aht_generation.layouts.families import LAYOUT_FAMILIES, LAYOUT_SPLITS
from icrl4aht_generation.layouts.fixtures import FREE_COUNTERS, faced_cells
from icrl4aht_generation.layouts.grids import agent_rooms, grid_of, symmetric_images
from icrl4aht_generation.layouts.rooms import MOST_COLUMNS, MOST_ROWS
from icrl4aht_generation.layouts.templates import has_test_rooms, published_rooms

from icrl4aht_data.benchmark.facts import LAYOUT_NAMES, TRACKS
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from tests.helpers.commands import run_cli

GOLDEN = {
    "rearranged": "40f6dac5bd75f870cf4813c9d5a9248dfaa7bb1315b5a03b4c6cfc9fd616d4ab",
    "templates": "8d9cf816e96a2fd62fa753634665d38b1aab1c314359a1b01618f991b291956f",
    "rooms": "7e06a247d88cf498b04367eeafd1c94d22c66c16682a715ea5744f381e5fc82e",
}
"""SHA-256 of the first 40 layouts of seed 0 of each family, which must not change after publication."""

EVERY_FAMILY = pytest.mark.parametrize("family", LAYOUT_FAMILIES)


@pytest.fixture(scope="module")
def samples() -> dict[str, list[Layout]]:
    """Return 800 generated layouts of each family."""
    return {family: generate_layouts(family, 0, 800) for family in LAYOUT_FAMILIES}


def layout_fields(layouts: list[Layout]) -> list[tuple]:
    return [(one.name, one.alias, one.rows, one.recipes, one.indicates_delivery) for one in layouts]


@EVERY_FAMILY
def test_generated_layouts_have_the_stored_hash(family, samples):
    text = repr(layout_fields(samples[family][:40]) + [split_of(one) for one in samples[family][:40]])
    assert hashlib.sha256(text.encode()).hexdigest() == GOLDEN[family]


@EVERY_FAMILY
def test_first_generated_layouts_do_not_depend_on_the_count(family, samples):
    assert layout_fields(generate_layouts(family, 0, 30)) == layout_fields(samples[family][:30])
    assert [one.rows for one in generate_layouts(family, 1, 5)] != [one.rows for one in samples[family][:5]]
    assert generate_layouts(family, 0, 0) == []
    assert layout_fields([find_generated(f"{family}-0-7")]) == layout_fields(samples[family][7:8])


@EVERY_FAMILY
def test_generated_layouts_are_solvable_and_distinct_up_to_symmetry(family, samples):
    maps = [canonical_map(get_layout(name)) for name in LAYOUT_NAMES] + [canonical_map(one) for one in samples[family]]
    assert len(set(maps)) == len(maps)
    for layout in samples[family]:
        check_solvable(layout)


@pytest.mark.parametrize("family", ["templates", "rooms"])
def test_generated_layouts_have_allowed_fixtures_and_recipes(family, samples):
    """Agents can face all fixtures; a layout has 4 to 6 fixtures more than needed, or fewer if there is no space."""
    shown = set()
    for layout in samples[family]:
        grid, types = grid_of(layout), layout.ingredients
        faced = np.logical_or(*faced_cells(agent_rooms(layout)))
        assert faced[(grid != "W") & (grid != " ") & (grid != "A")].all()
        assert np.array_equal(agent_rooms(layout).any(axis=0), (grid == " ") | (grid == "A"))
        fixtures = int((faced & (grid != "W")).sum())
        more, free = fixtures - len(types) - 3, int((faced & (grid == "W")).sum())
        assert 4 <= more <= 6 or (more < 4 and free == FREE_COUNTERS)
        assert len(types) in (2, 3) and max(types) <= 3
        assert 2 <= len(set(layout.recipes)) == len(layout.recipes) <= {2: 4, 3: 10}[len(types)]
        shown.add(((grid == "R").any(), (grid == "L").any(), layout.indicates_delivery))
    assert len(shown) == 8, "with and without recipe indicators, buttons and the delivery indicator"


def test_layouts_of_family_rooms_are_small_and_every_third_separates_the_agents(samples):
    published = published_rooms(False) | published_rooms(True)
    assert len(published) == 7  # some layouts, such as coord_simple and test_simple, have the same floor cells
    for layout in samples["rooms"]:
        assert layout.height <= MOST_ROWS and layout.width <= MOST_COLUMNS
    shared = [np.array_equal(*layout.rooms) for layout in samples["rooms"][:300]]
    assert shared == [True, False, True] * 100


def test_symmetric_layouts_have_equal_canonical_map_and_split(samples):
    for layout in (*map(get_layout, ("asymm_both", "cramped_up")), *samples["rooms"][:20], *samples["templates"][:20]):
        images = [
            Layout("", "", tuple(map("".join, grid)), layout.recipes) for grid in symmetric_images(grid_of(layout))
        ]
        assert {canonical_map(one) for one in images} == {canonical_map(layout)}
        assert {split_of(one) for one in images} == {split_of(layout)}


def test_canonical_map_depends_on_start_rooms_but_not_start_cells():
    first = Layout("", "", ("W0PWW", "WA A1", "W   W", "WBWXW"))
    second = Layout("", "", ("W0PWW", "W   1", "WA AW", "WBWXW"))
    one_each = Layout("", "", ("W0PBX1W", "W WA AW", "WWWWWWW"), recipes=((0, 0, 1),))
    other = Layout("", "", ("W0PBX1W", "WAWA  W", "WWWWWWW"), recipes=((0, 0, 1),))
    assert canonical_map(first) == canonical_map(second)
    assert canonical_map(one_each) != canonical_map(other), "an agent starts in another room"


def test_generated_layouts_are_split_by_declared_shares(samples):
    for family, layouts in samples.items():
        splits = [split_of(one) for one in layouts]
        may_train = np.array([not has_test_rooms(one) for one in layouts])
        assert not {"train"} & {split for split, may in zip(splits, may_train, strict=True) if not may}
        for split, share in LAYOUT_SPLITS.items():
            trained = np.array(splits)[may_train] == split
            assert abs(trained.mean() - share) < 0.05
        some = generate_layouts(family, 0, 20, split="validation")
        assert layout_fields(some) == layout_fields([one for one in layouts if split_of(one) == "validation"][:20])


def test_layouts_with_rooms_of_test_layouts_are_not_for_training(samples):
    """Rooms of test layouts are excluded from training, except rooms that training layouts of track `layout` have."""
    assert {name for name in LAYOUT_NAMES if not has_test_rooms(get_layout(name))} == {
        *TRACKS["layout"]["train"],
        *TRACKS["layout"]["test"],
    }
    tested = [one for one in samples["templates"] if has_test_rooms(one)]
    assert len(tested) == 400 and {split_of(one) for one in tested} == {"validation", "test"}


def test_invalid_arguments_of_layout_generation_raise_errors():
    with pytest.raises(UnknownNameError, match=r"unknown family of layouts 'template'.*Did you mean 'templates'"):
        generate_layouts("template", 0, 1)
    with pytest.raises(UnknownNameError, match="unknown split of layouts 'heldout'"):
        generate_layouts("rooms", 0, 1, split="heldout")
    for seed, count, message in ((-1, 3, "seed = -1"), (0, 1.5, "count = 1.5"), (True, 1, "seed = True")):
        with pytest.raises(OptionError, match=message):
            generate_layouts("rooms", seed, count)  # type: ignore[arg-type]
    for draw in (lambda: generate_layouts("rooms", 0, 10**9), lambda: find_generated(f"rooms-0-{10**9 - 1}")):
        with pytest.raises(OptionError, match=f"count = {10**9}"):
            draw()
    for name in ("templates-0", "templates-0-x", "coord_ring"):
        with pytest.raises(OptionError, match=f"{name}: expected the name of a generated layout"):
            find_generated(name)


def test_request_for_too_many_layouts_raises_error_with_the_number_found(monkeypatch):
    few = generate_layouts("rooms", 0, 3)
    draws = [(one.rows, one.recipes, False) for one in few]
    monkeypatch.setattr(families, "MOST_REPEATS", 20)
    monkeypatch.setitem(LAYOUT_FAMILIES, "few", lambda seed: cycle(draws))
    with pytest.raises(OptionError, match="family few, seed 0: found only 3 layouts, expected 4; ask for fewer"):
        generate_layouts("few", 0, 4)
    trained = sum(split_of(one) == "train" for one in few)
    with pytest.raises(OptionError, match=f"found only {trained} layouts of split train, expected 4"):
        generate_layouts("few", 0, 4, split="train")


def test_layouts_command_lists_and_draws_layouts(tmp_path):
    from PIL import Image

    sheet = tmp_path / "sheet.png"
    arguments = ["layouts", "--family", "rooms", "--count", "8", "--split", "train", "--out", str(sheet)]
    printed = run_cli(*arguments)
    wanted = generate_layouts("rooms", 0, 8, split="train")
    lines = printed.splitlines()
    assert [line.split()[:2] for line in lines[:-1]] == [[one.name, "train"] for one in wanted]
    assert lines[-1].startswith("wrote ")
    with Image.open(sheet) as picture:
        assert picture.width > 6 * 4 * 22 and picture.height > 2 * 4 * 22
    with pytest.raises(OptionError, match="--overwrite"):
        run_cli(*arguments)
    printed = run_cli(*arguments, "--overwrite", "--json")
    found = json.loads(printed[: printed.rindex("]") + 1])
    assert [(one["name"], tuple(one["rows"]), one["split"]) for one in found] == [
        (one.name, one.rows, "train") for one in wanted
    ]


@pytest.mark.slow
def test_oracles_deliver_on_generated_layouts(samples, monkeypatch):
    monkeypatch.setattr(playable, "_AT_ONCE", 4)  # the layouts are played in two batches
    idle = Layout("idle", "idle", ("WWWWWW", "WA  WW", "WAW0PB", "WWWWXW"), recipes=((0, 0, 0),))
    layouts = [one for family in LAYOUT_FAMILIES for one in samples[family][:2]]
    assert playable.are_playable([*layouts, idle]).tolist() == [True] * len(layouts) + [False]
