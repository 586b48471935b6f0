"""Reports of evaluation results, as Markdown, CSV and a web page."""

import sys
from collections.abc import Sequence

from icrl4aht_baselines import CallablePackage
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.report.page import markdown, write_report
from icrl4aht_baselines.report.results import as_run, merge, read_run

__all__ = ["as_run", "markdown", "merge", "read_run", "report", "write_report"]


def report(*results: Sequence[Result]) -> str:
    """Return a Markdown report; each argument is the list of results that `evaluate` returned for one agent."""
    return markdown(merge([as_run(of_agent, f"results {number}") for number, of_agent in enumerate(results, 1)]))


sys.modules[__name__].__class__ = CallablePackage
