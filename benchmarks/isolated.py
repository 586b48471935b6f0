"""Runs benchmark cases in child processes, so that a crash or full memory affects one case only."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from threading import Timer
from typing import Any

PrintFacts = Callable[[str, Mapping[str, Any]], None]
"""Called with the name of a case and the facts of its line."""


def run_isolated(
    cases: Sequence[str],
    command: Callable[[Sequence[str]], list[str]],
    print_facts: PrintFacts,
    *,
    until: float,
    case_seconds: float,
    environment: Mapping[str, str] | None = None,
) -> int:
    """Run cases in a child process, and in a new one after each failure, and return the number of failures.

    A child runs its cases in order and prints one JSON object for each to stdout, with the name as "case"; it ends
    after one with "error". A case without a result (child crashed, stopped or never started) gets a line, too.

    Args:
        cases: names of the cases.
        command: names -> command line of a child that runs them.
        print_facts: prints one line.
        until: `time.monotonic()` at which the running child is killed and no other is started.
        case_seconds: limit of a single case, the start of its process included.
        environment: environment variables of the children; inherited by default.
    """
    pending, failures = list(cases), 0
    while pending and time.monotonic() < until:
        child, failed = _Child(command(pending), environment), False
        for facts in child.lines(until, case_seconds):
            pending.remove(facts["case"])
            failed = "error" in facts
            print_facts(facts.pop("case"), facts)
        if pending and not failed:
            print_facts(pending.pop(0), {"error": child.end})
            failed = True
        failures += failed
    for case in pending:
        print_facts(case, {"skipped": "no time left"})
    return failures


class _Child:
    """A child process, killed when its next line takes too long.

    Attributes:
        end: reason why the process ended, set after its last line.
    """

    def __init__(self, command: list[str], environment: Mapping[str, str] | None) -> None:
        self.end = ""
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)

    def lines(self, until: float, case_seconds: float) -> Iterator[dict[str, Any]]:
        """Yield the parsed lines of cases; other output is dropped."""
        with self._process as process:
            assert process.stdout is not None
            timer = self._timer(until, case_seconds)
            try:
                for line in process.stdout:
                    facts = _parse_line(line)
                    if facts:
                        timer.cancel()
                        yield facts
                        timer = self._timer(until, case_seconds)
                process.wait()
            except BaseException:
                process.kill()
                raise
            finally:
                timer.cancel()
        self.end = self.end or f"the process ended with code {process.returncode}"

    def _timer(self, until: float, case_seconds: float) -> Timer:
        left = until - time.monotonic()
        why = "stopped: no time left" if left < case_seconds else f"stopped after {case_seconds:.0f} s"

        def kill() -> None:
            self.end = why
            self._process.kill()

        timer = Timer(max(0.0, min(left, case_seconds)), kill)
        timer.daemon = True
        timer.start()
        return timer


def _parse_line(line: str) -> dict[str, Any] | None:
    """Return the facts of a case's line; None for other output."""
    try:
        facts = json.loads(line)
    except ValueError:
        return None
    return facts if isinstance(facts, dict) and "case" in facts else None
