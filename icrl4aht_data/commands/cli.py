"""Entry point of `icrl4aht-data`: imports a command only when it runs, and converts errors to exit codes.

Exit codes: 0 success; 1 an error, a problem found, or a closed output pipe; 2 wrong usage; 128 plus the signal's number
if a signal stopped a run, after its progress was saved.
"""

from __future__ import annotations

import errno
import os
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from icrl4aht_data.commands.verbs import SECTIONS, VERB_GROUP, VERBS, Verb
from icrl4aht_data.errors import Icrl4ahtError, UnknownNameError, unknown_name
from icrl4aht_data.utils.files import FULL, describe_disk, final_name
from icrl4aht_data.utils.install_hints import missing_library_message
from icrl4aht_data.utils.plugins import Plugins
from icrl4aht_data.utils.system import keep_freed_memory

_REMEDIES = {
    errno.ENOENT: "check the path; a new file's folder has to exist",
    **dict.fromkeys((errno.ENOTDIR, errno.EEXIST), "expected a folder, found a file: give the path of a folder"),
    errno.EISDIR: "expected a file, found a folder: give another name",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "give a folder that you may write to, and files that you may read"),
    errno.EROFS: "give a folder that can be written to",
    errno.EFBIG: "a limit on the size of files is set, see `ulimit -f`",
    **dict.fromkeys(FULL, "free some space, or give a folder on another disk"),
}

_EPILOG = """\b
Examples:
  icrl4aht-data show --layout coord_simple --plot curves.png
  icrl4aht-data download hf://datasets/you/icrl4aht --layout coord_simple
  icrl4aht-data train ad --layout demo_wide --out runs/ad
  icrl4aht-data evaluate --agent runs/ad --layout demo_wide --out runs/ad-results

ROOT is a release: its folder, or its address hf://datasets/<org>/<repo>[@<revision>], https://... or s3://... The
default is the mini release that is part of the package.

Exit codes: 0 success, 1 a failure or a problem found, 2 wrong usage, 130 or 143 training stopped by SIGINT or
SIGTERM, and saved. Commands that train or generate resume an interrupted run. `icrl4aht-data doctor` prints the folders
and environment variables in use.

\b
Completion, in bash (for zsh and fish: zsh_source, fish_source):
  eval "$(_ICRL4AHT_DATA_COMPLETE=bash_source icrl4aht-data)"
"""


@cache
def all_verbs() -> dict[str, Verb]:
    """Return the `Verb` of every command of this and other installed packages, by the command's name.

    Raises:
        PluginError: if a package's table of commands cannot be imported, or a command already exists.
    """
    plugins, verbs = Plugins(VERB_GROUP, ()), {verb.name: verb for verb in VERBS}
    for package in plugins.names:
        for verb in plugins.load(package, tuple):
            if not isinstance(verb, Verb) or verb.name in verbs:
                raise plugins.error(package, f"expected only Verbs with new names, found {verb!r:.100}")
            verbs[verb.name] = verb
    return verbs


class VerbGroup(click.Group):
    """Command group whose help text lists commands under headings, without importing them.

    Args:
        prefix: start of the names of the group's commands, such as "research "; empty for the program.
    """

    def __init__(self, *args: Any, prefix: str = "", **options: Any) -> None:
        super().__init__(*args, **options)
        self._prefix = prefix

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._verbs())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        verb = self._verbs().get(cmd_name)
        if verb is None:
            return None
        if not verb.target:
            return VerbGroup(cmd_name, prefix=f"{verb.name} ", help=verb.help)
        module, _, attribute = verb.target.partition(":")
        return getattr(import_module(module), attribute)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        verbs = self._verbs()
        width = max(map(len, verbs))
        for section in dict.fromkeys(verb.section for verb in verbs.values()):
            with formatter.section(section):
                rows = [(name, verb.help) for name, verb in verbs.items() if verb.section == section]
                formatter.write_dl([(name.ljust(width), text) for name, text in rows])

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        if not self._prefix and f"research {args[0]}" in all_verbs():
            ctx.fail(f"{args[0]} is a command of the group research: icrl4aht-data research {' '.join(args)}")
        if not args[0].startswith("-") and args[0] not in self._verbs():
            ctx.fail(str(unknown_name("command", args[0], self._verbs())))
        return super().resolve_command(ctx, args)

    def _verbs(self) -> dict[str, Verb]:
        """Return a dict from a command's name in this group to its `Verb`, in the order of the help text."""
        found = {
            name.removeprefix(self._prefix): verb
            for name, verb in all_verbs().items()
            if name.startswith(self._prefix) and " " not in name.removeprefix(self._prefix)
        }
        order = {section: number for number, section in enumerate(SECTIONS)}
        return dict(sorted(found.items(), key=lambda item: order.get(item[1].section, len(order))))


cli = VerbGroup(
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    help="Learning histories of the ICRL4AHT benchmark: read, train on and rebuild them.",
    epilog=_EPILOG,
)
"""Click group with all commands of `icrl4aht-data`."""
click.version_option(package_name="icrl4aht-data", message="%(package)s %(version)s")(cli)


def main() -> None:
    """Run the program on the command line's arguments."""
    keep_freed_memory()
    run(cli)


def run(command: click.Command) -> None:
    """Run a command; expected errors are printed on one line and become an exit code.

    If the reader of a pipe exits (`| head`), the command stops quietly with exit code 1. Output to a stream that is
    closed from the start (`>&-`) is dropped.
    """
    for name in ("stdout", "stderr"):  # otherwise the next opened file would get descriptor 1 or 2
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
    try:
        command()
    except BrokenPipeError:
        sys.exit(1)
    except UnknownNameError as error:
        _exit_with_error(str(error), 2)
    except Icrl4ahtError as error:
        _exit_with_error(str(error), 1)
    except OSError as error:
        _exit_with_error(_os_error_message(error), 1)
    except ModuleNotFoundError as error:
        if (message := missing_library_message(error.name or "")) is None:
            raise
        _exit_with_error(message, 1)
    except SystemExit as stop:
        if message := getattr(stop, "message", None):  # a signal stopped a training run, which was saved
            click.echo(message, err=True)
        raise


def _exit_with_error(message: str, code: int) -> None:
    click.echo(f"error: {message}", err=True)
    sys.exit(code)


def _os_error_message(error: OSError) -> str:
    """Return the message for an OSError, with the name of the file that was written, not of a temporary file."""
    if error.errno is None or error.filename is None:
        return str(error)
    path = Path(final_name(os.fsdecode(error.filename)))
    remedy = _REMEDIES.get(error.errno)
    if error.errno in FULL:
        remedy = f"{remedy}: {describe_disk(path)}"
    return f"{path}: {os.strerror(error.errno)}" + (f"; {remedy}" if remedy else "")
