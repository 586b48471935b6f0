"""Options of training and of the choice of histories. The module does not import JAX, so help texts print quickly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

from msgspec import Meta

from icrl4aht_baselines.methods.options import RL2_SETTINGS
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.channels import Channels
from icrl4aht_data.reading.history import Labels
from icrl4aht_data.sampling.dpt import ContextOrder
from icrl4aht_data.utils.options import Count, Natural, NotNegative, Option, Positive, Seed, Share, check_options

MOST_REARRANGED = 256
"""Largest number of rearranged versions of a layout to train on."""


@dataclass(frozen=True)
class TrainOptions:
    """Settings of a training run; the defaults are the paper's (App. E.5).

    Raises:
        OptionError: if a value is out of bounds.
    """

    steps: Annotated[Count, Option("Training steps.")] = 20_000
    batch_size: Annotated[Count, Option("Windows or contexts per batch, over all devices and processes.")] = 1024
    context: Annotated[Count, Option("K: steps of a window, or transitions of a context.")] = 500
    learning_rate: Annotated[Positive, Option("Highest learning rate.")] = 1e-3
    warmup: Annotated[Share, Option("Share of the steps in which the learning rate rises.")] = 0.05
    weight_decay: Annotated[NotNegative, Option("Weight decay of AdamW.")] = 0.0
    clip: Annotated[Positive, Option("Largest global norm of the gradient.")] = 1.0
    accumulate: Annotated[Count, Option("Parts that a batch is computed in, one after the other.")] = 1
    seed: Annotated[Seed, Option("Seed of parameters, batches and dropout.")] = 0
    log_every: Annotated[Count, Option("Steps between lines of the log.")] = 50
    validate_every: Annotated[Count, Option("Steps between validations.")] = 1000
    validation_batches: Annotated[Natural, Option("Batches of each held-out part in a validation.")] = 2
    save_every: Annotated[Count, Option("Steps between checkpoints.")] = 1000

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class PlayOptions:
    """Settings of a method that learns by playing `episodes` episodes of `batch_size` tasks in each training step.

    Raises:
        OptionError: if a value is out of bounds.
    """

    epochs: Annotated[Count, Option("Passes over the episodes of a step.")] = 2
    minibatches: Annotated[Count, Option("Parts of a pass, each with an update of the parameters.")] = 4
    discount: Annotated[Share, Option("Discount of rewards, which continue over a task's episodes.")] = 0.99
    gae_lambda: Annotated[Share, Option("Decay of the advantage estimate's trace.")] = 0.95
    entropy: Annotated[NotNegative, Option("Weight of the entropy bonus.")] = 0.01
    episodes: Annotated[
        Count, Option("Episodes of each task that a step plays; the model learns to remember over these episodes.")
    ] = 1
    task_end: Annotated[float, Meta(gt=0, le=1), Option("Chance that a task ends after a step's episodes.")] = 1 / 16
    imitation: Annotated[
        NotNegative,
        Option("Weight of imitating a script at the start: the oracle, or `search` in tasks with a hidden dish."),
    ] = 1.0
    imitation_end: Annotated[Positive, Option("Share of the steps at which that weight has fallen to 0.")] = 0.5
    rearranged: Annotated[
        int,
        Meta(ge=0, le=MOST_REARRANGED),
        Option("Also play on so many rearranged versions of each layout, every second one with four recipes."),
    ] = 0
    four_recipes: Annotated[
        bool,
        Option(
            "Also play on each layout with the four recipes of the protocol `published`, with teammates of one family."
        ),
    ] = False

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class ResponseOptions:
    """Settings of the training of a best response.

    Attributes:
        init: name of a bundled rl2 model to start from; None for random parameters.
    """

    steps: Annotated[Count, Option("Environment steps of a training run.")] = 3_000_000
    tasks: Annotated[Count, Option("Episodes that are played at once.")] = 128
    learning_rate: Annotated[Positive, Option("Highest learning rate.")] = 1e-3
    width: Annotated[
        Count, Option("Width of features and of the recurrent state; with 64 a core learns 1.6 times as fast.")
    ] = 128
    init: str | None = None

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps in one training step, which plays one episode of each of `tasks` tasks."""
        return self.tasks * KEPT_STEPS

    @property
    def updates(self) -> int:
        """Number of training steps."""
        return max(1, self.steps // self.steps_per_update)

    @property
    def played_steps(self) -> int:
        """Number of environment steps that a training run plays: a multiple of `steps_per_update`."""
        return self.updates * self.steps_per_update

    def training(self, seed: int) -> TrainOptions:
        """Return the options of the trainer for a run with this seed."""
        settings = {**RL2_SETTINGS["train"], "steps": self.updates, "batch_size": self.tasks, "seed": seed}
        return replace(TrainOptions(**settings), learning_rate=self.learning_rate, save_every=self.updates)


SAVE_MINUTES = 5.0
"""Largest number of minutes between checkpoints, which are also written every `save_every` steps."""

FILTERS = ("teammate_family", "source", "label_view", "algorithm")
"""Fields of `HistoryOptions` with the accepted values of an index field of this name, see `Dataset.filter`."""

ALL_LAYOUTS = "all"
"""Value of `layouts` for all layouts with histories that pass the other filters."""


@dataclass(frozen=True)
class HistoryOptions:
    """Choice of the training histories of a run.

    Attributes:
        layouts: names of training layouts, or `ALL_LAYOUTS` alone.
        root: folder or address of a release; None for the bundled mini release.
    """

    layouts: tuple[str, ...]
    root: str | None = None
    teammate_family: Annotated[
        tuple[str, ...],
        Option("Only histories with teammates of this family: rl (learned), H1, H2, H3 or H4; repeat for several."),
    ] = ()
    algorithm: Annotated[
        tuple[str, ...],
        Option("Only histories with teammates of this algorithm, such as fcp, or kind of heuristic; repeat."),
    ] = ()
    source: Annotated[
        tuple[str, ...], Option("Only histories of this source: ppo, noise, agent or search; repeat for several.")
    ] = ()
    label_view: Annotated[
        tuple[str, ...],
        Option("Only histories with expert actions from this view: ego or state; repeat."),
    ] = ()
    order: Annotated[ContextOrder, Option("Order of the transitions in DPT's contexts.")] = "contiguous"
    queries: Annotated[Count, Option("Queries that DPT answers with each context, posed in turn.")] = 1
    labels: Annotated[
        Labels | None,
        Option(
            "Actions to learn: expert (of a policy, without noise) or oracle (of a script that knows the full state).",
            default="expert for dpt, the histories' own actions for the others",
        ),
    ] = None
    every: Annotated[
        Count, Option("Windows hold every n-th episode of a history, so that they span more of its learning.")
    ] = 1
    first: Annotated[
        Natural,
        Option(
            "Only the first n episodes of each history; with a context of as many steps all windows begin where a "
            "history begins, as a test does.",
            default="all",
        ),
    ] = 0
    at_start: Annotated[Share, Option("Share of the windows that begin where a history begins, as a test does.")] = 0.0
    balance: Annotated[bool, Option("Draw windows from each source equally often, not from each history.")] = False
    held_out: Annotated[
        float,
        Meta(gt=0, lt=1),
        Option(
            "Share of the histories to hold out; also of the teammates, if no validation histories pass the filters."
        ),
    ] = 0.1
    channels: Annotated[
        Channels | None,
        Option(
            "Channels of observations: a layout's own, or canonical, which all layouts share.",
            default="canonical for --layout all and for layouts of unequal shape, or else own",
        ),
    ] = None

    mirror: Annotated[
        bool, Option("Mirror histories at random, up and down or left and right exchanged, to learn of more layouts.")
    ] = False
    hide_recipe: Annotated[
        tuple[str, ...], Option("The model does not see the recipe indicators of this layout; repeat for several.")
    ] = ()

    def __post_init__(self) -> None:
        check_options(self)
        if ALL_LAYOUTS in self.layouts and len(self.layouts) > 1:
            raise OptionError(f"layouts = {', '.join(self.layouts)}: expected names of layouts, or {ALL_LAYOUTS} alone")

    @property
    def filters(self) -> dict[str, Any]:
        """Accepted values of each filter that is set, by the field's name in `FILTERS`."""
        return {name: getattr(self, name) for name in FILTERS if getattr(self, name)}
