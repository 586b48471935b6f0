"""Test pictures of states: each visible thing changes only the pixels of its own cell."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.cells import COOKED, INDICATOR, PLATE
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.render import draw_frame, save_episode
from icrl4aht_data.overcooked.state import columns
from tests.helpers.states import random_records, state_record

CELL = 32
COORD = LAYOUTS["coord_simple"]  # this layout has a pot, a button, an indicator and three ingredients
ONION, TOMATO = COORD.recipe_items.tolist()[0] // 3, COORD.recipe_items.tolist()[1] // 3
DISH = 3 * ONION | PLATE | COOKED


def draw_scene(ego=(2, 2, "down"), teammate=(5, 3, "up"), **fields) -> np.ndarray:
    return draw_frame(COORD, state_record(COORD, ego, teammate, **fields)[0], cell=CELL, view=False)


def cell_pixels(frame: np.ndarray, layout, cell: int) -> np.ndarray:
    y, x = CELL * (cell // layout.width), CELL * (cell % layout.width)
    return frame[y : y + CELL, x : x + CELL].astype(int)


def changed_cells(before: np.ndarray, after: np.ndarray, layout=COORD) -> set[int]:
    return {
        cell
        for cell in range(layout.cells)
        if np.any(cell_pixels(before, layout, cell) != cell_pixels(after, layout, cell))
    }


def dominant_share(pixels: np.ndarray, strong: int, weak: tuple[int, int], least: int = 80) -> float:
    """Return the share of pixels in which one colour channel exceeds the other two by more than `least`."""
    return float((pixels[..., strong] > pixels[..., list(weak)].max(axis=-1) + least).mean())


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_every_layout_is_drawn_with_a_blue_ego_and_a_red_teammate(layout):
    for record in random_records(layout, 5, np.random.default_rng(0)):
        record[columns(layout).hands] = 0
        frame = draw_frame(layout, record, cell=CELL, caption="step 12   return 20")
        assert frame.dtype == np.uint8
        assert frame.shape == (round((layout.height + 0.8) * CELL), layout.width * CELL, 3)
        ego, teammate = (cell_pixels(frame, layout, int(record[agent])) for agent in (EGO, TEAMMATE))
        assert dominant_share(ego, 2, (0, 1)) > 0.15 > dominant_share(ego, 0, (1, 2))
        assert dominant_share(teammate, 0, (1, 2)) > 0.15 > dominant_share(teammate, 2, (0, 1))


def test_all_facings_and_held_items_look_different():
    items = (0, PLATE, ONION, TOMATO, DISH, 3 * TOMATO | PLATE | COOKED)
    for ego in (True, False):
        seen = set()
        for facing in ("up", "down", "right", "left"):
            for item in items:
                if ego:
                    frame = draw_scene(ego=(2, 2, facing), hands=(item, 0))
                else:
                    frame = draw_scene(teammate=(5, 3, facing), hands=(0, item))
                seen.add(frame.tobytes())
        assert len(seen) == 4 * len(items)


@pytest.mark.parametrize(
    "thing, fields",
    [
        ("pots", [{"pot_items": (n * ONION,)} for n in range(3)]),
        ("pots", [{"pot_items": (3 * ONION,), "pot_timers": (timer,)} for timer in range(1, 20)]),
        ("pots", [{"pot_items": (item,)} for item in (0, 3 * ONION | COOKED, 3 * TOMATO | COOKED)]),
        ("buttons", [{"buttons": (timer,)} for timer in range(11)]),
    ],
    ids=["filling", "cooking", "cooked", "lamp"],
)
def test_pot_and_button_states_change_only_their_own_cells(thing, fields):
    frames = [draw_scene(**options) for options in fields]
    assert len({frame.tobytes() for frame in frames}) == len(frames)
    assert all(changed_cells(frames[0], frame) == set(getattr(COORD, thing)) for frame in frames[1:])


def test_recipe_is_drawn_on_indicator_footer_and_lit_buttons():
    recipes = COORD.recipe_items.tolist()
    indicator = set((COORD.kinds == INDICATOR).nonzero()[0].tolist())
    for lit, cells in ((0, indicator), (5, indicator | set(COORD.buttons))):
        first, second = (draw_scene(recipe=recipe, buttons=(lit,)) for recipe in recipes)
        assert changed_cells(first, second) == cells
        footer = COORD.height * CELL
        assert np.any(first[footer:] != second[footer:])


def test_view_of_the_ego_is_outlined_only_on_request():
    layout = LAYOUTS["coord_ring"]
    record = state_record(layout, (4, 3, "up"), (1, 1, "up"))[0]
    with_view, without = (draw_frame(layout, record, cell=CELL, view=view).astype(int) for view in (True, False))
    rows, columns_ = np.any(with_view != without, axis=-1).nonzero()
    assert (rows.min(), columns_.min()) == (1 * CELL, 2 * CELL)
    assert max(rows.max() - 6 * CELL, columns_.max() - 7 * CELL, key=abs) in (-1, 0)
    edge = with_view[CELL + 1, 2 * CELL : 7 * CELL]
    assert dominant_share(edge, 2, (0, 1)) == 1 > dominant_share(without[CELL + 1, 2 * CELL : 7 * CELL], 2, (0, 1))


def test_save_episode_writes_a_looping_gif_with_one_frame_per_step(tmp_path):
    records = np.repeat(state_record(COORD, (2, 2, "up"), (5, 2, "up")), 6, axis=0)
    records[3:, columns(COORD).hands] = DISH
    path = tmp_path / "episode.gif"
    save_episode(path, COORD, records, np.array([0, 0, 20, 0, -5, 0.0]), cell=24, fps=10)
    with Image.open(path) as image:
        assert (image.format, getattr(image, "n_frames", 1), image.info["loop"]) == ("GIF", 6, 0)
        frames, durations = [], []
        for number in range(6):
            image.seek(number)
            frames.append(np.array(image.convert("RGB")).astype(int))
            durations.append(image.info["duration"])
    assert durations == [100] * 6
    captions = [f"step {k}   return {earned}" for k, earned in enumerate((0, 0, 0, 20, 20, 15))]
    for record, caption, frame in zip(records, captions, frames, strict=True):
        apart = [
            np.abs(frame - draw_frame(COORD, record, cell=24, caption=text)).mean() for text in (caption, caption + "9")
        ]
        assert apart[0] < 1, caption
        assert apart[0] < apart[1], caption
    assert len(np.unique(np.concatenate(frames).reshape(-1, 3), axis=0)) <= 128
    assert [entry.name for entry in tmp_path.iterdir()] == ["episode.gif"]


def test_wrong_input_raises_error_with_expected_and_found_values(tmp_path):
    records = state_record(COORD, (2, 2, "up"), (5, 2, "up"))
    size, path = records.shape[-1], tmp_path / "episode.gif"
    off_the_floor = records[0].copy()
    off_the_floor[0] = 0
    for match, call in {
        rf"uint8 \({size},\).*found uint8 \({size - 1},\)": lambda: draw_frame(COORD, records[0, 1:]),
        rf"uint8 \({size},\).*found int64 \({size},\)": lambda: draw_frame(COORD, records[0].astype(np.int64)),
        "not reachable floor": lambda: draw_frame(COORD, off_the_floor),
        "from 16 to 128 pixels, found 8": lambda: draw_frame(COORD, records[0], cell=8),
        rf"uint8 \(T, {size}\).*found uint8 \({size},\)": lambda: save_episode(path, COORD, records[0]),
        r"rewards \(1,\).*found \(2,\)": lambda: save_episode(path, COORD, records, np.zeros(2)),
        "fps from 1 to 50, found 0": lambda: save_episode(path, COORD, records, fps=0),
    }.items():
        with pytest.raises(OptionError, match=match):
            call()
    assert not list(tmp_path.iterdir())
