"""Hyper-parameters of the models. This module does not import JAX, so that help texts are printed quickly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

from icrl4aht_generation.learners.config import EncoderKind
from msgspec import Meta

from icrl4aht_data.utils.options import Count, Option, Positive, ShareBelowOne, check_options

Positions = Literal["none", "rope"]
"""Position embedding of tokens: none, as published, or rotary (Su et al. 2021)."""


class ModelSize(NamedTuple):
    """Values of some options for a named model size; all other options have their defaults.

    Attributes:
        model: values of `ModelOptions`.
        train: `steps` and `context` of `TrainOptions`.
        cpu_batch: default batch size on a CPU.
    """

    model: dict[str, Any]
    train: dict[str, Any]
    cpu_batch: int = 8


_TINY = {"layers": 2, "width": 64, "heads": 2, "positions": "rope", "encoder": "mlp"}

SIZES = {
    "tiny": ModelSize(_TINY, {"steps": 20_000, "context": 200}, cpu_batch=16),
    "small": ModelSize({"layers": 4, "width": 256}, {"steps": 20_000, "context": 500}),
    "medium": ModelSize({"layers": 8, "width": 512}, {"steps": 50_000, "context": 500}),
    "large": ModelSize({"layers": 12, "width": 768}, {"steps": 100_000, "context": 500}),
}
"""Model sizes by name: `tiny` for two CPU cores, and the paper's (Sec. 5.3, "Model Scale and Training Budget")."""

RL2_SETTINGS: dict[str, dict[str, Any]] = {
    "model": {
        "width": 128,
        "recurrent_layers": 1,
        "dropout": 0.0,
        "encoder": "mlp",
        "teammate_actions": True,
        "reward_scale": 0.05,
    },
    "train": {
        "steps": 2000,
        "batch_size": 256,
        "learning_rate": 1e-3,
        "warmup": 0.02,
        "clip": 0.5,
        "log_every": 20,
        "save_every": 200,
    },
}
"""Default values of `ModelOptions` and of `TrainOptions` for RL^2 on two CPU cores."""


@dataclass(frozen=True)
class ModelOptions:
    """Architecture of a model; the defaults are the paper's (App. E.5).

    Raises:
        OptionError: if a value is out of bounds.
    """

    layers: Annotated[Count, Option("Layers of the transformer; of bc, dense layers.")] = 4
    width: Annotated[Count, Option("Width of tokens and features.")] = 256
    heads: Annotated[Count, Option("Attention heads.")] = 4
    recurrent_layers: Annotated[Count, Option("GRU layers of Hybrid-AD, in place of the transformer.")] = 2
    dropout: Annotated[ShareBelowOne, Option("Dropout rate in training.")] = 0.1
    encoder: Annotated[
        EncoderKind, Option("Encoder of observations: paper, words (the same, faster) or mlp (one dense layer).")
    ] = "paper"
    positions: Annotated[Positions, Option("Position embedding: none, as published, or rope.")] = "none"
    teammate_actions: Annotated[bool, Option("+TA: input the teammate's previous action, too.", flags=("--ta",))] = (
        False
    )
    reward_scale: Annotated[Positive, Option("Factor of the rewards in tokens; a delivery earns 20.")] = 1.0
    next_obs: Annotated[bool, Option("+next_obs: also learn to predict the next observation.")] = False
    label_smoothing: Annotated[ShareBelowOne, Option("Label smoothing of the action loss.")] = 0.0
    discounts: Annotated[
        tuple[ShareBelowOne, ...],
        Meta(min_length=1),
        Option("Discount factor of AMAGO-Offline, which acts by the last one; repeat for several."),
    ] = (0.9, 0.95, 0.99, 0.995)
    bfloat16: Annotated[bool, Option("Compute in bfloat16; parameters stay float32.")] = False
    remat: Annotated[bool, Option("Recompute activations in the backward pass: less memory, more time.")] = False

    def __post_init__(self) -> None:
        check_options(self)


_TRANSFORMER = {"layers", "heads", "positions", "remat"}

UNUSED = {
    "ad": {"recurrent_layers", "discounts"},
    "dpt": {"recurrent_layers", "discounts"},
    "hybrid_ad": {*_TRANSFORMER, "discounts"},
    "amago_offline": {"recurrent_layers"},
    "bc": {"heads", "positions", "remat", "recurrent_layers", "discounts", "teammate_actions", "reward_scale"},
    "rl2": {
        *(*_TRANSFORMER, "discounts", "dropout", "next_obs", "label_smoothing", "bfloat16"),
        *("context", "accumulate", "weight_decay", "validate_every", "validation_batches"),
    },
}
"""Name of a method -> names of the options of models and training that it does not use."""
