"""Hyper-parameters of training and the choice of histories, without JAX, so that the command line can show them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.channels import Channels
from icrl4aht_data.reading.history import Labels, Obs
from icrl4aht_data.sampling.dpt import ContextOrder
from icrl4aht_data.utils.options import check_fields, option_field

MOST_REARRANGED = 256
"""Most rearranged versions of a layout to train on; the next ones are for validation."""


@dataclass(frozen=True)
class TrainOptions:
    """Settings of a training run; the defaults are the paper's (App. E.5).

    Raises:
        OptionError: if a value is out of bounds.
    """

    steps: int = option_field(20_000, "Training steps.", at_least=1)
    batch_size: int = option_field(1024, "Windows or contexts per batch, over all devices and processes.", at_least=1)
    context: int = option_field(500, "K: steps of a window, or transitions of a context.", at_least=1)
    learning_rate: float = option_field(1e-3, "Highest learning rate.", above=0)
    warmup: float = option_field(0.05, "Share of the steps in which the learning rate rises.", at_least=0, at_most=1)
    weight_decay: float = option_field(0.0, "Weight decay of AdamW.", at_least=0)
    clip: float = option_field(1.0, "Largest global norm of the gradient.", above=0)
    accumulate: int = option_field(1, "Parts that a batch is computed in, one after the other.", at_least=1)
    seed: int = option_field(0, "Seed of parameters, batches and dropout.", at_least=0, below=2**32)
    log_every: int = option_field(50, "Steps between lines of the log.", at_least=1)
    validate_every: int = option_field(1000, "Steps between validations.", at_least=1)
    validation_batches: int = option_field(2, "Batches of each held-out part in a validation.", at_least=0)
    save_every: int = option_field(1000, "Steps between checkpoints.", at_least=1)

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class PlayOptions:
    """Settings of a method that is trained by playing; one step plays an episode of each of `batch_size` tasks.

    Raises:
        OptionError: if a value is out of bounds.
    """

    epochs: int = option_field(2, "Passes over the episodes of a step.", at_least=1)
    minibatches: int = option_field(4, "Parts of a pass, each with an update of the parameters.", at_least=1)
    discount: float = option_field(
        0.99, "Discount of rewards, which continue over a task's episodes.", at_least=0, at_most=1
    )
    gae_lambda: float = option_field(0.95, "Decay of the advantage estimate's trace.", at_least=0, at_most=1)
    entropy: float = option_field(0.01, "Weight of the entropy bonus.", at_least=0)
    task_end: float = option_field(1 / 16, "Chance that a task ends after an episode.", above=0, at_most=1)
    imitation: float = option_field(1.0, "Weight of imitating the oracle at the start.", at_least=0)
    imitation_end: float = option_field(0.5, "Share of the steps at which that weight has fallen to 0.", above=0)
    rearranged: int = option_field(
        0,
        "Also play on so many rearranged versions of each layout, every second one with four recipes.",
        at_least=0,
        at_most=MOST_REARRANGED,
    )
    four_recipes: bool = option_field(
        False, "Also play on each layout with the four recipes of the protocol published, with teammates of one family."
    )

    def __post_init__(self) -> None:
        check_fields(self)


SAVE_MINUTES = 5.0
"""Most minutes between checkpoints of a training run; no setting of the run, whose results do not depend on it."""

FILTERS = {"teammate_family": "teammate_family", "algorithm": "teammate_kind", "source": "source"}
"""Field of `HistoryOptions` -> the field of a release's index that it filters by."""


ALL_LAYOUTS = "all"
"""In place of the names of layouts: all layouts on which the release has histories that pass the other filters."""


@dataclass(frozen=True)
class HistoryOptions:
    """Choice of the histories that a run is trained on.

    Attributes:
        layouts: names of training layouts, or `ALL_LAYOUTS` alone.
        root: folder or address of a release; None for the bundled mini release.
        split: split of the release.
        teammate_family: families of teammates, "rl" or "H1".."H4"; any by default.
        algorithm: algorithms of learned teammates or kinds of heuristics, such as "fcp"; any by default.
        source: how histories were made, "ppo", "noise" or "student"; any by default.
        hide_recipe: names of layouts whose recipe indicators the model does not see, in training and when it acts.
    """

    layouts: tuple[str, ...]
    root: str | None = None
    split: str = "train"
    teammate_family: tuple[str, ...] = ()
    algorithm: tuple[str, ...] = ()
    source: tuple[str, ...] = ()
    order: ContextOrder = option_field("contiguous", "Order of the transitions in DPT's contexts.")
    queries: int = option_field(1, "Queries that DPT answers with each context, posed in turn.", at_least=1)
    labels: Labels | None = option_field(
        None,
        "Actions to learn: expert (greedy ones of a policy) or oracle (of a script that knows the full state).",
        default_text="expert for dpt, the histories' own actions for the others",
    )
    every: int = option_field(
        1, "Windows hold every n-th episode of a history, so that they span more of its learning.", at_least=1
    )
    weights: Literal["uniform", "improvement"] = option_field(
        "uniform", "Draw histories uniformly, or by how much their returns rise (improvement)."
    )
    curriculum: float = option_field(
        0.0,
        "Share of the steps in which windows move from a history's first quarter to all of it.",
        at_least=0,
        at_most=1,
    )
    held_out: float = option_field(
        0.1,
        "Share of the histories to hold out; also of the tasks, if no histories of split validation pass the filters.",
        above=0,
        below=1,
    )
    obs: Obs | None = option_field(
        None,
        "Representation of observations in batches.",
        default_text="state, or uint8 if there are no state records",
    )
    channels: Channels | None = option_field(
        None,
        "Channels of observations: a layout's own, or canonical, which all layouts share.",
        default_text="canonical for --layout all and for layouts of unequal shape, or else own",
    )

    mirror: bool = option_field(
        False, "Mirror histories at random, up and down or left and right exchanged, to learn of more layouts."
    )
    hide_recipe: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        if ALL_LAYOUTS in self.layouts and len(self.layouts) > 1:
            raise OptionError(f"layouts = {', '.join(self.layouts)}: expected names of layouts, or {ALL_LAYOUTS} alone")

    @property
    def filters(self) -> dict[str, tuple[str, ...]]:
        """The filters that are set: name of the field -> accepted values."""
        return {name: getattr(self, name) for name in FILTERS if getattr(self, name)}
