"""Helpers that run the command-line program in this process, or Python in a new process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from click import Command
from click.testing import CliRunner

from icrl4aht_data.commands.cli import cli
from tests.helpers.paths import ROOT


def run_cli(*words: object, code: int = 0, program: Command = cli) -> str:
    """Run a command in this process, check its exit code, and return its output; exceptions are raised.

    Args:
        words: the command and its arguments, as separate words or as one string to split.
        code: expected exit code.
        program: click command to run, by default the program icrl4aht-data.
    """
    arguments = words[0].split() if len(words) == 1 and isinstance(words[0], str) else [str(word) for word in words]
    result = CliRunner().invoke(program, arguments, catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.output


def python_environment(**environment: str) -> dict[str, str]:
    """Return this process's environment with the repository on Python's path, and with variables added to it."""
    variables = os.environ | environment
    return variables | {"PYTHONPATH": os.pathsep.join([str(ROOT), variables.get("PYTHONPATH", "")])}


def run_python(*arguments: object, cwd: Path = ROOT, **environment: str) -> str:
    """Run Python in a new process without errors, and return its standard output followed by its error output.

    Args:
        arguments: arguments of Python, such as "-c" and a program.
        cwd: working folder of the process.
        environment: variables added to the environment of this process.
    """
    command, variables = [sys.executable, *map(str, arguments)], python_environment(**environment)
    done = subprocess.run(command, cwd=cwd, env=variables, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr
