"""Test the page of `icrl4aht-data browse` in headless Chromium: decoding, drawing, keys, phone width and dark mode."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.browsing.page import make_browser_page, save_browser_page
from icrl4aht_data.dataset import Dataset
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import draw_frame
from tests.helpers.chromium import NEEDS_CHROMIUM, PHONE, check_fits_window, chromium, wait_until
from tests.helpers.random_releases import random_release

pytestmark = NEEDS_CHROMIUM

OpenPage = Callable[..., Any]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    root = tmp_path_factory.mktemp("browse") / "release"
    random_release(root, layouts=("coord_simple", "test_wide"), oracle=True, streams=2)
    return load_icrl4aht(root)


@pytest.fixture(scope="module")
def page_file(dataset, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "browse.html"
    save_browser_page(make_browser_page(dataset), path)
    return path


@pytest.fixture(scope="module")
def open_page(page_file) -> Iterator[OpenPage]:
    """Yield a function that opens the page in Chromium and waits until its data are decoded."""
    with chromium() as open_address:

        def open_and_wait(address: str = "", path: Path = page_file, **options: Any) -> Any:
            page = open_address(f"{path.as_uri()}{address}", **options)
            page.evaluate("opened")
            return page

        yield open_and_wait


def step_details(page) -> dict[str, str]:
    """Return the table of step details in the first pane, as label -> text."""
    cells = page.locator(".pane").first.locator("th, td").all_inner_texts()
    return dict(zip(cells[::2], cells[1::2], strict=True))


def test_page_decodes_the_stored_arrays(open_page, dataset):
    page = open_page()
    assert page.evaluate("[chosen.history, chosen.episode, chosen.step]") == [0, 0, 0]
    decode = """async (position) => (await episodesOf(position)).map(({ records, rewards, actions, expert_actions }) =>
        [records.map((record) => [...record]), [...rewards], [...actions], [...expert_actions]])"""
    for position, history in enumerate(dataset):
        decoded = page.evaluate(decode, position)
        assert len(decoded) == history.entry.episodes
        states, rewards, actions, expert = (np.stack(part) for part in zip(*decoded, strict=True))
        np.testing.assert_array_equal(states[:, :-1].reshape(history.state.shape), history.state[:])
        np.testing.assert_array_equal(states[:, -1], history.episode_end_state[:])
        for shown, array in ((rewards, history.rewards), (actions, history.actions), (expert, history.expert_actions)):
            np.testing.assert_array_equal(shown[:, :-1].reshape(-1), array[:])
    page.close()


def test_pixels_drawn_by_the_page_equal_those_of_draw_frame(open_page, dataset):
    """Small differences are allowed, because browsers smooth text and edges differently."""
    for number in (0, len(dataset) - 1):
        history = dataset[number]
        layout = get_layout(history.entry.layout)
        page = open_page(f"#history={history.entry.history_id}&episode=2&step=9")
        page.uncheck("#window")
        width = 48 * layout.width
        picture = page.evaluate(
            """(width) => {
                const canvas = document.querySelector(".picture");
                canvas.style.cssText = `width: ${width}px; max-width: none; border: 0`;
                canvas.parentElement.style.display = "block";
                drawState(canvas, index.layouts[currentFacts().layout], shownEpisodes()[0].records[9]);
                return canvas.toDataURL();
            }""",
            width,
        )
        drawn = np.array(Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2]))).convert("RGB")).astype(int)
        expected = draw_frame(layout, history.state[29], cell=48, view=False).astype(int)
        other = draw_frame(layout, history.state[5], cell=48, view=False).astype(int)
        height = 48 * layout.height
        assert drawn.shape[1] == width
        difference, larger = (np.abs(drawn[:height] - frame[:height]).mean() for frame in (expected, other))
        assert difference < 3 < larger
        page.close()


def test_page_shows_actions_reward_and_return_of_a_step(open_page, dataset):
    history = dataset[1]
    page = open_page(f"#history={history.entry.history_id}&episode=3&step=7")
    at, earned = 47, history.rewards[40:47].sum()
    names = {"Ego": "actions", "Expert": "expert_actions", "Oracle": "oracle_actions", "Teammate": "teammate_actions"}
    acted = {who: ACTIONS[int(history.read(field)[at])] for who, field in names.items()}
    marks = {who: "same" if acted[who] == acted["Ego"] else "differs" for who in ("Expert", "Oracle")}
    assert step_details(page) == {
        "Step": "7 of 20",
        "Return so far": f"{earned:g} of {history.returns()[2]:g}",
        "Reward of this step": f"{history.rewards[at]:+g}".replace("+0", "0"),
        **{f"{who}'s action": f"{name} ({marks[who]})" if who in marks else name for who, name in acted.items()},
    }
    page.keyboard.press("End")
    assert step_details(page)["Ego's action"] == "none, the episode is over"
    assert step_details(page)["Return so far"] == "{0:g} of {0:g}".format(history.returns()[2])
    page.close()


def test_keys_and_menus_change_the_shown_episode(open_page, dataset):
    page = open_page("#history=0&episode=3&step=0")
    shown = "document.querySelector('.pane figcaption').textContent.split(',')[0]"
    page.keyboard.press("n")
    wait_until(page, f"{shown} === 'Episode 4 of 6'")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert step_details(page)["Step"] == "2 of 20"
    page.fill("#scrub", "13")
    assert step_details(page)["Step"] == "13 of 20"
    page.focus("#curve")
    page.keyboard.press("Home")
    wait_until(page, f"{shown} === 'Episode 1 of 6'")
    page.keyboard.press("f")
    wait_until(page, "document.querySelectorAll('.pane').length === 2")
    assert [text[:14] for text in page.locator("figcaption").all_inner_texts()] == ["Episode 1 of 6", "Episode 6 of 6"]
    page.keyboard.press("f")
    wait_until(page, "document.querySelectorAll('.pane').length === 1")
    curve = page.locator("#curve")
    curve.click(position={"x": curve.bounding_box()["width"] / 2, "y": 60})
    wait_until(page, f"['Episode 3 of 6', 'Episode 4 of 6'].includes({shown})")
    page.select_option("#layout", "test_wide")
    wait_until(page, "currentFacts().layout === 'test_wide'")
    kind = dataset.entries[0].teammate_kind
    teammates = page.locator("#teammate option").all_text_contents()
    assert [name.partition("/")[2] for name in teammates] == [f"{kind} t0", f"{kind} t1"]
    page.select_option("#teammate", teammates[1])
    wait_until(page, f"currentFacts().teammate === '{teammates[1]}'")
    assert page.locator("#history option").count() == 2
    page.close()


def test_playback_stops_at_the_end_of_the_episode_and_can_be_paused(open_page):
    page = open_page("#history=0&episode=1&step=0")
    page.select_option("#speed", "50")
    page.keyboard.press(" ")
    wait_until(page, "chosen.step === 20 && playing === null")
    assert page.inner_text("#play") == "Play"
    page.select_option("#speed", "1")
    page.keyboard.press("Home")
    page.click("#play")
    assert page.inner_text("#play") == "Pause"
    page.click("#play")
    assert page.evaluate("playing === null && chosen.step < 20")
    page.close()


@pytest.mark.parametrize("dark", [False, True])
def test_page_fits_the_width_of_a_phone(open_page, dark):
    page = open_page("#history=0&episode=1&step=3&ends=1", width=PHONE, dark=dark)
    assert page.locator(".pane").count() == 2
    check_fits_window(page, PHONE, dark)
    page.close()


def test_a_damaged_page_shows_an_error(open_page, page_file, tmp_path):
    text = page_file.read_text()
    at = text.index('"histories": ["') + 200
    (tmp_path / "damaged.html").write_text(text[:at] + "AAAA" + text[at + 4 :])
    page = open_page("", tmp_path / "damaged.html")
    wait_until(page, "!document.getElementById('problem').hidden")
    assert page.inner_text("#problem").startswith("This page is damaged")
    page.close()
