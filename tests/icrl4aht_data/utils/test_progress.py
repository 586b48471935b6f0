"""Plain lines of progress where the output is no terminal, by a clock that the test moves."""

from __future__ import annotations

import io
import time

import pytest
from icrl4aht_generation.progress import ProgressBoard, progress_bars
from rich.console import Console

from icrl4aht_data.commands import options
from icrl4aht_data.utils.progress import LineProgress


class Clock:
    """A clock that only `wait` moves."""

    now = 0.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds


class Output(io.StringIO):
    """A file that counts the lines that have been flushed."""

    flushed = 0

    def flush(self) -> None:
        self.flushed = self.getvalue().count("\n")


def test_a_line_at_the_start_every_minute_and_at_the_end():
    clock, output = Clock(), Output()
    bars = progress_bars(Console(file=output, width=20), clock=clock, interval=None)
    with bars:
        bar = bars.add_task("fcp on demo_wide", total=600, note="", unit="updates")
        for number in range(1, 601):
            clock.wait(1)
            bars.update(bar, completed=number, note=f"self-play {number // 10}")
            if number % 240 == 0:
                bars.print_lines()
                assert output.flushed == output.getvalue().count("\n")
    assert output.getvalue().splitlines() == [
        "fcp on demo_wide: started, 600 updates",
        "fcp on demo_wide: 240 of 600 updates (40 %) after 4 min, 1.0 a second, 6 min left; self-play 24",
        "fcp on demo_wide: 480 of 600 updates (80 %) after 8 min, 1.0 a second, 2 min left; self-play 48",
        "fcp on demo_wide: 600 of 600 updates after 10 min; self-play 60",
    ]


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0.01, "9 of 1,000 (1 %) after 0 s, 100 a second, 10 s left"),
        (30, "9 of 1,000 (1 %) after 4 min, 2.0 a minute, 8 h 16 min left"),
        (600, "9 of 1,000 (1 %) after 1 h 30 min, 6.0 a hour, 165 h 10 min left"),
    ],
)
def test_rates_and_times_are_in_fitting_units(seconds, expected):
    clock, output = Clock(), io.StringIO()
    with LineProgress(console=Console(file=output), clock=clock, interval=None) as bars:
        bar = bars.add_task("x", total=1000)
        for _ in range(9):
            clock.wait(seconds)
            bars.advance(bar)
        bars.print_lines()
    assert output.getvalue() == f"x: {expected.replace('a hour', 'an hour')}\n"


def test_the_speed_falls_while_nothing_moves():
    clock, output = Clock(), io.StringIO()
    with LineProgress(console=Console(file=output), clock=clock, interval=None) as bars:
        bar = bars.add_task("x", total=1600)
        for number in (200, 500, 800):
            clock.wait(1)
            bars.update(bar, completed=number)
        for _ in range(2):
            bars.print_lines()
            clock.wait(10)
    assert output.getvalue().splitlines() == [
        "x: 800 of 1,600 (50 %) after 3 s, 300 a second, 3 s left",
        "x: 800 of 1,600 (50 %) after 13 s, 50 a second, 16 s left",
    ]


def test_what_a_resumed_work_had_finished_is_no_speed():
    clock, output = Clock(), io.StringIO()
    with LineProgress(console=Console(file=output), clock=clock, interval=None) as bars:
        bar = bars.add_task("x", total=1000)
        clock.wait(5)
        bars.update(bar, completed=900)
        bars.print_lines()
        clock.wait(10)
        bars.update(bar, completed=910)
        bars.print_lines()
    assert output.getvalue().splitlines() == [
        "x: 900 of 1,000 (90 %) after 5 s, time left unknown",
        "x: 910 of 1,000 (91 %) after 15 s, 1.0 a second, 2 min left",
    ]


def test_nothing_is_known_before_the_first_step():
    clock, output = Clock(), io.StringIO()
    with LineProgress(console=Console(file=output), clock=clock, interval=None) as bars:
        bars.add_task("x", total=4)
        bars.add_task("unknown size", total=None)
        clock.wait(61)
        bars.print_lines()
    assert output.getvalue() == "x: 0 of 4 (0 %) after 1 min, time left unknown\n"


def test_work_that_stops_says_where():
    output = io.StringIO()
    bars = progress_bars(Console(file=output), clock=Clock(), interval=None)
    with pytest.raises(KeyboardInterrupt), bars:
        bars.advance(bars.add_task("packing", total=4, note=""))
        raise KeyboardInterrupt
    assert output.getvalue().splitlines()[-1] == "packing: stopped at 1 of 4 after 0 s"


def test_the_board_has_one_line_for_all_tasks():
    clock, output = Clock(), io.StringIO()
    with ProgressBoard(
        Console(file=output), updates=dict.fromkeys(("one", "two", "three"), 100), clock=clock, interval=None
    ) as board:
        for number in range(1, 51):
            clock.wait(2)
            board.show_running("one", number, 1_000.0)
            board.show_running("two", number, 500.0)
        board.print_lines()
        board.show_ended("one")
    assert output.getvalue().splitlines() == [
        "all tasks: started, 300 updates",
        "all tasks: 100 of 300 updates (33 %) after 2 min, 1.0 a second, 3 min left; 0/3 tasks, 1,500 steps/s",
        "all tasks: stopped at 150 of 300 updates after 2 min; 1/3 tasks, 500 steps/s",
    ]


def test_a_thread_prints_while_a_step_takes_long():
    output = io.StringIO()
    with LineProgress(console=Console(file=output), interval=0.02) as bars:
        bars.add_task("compiling", total=1)
        for _ in range(500):
            time.sleep(0.01)
            if output.getvalue().count("\n") >= 2:
                break
    printed = output.getvalue()
    assert printed.count("compiling: 0 of 1 (0 %) after 0 s, time left unknown\n") >= 2
    time.sleep(0.05)
    assert output.getvalue() == printed


@pytest.mark.parametrize(("terminal", "quiet"), [(True, False), (False, True)])
def test_terminals_get_bars_and_quiet_commands_nothing(terminal, quiet):
    output = io.StringIO()
    console = Console(file=output, force_terminal=terminal)
    with LineProgress(console=console, quiet=quiet, edges=True, interval=None) as bars:
        bars.advance(bars.add_task("x", total=2))
        bars.print_lines()
    assert "x: " not in output.getvalue()


def test_bars_of_commands_have_lines_on_stderr(monkeypatch, capsys):
    monkeypatch.setitem(LineProgress.__init__.__kwdefaults__, "interval", 0.02)
    with options.bars(of_bytes=True) as show:
        show("download", 3_000_000, 10_000_000)
        printed = ""
        for _ in range(500):
            time.sleep(0.01)
            if "\n" in (printed := capsys.readouterr().err):
                break
    assert printed.startswith("download: 3.0 MB of 10.0 MB (30 %) after 0 s, ")


def test_lines_of_commands_have_units(capsys):
    with options.bars(edges=True, unit="steps") as show:
        show("ad", 649, 100_000, ", loss 1.234")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "ad, loss 1.234: started, 100,000 steps",
        "ad, loss 1.234: stopped at 649 of 100,000 steps after 0 s",
    ]
