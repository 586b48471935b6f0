"""Types of arguments and options, and decorators that add options, shared by several commands."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from icrl4aht_data.benchmark.facts import ALL_TRACKS, SPLITS, all_families
from icrl4aht_data.errors import UnknownNameError, check_choice
from icrl4aht_data.fetch import is_address
from icrl4aht_data.overcooked.layouts import LAYOUT_PLUGINS, LAYOUTS, get_layout


class Names(click.ParamType):
    """Click type of a name; the valid names are computed when needed, and errors suggest the nearest name.

    Args:
        name: singular noun for the names, such as "layout".
        valid: function that returns the valid names, which shell completion offers.
        check: function that raises `UnknownNameError` for a wrong name; by default, for a name that `valid` does not
            return.
    """

    def __init__(
        self, name: str, valid: Callable[[], Iterable[str]], check: Callable[[str], object] | None = None
    ) -> None:
        self.name, self.valid = name, valid
        self._check = check or (lambda value: check_choice(name, value, valid()))

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        try:
            self._check(value)
        except UnknownNameError as error:
            self.fail(str(error), param, ctx)
        return value

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(name) for name in self.valid() if name.startswith(incomplete)]


def accept_any_name(value: str) -> str:
    """Accept any name, for names that only the command can check, such as the layouts of a given release."""
    return value


def _short_layout_names() -> list[str]:
    return [*LAYOUTS, *LAYOUT_PLUGINS.names]


LAYOUT = Names("layout", _short_layout_names, get_layout)
RELEASE_LAYOUT = Names("layout", _short_layout_names, accept_any_name)
TRACK, SPLIT = Names("track", lambda: ALL_TRACKS), Names("split", lambda: SPLITS)
FAMILY = Names("family", all_families)


class Folder(click.Path):
    """Click type of a folder that need not exist; rejects an empty string, as from an unset shell variable.

    Args:
        made_by: the command that makes such folders, for the message; if given, the folder must exist.
    """

    def __init__(self, made_by: str | None = None) -> None:
        super().__init__(file_okay=False, path_type=Path)
        self._made_by = made_by

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not str(value):
            self.fail("expected a folder, found an empty text", param, ctx)
        path: Any = super().convert(value, param, ctx)
        if self._made_by and not path.is_dir():
            self.fail(f"{path}: no such folder; {self._made_by} makes one", param, ctx)
        return path


class ReleaseArgument(Folder):
    """Click type of a release: a folder, converted to a path, or an address, which remains a string.

    Args:
        remote: accept addresses only.
    """

    name = "release"

    def __init__(self, remote: bool = False) -> None:
        super().__init__()
        self._remote = remote

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str | Path:
        if is_address(value):
            return value
        if self._remote:
            self.fail(
                f"{value}: expected an address such as hf://datasets/<org>/<repo>, s3://... or https://...", param, ctx
            )
        return super().convert(value, param, ctx)


class NewFile(click.Path):
    """Click type of a file to write in an existing folder.

    Args:
        suffixes: accepted suffixes of the file name; any by default.
    """

    def __init__(self, *suffixes: str) -> None:
        super().__init__(dir_okay=False, path_type=Path)
        self._suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path: Any = super().convert(value, param, ctx)
        if self._suffixes and path.suffix not in self._suffixes:
            self.fail(f"{path}: expected a name that ends in {' or '.join(self._suffixes)}", param, ctx)
        if not path.parent.is_dir():
            self.fail(f"{path}: no folder {path.parent}: make it first, or give another path", param, ctx)
        return path


SEED = click.IntRange(0, 2**32 - 1)
COUNT = click.IntRange(min=1)
COUNT_OR_NONE = click.IntRange(min=0)


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace existing files, or an existing release folder."
)
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print problems only.")


_FILTERS: dict[str, tuple[click.ParamType, str | None, str]] = {
    "layout": (RELEASE_LAYOUT, None, "Only this layout; repeat the option for more."),
    "split": (SPLIT, None, "Only this split: train, validation, test or heldout."),
    "track": (TRACK, None, "Only this track: teammate, layout or preference."),
    "teammate-family": (FAMILY, None, "Only this family: rl (learned), H1, H2, H3 or H4."),
    "teammate-kind": (click.STRING, "KIND", "Only this kind, such as utility_greedy or fcp."),
    "source": (click.STRING, "NAME", "Only histories of this source: ppo, noise, agent, search or human."),
    "label-view": (click.STRING, "VIEW", "Only histories whose expert sees the ego's view (ego) or all (state)."),
}
"""Option name -> type, placeholder and help text of the option."""


def filter_options(command: Any) -> Any:
    """Add the options that select histories; each value is a list, or None for all, as in `load_icrl4aht`."""
    for name, (kind, metavar, about) in reversed(_FILTERS.items()):
        settings: dict[str, Any] = {"type": kind, "metavar": metavar, "help": about, "multiple": True}
        command = click.option(f"--{name}", callback=lambda ctx, param, value: list(value) or None, **settings)(command)
    return command


def print_result(facts: Any, text: str, as_json: bool, quiet: bool = False) -> None:
    """Print a command's result as JSON or as text; with `quiet`, print no text."""
    if as_json:
        click.echo(json.dumps(facts, indent=2))
    elif not quiet:
        click.echo(text)


def is_terminal() -> bool:
    """Return whether the output is a terminal, not a file or a pipe."""
    return sys.stdout is not None and sys.stdout.isatty()


def examples(*lines: str) -> str:
    """Return a help epilog with example command lines."""
    return "\n".join(["\b", f"Example{'s' * (len(lines) > 1)}:", *(f"  {line}" for line in lines)])
