"""Commands that this package adds to `icrl4aht-data`, see `icrl4aht_data.commands.verbs`."""

from icrl4aht_data.commands.verbs import Verb

_CLI, _MODELS, _LAB, _PLAY = (
    f"icrl4aht_baselines.commands.{name}_commands" for name in ("train", "model", "experiment", "play")
)
_TRAIN, _CHECKS = "Train and evaluate", "Reference models and checks"

VERBS = (
    Verb("demo", f"{_CLI}:demo_command", _TRAIN, "Demonstrate every step on the bundled release."),
    Verb("train", f"{_CLI}:train_command", _TRAIN, "Train a model on learning histories."),
    Verb("evaluate", f"{_CLI}:evaluate_command", _TRAIN, "Evaluate an agent on test tasks, or on validation tasks."),
    Verb("report", f"{_CLI}:report_command", _TRAIN, "Compare results with the paper's."),
    Verb("results", f"{_MODELS}:results_command", _TRAIN, "Compare models on the benchmark's tasks."),
    Verb("submit", f"{_MODELS}:submit_command", _TRAIN, "Make a file of results for the page of `results`."),
    Verb("models", f"{_MODELS}:models_command", _TRAIN, "List the bundled models."),
    Verb("watch", f"{_CLI}:watch_command", _TRAIN, "Play an episode and draw it as a GIF."),
    Verb("play", f"{_PLAY}:play_command", _TRAIN, "Play on a web page with a policy or a person."),
    Verb("collect", f"{_MODELS}:collect_command", _TRAIN, "Record histories of an agent with a release's teammates."),
    Verb("best-response", f"{_LAB}:best_response_command", _TRAIN, "Train a best response to each teammate."),
    Verb(
        "adaptation-headroom",
        f"{_LAB}:adaptation_headroom_command",
        _TRAIN,
        "Estimate what memory across episodes can earn.",
    ),
    Verb("control", f"{_LAB}:control_command", _TRAIN, "Check that AD and DPT adapt in context."),
    Verb(
        "research reference",
        f"{_MODELS}:reference_command",
        _CHECKS,
        "Make reference models, and the data that they are trained on.",
    ),
    Verb("research proof", f"{_LAB}:proof_command", _CHECKS, "Show what a release teaches."),
    Verb("research headroom", f"{_LAB}:headroom_command", _CHECKS, "Measure the reference egos on every test task."),
)
