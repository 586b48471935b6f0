"""Runs benchmark cases in child processes, so that a crash or full memory affects one case only."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
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
        failed, stopped, line, left = False, False, " ", 0.0
        with subprocess.Popen(command(pending), stdout=subprocess.PIPE, text=True, env=environment) as child:
            assert child.stdout is not None
            while line:
                left = until - time.monotonic()
                timer = Timer(max(0.0, min(left, case_seconds)), child.kill)
                timer.start()
                line = child.stdout.readline()
                stopped = not timer.is_alive()
                timer.cancel()
                if line.startswith("{"):  # other output is dropped
                    facts = json.loads(line)
                    failed = "error" in facts
                    print_facts(pending.pop(0), {name: value for name, value in facts.items() if name != "case"})
        if pending and not failed:
            why = f"the process ended with code {child.returncode}"
            if stopped:
                why = "stopped: no time left" if left < case_seconds else f"stopped after {case_seconds:.0f} s"
            print_facts(pending.pop(0), {"error": why})
            failed = True
        failures += failed
    for case in pending:
        print_facts(case, {"skipped": "no time left"})
    return failures
