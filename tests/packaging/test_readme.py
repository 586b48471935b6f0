"""The README: short, its code prints the shown output, and its commands are valid."""

from __future__ import annotations

import contextlib
import io
import re
import shlex

import click

from icrl4aht_data.commands.cli import cli
from tests.helpers.paths import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
CHARACTERS = 8000
"""Length limit of the README: the rest is in docs/."""


def blocks(language: str, page: str = README) -> list[str]:
    """Return the code blocks of a page in one language."""
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)


def commands(page: str = README, program: str = "icrl4aht-data") -> list[list[str]]:
    """Return the arguments of every call of a program in the shell blocks of a page."""
    lines = [line for block in blocks("sh", page) for line in block.splitlines() if line.startswith(program)]
    return [shlex.split(line, comments=True)[1:] for line in lines]


def understand(group: click.Group, arguments: list[str]) -> None:
    """Check that a program has the command and accepts its arguments, without running it."""
    name, command, rest = group.resolve_command(group.make_context("x", ["x"], resilient_parsing=True), arguments)
    assert command is not None
    if isinstance(command, click.Group):
        understand(command, rest)
    else:
        command.make_context(name, rest)


def test_it_is_short():
    assert len(README) <= CHARACTERS


def test_ten_lines_print_the_shown_output():
    (code,), (shown,) = blocks("python"), blocks("text")
    assert len([line for line in code.splitlines() if line]) <= 10
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, "README.md", "exec"), {})
    assert printed.getvalue() == shown


def test_commands_are_accepted():
    assert commands()
    for arguments in commands():
        understand(cli, arguments)
