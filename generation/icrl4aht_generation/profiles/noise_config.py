"""Options of the sources `noise` and `search`: number and length of the histories, and noise schedules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.options import Count, Share, check_options

Range = tuple[Share, Share]
"""Minimum and maximum of a uniform distribution, from which a value is drawn for every history."""

_Power = Annotated[float, Meta(gt=0, le=10)]


@dataclass(frozen=True)
class NoiseConfig:
    """Options of histories by noise distillation: the chance of a random action falls over a history's episodes.

    The chance is `start` until the share `begin` of the episodes has passed, and `end` after the share `finish`. In
    between, x grows linearly from 0 to 1, and the chance is `end + (start - end) * (1 - x) ** power`.

    Attributes:
        histories: number of histories of each task.
        episodes: number of episodes of each history, of 100 steps each.
        start: chance of a random action before the fall.
        end: chance of a random action after the fall.
        begin: share of the history at which the fall begins.
        finish: share of the history at which the fall ends.
        power: exponent of the fall; 1 is linear, larger exponents fall sooner.

    Raises:
        OptionError: if a value is out of bounds.
    """

    histories: Count = 8
    episodes: Annotated[int, Meta(ge=2)] = 60
    start: Range = (1.0, 1.0)
    end: Range = (0.0, 0.0)
    begin: Range = (0.0, 0.0)
    finish: Range = (1.0, 1.0)
    power: tuple[_Power, _Power] = (1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("start", "end", "begin", "finish", "power"):
            value = getattr(self, name)
            if isinstance(value, int | float):  # a single number is a range of one value
                object.__setattr__(self, name, (value, value))
        check_options(self)
        for name in ("start", "end", "begin", "finish", "power"):
            low, high = getattr(self, name)
            object.__setattr__(self, name, (float(low), float(high)))
            if low > high:
                raise OptionError(f"{name} = {[low, high]}: expected a range [low, high]")
        if self.begin[1] > self.finish[0]:
            raise OptionError(f"begin = {list(self.begin)}: expected no value above finish = {list(self.finish)}")
        if self.start[0] < self.end[1]:
            raise OptionError(f"start = {list(self.start)}: expected no value below end = {list(self.end)}")


SEARCH = NoiseConfig(start=(0.0, 0.2), begin=(1.0, 1.0))
"""Default of the source `search`: each history has a constant chance of a random action, so the number of an episode
does not reveal how well the ego plays."""
