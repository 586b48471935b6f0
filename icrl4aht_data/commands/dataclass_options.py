"""Command-line options made from options dataclasses.

    @click.command()
    @dataclass_options(TrainOptions, "train", default_text={"steps": "the size's"})
    def run(train: dict[str, Any]) -> None:
        options = replace_given(TrainOptions(), train)

One option per field that `icrl4aht_data.utils.options.option_field` made: `learning_rate` becomes
`--learning-rate`. Only values that were given on the command line are passed on, so that a command may start from other
values than the dataclass's defaults (a profile, a size) without repeating any of them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from icrl4aht_data.utils.options import FieldBounds, OptionField, option_fields

Command = TypeVar("Command", bound=Callable[..., Any])
Options = TypeVar("Options")

_PLAIN_TYPES = {str: click.STRING, Path: click.Path(path_type=Path)}


class FiniteRange(click.FloatRange):
    """A `click.FloatRange` that also refuses nan and infinity, which satisfy every comparison that it makes."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


def dataclass_options(
    kind: type, argument: str, *, exclude: Collection[str] = (), default_text: Mapping[str, str] | None = None
) -> Callable[[Command], Command]:
    """Returns a decorator that adds an option for every option field of a dataclass, also of dataclasses in its fields.

    Args:
        kind: the dataclass. Bool fields become flags, with a `--no-` form if their default is True; tuples become
            options that may be repeated; Literal fields are a choice.
        argument: name of the command's argument that receives a dict, field name -> value, of the options given by
            the user. `replace_given` puts them into an instance.
        exclude: names of fields without an option in this command.
        default_text: field name -> text shown as its default, where the command starts from other values.
    """
    chosen = [field for field in _all_fields(kind) if field.name not in exclude]
    texts = default_text or {}

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def collect(*args: Any, **values: Any) -> Any:
            passed = {field.name: values.pop(field.name) for field in chosen}
            values[argument] = {name: value for name, value in passed.items() if value not in (None, ())}
            return command(*args, **values)

        decorated: Any = collect
        for field in reversed(chosen):
            decorated = _option(field, texts.get(field.name))(decorated)
        return decorated

    return decorate


def replace_given(options: Options, given: Mapping[str, Any]) -> Options:
    """Returns a copy of a dataclass instance with the given fields replaced, at any depth of nested dataclasses.

    Args:
        options: an instance of the dataclass that the options were made from.
        given: field name -> value, as `dataclass_options` passes it.

    Raises:
        OptionError: from the dataclass's own validation.
    """
    instance: Any = options
    changes = {}
    for field in dataclasses.fields(instance):
        value = getattr(instance, field.name)
        if dataclasses.is_dataclass(value):
            changes[field.name] = replace_given(value, given)
        elif field.name in given:
            changes[field.name] = given[field.name]
    return dataclasses.replace(instance, **changes)


def _all_fields(kind: type) -> Iterator[OptionField]:
    """Yields the option fields of a dataclass, then those of the dataclasses that are its fields' default factories."""
    yield from option_fields(kind)
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(field.default_factory):
            yield from _all_fields(field.default_factory)  # type: ignore[arg-type]


def _option(field: OptionField, default_text: str | None) -> Callable[[Any], Any]:
    flag = "--" + field.name.replace("_", "-")
    common: dict[str, Any] = {"default": None, "help": field.bounds.help}
    shown = default_text or field.bounds.default_text
    if field.type is bool:
        both = f"{flag}/--no-{flag[2:]}" if field.default is True else flag
        if field.default is True or shown:
            common["show_default"] = shown or flag[2:]
        return click.option(both, *field.bounds.flags, field.name, is_flag=True, **common)
    if shown is None and field.default not in (None, dataclasses.MISSING):
        shown = ", ".join(map(str, field.default)) if field.repeated else str(field.default)
    return click.option(
        flag,
        *field.bounds.flags,
        field.name,
        type=_parameter_type(field),
        multiple=field.repeated,
        show_default=shown or False,
        **common,
    )


def _parameter_type(field: OptionField) -> click.ParamType:
    if field.choices:
        return click.Choice(field.choices)
    if field.type in _PLAIN_TYPES:
        return _PLAIN_TYPES[field.type]
    return _number_range(field.type, field.bounds)


def _number_range(kind: type, bounds: FieldBounds) -> click.ParamType:
    ranges: Any = click.IntRange if kind is int else FiniteRange
    return ranges(
        min=bounds.at_least if bounds.above is None else bounds.above,
        max=bounds.at_most if bounds.below is None else bounds.below,
        min_open=bounds.above is not None,
        max_open=bounds.below is not None,
    )
