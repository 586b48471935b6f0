"""Entries of experiments, and what ablations of windows and contexts vary; no JAX, so that pages can list them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

from icrl4aht_baselines.methods.options import SIZES


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


def _ablated(
    name: str,
    about: str,
    model: Mapping[str, Any] = MappingProxyType({}),
    train: Mapping[str, Any] = MappingProxyType({}),
    histories: Mapping[str, Any] = MappingProxyType({}),
    **options: Any,
) -> ExperimentEntry:
    """Returns an entry of an ablation: these values, and for the rest those that all entries share."""
    return ExperimentEntry(
        name,
        {**SIZES["tiny"].model, "teammate_actions": True, "reward_scale": 0.05, "dropout": 0.0, **model},
        {"context": 200, "batch_size": 16, **train},
        histories={"labels": "expert", **histories},
        about=about,
        **options,
    )


def _asked(
    name: str, about: str, histories: Mapping[str, Any] = MappingProxyType({}), **options: Any
) -> ExperimentEntry:
    """Returns an entry of an ablation whose contexts have a query after every part of 200 transitions."""
    return _ablated(name, about, histories={"queries": 201, **histories}, **options)


WINDOW_ENTRIES = (
    _ablated("plain", "size tiny, K = 200, 16 windows a batch, +TA, labels of RL^2, scaled rewards, rope"),
    _ablated("sampled", "draws its actions", run_of="plain", sampled=True),
    _ablated("K500", "K = 500, 6 windows a batch", train={"context": 500, "batch_size": 6}),
    _ablated("K1000", "K = 1000, 3 windows a batch", train={"context": 1000, "batch_size": 3}),
    _ablated("K2000", "K = 2000, 2 windows a batch", train={"context": 2000, "batch_size": 2}),
    _ablated("every3", "every third episode", histories={"every": 3}),
    _ablated("every10", "every tenth episode", histories={"every": 10}),
    _ablated("own-actions", "targets are the actions taken, noise included", histories={"labels": None}),
    _ablated("oracle", "labels of the oracle, which sees the full state", histories={"labels": "oracle"}),
    _ablated("improvement", "histories by their improvement", histories={"weights": "improvement"}),
    _ablated("curriculum", "from early windows to all", histories={"curriculum": 0.5}),
    _ablated("no-ta", "without the teammate's actions", {"teammate_actions": False}),
    _ablated("next_obs", "predicts the next observation, too", {"next_obs": True}),
    _ablated("teammate", "predicts the teammate's action, too", {"teammate_loss": True}),
    _ablated("no-positions", "without rope", {"positions": "none"}),
    _ablated("smoothing", "label smoothing of 0.1", {"label_smoothing": 0.1}),
    _ablated("rewards", "rewards as they are, 20 a delivery", {"reward_scale": 1.0}),
)
"""Models of AD that differ in one thing each, trained on histories of RL^2 with its labels, as `collect` makes them."""

CONTEXT_ENTRIES = (
    _asked("plain", "size tiny, contiguous contexts of K = 200, 16 a batch, 201 queries each, +TA, labels of RL^2"),
    _asked("sampled", "draws its actions", run_of="plain", sampled=True),
    _asked("one-query", "one query with each context, as published", histories={"queries": 1}),
    _asked("mixed", "contexts of mixed skill: transitions of all of a history", histories={"order": "random"}),
    _asked("K500", "K = 500, 6 contexts a batch", train={"context": 500, "batch_size": 6}),
    _asked("oracle", "labels of the oracle, which sees the full state", histories={"labels": "oracle"}),
)
"""Models of DPT that differ in one thing each, trained on the same histories."""


class Ablation(NamedTuple):
    """An ablation, an experiment with one method.

    Attributes:
        title: for the report.
        method: its name.
        entries: one per model; with all others, the first one is compared.
    """

    title: str
    method: str
    entries: tuple[ExperimentEntry, ...]

    @property
    def sets(self) -> tuple[str, ...]:
        """Names of the values of `ModelOptions` and `TrainOptions` that the entries set."""
        return tuple(dict.fromkeys(name for entry in self.entries for name in (*entry.model, *entry.train)))


ABLATIONS = {
    "ablate windows": Ablation("Windows that teach", "ad", WINDOW_ENTRIES),
    "ablate contexts": Ablation("Contexts that teach", "dpt", CONTEXT_ENTRIES),
}
"""Ablations by the name of their experiment."""
