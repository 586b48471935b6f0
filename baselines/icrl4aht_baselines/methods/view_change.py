"""Changes of an ego's observations for a complete task: mirrored observations, and hidden recipe indicators.

The game has no preferred direction, so a mirrored task is equal to a task on the mirrored layout. For models that are
tested on new layouts, mirroring is data augmentation. A hidden recipe indicator looks like a counter, as on layouts
without an indicator. In a batch, the layout number of a row also states the row's mirroring, see `changed_view`.

`B` denotes any leading axes. Observations have the canonical channels.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.learners.encoder import CompactView
from jaxtyping import Array, Bool, Int, Num

from icrl4aht_baselines.methods.tokens import BatchView, StepInput
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
"""Table [number of the mirroring, see `changed_view`; action in the environment] -> action in the mirrored view."""


class ViewChange(NamedTuple):
    """Changes of the observations in B tasks or windows.

    Attributes:
        hidden: bool (*B,), whether recipe indicators look like counters.
        upside_down: bool (*B,), whether the view is mirrored so that up and down are exchanged.
        sideways: bool (*B,), whether the view is mirrored so that left and right are exchanged.
    """

    hidden: Bool[Array, "*B"]
    upside_down: Bool[Array, "*B"]
    sideways: Bool[Array, "*B"]

    def observations(self, obs: Num[Array, "*B 5 5 46"]) -> Num[Array, "*B 5 5 46"]:
        """Convert the environment's observations to the changed observations that the ego sees."""
        hidden, rows, columns = (flag[..., None, None, None] for flag in self)
        # `.at[..., _WALL].max` would be a scatter, which is several times slower than the rest of this function.
        walls = jnp.maximum(obs, obs[..., _INDICATOR, None])
        counters = jnp.where(_RECIPE, 0, jnp.where(_IS_WALL, walls, obs))
        obs = jnp.where(hidden, counters, obs)
        obs = jnp.where(rows, _exchange_directions(jnp.flip(obs, _ROWS), "up", "down"), obs)
        return jnp.where(columns, _exchange_directions(jnp.flip(obs, _COLUMNS), "left", "right"), obs)

    def actions(self, actions: Int[Array, "*B"]) -> Int[Array, "*B"]:
        """Convert actions from the environment to the ego's view, or from the ego's view to the environment."""
        return jnp.asarray(_MIRRORED_ACTIONS, actions.dtype)[self.upside_down + 2 * self.sideways, actions]

    def steps(self, steps: StepInput, started: Bool[Array, "*B"]) -> StepInput:
        """Return steps with changed observations, and with previous actions converted to the changed view.

        Args:
            steps: steps with the environment's observations (*B, ..); the changes may have fewer leading axes.
            started: whether each step has a previous step in its task; if not, previous actions are fillers and stay 0.
        """

        def view_actions(actions: Array) -> Array:
            return jnp.where(started, self.actions(actions), actions)

        mate = steps.prev_teammate_action
        return steps._replace(
            obs=self.observations(steps.obs),
            prev_action=view_actions(steps.prev_action),
            prev_teammate_action=None if mate is None else view_actions(mate),
        )


def _exchange_directions(obs: Array, one: str, other: str) -> Array:
    """Return observations in which two directions that agents may face are exchanged.

    The channels are copied in slices, which is much faster than a gather of all channels.
    """
    exchanged = {
        f"{who}_facing_{here}": f"{who}_facing_{there}"
        for who in ("self", "other")
        for here, there in ((one, other), (other, one))
    }
    source = [CANONICAL_CHANNELS.index(exchanged.get(name, name)) for name in CANONICAL_CHANNELS]
    runs = np.split(source, np.flatnonzero(np.diff(source) != 1) + 1)
    return jnp.concatenate([obs[..., run[0] : run[-1] + 1] for run in runs], axis=-1)


def no_change() -> ViewChange:
    """Return a `ViewChange` of scalars that leaves observations and actions unchanged."""
    no: Any = jnp.bool_(False)
    return ViewChange(no, no, no)


def changed_view(layouts: Sequence[Layout], hidden: Collection[str] = ()) -> BatchView:
    """Return a function from a batch of state records to observations, possibly mirrored or with hidden indicators.

    The layout number of a batch row is n + N * m, for layout n of N layouts and mirroring m: 0 for none, 1 for up-down,
    2 for left-right, 3 for both.

    Args:
        layouts: the N layouts.
        hidden: names of the layouts on which recipe indicators are shown as counters.
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


class RenumberedLayoutSampler:
    """Sampler of state records that renumbers the layouts of another sampler's batches, and may mirror rows at random.

    Args:
        sampler: sampler of histories.
        numbers: int32, new number of each layout of `sampler.layouts`.
        layouts: total number of layouts, if rows are to be mirrored at random, see `changed_view`; otherwise 0.
    """

    def __init__(self, sampler: Any, numbers: np.ndarray, layouts: int = 0) -> None:
        self._sampler, self._numbers, self._layouts = sampler, numbers, layouts

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sampler, name)

    def batch(self, i: int, out: Any = None) -> Any:
        """Return batch number i, written into `out` if given."""
        batch = self._sampler.batch(i, out)
        rows = len(batch.obs if hasattr(batch, "obs") else batch.query_obs)
        # The batches of a sampler with one layout have no layout numbers.
        numbers = self._numbers[np.zeros(rows, np.int32) if batch.layouts is None else batch.layouts]
        if not self._layouts:
            return batch._replace(layouts=numbers)
        # Like the batch itself, the mirroring depends only on the seed, the batch number and the process.
        drawn = np.random.default_rng((self._sampler.seed, i, self._sampler.process_index))
        mirroring = drawn.integers(4, size=rows, dtype=np.int32)
        actions = {
            name: _MIRRORED_ACTIONS.astype(values.dtype)[mirroring.reshape(-1, *(1,) * (values.ndim - 1)), values]
            for name, values in batch._asdict().items()
            if values is not None and (name.endswith("actions") or name == "query_target")
        }
        if hasattr(batch, "is_first"):
            # At a task's first step and in padding, previous actions are fillers, which stay 0.
            filler = batch.is_first | ~batch.attention_mask
            actions |= {name: np.where(filler, 0, actions[name]) for name in actions if name.startswith("prev_")}
        return batch._replace(**actions, layouts=numbers + self._layouts * mirroring)


def number_layouts(sampler: Any, layouts: Sequence[Layout], mirror: bool = False) -> Any:
    """Return a sampler of batches in which the number of a layout is its position in `layouts`."""
    numbers = np.array([layouts.index(layout) for layout in sampler.layouts], np.int32)
    if mirror:
        return RenumberedLayoutSampler(sampler, numbers, len(layouts))
    agree = sampler.dataset.obs != "state" or numbers.tolist() == list(range(len(layouts)))
    return sampler if agree else RenumberedLayoutSampler(sampler, numbers)
