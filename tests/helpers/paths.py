"""Paths of the repository's folders that tests read."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]

PACKAGES = {
    "icrl4aht_data": ROOT / "icrl4aht_data",
    "icrl4aht_generation": ROOT / "generation" / "icrl4aht_generation",
    "icrl4aht_baselines": ROOT / "baselines" / "icrl4aht_baselines",
    "benchmarks": ROOT / "benchmarks",
    "tests": ROOT / "tests",
}
"""Import name -> source folder, for each package of the repository."""
