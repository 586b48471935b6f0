"""Test the page of the command `play` in headless Chromium: keys, touch, a lost connection, and recording."""

from __future__ import annotations

import itertools
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.browsing.page import make_browser_page
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.cells import FACING_OF
from icrl4aht_data.overcooked.state import columns
from icrl4aht_data.plotting import plot_learning_curves
from tests.helpers.chromium import NEEDS_CHROMIUM, PHONE, check_fits_window, chromium, wait_until

pytest.importorskip("starlette", reason="needs the extra play")

import uvicorn
from icrl4aht_baselines.play.server import PlaySession, make_app, open_port

from tests.helpers.play import LAYOUT, new_session, scripted_person

pytestmark = NEEDS_CHROMIUM

KEYS = {"up": "ArrowUp", "down": "ArrowDown", "left": "ArrowLeft", "right": "ArrowRight", "stay": ".", "interact": " "}
STEPS = 12
DESKTOP = 1280

MEASURE = """() => {
  window.delays = [];
  let pressed = 0;
  const drawOnly = draw;
  document.addEventListener("keydown", (event) => (pressed = event.timeStamp), true);
  draw = () => {
    drawOnly();
    const since = pressed;
    requestAnimationFrame(() => since && delays.push(performance.now() - since));
    pressed = 0;
  };
}"""
"""Script that measures the milliseconds from each key press to the picture of the new state."""


@contextmanager
def serve(session: PlaySession) -> Iterator[str]:
    """Serve a session from a thread; yield the address of the page."""
    with open_port(0) as listener:
        server = uvicorn.Server(uvicorn.Config(make_app(session), log_level="warning", ws="websockets-sansio"))
        thread = Thread(target=server.run, args=[[listener]])
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


