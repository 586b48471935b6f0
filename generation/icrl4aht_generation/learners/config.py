"""Hyper-parameters of the learners; no JAX, so that command lines can list them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from icrl4aht_data.benchmark.facts import EPISODE_STEPS, KEPT_STEPS, PAPER_EGO_STEPS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.rules import WRONG_DELIVERY_REWARD
from icrl4aht_data.utils.options import check_fields, option_field

EncoderKind = Literal["paper", "words", "mlp"]
"""How a network encodes observations.

`paper`: the paper's convolutions. `words`: the same parameters, with the first layers computed once per word of a cell,
see `learners.encoder`. `mlp`: one dense layer of the flat window, in place of the convolutions.
"""

_WIDEST, _LAYERS = 2**13, 16  # larger values in a file are a mistake, or meant to exhaust memory


@dataclass(frozen=True)
class Widths:
    """Encoder and layer widths of the network; the defaults are the paper's (273,375 parameters at C = 40).

    Encoder `mlp` has no convolutions: `pointwise` and `spatial` are empty then, whatever was given.
    """

    pointwise: tuple[int, ...] = option_field(
        (128, 128, 8),
        "Width of a 1 x 1 convolution; repeat for more layers.",
        at_least=1,
        at_most=_WIDEST,
        may_be_empty=True,
    )
    spatial: tuple[int, ...] = option_field(
        (16, 32, 32),
        "Width of a 3 x 3 convolution; repeat for more layers.",
        at_least=1,
        at_most=_WIDEST,
        may_be_empty=True,
    )
    dense: int = option_field(128, "Width of the encoder's dense layer.", at_least=1, at_most=_WIDEST)
    gru: int = option_field(128, "Width of the recurrent state.", at_least=1, at_most=_WIDEST)
    head: int = option_field(128, "Width of the actor's and the critic's hidden layers.", at_least=1, at_most=_WIDEST)
    encoder: EncoderKind = option_field("paper", "Encoder of observations: paper, words (the same, faster) or mlp.")

    def __post_init__(self) -> None:
        for name in ("pointwise", "spatial"):
            if self.encoder == "mlp":
                object.__setattr__(self, name, ())
            if len(getattr(self, name)) > _LAYERS:
                raise OptionError(f"{name} = {getattr(self, name)!r:.200}: expected at most {_LAYERS} layers")
        check_fields(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Widths:
        """Returns the widths that a JSON or TOML object holds, where tuples are lists.

        Raises:
            TypeError: for unknown names.
            OptionError: for values other than positive integers up to 8192.
        """
        converted: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**converted)


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters of PPO; the defaults are the paper's for egos (App. C.2.2).

    Raises:
        OptionError: for a value out of bounds.
        ValueError: if the environments cannot be divided into the minibatches.
    """

    total_steps: int = option_field(PAPER_EGO_STEPS, "Environment steps, over all environments.", at_least=1)
    environments: int = option_field(1024, "Environments that are stepped in parallel.", at_least=1)
    rollout: int = option_field(256, "Steps of each environment between two updates.", at_least=1)
    epochs: int = option_field(4, "Passes over the steps of an update.", at_least=1)
    minibatches: int = option_field(64, "Minibatches of an epoch; a divisor of the environments.", at_least=1)
    learning_rate: float = option_field(2.5e-4, "Peak learning rate.", above=0)
    warmup: float = option_field(0.1, "Share of the updates in which the learning rate rises.", at_least=0, at_most=1)
    discount: float = option_field(0.99, "Discount of rewards, gamma.", at_least=0, at_most=1)
    gae_lambda: float = option_field(0.95, "Decay of the advantage estimate's trace, lambda.", at_least=0, at_most=1)
    clip: float = option_field(0.2, "Largest change of the probability ratio and of the value.", above=0)
    entropy: float = option_field(0.01, "Weight of the entropy bonus.", at_least=0)
    value: float = option_field(0.5, "Weight of the value loss.", at_least=0)
    max_grad_norm: float = option_field(0.25, "Largest global norm of a gradient.", above=0)
    shaping_horizon: int = option_field(
        PAPER_EGO_STEPS, "Environment steps until shaped rewards have the weight 0.", at_least=1
    )
    forgiveness: float = option_field(
        0.0,
        "Shaped reward of a wrong delivery: with 20, its penalty grows from 0 to 20 as the shaping ends.",
        at_least=0,
        at_most=-WRONG_DELIVERY_REWARD,
    )
    widths: Widths = field(default_factory=Widths)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.environments % self.minibatches:
            raise ValueError(f"environments = {self.environments}: not a multiple of minibatches = {self.minibatches}")

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
