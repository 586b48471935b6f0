"""Test the page of the command `play` in headless Chromium: keys, touch, a lost connection, and recording."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.cells import FACING_OF
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import columns
from tests.helpers.chromium import NEEDS_CHROMIUM, PHONE, chromium, wait_until

pytest.importorskip("starlette", reason="needs the extra play")

pytestmark = [pytest.mark.slow, NEEDS_CHROMIUM]

KEYS = {"up": "ArrowUp", "down": "ArrowDown", "left": "ArrowLeft", "right": "ArrowRight", "stay": ".", "interact": " "}
STEPS = 12


@pytest.fixture
def game_server(tmp_path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Serve a game of one episode and record it; yield the address of the page and the server process."""
    words = f"play --layout cramped_up --with H2/t3 --episodes 1 --steps {STEPS} --ticks 0 --port 0 --seed 3".split()
    command = [sys.executable, "-u", "-m", "icrl4aht_data", *words, "--record", str(tmp_path / "record")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout
            found = re.search(r"http://127\.0\.0\.1:\d+", server.stdout.readline())
            assert found
            yield found[0], server
        finally:
            server.kill()


@pytest.fixture
def page(game_server) -> Iterator[Any]:
    """Open the page of the game in a window as wide as a phone."""
    with chromium() as open_page:
        page = open_page(game_server[0], PHONE, has_touch=True)
        wait_until(page, "setup !== undefined")
        yield page


def test_game_in_the_browser_is_recorded_despite_lost_connection(page, game_server, tmp_path):
    """A person plays one recorded episode, and loses the connection in the middle of the episode."""
    assert page.locator("#game").is_hidden()
    page.fill("#pseudonym", "someone")
    page.check("#agrees")
    page.click("#consent button")
    wait_until(page, "!document.getElementById('game').hidden && frame.waiting")
    page.keyboard.press("ArrowLeft")
    wait_until(page, "!frame.waiting")
    facing = columns(get_layout("cramped_up")).facings.start + EGO
    names = ("left", "up", "right", "interact", "stay")
    for clock, name in enumerate(names, 1):
        page.keyboard.press(KEYS[name])
        wait_until(page, f"frame.clock === {clock}")
        if (action := ACTIONS.index(name)) < len(FACING_OF):  # every move turns the agent
            assert page.evaluate("frame.record")[facing] == FACING_OF[action]
    page.tap("#pad [data-action=down]")
    wait_until(page, "frame.clock === 6")
    page.uncheck("#window")
    assert page.evaluate("document.documentElement.scrollWidth") == PHONE

    page.evaluate("socket.close()")
    wait_until(page, "!document.getElementById('problem').hidden")
    wait_until(page, "socket.readyState === 1 && frame.waiting && document.getElementById('problem').hidden")
    assert page.evaluate("frame.clock") == 6
    page.keyboard.press("ArrowLeft")
    wait_until(page, "!frame.waiting")
    for clock in range(7, STEPS + 1):
        page.keyboard.press("ArrowLeft")
        wait_until(page, f"frame.clock === {clock}")
    wait_until(page, "frame.over && Object.keys(frame.references).length === 3", 120)
    assert page.locator("#means li").count() == 4

    page.close()
    server = game_server[1]
    server.send_signal(signal.SIGINT)
    assert f"{tmp_path / 'record'}: 1 episode;" in server.stdout.read()
    assert server.wait(30) == 0
    assert verify_release(tmp_path / "record", level="deep").ok
    actions = load_icrl4aht(tmp_path / "record")[0].actions[:6].tolist()
    assert actions == [ACTIONS.index(name) for name in (*names, "down")]
