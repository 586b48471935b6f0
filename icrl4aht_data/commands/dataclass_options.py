"""Command-line options generated from option classes, see `icrl4aht_data.utils.options`.

    @click.command(cls=TopicCommand)
    @dataclass_options(TrainOptions, "train", default_text={"steps": "the size's"})
    def run(train: dict[str, Any]) -> None:
        options = replace_options(TrainOptions(), train)

Only values given on the command line are passed to the command, whose defaults may differ from the class's.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar, get_args, get_origin

import click
from msgspec import Meta

from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.utils.groups import grouped
from icrl4aht_data.utils.options import Option, annotation_parts, convert_option, option_choices, option_hints

Command = TypeVar("Command", bound=Callable[..., Any])


class TopicCommand(click.Command):
    """Command whose help lists options under headings set by `topic`, and other options under "Options"."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        listed = [param for param in self.get_params(ctx) if param.get_help_record(ctx)]
        for heading, params in grouped(listed, lambda param: getattr(param, "topic", "Options")).items():
            with formatter.section(heading):
                formatter.write_dl([record for param in params if (record := param.get_help_record(ctx))])


def topic(heading: str, *options: Callable[[Any], Any]) -> Callable[[Command], Command]:
    """Return a decorator that adds options under a heading in the help of a `TopicCommand`."""

    def decorate(command: Command) -> Command:
        decorated: Any = command
        before = len(getattr(decorated, "__click_params__", ()))
        for option in reversed(options):
            decorated = option(decorated)
        for param in decorated.__click_params__[before:]:
            param.topic = heading
        return decorated

    return decorate


class OptionValue(click.ParamType):
    """Click type that checks an option's value against the type and bounds of an annotation.

    Args:
        hint: the annotation, such as `Annotated[int, Meta(ge=1)]`.
    """

    def __init__(self, hint: Any) -> None:
        kinds = {int: "integer", float: "float"}
        self._hint, self.choices = hint, option_choices(hint)
        self.name = next((name for kind, name in kinds.items() if kind in annotation_parts(hint)), "text")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return convert_option(param.name if param and param.name else "value", value, self._hint, strict=False)
        except (OptionError, UnknownNameError) as error:
            self.fail(str(error), param, ctx)


class _OptionField(NamedTuple):
    path: tuple[str, ...]
    default: Any
    hint: Any


def dataclass_options(
    kind: type, argument: str, *, exclude: Collection[str] = (), default_text: Mapping[str, str] | None = None
) -> Callable[[Command], Command]:
    """Return a decorator that adds an option for each `Option` field of a dataclass and of its nested dataclasses.

    Args:
        kind: the dataclass. Bool fields become flags, with a `--no-` form if their default is True; tuples become
            options that may be repeated.
        argument: name of the command's argument that receives the options given by the user: a dict, field -> value,
            nested like the dataclasses; see `icrl4aht_data.utils.options.replace_options`.
        exclude: names of fields without an option in this command.
        default_text: field name -> text shown as the option's default, if the command uses another default than the
            class.
    """
    chosen = [field for field in _all_fields(kind) if field.path[-1] not in exclude]
    texts = default_text or {}

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def collect(*args: Any, **values: Any) -> Any:
            given: dict[str, Any] = {}
            for field in chosen:
                *tables, name = field.path
                if (value := values.pop(name)) not in (None, ()):
                    functools.reduce(lambda table, key: table.setdefault(key, {}), tables, given)[name] = value
            return command(*args, **values, **{argument: given})

        decorated: Any = collect
        for field in reversed(chosen):
            decorated = _option(field, texts.get(field.path[-1]))(decorated)
        return decorated

    return decorate


def _all_fields(kind: type, path: tuple[str, ...] = ()) -> Iterator[_OptionField]:
    """Yield the `Option` fields of a dataclass, then the `Option` fields of its nested dataclasses."""
    hints = option_hints(kind)
    for field in dataclasses.fields(kind):
        if field.name in hints:
            yield _OptionField((*path, field.name), field.default, hints[field.name])
    for field in dataclasses.fields(kind):
        if isinstance(field.default_factory, type):
            yield from _all_fields(field.default_factory, (*path, field.name))


def _option(field: _OptionField, default_text: str | None) -> Callable[[Any], Any]:
    about = next(part for part in get_args(field.hint) if isinstance(part, Option))
    name, hint, default = field.path[-1], get_args(field.hint)[0], field.default
    flag, shown, repeated = "--" + name.replace("_", "-"), default_text or about.default, get_origin(hint) is tuple
    settings: dict[str, Any] = {"default": None, "show_default": False}
    if hint is bool:
        settings["is_flag"], flag = True, f"{flag}/--no-{flag[2:]}" if default is True else flag
        shown = shown or (flag.partition("/")[0][2:] if default is True else None)
    else:
        settings |= {"type": OptionValue(get_args(hint)[0] if repeated else field.hint), "multiple": repeated}
        if choices := option_choices(hint):
            settings["metavar"] = "|".join(choices)
        if shown is None and default is not None:
            shown = ", ".join(map(str, default)) if repeated else str(default)
    notes = [f"default: {shown}"] * bool(shown) + [
        f"{sign} {bound:.10g}"
        for meta in annotation_parts(field.hint)
        if isinstance(meta, Meta)
        for sign, bound in ((">=", meta.ge), (">", meta.gt), ("<=", meta.le), ("<", meta.lt))
        if bound is not None
    ]
    help = about.help + (f"  [{'; '.join(notes)}]" if notes else "")
    return click.option(flag, *about.flags, name, help=help, **settings)
