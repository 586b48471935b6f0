"""Entries of experiments, and what ablations of windows and contexts vary; no JAX, so that pages can list them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple


@dataclass(frozen=True)
class ExperimentEntry:
    """One model of an experiment: the differences from the default settings.

    Attributes:
        name: of its folder, without the method.
        model: values of `ModelOptions`.
        train: values of `TrainOptions`.
        variant: of a sweep: the varied quantity and its value.
        histories: values of `HistoryOptions`.
        run_of: name of the entry whose trained model it is; its own by default.
        sampled: whether the model draws its actions.
        about: what differs, for a table.
    """

    name: str
    model: dict[str, Any] = field(default_factory=dict)
    train: dict[str, Any] = field(default_factory=dict)
    variant: dict[str, Any] | None = None
    histories: dict[str, Any] = field(default_factory=dict)
    run_of: str = ""
    sampled: bool = False
    about: str = ""


_ABLATED: dict[str, Any] = {"teammate_actions": True, "reward_scale": 0.05, "dropout": 0.0}


def _window_entry(
    name: str,
    about: str,
    model: Mapping[str, Any] = MappingProxyType({}),
    train: Mapping[str, Any] = MappingProxyType({}),
    histories: Mapping[str, Any] = MappingProxyType({}),
    **options: Any,
) -> ExperimentEntry:
    labels = {"labels": "expert"}
    return ExperimentEntry(
        name, {**_ABLATED, **model}, dict(train), None, {**labels, **histories}, **options, about=about
    )


WINDOW_ENTRIES = (
    _window_entry("plain", "K = 200, +TA, labels of RL^2, rewards scaled, rope"),
    _window_entry("sampled", "draws its actions", run_of="plain", sampled=True),
    _window_entry("K500", "K = 500, 6 windows a batch", train={"context": 500, "batch_size": 6}),
    _window_entry("K1000", "K = 1000, 3 windows a batch", train={"context": 1000, "batch_size": 3}),
    _window_entry("K2000", "K = 2000, 2 windows a batch", train={"context": 2000, "batch_size": 2}),
    _window_entry("every3", "every third episode", histories={"every": 3}),
    _window_entry("every10", "every tenth episode", histories={"every": 10}),
    _window_entry("own-actions", "targets are the actions taken, noise included", histories={"labels": None}),
    _window_entry("oracle", "labels of the oracle, which sees the full state", histories={"labels": "oracle"}),
    _window_entry("improvement", "histories by their improvement", histories={"weights": "improvement"}),
    _window_entry("curriculum", "from early windows to all", histories={"curriculum": 0.5}),
    _window_entry("no-ta", "without the teammate's actions", {"teammate_actions": False}),
    _window_entry("next_obs", "predicts the next observation, too", {"next_obs": True}),
    _window_entry("teammate", "predicts the teammate's action, too", {"teammate_loss": True}),
    _window_entry("no-positions", "without rope", {"positions": "none"}),
    _window_entry("smoothing", "label smoothing of 0.1", {"label_smoothing": 0.1}),
    _window_entry("rewards", "rewards as they are, 20 a delivery", {"reward_scale": 1.0}),
)
"""What makes a window teach: AD with one difference each, on histories with labels of RL^2, as `collect` makes them."""

CONTEXT_ENTRIES = (
    _window_entry("plain", "contiguous contexts of K = 200, +TA, labels of RL^2"),
    _window_entry("sampled", "draws its actions", run_of="plain", sampled=True),
    _window_entry("mixed", "contexts of mixed skill: transitions of all of a history", histories={"order": "random"}),
    _window_entry("K500", "K = 500, 6 contexts a batch", train={"context": 500, "batch_size": 6}),
    _window_entry("oracle", "labels of the oracle, which sees the full state", histories={"labels": "oracle"}),
)
"""What makes a context teach: DPT with one difference each, on the same histories."""


class Ablation(NamedTuple):
    """An ablation, an experiment with one method.

    Attributes:
        title: for the report.
        method: its name.
        entries: one per model.
    """

    title: str
    method: str
    entries: tuple[ExperimentEntry, ...]


ABLATIONS = {
    "ablate windows": Ablation("Windows that teach", "ad", WINDOW_ENTRIES),
    "ablate contexts": Ablation("Contexts that teach", "dpt", CONTEXT_ENTRIES),
}
"""Ablations by the name of their experiment."""

VARIED_IN_ABLATIONS = (
    "context",
    "teammate_actions",
    "next_obs",
    "teammate_loss",
    "positions",
    "label_smoothing",
    "reward_scale",
)
"""Options of models and trainings that an ablation sets itself."""
