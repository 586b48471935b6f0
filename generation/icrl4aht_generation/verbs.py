"""Commands that this package adds to `icrl4aht-data`, see `icrl4aht_data.commands.verbs`."""

from icrl4aht_data.commands.verbs import Verb

_CLI = "icrl4aht_generation.commands"
_TASKS = "Tasks and teammates"

VERBS = (
    Verb("generate", f"{_CLI}:generate", "Generate", "Rebuild a release, or resume a rebuild."),
    Verb("teammates", f"{_CLI}:teammates", "Generate", "Train populations of teammates."),
    Verb("layouts", f"{_CLI}:layouts", "Generate", "List generated layouts, and draw them."),
    Verb("plan", f"{_CLI}:plan", "Generate", "Estimate the cost of a rebuild."),
    Verb("check", f"{_CLI}:check", "Generate", "Compare two rebuilds bit for bit."),
    Verb("research draws", f"{_CLI}:draws", _TASKS, "Measure the heuristic teammates that tasks may draw."),
    Verb("research manifests", f"{_CLI}:manifests", _TASKS, "Write the manifests of drawn tasks in the package."),
    Verb("research diversity", f"{_CLI}:diversity", _TASKS, "Report how much the teammates of a suite differ."),
)
