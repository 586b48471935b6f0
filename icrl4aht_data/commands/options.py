"""What the command lines `icrl4aht-data`, `python -m generation` and `python -m baselines` share.

Exit codes: 0 done and, for `verify`, whole; 1 an error, or a release that is not whole; 2 a misused command.
"""

from __future__ import annotations

import errno
import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem
from rich.console import Console
from rich.progress import DownloadColumn, Progress, TransferSpeedColumn

from icrl4aht_data.benchmark.facts import FAMILIES, SPLITS, TRACKS
from icrl4aht_data.errors import Icrl4ahtError, UnknownNameError, unknown
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.remote.remote_release import is_address

SETTINGS: dict[str, Any] = {"help_option_names": ["-h", "--help"], "show_default": True}

_REMEDIES = {
    errno.ENOENT: "check the path; a new file's folder has to exist",
    errno.ENOTDIR: "a file is where a folder is needed: give another folder",
    errno.EEXIST: "a file is where a folder is needed: give another folder",
    errno.EISDIR: "a folder is where a file is needed: give another name",
    errno.EACCES: "give a folder that you may write to, and files that you may read",
    errno.EPERM: "give a folder that you may write to, and files that you may read",
    errno.EROFS: "give a folder that can be written to",
    errno.ENOSPC: "free some space, or give a folder on another disk",
}


class Sections(click.Group):
    """Commands under headings, in a useful order.

    Args:
        sections: heading -> names of commands. Others come last.
    """

    def __init__(self, *args: Any, sections: Mapping[str, Sequence[str]], **options: Any) -> None:
        super().__init__(*args, **options)
        self.sections = sections

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for names in self._sorted().values() for name in names]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        longest = max(map(len, self.commands))
        for heading, names in self._sorted().items():
            rows = [(name, self.commands[name].get_short_help_str(formatter.width - longest - 6)) for name in names]
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(longest), text) for name, text in rows])

    def _sorted(self) -> dict[str, list[str]]:
        known = {heading: [n for n in names if n in self.commands] for heading, names in self.sections.items()}
        listed = {name for names in known.values() for name in names}
        known["Others"] = [name for name in self.commands if name not in listed]
        return {heading: names for heading, names in known.items() if names}


class Names(click.ParamType):
    """One of several names, which are looked up when one is given or completed: another is a misuse.

    Args:
        name: what they name.
        valid: gives them.
        offered: how many of them, the first ones, completion offers.
    """

    def __init__(self, name: str, valid: Callable[[], Iterable[str]], offered: int | None = None) -> None:
        self.name, self.valid, self._offered = name, valid, offered

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        names = list(self.valid())
        if value not in names:
            self.fail(str(unknown(self.name, value, names)), param, ctx)
        return value

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(name) for name in list(self.valid())[: self._offered] if name.startswith(incomplete)]


LAYOUT = Names("layout", lambda: [*LAYOUTS, *(layout.alias for layout in LAYOUTS.values())], offered=len(LAYOUTS))
TRACK, SPLIT, FAMILY = (
    Names("track", lambda: TRACKS),
    Names("split", lambda: SPLITS),
    Names("family", lambda: FAMILIES),
)


class Root(click.ParamType):
    """A release: its folder as a path, or its address as a text.

    Args:
        remote: whether it has to be an address.
    """

    name = "release"

    def __init__(self, remote: bool = False) -> None:
        self._remote = remote

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str | Path:
        if not str(value):
            self.fail("expected a release folder or an address, found an empty text", param, ctx)
        if is_address(value):
            return value
        if self._remote:
            self.fail(
                f"{value}: expected an address such as hf://datasets/<org>/<repo>, s3://... or https://...", param, ctx
            )
        return Path(value)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type="dir")]


class Folder(click.Path):
    """A folder.

    Args:
        made_by: what makes such folders, if it has to exist.
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


class NewFile(click.Path):
    """A file to write, in a folder that exists.

    Args:
        suffixes: that its name may end in.
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


