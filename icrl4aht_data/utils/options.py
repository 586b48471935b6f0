"""Option classes (dataclasses whose annotations define types, bounds and help texts), and checks of single arguments.

An option class checks its values, so the bounds are the same on the command line
(`icrl4aht_data.commands.dataclass_options`), in TOML and JSON files and in Python code. Modules with option classes do
not import JAX, to keep `--help` fast.

    @dataclass(frozen=True)
    class Options:
        steps: Annotated[Count, Option("Training steps.")] = 1000
        positions: Annotated[Literal["none", "rope"], Option("Position embedding.")] = "none"

        def __post_init__(self) -> None:
            check_options(self)
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from icrl4aht_data.errors import OptionError, PositionError, PositionTypeError, unknown_name

Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
Seed = Annotated[int, Meta(ge=0, lt=2**32)]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
ShareBelowOne = Annotated[float, Meta(ge=0, lt=1)]

Options = TypeVar("Options")
Sliceable = TypeVar("Sliceable", range, np.ndarray)


class Option(NamedTuple):
    """Annotation that makes a field an option of the command line.

    Attributes:
        help: help text of the option, one sentence.
        flags: names of the option in addition to the field's name with dashes, such as "--ta".
        default: text to show in place of an uninformative default, such as None.
    """

    help: str
    flags: tuple[str, ...] = ()
    default: str | None = None


@cache
def _hints_with(kind: type, *parts: Any) -> dict[str, Any]:
    """Return, by field name, the annotations in a dataclass that have a part of one of the given types."""
    hints = get_type_hints(kind, include_extras=True)
    return {
        name: hint
        for name, hint in hints.items()
        if any(type(part) in parts or get_origin(part) in parts for part in annotation_parts(hint))
    }


def option_hints(kind: type) -> dict[str, Any]:
    """Return, by field name, the annotations in a dataclass that have an `Option` as a part."""
    return _hints_with(kind, Option)


def check_options(options: Any) -> None:
    """Check the type, the choices and the bounds of each dataclass field annotated with `Option`, `Literal` or `Meta`.

    Lists are converted to tuples.

    Raises:
        OptionError: if a value has another type or is out of bounds.
        UnknownNameError: if a value is not among the choices; the message lists the choices.
    """
    for name, hint in _hints_with(type(options), Option, Meta, Literal).items():
        value = getattr(options, name)
        converted = convert_option(name, value, hint)
        if isinstance(value, list):
            object.__setattr__(options, name, converted)


def convert_option(name: str, value: Any, hint: Any, strict: bool = True) -> Any:
    """Convert a value to the type of its annotation, and check its bounds.

    Args:
        name: name of the field, for messages.
        value: the value.
        hint: the annotation.
        strict: refuse strings for numbers; False for the command line.

    Raises:
        OptionError: if the value has another type or is out of bounds.
        UnknownNameError: if the value is not among the choices.
    """
    choices = option_choices(hint)
    if choices and value not in choices and (value is not None or type(None) not in annotation_parts(hint)):
        raise unknown_name(name, value, choices)
    try:
        converted = msgspec.convert(value, hint, strict=strict)
    except msgspec.ValidationError as error:
        raise OptionError(f"{name} = {value!r:.100}: {str(error).replace('Expected', 'expected')}") from error
    if isinstance(converted, float) and not math.isfinite(converted):
        raise OptionError(f"{name} = {value!r}: expected a finite number")
    return converted


def annotation_parts(hint: Any) -> Iterator[Any]:
    """Yield an annotation and, recursively, its parts: types, bounds, help."""
    yield hint
    for part in get_args(hint):
        yield from annotation_parts(part)


def option_choices(hint: Any) -> tuple[Any, ...]:
    """Return the values of a Literal in an annotation; empty for other types."""
    return next((get_args(part) for part in annotation_parts(hint) if get_origin(part) is Literal), ())


def replace_options(options: Options, values: Mapping[str, Any], where: str = "") -> Options:
    """Return a copy of a dataclass with some fields replaced, including those of nested dataclasses.

    Args:
        options: an instance.
        values: field -> value, as in JSON or TOML; the value for a nested dataclass is a mapping.
        where: prefix of field names in messages, such as "ego.".

    Raises:
        OptionError: if a check of the dataclass fails, or `values`, also for a nested dataclass, is not a mapping.
        UnknownNameError: if a field does not exist.
    """
    if not isinstance(values, Mapping):
        raise OptionError(f"{where.removesuffix('.')} = {values!r}: expected a table")
    instance: Any = options
    known = [field.name for field in dataclasses.fields(instance)]
    changes = {}
    for name, value in values.items():
        if name not in known:
            raise unknown_name("key", where + name, [where + each for each in known])
        before = getattr(instance, name)
        nested = dataclasses.is_dataclass(before)
        changes[name] = replace_options(before, value, f"{where}{name}.") if nested else value
    try:
        return dataclasses.replace(instance, **changes)
    except OptionError as error:
        raise OptionError(f"{where}{error}") from error


def _as_int(value: Any) -> int | None:
    """Convert an integer of any library to an int; return None for bools and other types."""
    try:
        return None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        return None


def check_int(name: str, value: Any, least: int) -> int:
    """Return the value as an int after checking that it is an integer from `least` to 2**63 - 1.

    Raises:
        OptionError: if the value is not such an integer; the message has the option's name.
    """
    if (number := _as_int(value)) is None:
        raise OptionError(f"{name} = {value!r}: expected an integer")
    if not least <= number < 2**63:
        raise OptionError(f"{name} = {number}: expected at least {least} and below 2**63")
    return number


def check_number(name: str, value: Any, hint: Any = float) -> float:
    """Check that a number, which may be a NumPy scalar, is within bounds, and return it as a float.

    Raises:
        OptionError: if the value is not a finite number within the bounds; the message has the option's name.
    """
    return convert_option(name, value.item() if isinstance(value, np.generic) else value, hint)


def take_slice(items: Sliceable, position: slice, what: str) -> Sliceable:
    """Return the items at a slice.

    Args:
        items: a sequence or an array.
        position: the slice.
        what: the items in words, such as "episodes", for the message.

    Raises:
        PositionTypeError: if a bound of the slice is not an integer.
    """
    try:
        return items[position]
    except TypeError as error:
        raise PositionTypeError(f"{position!r}: expected integers in a slice of {what}") from error


def check_position(sequence: str, position: Any, count: int) -> int:
    """Return a position as an int after checking that it is an integer from -count to count - 1.

    Args:
        sequence: name of the sequence, for the message.
        position: the position, counted from 0, or from the end if negative.
        count: number of items.

    Raises:
        PositionTypeError: if the position is not an integer.
        PositionError: if the position is out of range.
    """
    if (number := _as_int(position)) is None:
        raise PositionTypeError(f"position {position!r} of {sequence}: expected an integer or a slice")
    if not -count <= number < count:
        within = f"a number from {-count} to {count - 1}" if count else "no position, because there are no items"
        raise PositionError(f"position {number} of {sequence}: expected {within}")
    return number
