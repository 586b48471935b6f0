"""Reports of evaluation results: tables, figures, pages."""

from baselines.report.markdown import markdown, rows
from baselines.report.results import as_run, merge, read_run
from baselines.report.write import write_report

__all__ = ["as_run", "markdown", "merge", "read_run", "rows", "write_report"]
