"""Test that a process can keep freed memory, so that later allocations cause no page faults."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
from icrl4aht_data.utils.system import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()

def faults(times):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(times):
        b"x" * 2**26
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print(faults(1), faults(10))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_freed_memory_is_used_again_without_page_faults():
    def run(choice: str) -> list[int]:
        command = [sys.executable, "-c", FAULTS, choice]
        return [*map(int, subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())]

    first, later = run("keep")
    assert later < first / 10
    assert run("default")[1] > 10 * max(later, 1)
