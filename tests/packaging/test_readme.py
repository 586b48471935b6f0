"""The README: commands and Python snippets work, tables match the code."""

from __future__ import annotations

import json
import pydoc
import re
import shlex

import click
import pytest
from click.testing import CliRunner

from baselines.commands.cli import cli as baselines_cli
from baselines.report.summary import published_table
from generation.cli import cli as generation_cli
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.utils.templates import card_file
from tests.helpers.paths import ROOT
from tests.servers.common import hub_server, uploads

PROGRAMS = {"icrl4aht-data": cli, "python -m generation": generation_cli, "python -m baselines": baselines_cli}
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str, page: str = README) -> list[str]:
    """Return the code blocks of a page in one language."""
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)


def commands(program: str, page: str = README) -> list[list[str]]:
    """Return the arguments of every call of a program in the shell blocks of a page."""
    lines = [line for block in blocks("sh", page) for line in block.splitlines() if line.startswith(program)]
    return [shlex.split(line, comments=True)[len(program.split()) :] for line in lines]


def understand(group: click.Group, arguments: list[str]) -> None:
    """Check that a program has the command and accepts its arguments, without running it."""
    name, command, rest = group.resolve_command(group.make_context("x", ["x"], resilient_parsing=True), arguments)
    assert command is not None
    command.make_context(name, rest)


def run(arguments: list[str]) -> None:
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output


READER = commands("icrl4aht-data")
HUB = [a for a in READER if a[:2] == ["release", "build"] or any("icrl4aht" in argument for argument in a)]
LOCAL = [arguments for arguments in READER if arguments not in HUB]
LONG = [
    pytest.param(program, arguments, id=" ".join([program, *arguments]))
    for program in ("python -m generation", "python -m baselines")
    for arguments in commands(program)
]
"""Commands that other tests run on tiny profiles and single tasks."""


@pytest.mark.parametrize(
    "snippet",
    [pytest.param(code, marks=pytest.mark.slow if "baselines.evaluate" in code else ()) for code in blocks("python")],
)
def test_python_snippets(snippet):
    exec(compile(snippet, "README.md", "exec"), {})


@pytest.mark.parametrize("arguments", LOCAL, ids=" ".join)
def test_reader_commands(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(arguments)


@pytest.mark.slow
@uploads
def test_hub_commands(tmp_path, monkeypatch):
    """Upload the bundled release to a local hub, then read it from there: the commands in the README's order."""
    monkeypatch.chdir(tmp_path)
    with hub_server(tmp_path / "hub") as hub:
        for arguments in HUB:
            run(arguments)
        assert "README.md" in hub.files("you/icrl4aht")


@pytest.mark.parametrize(("program", "arguments"), LONG)
def test_long_commands_are_accepted(program, arguments):
    understand(PROGRAMS[program], arguments)


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = set(re.findall(r"(?:`|^    )make ([a-z-]+)", README, flags=re.MULTILINE))
    assert {"demo", "test", "test-slow", "help"} <= named
    for target in named:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_commands_and_snippets_were_found():
    assert blocks("python")
    assert LOCAL and HUB
    assert {case.values[0] for case in LONG} == {"python -m generation", "python -m baselines"}


def test_published_returns_are_those_of_headroom_json():
    table = published_table(json.loads(card_file("headroom.json").read_text())["published"])
    assert table in README
    assert table in card_file("headroom.md").read_text()


def test_the_public_interface_exists():
    (table,) = re.findall(r"## Public interface\n(.*?)\n## ", README, flags=re.DOTALL)
    listed = re.findall(r"`([\w.]+)`: ((?:`[\w.]+`(?:, )?)+)", table)
    assert len(listed) >= 5
    for module, names in listed:
        for name in re.findall(r"`([\w.]+)`", names):
            assert pydoc.locate(f"{module}.{name}") is not None, (module, name)
