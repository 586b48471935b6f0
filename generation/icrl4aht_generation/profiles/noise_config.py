"""Sizes and schedules of histories of the source `noise`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.options import Count, Share, check_options

Range = tuple[Share, Share]
"""Smallest and largest value; every history draws its own, uniformly."""

_Power = Annotated[float, Meta(gt=0, le=10)]


@dataclass(frozen=True)
class NoiseConfig:
    """Learning histories by noise distillation: the chance of a random action falls over a history's episodes.

    A history's chance is `start` until the share `begin` of its episodes, `end` from the share `finish` on, and between
    them, at the share x of that way, `end + (start - end) * (1 - x) ** power`.

    Attributes:
        histories: histories of each task.
        episodes: episodes of each history, of 100 steps.
        start: chance of a random action before the fall.
        end: chance of a random action after the fall.
        begin: share of the history at which the fall begins.
        finish: share of the history at which the fall ends.
        power: exponent of the fall; 1 is linear, larger ones fall sooner.

    Raises:
        OptionError: for a value out of bounds.
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
            if isinstance(value, int | float):  # a range of one value
                object.__setattr__(self, name, (value, value))
        check_options(self)
        for name in ("start", "end", "begin", "finish", "power"):
            low, high = getattr(self, name)
            object.__setattr__(self, name, (float(low), float(high)))
            if low > high:
                raise OptionError(f"{name} = {[low, high]}: expected a range [low, high]")
        if self.begin[1] > self.finish[0]:
            raise OptionError(f"begin = {list(self.begin)}: expected it to end before finish = {list(self.finish)}")
        if self.start[0] < self.end[1]:
            raise OptionError(f"start = {list(self.start)}: expected no value below those of end = {list(self.end)}")


SEARCH = NoiseConfig(start=(0.0, 0.2), begin=(1.0, 1.0))
"""Default of the source `search`: each history has one chance of a random action until its last episode, so that the
number of an episode does not tell how well it is played."""
