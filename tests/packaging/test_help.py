"""Test the program's help and completion: every command has complete help, and help imports no command's module."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from icrl4aht_data.commands.cli import VerbGroup, all_verbs, cli
from icrl4aht_data.commands.verbs import Verb
from tests.helpers.commands import run_cli, run_python
from tests.packaging.test_readme import check_arguments

PUBLIC = (
    "list show browse verify download convert combine release upload doctor generate teammates layouts plan check "
    "train evaluate report results submit models best-response adaptation-headroom control demo watch play collect"
)
RESEARCH = "draws manifests diversity reference headroom proof"


def find_command(verb: Verb) -> click.Command:
    """Return the click command of a verb, found by the words of the verb's name, such as "release build"."""
    command: click.Command | None = cli
    for word in verb.name.split():
        assert isinstance(command, VerbGroup)
        command = command.get_command(click.Context(command), word)
    assert command is not None
    return command


def test_program_has_exactly_the_expected_commands():
    assert set(cli.list_commands(click.Context(cli))) == {*PUBLIC.split(), "research"}
    assert {name for name in all_verbs() if " " in name} == {f"research {one}" for one in RESEARCH.split()} | {
        "release build"
    }


@pytest.mark.parametrize("words", all_verbs())
def test_every_command_has_complete_help(words):
    command = find_command(all_verbs()[words])
    run_cli(*words.split(), "--help")
    assert (command.help or "").splitlines()[0] == all_verbs()[words].help, "the table and the command's own text"
    assert command.get_short_help_str(62) == all_verbs()[words].help, "a list of commands shows it completely"
    for option in command.params:
        assert not isinstance(option, click.Option) or option.help, f"{option.name} has no help"


def test_help_of_the_program_imports_no_command():
    """Help takes less than 0.5 s of CPU time, mostly for NumPy, because it imports neither commands nor JAX."""
    code = "import sys; from icrl4aht_data.commands.cli import cli; cli(['--help'], standalone_mode=False); "
    code += "print('loaded:', *sys.modules)"
    text, _, loaded = run_python("-c", code).partition("loaded: ")
    assert all(f"\n  {name} " in text for name in PUBLIC.split()), text
    targets = {verb.target.partition(":")[0] for verb in all_verbs().values()}
    assert not {*targets, "jax", "h5py", "rich", "icrl4aht_data.dataset"} & {*loaded.split()}


def test_research_command_without_its_group_suggests_the_full_command():
    printed = run_cli("draws", "--overwrite", code=2)
    assert "icrl4aht-data research draws --overwrite" in printed


def help_examples() -> list[str]:
    epilogs = [find_command(verb).epilog or "" for verb in all_verbs().values()] + [cli.epilog or ""]
    return sorted({line.strip() for text in epilogs for line in text.splitlines() if line.startswith("  icrl4aht")})


@pytest.mark.parametrize("line", help_examples())
def test_examples_in_help_are_valid(line):
    check_arguments(cli, shlex.split(line)[1:])


def bash_completions(*words: str) -> list[str]:
    """Return the completions that the console script offers in bash after the given words."""
    line = " ".join(("icrl4aht-data", *words))
    request = {"_ICRL4AHT_DATA_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(words))}
    path = Path(sys.executable).with_name("icrl4aht-data")
    environment = os.environ | request
    done = subprocess.run([path], env=environment, capture_output=True, text=True, check=True)
    return [offer.partition(",")[2] for offer in done.stdout.splitlines()]


def test_bash_completion_offers_commands_and_values():
    assert bash_completions("ver") == ["verify"]
    assert bash_completions("list", "--layout", "demo_") == ["demo_simple", "demo_wide"]
    assert "--json" in bash_completions("doctor", "--")
