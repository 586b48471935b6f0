"""Help texts of the three programs: complete and consistent, with valid examples; completion in shells."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from icrl4aht_baselines.commands.cli import cli as baselines_cli
from icrl4aht_generation.cli import cli as generation_cli

from icrl4aht_data.commands.cli import cli
from icrl4aht_data.commands.options import LAYOUT, Names, Sections
from tests.packaging.test_readme import ROOT, understand

PROGRAMS = {
    "icrl4aht-data": cli,
    "icrl4aht-data": generation_cli,
    "icrl4aht-data": baselines_cli,
}


def commands(program: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    """Yield a command and its subcommands, with the words that run each."""
    yield program, command
    if isinstance(command, click.Group):
        for name, below in command.commands.items():
            yield from commands(f"{program} {name}", below)


EVERY = dict(pair for program, group in PROGRAMS.items() for pair in commands(program, group))


def help_of(command: click.Command) -> str:
    result = CliRunner().invoke(command, ["--help"])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("typed", EVERY)
def test_help(typed):
    command = EVERY[typed]
    assert "Usage" in help_of(command)
    assert command.help
    first = command.help.splitlines()[0]
    assert first.endswith("."), "the first line is one sentence"
    if typed not in PROGRAMS:
        assert command.get_short_help_str(62) == first, "a list of commands shows it completely"
    for option in command.params:
        if isinstance(option, click.Option):
            assert option.help, f"{option.name} has no help"
            assert option.help.endswith("."), f"{option.name}: a sentence"


@pytest.mark.parametrize("typed", EVERY)
def test_help_lists_the_valid_names(typed):
    for option in EVERY[typed].params:
        if isinstance(option, click.Option) and isinstance(option.type, Names) and option.type is not LAYOUT:
            names, text = list(option.type.valid()), (option.help or "") + help_of(EVERY[typed])
            if "such as" not in (option.help or ""):
                assert all(name in text for name in names), f"{option.name}: {names}"


def test_every_command_has_a_heading():
    for group in PROGRAMS.values():
        assert isinstance(group, Sections)
        listed = group.list_commands(click.Context(group))
        assert sorted(listed) == sorted(group.commands)
        assert "Others:" not in help_of(group)


def test_a_command_without_a_heading_comes_last():
    group = Sections(sections={"Look": ["show", "not made"]})
    for name in ("other", "show"):
        group.add_command(click.Command(name, help=f"{name}."))
    assert group.list_commands(click.Context(group)) == ["show", "other"]
    text = help_of(group)
    assert text.index("Look:") < text.index("show") < text.index("Others:") < text.index("other")


def test_options_of_one_name_have_one_type():
    types: dict[str, set[str]] = {}
    for command in EVERY.values():
        for option in command.params:
            if isinstance(option, click.Option):
                types.setdefault(option.opts[0], set()).add(option.type.name)
    mixed = {name for name, kinds in types.items() if len(kinds) > 1}
    assert mixed == {"--out", "--tasks", "--to"}, "their commands explain them"


def examples() -> list[str]:
    epilogs = [command.epilog or "" for command in EVERY.values()]
    lines = [line.strip() for epilog in epilogs for line in epilog.splitlines() if line.startswith("  ")]
    return sorted({line for line in lines if line.startswith(tuple(PROGRAMS))})


@pytest.mark.parametrize("line", examples())
def test_examples_are_valid(line):
    program = next(name for name in PROGRAMS if line.startswith(name))
    understand(PROGRAMS[program], shlex.split(line)[len(program.split()) :])


def completed(*words: str) -> list[str]:
    """Return what the console script offers in bash after these words."""
    line = " ".join(("icrl4aht-data", *words))
    request = {"_ICRL4AHT_DATA_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(words))}
    return [offer.partition(",")[2] for offer in script(request).splitlines()]


def script(environment: dict[str, str]) -> str:
    path = Path(sys.executable).with_name("icrl4aht-data")
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    done = subprocess.run([path], env=environment, capture_output=True, text=True, check=True)
    return done.stdout


def test_completion():
    source = script({"_ICRL4AHT_DATA_COMPLETE": "bash_source"})
    assert "complete -o nosort -F _icrl4aht_data_completion icrl4aht-data" in source
    assert 'eval "$(_ICRL4AHT_DATA_COMPLETE=bash_source icrl4aht-data)"' in help_of(cli)
    assert completed("ver") == ["verify"]
    assert completed("list", "--layout", "demo_") == ["demo_simple", "demo_wide"]
    assert "--json" in completed("doctor", "--")
