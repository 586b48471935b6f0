"""Changes of what an ego sees, the same in all steps of a task: mirrored windows, and hidden recipe indicators.

Batches state the mirroring of their rows with the numbers of their layouts, see `changed_view`.

The game has no preferred direction, so a mirrored task is another task of the same kind, played on the mirrored layout.
Models that are tested on other layouts than they are trained on learn from mirrored tasks, too. A hidden recipe
indicator looks like a counter, as on layouts without an indicator.

`B` denotes any leading axes. Observations have the canonical channels.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.learners.encoder import CompactView
from jaxtyping import Array, Bool, Int, Num

from icrl4aht_baselines.methods.tokens import BatchView
from icrl4aht_data.overcooked.actions import DOWN, INTERACT, LEFT, RIGHT, STAY, UP
from icrl4aht_data.overcooked.channels import CANONICAL_CHANNELS
from icrl4aht_data.overcooked.layouts import Layout

_INDICATOR, _WALL = (CANONICAL_CHANNELS.index(name) for name in ("recipe_indicator", "wall"))
_IS_WALL = np.arange(len(CANONICAL_CHANNELS)) == _WALL
_RECIPE = np.array([name.startswith("recipe_") for name in CANONICAL_CHANNELS])
_ROWS, _COLUMNS = -3, -2
_MIRRORED_ACTIONS = np.array(
    [
        (UP, DOWN, LEFT, RIGHT, STAY, INTERACT),
        (DOWN, UP, LEFT, RIGHT, STAY, INTERACT),
        (UP, DOWN, RIGHT, LEFT, STAY, INTERACT),
        (DOWN, UP, RIGHT, LEFT, STAY, INTERACT),
    ]
)
"""Number of the mirroring, see `changed_view` -> action in the mirrored view for each action."""


class ViewChange(NamedTuple):
    """Changes of the view in B tasks or windows.

    Attributes:
        hidden: bool (*B,), whether recipe indicators look like counters.
        upside_down: bool (*B,), whether up and down are exchanged.
        sideways: bool (*B,), whether left and right are exchanged.
    """

    hidden: Bool[Array, "*B"]
    upside_down: Bool[Array, "*B"]
    sideways: Bool[Array, "*B"]

    def observations(self, obs: Num[Array, "*B 5 5 46"]) -> Num[Array, "*B 5 5 46"]:
        """Return the observations as the ego sees them."""
        hidden, rows, columns = (flag[..., None, None, None] for flag in self)
        # `.at[..., _WALL].max` would be a scatter, which takes several times as long as all else here.
        walls = jnp.maximum(obs, obs[..., _INDICATOR, None])
        counters = jnp.where(_RECIPE, 0, jnp.where(_IS_WALL, walls, obs))
        obs = jnp.where(hidden, counters, obs)
        obs = jnp.where(rows, _exchanged(jnp.flip(obs, _ROWS), "up", "down"), obs)
        return jnp.where(columns, _exchanged(jnp.flip(obs, _COLUMNS), "left", "right"), obs)

    def actions(self, actions: Int[Array, "*B"]) -> Int[Array, "*B"]:
        """Return actions in the ego's view for actions in the environment, and the other way round."""
        return jnp.asarray(_MIRRORED_ACTIONS, actions.dtype)[self.upside_down + 2 * self.sideways, actions]

    def at_each_step(self, steps: int, axis: int) -> ViewChange:
        """Return the changes with an axis of steps inserted."""
        return ViewChange(*(jnp.repeat(jnp.expand_dims(flag, axis), steps, axis) for flag in self))


def _exchanged(obs: Array, one: str, other: str) -> Array:
    """Return observations in which agents face one direction where they faced the other.

    Slices are much faster than a gather of all channels.
    """
    exchanged = {
        f"{who}_facing_{here}": f"{who}_facing_{there}"
        for who in ("self", "other")
        for here, there in ((one, other), (other, one))
    }
    source = [CANONICAL_CHANNELS.index(exchanged.get(name, name)) for name in CANONICAL_CHANNELS]
    runs = np.split(source, np.flatnonzero(np.diff(source) != 1) + 1)
    return jnp.concatenate([obs[..., run[0] : run[-1] + 1] for run in runs], axis=-1)


