"""Sizes and schedules of histories of the source `noise`; no JAX, so that command lines can list them."""

from __future__ import annotations

from dataclasses import dataclass, fields

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.options import check_fields, option_field

Range = tuple[float, float]
"""Smallest and largest value; every history draws its own, uniformly."""

_LARGEST_POWER = 10.0


@dataclass(frozen=True)
class NoiseConfig:
    """Learning histories by noise distillation: the chance of a random action falls over a history's episodes.

    A history's chance is `start` until the share `begin` of its episodes, `end` from the share `finish` on, and between
    them, at the share x of that way, `end + (start - end) * (1 - x) ** power`.

    Attributes:
        histories: histories of each task.
        episodes: episodes of each history, of 100 steps.
        start, end: chance of a random action before the fall and after it.
        begin, finish: shares of the history at which the fall begins and ends.
        power: exponent of the fall; 1 is linear, larger ones fall sooner.

    Raises:
        OptionError: for a value out of bounds.
    """

    histories: int = option_field(8, "Histories of each task.", at_least=1)
    episodes: int = option_field(60, "Episodes of each history, of 100 steps.", at_least=10)
    start: Range = (1.0, 1.0)
    end: Range = (0.0, 0.0)
    begin: Range = (0.0, 0.0)
    finish: Range = (1.0, 1.0)
    power: Range = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_fields(self)
        for name in _RANGES:
            object.__setattr__(self, name, _checked(name, getattr(self, name)))
        if self.begin[1] > self.finish[0]:
            raise OptionError(f"begin = {list(self.begin)}: expected it to end before finish = {list(self.finish)}")
        if self.start[0] < self.end[1]:
            raise OptionError(f"start = {list(self.start)}: expected no value below those of end = {list(self.end)}")


_RANGES = tuple(field.name for field in fields(NoiseConfig) if field.name not in ("histories", "episodes"))


def _checked(name: str, value: object) -> Range:
    """A range with its bounds; a single number is a range of one value."""
    given = [value, value] if isinstance(value, int | float) else value
    numbers = isinstance(given, list | tuple) and all(
        isinstance(number, int | float) and not isinstance(number, bool) for number in given
    )
    low, high = (0.0, _LARGEST_POWER) if name == "power" else (0.0, 1.0)
    if not numbers or len(given) != 2 or not low <= given[0] <= given[1] <= high or (name == "power" and not given[0]):  # type: ignore[index, arg-type]
        above = "above 0 and " if name == "power" else ""
        raise OptionError(f"{name} = {value!r}: expected a range [low, high] {above}within {low:g}..{high:g}")
    return float(given[0]), float(given[1])  # type: ignore[index]
