"""Commands that this package adds to `icrl4aht-data`, see `icrl4aht_data.commands.verbs`."""

from icrl4aht_data.commands.verbs import Verb

_TRAIN, _CHECKS = "Train and evaluate", "Reference models and checks"


def _verb(module: str, name: str, section: str, help: str) -> Verb:
    """Return the command `name`. The last word of `name` also names the function, as in `best_response_command`."""
    function = name.split()[-1].replace("-", "_")
    return Verb(name, f"icrl4aht_baselines.commands.{module}_commands:{function}_command", section, help)


VERBS = (
    _verb("train", "demo", _TRAIN, "Load data, train, evaluate and report on the bundled release."),
    _verb("train", "train", _TRAIN, "Train a model on learning histories."),
    _verb("train", "evaluate", _TRAIN, "Evaluate an agent on test tasks, or on validation tasks."),
    _verb("train", "report", _TRAIN, "Compare results with the paper's."),
    _verb("model", "results", _TRAIN, "Compare models on the benchmark's tasks."),
    _verb("model", "submit", _TRAIN, "Make a file of results for the page that `results` writes."),
    _verb("model", "models", _TRAIN, "List the bundled models."),
    _verb("train", "watch", _TRAIN, "Play an episode and draw it as a GIF."),
    _verb("play", "play", _TRAIN, "Play on a web page with a policy or a person."),
    _verb("model", "collect", _TRAIN, "Record histories of an agent with a release's teammates."),
    _verb("experiment", "best-response", _TRAIN, "Train a best response to each teammate."),
    _verb("experiment", "adaptation-headroom", _TRAIN, "Estimate how much memory across episodes can raise returns."),
    _verb("experiment", "control", _TRAIN, "Check that AD and DPT adapt in context."),
    _verb("model", "research reference", _CHECKS, "Make reference models, and the data that they are trained on."),
    _verb("experiment", "research proof", _CHECKS, "Show what models learn from a release."),
    _verb("experiment", "research headroom", _CHECKS, "Measure the reference egos on every test task."),
)
