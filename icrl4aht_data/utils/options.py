"""Fields of options dataclasses: default, help text and bounds of a hyper-parameter, stated once.

A dataclass made of such fields validates itself with `check_fields`, and `icrl4aht_data.commands.dataclass_options`
makes command-line options from it. A module that defines one should not import JAX, so that `--help` stays fast.

    @dataclass(frozen=True)
    class Options:
        steps: int = option_field(1000, "Training steps.", at_least=1)
        positions: Literal["none", "rope"] = option_field("none", "Position embedding.")

        def __post_init__(self) -> None:
            check_fields(self)
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Sequence
from types import NoneType
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from icrl4aht_data.errors import OptionError, PositionError, PositionTypeError, unknown


def check_int(name: str, value: Any, least: int) -> int:
    """The value as an int, checked to be an integer from `least` to 2**63 - 1.

    Raises:
        OptionError: names the option.
    """
    try:
        if isinstance(value, bool):
            raise TypeError
        number = operator.index(value)
    except TypeError as error:
        raise OptionError(f"{name} = {value!r}: expected an integer") from error
    if not least <= number < 2**63:
        raise OptionError(f"{name} = {number}: expected at least {least} and below 2**63")
    return number


def check_position(sequence: str, position: Any, count: int) -> int:
    """The position of an item as an int, checked to be an integer from -count to count - 1.

    Args:
        sequence: the sequence in words, for the message.
        position: from 0, or from the end if negative.
        count: number of items.

    Raises:
        PositionTypeError: for anything but an integer.
        PositionError: for a position that the sequence does not have.
    """
    try:
        if isinstance(position, bool):
            raise TypeError
        number = operator.index(position)
    except TypeError as error:
        raise PositionTypeError(f"position {position!r} of {sequence}: expected an integer or a slice") from error
    if not -count <= number < count:
        within = f"a number from {-count} to {count - 1}" if count else "no position, as it is empty"
        raise PositionError(f"position {number} of {sequence}: expected {within}")
    return number


_KEY = "option"


class FieldBounds(NamedTuple):
    """Metadata of an option field: its help text and valid values. A bound of None does not apply.

    Attributes:
        help: help text of the option.
        at_least, above: lower bounds, inclusive and exclusive.
        at_most, below: upper bounds, inclusive and exclusive.
        flags: further names of the option, such as "--ta".
        default_text: text shown as the default, for a default that says nothing, such as None.
        may_be_empty: whether a tuple without values is valid.
    """

    help: str
    at_least: float | None = None
    above: float | None = None
    at_most: float | None = None
    below: float | None = None
    flags: tuple[str, ...] = ()
    default_text: str | None = None
    may_be_empty: bool = False

    def describe(self) -> str:
        """Returns the bounds in words, such as "at least 0 and below 1"."""
        names = ("at_least", "above", "at_most", "below")
        bounds = {name.replace("_", " "): getattr(self, name) for name in names}
        return " and ".join(f"{name} {bound}" for name, bound in bounds.items() if bound is not None)

    def contain(self, value: float) -> bool:
        """Returns whether a number is finite and within the bounds."""
        return (
            math.isfinite(value)
            and (self.at_least is None or value >= self.at_least)
            and (self.above is None or value > self.above)
            and (self.at_most is None or value <= self.at_most)
            and (self.below is None or value < self.below)
        )


class OptionField(NamedTuple):
    """An option field with its parsed annotation: `tuple[float, ...]` has the type float and is repeated.

    Attributes:
        name: name of the field.
        default: default value.
        type: int, float, bool, str or Path.
        choices: values of a Literal; empty for other types.
        repeated: whether the field is a tuple.
        optional: whether None is valid.
        bounds: metadata of the field.
    """

    name: str
    default: Any
    type: Any
    choices: tuple[Any, ...]
    repeated: bool
    optional: bool
    bounds: FieldBounds


def option_field(
    default: Any,
    help: str,
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    flags: Sequence[str] = (),
    default_text: str | None = None,
    may_be_empty: bool = False,
) -> Any:
    """Returns a dataclass field that becomes a command-line option.

    Args:
        default: value of the field if it is not given; immutable. `dataclasses.MISSING` for a required field.
        help: text of the option, one sentence.
        at_least, above, at_most, below: bounds of numbers.
        flags: further names of the option. Its first name is that of the field, with dashes.
        default_text: shown instead of the default.
        may_be_empty: whether a tuple without values is valid.
    """
    bounds = FieldBounds(help, at_least, above, at_most, below, tuple(flags), default_text, may_be_empty)
    return dataclasses.field(default=default, metadata={_KEY: bounds})


def option_fields(kind: type) -> list[OptionField]:
    """Returns the fields of a dataclass that were made with `option_field`, in order of definition."""
    hints = get_type_hints(kind)
    found = []
    for field in dataclasses.fields(kind):
        if _KEY not in field.metadata:
            continue
        hint, repeated, choices = hints[field.name], False, ()
        members = [member for member in get_args(hint) if member is not NoneType]
        optional = len(members) < len(get_args(hint))
        if optional:
            (hint,) = members
        if get_origin(hint) is tuple:
            hint, repeated = get_args(hint)[0], True
        if get_origin(hint) is Literal:
            hint, choices = type(get_args(hint)[0]), get_args(hint)
        found.append(OptionField(field.name, field.default, hint, choices, repeated, optional, field.metadata[_KEY]))
    return found


def check_fields(options: Any) -> None:
    """Validate the values of a dataclass against the choices and bounds of its fields.

    Raises:
        OptionError: for a number of the wrong type or out of bounds, or an empty tuple where values are required; names
            the field.
        UnknownNameError: for a value that is not among the choices; lists them.
    """
    for field in option_fields(type(options)):
        value = getattr(options, field.name)
        if value is None and field.optional:
            continue
        values: Any = value if field.repeated else (value,)
        if not values and not field.bounds.may_be_empty:
            raise OptionError(f"{field.name} = {value}: expected one value or more")
        for item in values:
            _check_value(field, item)


def _check_value(field: OptionField, value: Any) -> None:
    if field.choices and value not in field.choices:
        raise unknown(field.name, value, field.choices)
    if field.type not in (int, float):
        return
    numbers = int if field.type is int else (int, float)
    if not isinstance(value, numbers) or isinstance(value, bool) or not field.bounds.contain(value):
        noun = "an integer" if field.type is int else "a number"
        raise OptionError(f"{field.name} = {value}: expected {f'{noun} {field.bounds.describe()}'.strip()}")