def mirrored_action(actions: np.ndarray, mirroring: np.ndarray) -> np.ndarray:
    """Return the actions of mirrored rows.

    Args:
        actions: int (B, ..).
        mirroring: int (B,), as in `changed_view`.
    """
    return _MIRRORED_ACTIONS.astype(actions.dtype)[mirroring.reshape(-1, *(1,) * (actions.ndim - 1)), actions]


def no_change(*shape: int) -> ViewChange:
    """Return changes of shape (*B,) that change nothing."""
    no: Any = jnp.zeros(shape, bool)
    return ViewChange(no, no, no)


def changed_view(layouts: Sequence[Layout], hidden: Collection[str] = ()) -> BatchView:
    """Return the view of batches of state records whose ego sees hidden recipe indicators, or a mirrored game.

    The number of a row's layout in a batch says both: number n of N layouts, and N times the number of the mirroring, 0
    for none, 1 for upside down, 2 for sideways, 3 for both.

    Args:
        layouts: the N layouts.
        hidden: names of those whose recipe indicators look like counters.
    """
    compact = CompactView("paper", tuple(layouts), canonical=True)
    hides = jnp.asarray([layout.name in hidden for layout in layouts])

    def view(records: Any, numbers: Any) -> Any:
        variant = jnp.zeros(records.shape[0], jnp.int32) if numbers is None else jnp.asarray(numbers)
        number, mirroring = variant % len(layouts), variant // len(layouts)
        obs: Any = compact(records, number if len(layouts) > 1 else None)
        change = ViewChange(hides[number], mirroring % 2 > 0, mirroring // 2 > 0)
        within = (1,) * (records.ndim - 2)
        return ViewChange(*(flag.reshape(-1, *within) for flag in change)).observations(obs)

    return view


class NumberedBatches:
    """Batches of state records from a sampler, with renumbered layouts, optionally mirrored at random.

    Args:
        sampler: of histories on some of the layouts.
        numbers: int32, new number of each layout of `sampler.layouts`.
        layouts: number of all layouts, to mirror each row at random, see `changed_view`; 0 mirrors none.
    """

    def __init__(self, sampler: Any, numbers: np.ndarray, layouts: int = 0) -> None:
        self._sampler, self._numbers, self._layouts = sampler, numbers, layouts

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sampler, name)

    def __getitem__(self, i: int) -> Any:
        return self.batch(i)

    def batch(self, i: int, out: Any = None) -> Any:
        """Return batch i, written into `out` if it is given."""
        batch = self._sampler.batch(i, out)
        rows = len(batch.obs if hasattr(batch, "obs") else batch.query_obs)
        # A sampler of one layout does not number it.
        numbers = self._numbers[np.zeros(rows, np.int32) if batch.layouts is None else batch.layouts]
        if not self._layouts:
            return batch._replace(layouts=numbers)
        # The mirroring is a function of the batch's number and process, as the batch itself is.
        drawn = np.random.default_rng((self._sampler.seed, i, self._sampler.process_index))
        mirroring = drawn.integers(4, size=rows, dtype=np.int32)
        actions = {
            name: mirrored_action(values, mirroring)
            for name, values in batch._asdict().items()
            if values is not None and (name.endswith("actions") or name == "query_target")
        }
        if hasattr(batch, "is_first"):  # no step precedes: the fillers stay 0, as they are when a model acts
            filler = batch.is_first | ~batch.attention_mask
            actions |= {name: np.where(filler, 0, actions[name]) for name in actions if name.startswith("prev_")}
        return batch._replace(**actions, layouts=numbers + self._layouts * mirroring)


def number_layouts(sampler: Any, layouts: Sequence[Layout], mirror: bool = False) -> Any:
    """Return the sampler with its layouts numbered as in `layouts`; its histories may be on some of these only."""
    numbers = np.array([layouts.index(layout) for layout in sampler.layouts], np.int32)
    if mirror:
        return NumberedBatches(sampler, numbers, len(layouts))
    agree = sampler.dataset.obs != "state" or numbers.tolist() == list(range(len(layouts)))
    return sampler if agree else NumberedBatches(sampler, numbers)
