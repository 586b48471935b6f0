"""TODO."""

from __future__ import annotations

from pathlib import Path

from baselines.report.markdown import csv_text, markdown
from baselines.report.results import Run, plot_curves


def write_report(runs: list[Run], out: Path) -> list[Path]:
    """report.md, report.csv and curves.png in a folder."""
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / "report.md", out / "report.csv", out / "curves.png"]
    paths[0].write_text(markdown(runs), encoding="utf-8")
    paths[1].write_text(csv_text(runs), encoding="utf-8")
    plot_curves(runs, paths[2])
    return paths
