"""Commands that this package adds to `icrl4aht-data`, see `icrl4aht_data.commands.verbs`."""

from icrl4aht_data.commands.verbs import Verb

_CLI = "icrl4aht_generation.commands"
_TASKS = "Tasks and teammates"

VERBS = (
    Verb("generate", f"{_CLI}:generate", "Generate", "Generate a release, or resume an interrupted run."),
    Verb("teammates", f"{_CLI}:teammates", "Generate", "Train populations of teammates."),
    Verb("layouts", f"{_CLI}:layouts", "Generate", "List generated layouts, and draw pictures of them."),
    Verb("plan", f"{_CLI}:plan", "Generate", "Estimate the cost of generating a release."),
    Verb("check", f"{_CLI}:check", "Generate", "Compare two generated releases bit for bit."),
    Verb("research draws", f"{_CLI}:draws", _TASKS, "Sample heuristic teammates for tasks, and measure them."),
    Verb("research manifests", f"{_CLI}:manifests", _TASKS, "Write the package's manifests of tasks."),
    Verb(
        "research diversity", f"{_CLI}:diversity", _TASKS, "Report how much a suite's or a release's teammates differ."
    ),
)
