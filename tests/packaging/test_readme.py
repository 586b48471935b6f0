"""Test the README: its length, the output of its code, and its commands."""

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


def code_blocks(language: str, page: str = README) -> list[str]:
    """Return the content of the code blocks in one language on a page."""
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)


def shell_calls(page: str = README, program: str = "icrl4aht-data") -> list[list[str]]:
    """Return the arguments of each line in a page's shell blocks that calls `program`."""
    lines = [line for block in code_blocks("sh", page) for line in block.splitlines() if line.startswith(program)]
    return [shlex.split(line, comments=True)[1:] for line in lines]


def check_arguments(group: click.Group, arguments: list[str]) -> None:
    """Check that a program has a command and accepts the arguments, without running the command."""
    name, command, rest = group.resolve_command(group.make_context("x", ["x"], resilient_parsing=True), arguments)
    assert command is not None
    if isinstance(command, click.Group):
        check_arguments(command, rest)
    else:
        command.make_context(name, rest)


def test_readme_is_short():
    assert len(README) <= CHARACTERS


def test_code_of_the_readme_prints_the_shown_output():
    (code,), (shown,) = code_blocks("python"), code_blocks("text")
    assert len([line for line in code.splitlines() if line]) <= 10
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, "README.md", "exec"), {})
    assert printed.getvalue() == shown


def test_commands_of_the_readme_are_accepted():
    assert shell_calls()
    for arguments in shell_calls():
        check_arguments(cli, arguments)
