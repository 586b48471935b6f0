"""Reports of evaluation results: Markdown, CSV, figures, a page."""

from icrl4aht_baselines.report.page import markdown, write_report
from icrl4aht_baselines.report.results import as_run, merge, read_run
from icrl4aht_baselines.report.scores import rows

__all__ = ["as_run", "markdown", "merge", "read_run", "rows", "write_report"]