class Number(click.ParamType):
    """A number within bounds.

    Args:
        name: what it is.
        kind: click.INT or click.FLOAT.
        fits: whether a number is within them.
        expected: the bounds in words.
    """

    def __init__(self, name: str, kind: click.ParamType, fits: Callable[[Any], bool], expected: str) -> None:
        self.name, self._kind, self._fits, self._expected = name, kind, fits, expected

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = self._kind.convert(value, param, ctx)
        if not self._fits(number):
            self.fail(f"{value}: expected {self._expected}", param, ctx)
        return number


SEED = Number("seed", click.INT, lambda seed: 0 <= seed < 2**32, "a whole number from 0 to 2**32 - 1")
COUNT = Number("number", click.INT, lambda count: count >= 1, "a whole number from 1 on")
COUNT_OR_NONE = Number("number", click.INT, lambda count: count >= 0, "a whole number from 0 on")
RATE = Number("number", click.FLOAT, lambda rate: math.isfinite(rate) and rate > 0, "a number above 0")


def version_option(command: Any) -> Any:
    """`--version`: the same for each program."""
    return click.version_option(package_name="icrl4aht-data", message="%(package)s %(version)s")(command)


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print problems only.")


def filter_options(command: Any) -> Any:
    """The options that select histories."""
    options = [
        click.option("--layout", multiple=True, type=LAYOUT, help="Only this layout; again for more."),
        click.option("--split", multiple=True, type=SPLIT, help="Only this split: train, test or heldout."),
        click.option("--track", multiple=True, type=TRACK, help="Only this track: teammate or layout."),
        click.option(
            "--teammate-family", multiple=True, type=FAMILY, help="Only this family: rl (learned), H1, H2, H3 or H4."
        ),
        click.option(
            "--teammate-kind", multiple=True, metavar="KIND", help="Only this kind, such as utility_greedy or fcp."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def examples(*lines: str) -> str:
    """An epilog of command lines."""
    return "\n".join(["\b", f"Example{'s' * (len(lines) > 1)}:", *(f"  {line}" for line in lines)])


@contextmanager
def bars(quiet: bool = False, of_bytes: bool = False) -> Iterator[Callable[..., None]]:
    """Progress of several things, on a terminal only: call what is given with a name, how many are done, of how many,
    and maybe a note.

    Args:
        quiet: show nothing.
        of_bytes: what is counted are bytes: show them, and their speed.
    """
    console, running = Console(stderr=True), {}
    columns = (*Progress.get_default_columns(), *((DownloadColumn(), TransferSpeedColumn()) if of_bytes else ()))
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as shown:

        def show(what: str, done: int, of: int | None, note: str = "") -> None:
            if what not in running:
                running[what] = shown.add_task(what, total=of)
            shown.update(running[what], completed=done, total=of, description=f"{what}{note}")

        yield show


def counted(show: Callable[..., None], what: str, of: int) -> Callable[[int], None]:
    """For who says how many more are done, from any thread: the same bar, from 0 on."""
    total, lock = 0, threading.Lock()

    def more(number: int) -> None:
        nonlocal total
        with lock:
            total += number
            show(what, total, of)

    more(0)
    return more


def run(command: click.Command) -> None:
    """Run a command line; what is wrong with the input becomes one line and an exit code."""
    try:
        command()
    except BrokenPipeError:
        sys.exit(1)
    except UnknownNameError as error:
        _stop(str(error), 2)
    except Icrl4ahtError as error:
        _stop(str(error), 1)
    except OSError as error:
        _stop(_in_words(error), 1)
    except ModuleNotFoundError as error:
        from icrl4aht_data.commands.requirements import PACKAGE, extra_with

        extra = extra_with(error.name or "")
        if extra is None:
            raise
        _stop(f"this needs {error.name}, which is not installed: pip install '{PACKAGE}[{extra}]'", 1)


def _stop(message: str, code: int) -> None:
    click.echo(f"error: {message}", err=True)
    sys.exit(code)


def _in_words(error: OSError) -> str:
    """With the name that the user knows: not that of a file or a lock beside it, under which it is written first."""
    if error.errno is None or error.filename is None:
        return str(error)
    path = Path(os.fsdecode(error.filename))
    if path.name.startswith(".") and path.suffix in (".partial", ".lock"):
        path = path.with_name(path.stem.removeprefix("."))
    remedy = _REMEDIES.get(error.errno)
    return f"{path}: {os.strerror(error.errno)}" + (f"; {remedy}" if remedy else "")