@contextmanager
def serve_recorded(folder: Path, *words: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run the command `play --record`; yield the address of its page and the server process."""
    words = (*words, *f"--layout {LAYOUT.name} --with H2/t3 --ticks 0 --port 0 --seed 3 --record {folder}".split())
    command = [sys.executable, "-u", "-m", "icrl4aht_data", "play", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout
            found = re.search(r"http://127\.0\.0\.1:\d+", server.stdout.readline())
            assert found
            yield found[0], server
        finally:
            server.kill()


def stop(page: Any, server: subprocess.Popen[str]) -> str:
    """Close the page, stop the server as Ctrl+C does, and return its output."""
    page.close()
    server.send_signal(signal.SIGINT)
    assert server.stdout
    output = server.stdout.read()
    assert server.wait(30) == 0
    return output


def agree(page: Any) -> None:
    """Give the consent to the recording."""
    wait_until(page, "setup !== undefined")
    assert page.locator("#game").is_hidden()
    page.fill("#pseudonym", "someone")
    page.check("#agrees")
    page.click("#consent button")
    wait_until(page, "!document.getElementById('game').hidden")


def start_episode(page: Any) -> None:
    wait_until(page, "frame !== undefined && frame.waiting")
    page.keyboard.press("ArrowLeft")
    wait_until(page, "!frame.waiting")


def press(page: Any, act: Callable[..., int], episode: int, step: int) -> None:
    """Press the key of a script's action, and wait for the next state."""
    page.keyboard.press(KEYS[ACTIONS[act(page.evaluate("frame.record"), episode, step)]])
    wait_until(page, f"frame.returns.length > {episode} || frame.clock === {step + 1}")


def test_keys_deliver_a_soup_and_the_page_fits_all_windows():
    """Keys of the oracle's actions earn +20 on the page, which fits wide and narrow, light and dark windows."""
    steps, act = 60, scripted_person()
    session = new_session("H2/t3", episodes=1, steps=steps, compared=("stay",))
    with serve(session) as address, chromium() as open_page:
        page = open_page(address, DESKTOP)

        def check_windows() -> None:
            for width, dark in itertools.product((DESKTOP, PHONE), (False, True)):
                page.set_viewport_size({"width": width, "height": 800})
                page.emulate_media(color_scheme="dark" if dark else "light")
                page.evaluate("new Promise(requestAnimationFrame)")  # wait for the event handlers that redraw the page
                check_fits_window(page, width, dark)
                assert page.locator("#pad").is_visible() == (width == PHONE and not page.evaluate("frame.over"))

        start_episode(page)
        played = 0
        while page.evaluate("frame.earned") < 20:
            press(page, act, 0, played)
            played += 1
        assert (page.inner_text("#reward"), page.inner_text("#earned")) == ("+20", "20")
        check_windows()
        for step in range(played, steps):
            press(page, act, 0, step)
        wait_until(page, "frame.over && frame.references.stay !== undefined")
        assert page.inner_text("#means").splitlines()[0] == f"you: {session.game.returns[0]:.1f} an episode on average"
        check_windows()


@pytest.mark.slow
def test_ten_recorded_episodes_of_a_script_are_a_valid_history(tmp_path):
    """The record of ten episodes has the page's returns, and can be verified, browsed and plotted.

    `pytest -s` prints how long the page takes to show the outcome of a key.
    """
    record, act, steps = tmp_path / "record", scripted_person(), 100
    with serve_recorded(record) as (address, server), chromium() as open_page:
        page = open_page(address)
        agree(page)
        page.evaluate(MEASURE)
        for episode in range(10):
            start_episode(page)
            for step in range(steps):
                press(page, act, episode, step)
        wait_until(page, "frame.over && Object.keys(frame.references).length === 3", 120)
        returns, delays = page.evaluate("[frame.returns, delays]")
        assert f"{record}: 10 episodes;" in stop(page, server)
    middle, most = np.percentile(delays, (50, 95))
    print(f"\nfrom a key to the new picture: median {middle:.0f} ms, 95% within {most:.0f} ms ({len(delays)} keys)")
    report = verify_release(record, level="deep")
    assert report.ok, report.findings
    dataset = load_icrl4aht(record)
    assert dataset[0].returns().tolist() == returns and max(returns) >= 20
    assert make_browser_page(dataset).shown_episodes == 10
    figure = plot_learning_curves(dataset, tmp_path / "curves.png")
    assert figure is not None and (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_game_in_the_browser_is_recorded_despite_lost_connection(tmp_path):
    """A person plays one recorded episode on a phone, and loses the connection in the middle of the episode."""
    record = tmp_path / "record"
    words = f"--episodes 1 --steps {STEPS}".split()
    with serve_recorded(record, *words) as (address, server), chromium() as open_page:
        page = open_page(address, PHONE, has_touch=True)
        agree(page)
        start_episode(page)
        facing = columns(LAYOUT).facings.start + EGO
        names = ("left", "up", "right", "interact", "stay")
        for clock, name in enumerate(names, 1):
            page.keyboard.press(KEYS[name])
            wait_until(page, f"frame.clock === {clock}")
            if (action := ACTIONS.index(name)) < len(FACING_OF):  # every move turns the agent
                assert page.evaluate("frame.record")[facing] == FACING_OF[action]
        page.tap("#pad [data-action=down]")
        wait_until(page, "frame.clock === 6")

        page.evaluate("socket.close()")
        wait_until(page, "!document.getElementById('problem').hidden")
        wait_until(page, "socket.readyState === 1 && frame.waiting && document.getElementById('problem').hidden")
        assert page.evaluate("frame.clock") == 6
        start_episode(page)
        for clock in range(7, STEPS + 1):
            page.keyboard.press("ArrowLeft")
            wait_until(page, f"frame.clock === {clock}")
        wait_until(page, "frame.over && Object.keys(frame.references).length === 3", 120)
        assert page.locator("#means li").count() == 4
        assert f"{record}: 1 episode;" in stop(page, server)
    assert verify_release(record, level="deep").ok
    actions = load_icrl4aht(record)[0].actions[:6].tolist()
    assert actions == [ACTIONS.index(name) for name in (*names, "down")]
