"""Signatures for `help()`: with the types themselves in place of their source text, and every option by its name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, TypeVar, get_type_hints

F = TypeVar("F", bound=Callable[..., Any])


def show_types(function: F, options_of: Callable[..., Any] | None = None, names: Collection[str] = ()) -> F:
    """Give a function the signature that `help()` prints: real types, and the options behind its `**options`.

    Args:
        function: it is changed in place and returned.
        options_of: function with the options that `function` passes on, which are listed in place of its `**options`,
            with their types and defaults.
        names: names of these options.
    """
    found = inspect.signature(function)
    parameters = list(_with_types(function))
    if options_of is not None:
        parameters = [one for one in parameters if one.kind is not one.VAR_KEYWORD]
        parameters += [one for one in _with_types(options_of) if one.name in names]
    result = _hints(function).get("return", found.return_annotation)
    signature = found.replace(parameters=parameters, return_annotation=type(None) if result is None else result)
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function


def show_method_types(shown: type) -> None:
    """Apply `show_types` to the constructor and the public methods of a class and of its bases in this package.

    Those that it was applied to already stay as they are.
    """
    package = __name__.partition(".")[0]
    for base in shown.__mro__:
        for name, member in vars(base).items():
            is_ours = inspect.isfunction(member) and member.__module__.partition(".")[0] == package
            is_public = name == "__init__" or not name.startswith("_")
            if is_ours and is_public and not hasattr(member, "__signature__"):
                show_types(member)


def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    """The types of a function's annotations by name; texts stay where a library is imported for type checks only."""
    found = {}
    for name, text in function.__annotations__.items():
        with suppress(NameError):
            found |= get_type_hints(SimpleNamespace(__annotations__={name: text}), function.__globals__)
    return found


def _with_types(function: Callable[..., Any]) -> list[inspect.Parameter]:
    hints = _hints(function)
    return [
        one.replace(annotation=hints.get(one.name, one.annotation))
        for one in inspect.signature(function).parameters.values()
    ]
