"""Profiles that generate tiny releases, and a function that starts Python processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.helpers.commands import python_environment
from tests.helpers.paths import ROOT

TINY = """
[ego]
total_steps = 16_000
environments = 8
rollout = 80
minibatches = 2
shaping_horizon = 16_000
widths = { pointwise = [4], spatial = [4], dense = 8, gru = 8, head = 8 }

[release]
data_version = "0.0.1"
keep = 3

[tasks]
layouts = ["demo_wide"]
presets = ["default"]
"""
"""Profile of one task and 25 PPO updates."""

PAIR = TINY.replace('presets = ["default"]', 'presets = ["default", "high_inertia"]')
"""Profile with the task of `TINY` and a second task with another teammate."""

LEARNED = TINY.replace('presets = ["default"]', 'algorithms = ["fcp", "brdiv"]').replace(
    "[release]",
    """
[teammates]
members = 2
train = 1
heldout = 1
total_steps = 4_000
environments = 8
rollout = 100
minibatches = 2
shaping_horizon = 2_000
widths = { pointwise = [4], spatial = [4], dense = 8, gru = 8, head = 8 }

[release]""",
)
"""Profile of two tasks with learned teammates."""


def artefact(out: Path, number: int = 0) -> Path:
    """Return an artefact, the folder of a finished task; `number` counts the tasks in the order of their ids."""
    return sorted(path for path in (out / "artefacts").iterdir() if path.is_dir())[number]


def start_python(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    """Start Python in the repository's folder, with this folder on Python's path and given environment variables."""
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=python_environment(**environment),
        cwd=ROOT,
    )


NOISE = """
[noise]
histories = 4
episodes = 10
start = [0.9, 1.0]
end = [0.0, 0.1]
begin = [0.0, 0.2]
finish = [0.7, 1.0]
power = [0.5, 2.0]

[release]
data_version = "0.0.1"

[tasks]
layouts = ["demo_wide"]
sources = ["noise"]
presets = ["default"]
"""
"""Profile of one task with 4 noise histories of 10 episodes."""
