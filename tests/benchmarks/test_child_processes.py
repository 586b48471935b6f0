"""Test benchmark cases in child processes, which may crash, fail, print text or hang."""

from __future__ import annotations

import sys
import time

from benchmarks.harness import run_isolated

CHILD = """
import json, os, sys, time
print("warming up")
for case in sys.argv[1:]:
    if case == "crash":
        os._exit(7)
    if case == "hang":
        time.sleep(60)
    facts = {"error": "too large"} if case == "fail" else {"process": os.getpid()}
    print(json.dumps({"benchmark": "x", "case": case, **facts}), flush=True)
    if "error" in facts:
        sys.exit(1)
"""


def run_cases(*cases: str, seconds: float = 30, case_seconds: float = 20) -> tuple[int, dict]:
    """Run benchmark cases; return the number of failures and the printed values of each case."""
    found = {}

    def store_values(case, values):
        assert case not in found
        found[case] = values

    failures = run_isolated(
        cases,
        lambda names: [sys.executable, "-c", CHILD, *names],
        store_values,
        until=time.monotonic() + seconds,
        case_seconds=case_seconds,
    )
    assert list(found) == list(cases)
    return failures, found


def test_benchmark_cases_share_a_process_until_a_case_fails():
    failures, found = run_cases("one", "two", "fail", "three", "crash", "four")
    assert failures == 2
    assert found["one"] == found["two"]
    assert found["fail"] == {"benchmark": "x", "error": "too large"}
    assert found["crash"] == {"error": "the process ended with code 7"}
    assert len({found[case]["process"] for case in ("one", "three", "four")}) == 3


def test_hanging_benchmark_case_is_stopped_and_the_next_case_runs():
    failures, found = run_cases("one", "hang", "two", case_seconds=1)
    assert failures == 1
    assert found["hang"] == {"error": "stopped after 1 s"}
    assert found["one"]["process"] != found["two"]["process"]
