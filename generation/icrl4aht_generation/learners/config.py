"""Hyper-parameters of the learners; no JAX, so that command lines can list them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS, PAPER_EGO_STEPS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.rules import WRONG_DELIVERY_REWARD
from icrl4aht_data.utils.options import Count, NotNegative, Option, Positive, Share, check_options

EncoderKind = Literal["paper", "words", "mlp"]
"""How a network encodes observations.

`paper`: the paper's convolutions. `words`: the same parameters, with the first layers computed once per word of a cell,
see `learners.encoder`. `mlp`: one dense layer of the flat window, in place of the convolutions.
"""

# Larger values are a mistake, or an attack that exhausts memory.
_Width = Annotated[int, Meta(ge=1, le=2**13)]
_Layers = Annotated[tuple[_Width, ...], Meta(max_length=16)]


@dataclass(frozen=True)
class Widths:
    """Encoder and layer widths of the network; the defaults are the paper's (273,375 parameters at C = 40).

    Encoder `mlp` has no convolutions: `pointwise` and `spatial` are empty then, whatever was given.
    """

    pointwise: Annotated[_Layers, Option("Width of a 1 x 1 convolution; repeat for more layers.")] = (128, 128, 8)
    spatial: Annotated[_Layers, Option("Width of a 3 x 3 convolution; repeat for more layers.")] = (16, 32, 32)
    dense: Annotated[_Width, Option("Width of the encoder's dense layer.")] = 128
    gru: Annotated[_Width, Option("Width of the recurrent state.")] = 128
    head: Annotated[_Width, Option("Width of the actor's and the critic's hidden layers.")] = 128
    encoder: Annotated[EncoderKind, Option("Encoder of observations: paper, words (the same, faster) or mlp.")] = (
        "paper"
    )

    def __post_init__(self) -> None:
        check_options(self)
        if self.encoder == "mlp":
            object.__setattr__(self, "pointwise", ())
            object.__setattr__(self, "spatial", ())


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters of PPO; the defaults are the paper's for egos (App. C.2.2).

    Raises:
        OptionError: for a value out of bounds, or if the environments cannot be divided into the minibatches.
    """

    total_steps: Annotated[Count, Option("Environment steps, over all environments.")] = PAPER_EGO_STEPS
    environments: Annotated[Count, Option("Environments that are stepped in parallel.")] = 1024
    rollout: Annotated[Count, Option("Steps of each environment between two updates.")] = 256
    epochs: Annotated[Count, Option("Passes over the steps of an update.")] = 4
    minibatches: Annotated[Count, Option("Minibatches of an epoch; a divisor of the environments.")] = 64
    learning_rate: Annotated[Positive, Option("Peak learning rate.")] = 2.5e-4
    warmup: Annotated[Share, Option("Share of the updates in which the learning rate rises.")] = 0.1
    discount: Annotated[Share, Option("Discount of rewards, gamma.")] = 0.99
    gae_lambda: Annotated[Share, Option("Decay of the advantage estimate's trace, lambda.")] = 0.95
    clip: Annotated[Positive, Option("Largest change of the probability ratio and of the value.")] = 0.2
    entropy: Annotated[NotNegative, Option("Weight of the entropy bonus.")] = 0.01
    value: Annotated[NotNegative, Option("Weight of the value loss.")] = 0.5
    max_grad_norm: Annotated[Positive, Option("Largest global norm of a gradient.")] = 0.25
    shaping_horizon: Annotated[Count, Option("Environment steps until shaped rewards have the weight 0.")] = (
        PAPER_EGO_STEPS
    )
    forgiveness: Annotated[
        float,
        Meta(ge=0, le=-WRONG_DELIVERY_REWARD),
        Option("Shaped reward of a wrong delivery: with 20, its penalty grows from 0 to 20 as the shaping ends."),
    ] = 0.0
    widths: Widths = field(default_factory=Widths)

    def __post_init__(self) -> None:
        check_options(self)
        if self.environments % self.minibatches:
            raise OptionError(f"environments = {self.environments}: not a multiple of minibatches = {self.minibatches}")

    @property
    def steps_per_update(self) -> int:
        """Environment steps of an update, over all environments."""
        return self.environments * self.rollout

    @property
    def updates(self) -> int:
        """Number of complete updates within `total_steps`."""
        return self.total_steps // self.steps_per_update

    @property
    def episodes(self) -> int:
        """Episodes of each environment whose kept steps, and the state after them, are within the updates."""
        return max(0, (self.updates * self.rollout - KEPT_STEPS - 1) // EPISODE_STEPS + 1)
