"""The page of `play` in headless Chromium, served by the command: keys, touch, a lost connection, the record."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.cells import FACING_OF
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.state import columns
from tests.helpers.chromium import CHROMIUM, NEEDS_CHROMIUM

playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra browser")
pytest.importorskip("starlette", reason="needs the extra play")

pytestmark = [pytest.mark.slow, NEEDS_CHROMIUM]

KEYS = {"up": "ArrowUp", "down": "ArrowDown", "left": "ArrowLeft", "right": "ArrowRight", "stay": ".", "interact": " "}
STEPS, PHONE = 12, 390


def wait_until(page: Any, condition: str, seconds: float = 30) -> None:
    """Wait until a JavaScript expression is true."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(20)


@pytest.fixture
def served(tmp_path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Serve a recorded game of one episode; yield the address of the page, and the process."""
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
def page(served) -> Iterator[Any]:
    """Open the page on a phone; check that it has no errors."""
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": PHONE, "height": 844}, has_touch=True)
        page.set_default_timeout(60_000)
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: problems.append(message.text))
        page.goto(served[0])
        wait_until(page, "setup !== undefined")
        yield page
        browser.close()
        assert not problems


def test_a_game_in_the_browser(page, served, tmp_path):
    """A person plays one recorded episode, and loses the connection in the middle of it."""
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
        if (action := ACTIONS.index(name)) < len(FACING_OF):  # a move always turns
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
    server = served[1]
    server.send_signal(signal.SIGINT)
    assert f"{tmp_path / 'record'}: 1 episode;" in server.stdout.read()
    assert server.wait(30) == 0
    assert verify_release(tmp_path / "record", level="deep").ok
    actions = load_icrl4aht(tmp_path / "record")[0].actions[:6].tolist()
    assert actions == [ACTIONS.index(name) for name in (*names, "down")]
