"""Hyper-parameters of the learners, in a module without JAX that commands can import quickly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS, PAPER_EGO_STEPS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.rules import WRONG_DELIVERY_REWARD
from icrl4aht_data.utils.options import Count, NotNegative, Positive, Share, check_options

EncoderKind = Literal["paper", "words", "mlp"]
"""How a network encodes observations.

`paper`: the paper's convolutions. `words`: the same convolutions, but the 1 x 1 layers are computed only once for equal
contents of cells, see `learners.encoder`. `mlp`: one dense layer of the flat window instead of convolutions.
"""

# Larger values are a mistake, or an attack that exhausts memory.
_Width = Annotated[int, Meta(ge=1, le=2**13)]
_Layers = Annotated[tuple[_Width, ...], Meta(max_length=16)]


@dataclass(frozen=True)
class Widths:
    """Encoder and layer widths of the network; the defaults are the paper's (273,375 parameters at C = 40).

    Attributes:
        pointwise: widths of the 1 x 1 convolutions; always empty for encoder `mlp`.
        spatial: widths of the 3 x 3 convolutions; always empty for encoder `mlp`.
        dense: width of the encoder's dense layer.
        gru: width of the recurrent state.
        head: width of the actor's and the critic's hidden layers.
        encoder: how observations are encoded.
    """

    pointwise: _Layers = (128, 128, 8)
    spatial: _Layers = (16, 32, 32)
    dense: _Width = 128
    gru: _Width = 128
    head: _Width = 128
    encoder: EncoderKind = "paper"

    def __post_init__(self) -> None:
        check_options(self)
        if self.encoder == "mlp":
            object.__setattr__(self, "pointwise", ())
            object.__setattr__(self, "spatial", ())


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters of PPO; the defaults are the paper's for egos (App. C.2.2).

    Attributes:
        total_steps: environment steps, over all environments.
        environments: number of environments that are stepped in parallel.
        rollout: steps of each environment between two updates.
        epochs: passes over the steps of an update.
        minibatches: minibatches of an epoch; a divisor of the environments.
        learning_rate: peak learning rate.
        warmup: share of the updates in which the learning rate rises.
        discount: discount factor of rewards, gamma.
        gae_lambda: decay factor lambda of generalized advantage estimation.
        clip: largest change of the probability ratio and of the value.
        entropy: weight of the entropy bonus.
        value: weight of the value loss.
        max_grad_norm: largest global norm of a gradient.
        shaping_horizon: environment steps until shaped rewards have the weight 0.
        forgiveness: shaped reward of a wrong delivery; with 20, its penalty grows from 0 to 20 while shaping fades out.
        widths: encoder and layer widths of the network.

    Raises:
        OptionError: if a value is out of bounds, or the environments cannot be divided into the minibatches.
    """

    total_steps: Count = PAPER_EGO_STEPS
    environments: Count = 1024
    rollout: Count = 256
    epochs: Count = 4
    minibatches: Count = 64
    learning_rate: Positive = 2.5e-4
    warmup: Share = 0.1
    discount: Share = 0.99
    gae_lambda: Share = 0.95
    clip: Positive = 0.2
    entropy: NotNegative = 0.01
    value: NotNegative = 0.5
    max_grad_norm: Positive = 0.25
    shaping_horizon: Count = PAPER_EGO_STEPS
    forgiveness: Annotated[float, Meta(ge=0, le=-WRONG_DELIVERY_REWARD)] = 0.0
    widths: Widths = field(default_factory=Widths)

    def __post_init__(self) -> None:
        check_options(self)
        if self.environments % self.minibatches:
            raise OptionError(f"environments = {self.environments}: not a multiple of minibatches = {self.minibatches}")

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps per update, summed over all environments."""
        return self.environments * self.rollout

    @property
    def updates(self) -> int:
        """Number of complete updates within `total_steps`."""
        return self.total_steps // self.steps_per_update

    @property
    def episodes(self) -> int:
        """Number of episodes per environment that can be stored, with the state after their last stored step."""
        return max(0, (self.updates * self.rollout - KEPT_STEPS - 1) // EPISODE_STEPS + 1)
