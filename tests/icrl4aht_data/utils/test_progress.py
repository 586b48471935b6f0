"""Test progress output with a fake clock: bars on terminals, lines elsewhere."""

from __future__ import annotations

import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from rich.progress import Progress

from icrl4aht_data.utils import progress
from icrl4aht_data.utils.progress import bar_updater, progress_bars, progress_line


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0.01, "9 of 1,000 steps (1 %) after 0 s, 100.0 per second, 10 s left; loss 1.5"),
        (30, "9 of 1,000 steps (1 %) after 4 min, 2.0 per minute, 8 h 16 min left; loss 1.5"),
    ],
)
def test_progress_line_has_count_speed_and_time_left(seconds, expected):
    now = 0.0
    bars = Progress(get_time=lambda: now, speed_estimate_period=math.inf)
    number = bars.add_task("x", total=1000, note="")
    for done in range(10):
        now = done * seconds
        bars.update(number, completed=done, note=": loss 1.5")
    assert progress_line(bars.tasks[0], "steps", False) == f"x: {expected}"


def test_progress_speed_excludes_work_before_a_resume():
    now = 0.0
    bars = Progress(get_time=lambda: now, speed_estimate_period=math.inf)
    number = bars.add_task("x", total=1000, note="")
    bars.update(number, completed=900)
    assert progress_line(bars.tasks[0], "", False) == "x: 900 of 1,000 (90 %) after 0 s"
    now = 10.0
    bars.update(number, completed=910)
    expected = "x: 910 of 1,000 (91 %) after 10 s, 1.0 per second, 2 min left"
    assert progress_line(bars.tasks[0], "", False) == expected


def test_progress_lines_are_printed_during_long_steps(monkeypatch, capsys):
    monkeypatch.setattr(progress, "FIRST_LINE_SECONDS", 0.02)
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.02)  # a slow machine may have no task yet at the first line
    with progress_bars(of_bytes=True) as show:
        show("finished", 4, 4)
        show("of unknown size", 4, None)
        show("download", 3_000_000, 10_000_000)
        printed = ""
        for _ in range(500):
            time.sleep(0.01)
            if "\n" in (printed := capsys.readouterr().err):
                break
    assert printed.startswith("download: 3.0 MB of 10.0 MB (30 %) after 0 s")
    assert "progress" not in {thread.name for thread in threading.enumerate()}


def test_progress_bars_are_shown_on_terminals(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with progress_bars(unit="steps") as show:
        advance = bar_updater(show, "ad", 4)
        advance(3)
        show("ad", 3, 4, "loss 1.234")
    assert "ad: loss 1.234" in capsys.readouterr().err


def test_threads_can_advance_one_progress_bar():
    shown = []
    advance = bar_updater(lambda *bar: shown.append(bar), "x", 400)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(advance, [1] * 400))
    assert shown == [("x", done, 400) for done in range(401)]
