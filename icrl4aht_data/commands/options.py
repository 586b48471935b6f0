"""Shared parts of the command lines `icrl4aht-data`, `icrl4aht-data` and `icrl4aht-data`.

Exit codes: 0 success; 1 an error, or a release in which `verify` found a problem, or the reader of the output has gone;
2 a misused command.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from icrl4aht_data.benchmark.facts import SPLITS, TRACKS, all_families
from icrl4aht_data.errors import Icrl4ahtError, UnknownNameError, unknown
from icrl4aht_data.overcooked.layouts import LAYOUT_PLUGINS, LAYOUTS, all_layout_names
from icrl4aht_data.remote.remote_release import is_address
from icrl4aht_data.utils.files import FULL, describe_disk
from icrl4aht_data.utils.installation import PACKAGE
from icrl4aht_data.utils.requirements import missing_library

SETTINGS: dict[str, Any] = {"help_option_names": ["-h", "--help"], "show_default": True}

_REMEDIES = {
    errno.ENOENT: "check the path; a new file's folder has to exist",
    errno.ENOTDIR: "a file is where a folder is needed: give another folder",
    errno.EEXIST: "a file is where a folder is needed: give another folder",
    errno.EISDIR: "a folder is where a file is needed: give another name",
    errno.EACCES: "give a folder that you may write to, and files that you may read",
    errno.EPERM: "give a folder that you may write to, and files that you may read",
    errno.EROFS: "give a folder that can be written to",
    errno.EFBIG: "a limit on the size of files is set, see `ulimit -f`",
    **dict.fromkeys(FULL, "free some space, or give a folder on another disk"),
}


class Sections(click.Group):
    """Command group whose help lists the commands under headings.

    Args:
        sections: heading -> names of commands. Commands without a heading are listed last.
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
    """Choice of one name; the valid names are computed when needed, and errors suggest the nearest one.

    Args:
        name: singular noun for the names, such as "layout".
        valid: returns the valid names.
        offered: returns those that completion offers; all by default.
    """

    def __init__(
        self, name: str, valid: Callable[[], Iterable[str]], offered: Callable[[], Iterable[str]] | None = None
    ) -> None:
        self.name, self.valid, self.offered = name, valid, offered or valid

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        names = list(self.valid())
        if value not in names:
            self.fail(str(unknown(self.name, value, names)), param, ctx)
        return value

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(name) for name in self.offered() if name.startswith(incomplete)]


LAYOUT = Names("layout", all_layout_names, offered=lambda: [*LAYOUTS, *LAYOUT_PLUGINS.names])
TRACK, SPLIT, FAMILY = (
    Names("track", lambda: TRACKS),
    Names("split", lambda: SPLITS),
    Names("family", all_families),
)


class Root(click.ParamType):
    """Release: a folder, converted to a path, or an address, kept as text.

    Args:
        remote: accept addresses only.
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
    """Folder, which need not exist; an empty text, as from an unset shell variable, is an error.

    Args:
        made_by: the command that makes such folders, if the folder has to exist.
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
    """File to write, in an existing folder.

    Args:
        suffixes: accepted ends of its name; any by default.
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


def version_option(command: Any) -> Any:
    """Add `--version`, which prints the version of the installed package."""
    return click.version_option(package_name=PACKAGE, message="%(package)s %(version)s")(command)


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace what exists, if it carries this package's mark and nothing was added."
)
family_map_option = click.option(
    "--family-map",
    multiple=True,
    metavar="OLD=NEW",
    help="Teammate family in published files, and here: rl, H1 to H4, or a kind such as fcp; repeat for more.",
    show_default="the names of the published code",
)
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print problems only.")


def filter_options(command: Any) -> Any:
    """Add the options that select histories."""
    options = [
        click.option("--layout", multiple=True, type=LAYOUT, help="Only this layout; repeat it for more."),
        click.option("--split", multiple=True, type=SPLIT, help="Only this split: train, validation, test or heldout."),
        click.option("--track", multiple=True, type=TRACK, help="Only this track: teammate or layout."),
        click.option(
            "--teammate-family", multiple=True, type=FAMILY, help="Only this family: rl (learned), H1, H2, H3 or H4."
        ),
        click.option(
            "--teammate-kind", multiple=True, metavar="KIND", help="Only this kind, such as utility_greedy or fcp."
        ),
        click.option(
            "--source", multiple=True, metavar="NAME", help="Only histories of this source: ppo, noise or student."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def wanted_filters(filters: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    """Return the arguments of `load_icrl4aht` for the values of `filter_options`."""
    return {name: list(values) or None for name, values in filters.items()}


def is_terminal() -> bool:
    """Whether a person reads the output: on a terminal, not in a file or a pipe."""
    return sys.stdout is not None and sys.stdout.isatty()


def examples(*lines: str) -> str:
    """Return a help epilog that shows command lines."""
    return "\n".join(["\b", f"Example{'s' * (len(lines) > 1)}:", *(f"  {line}" for line in lines)])


def run(command: click.Command, extra: str | None = None) -> None:
    """Run a command line; errors about its input become one line and an exit code.

    Output that nobody reads is no error message: where the reader of a pipe has gone (`| head`) the command stops
    quietly with exit code 1, and output that was closed from the start (`>&-`) is dropped.

    Args:
        command: the command line.
        extra: the extra that all of its commands need; messages about missing modules suggest it if it has them.
    """
    _open_outputs()
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
        if (message := missing_library(error.name or "", extra)) is None:
            raise
        _stop(message, 1)


def _open_outputs() -> None:
    """Open closed output streams on the null device, also so that no file gets their descriptors."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115


def _stop(message: str, code: int) -> None:
    click.echo(f"error: {message}", err=True)
    sys.exit(code)


def _in_words(error: OSError) -> str:
    """Return the message with the user's name of the file, not that of the temporary file or lock next to it."""
    if error.errno is None or error.filename is None:
        return str(error)
    path = Path(os.fsdecode(error.filename))
    if path.name.startswith(".") and path.suffix in (".partial", ".lock"):
        path = path.with_name(path.stem.removeprefix("."))
    remedy = _REMEDIES.get(error.errno)
    if error.errno in FULL:
        remedy = f"{remedy}: {describe_disk(path)}"
    return f"{path}: {os.strerror(error.errno)}" + (f"; {remedy}" if remedy else "")
