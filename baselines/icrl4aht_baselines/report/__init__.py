"""Reports of evaluation results: Markdown, CSV, figures, a page."""

from icrl4aht_baselines.report.results import as_run, merge, read_run
from icrl4aht_baselines.report.summary import markdown, rows, write_report

__all__ = ["as_run", "markdown", "merge", "read_run", "rows", "write_report"]
