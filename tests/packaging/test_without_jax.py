"""Without JAX or an adapter's library, commands and adapters that need it name the command that installs it."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys

import pytest

from icrl4aht_data.utils.install_hints import install_command
from tests.helpers.paths import ROOT

PROGRAM = """
import sys

sys.modules.update(dict.fromkeys(("jax", "flax", "optax", "jaxtyping", "gymnasium"), None))
sys.argv = ["icrl4aht-data", *sys.argv[1:]]
from icrl4aht_data.commands.cli import main

main()
"""


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("train --help", 0),
        ("generate --help", 0),
        ("list", 0),
        ("evaluate --agent stay --out {out}", 1),
        ("train ad --layout demo_wide --out {out}", 1),
        ("plan", 1),
    ],
)
def test_commands_explain_themselves_or_name_the_extra(words, code, tmp_path):
    command = [sys.executable, "-c", PROGRAM, *words.format(out=tmp_path / "out").split()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    if code:
        needed = re.escape(f", which is not installed: {install_command('baselines')}")
        assert re.fullmatch(rf"error: this needs \w+{needed}\n", done.stderr), done.stderr
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("module", "library", "extra"),
    [
        ("gymnasium_env", "gymnasium", "gym"),
        ("pettingzoo_env", "pettingzoo", "pettingzoo"),
        ("pettingzoo_env", "gymnasium", "pettingzoo"),
        ("jaxmarl_env", "jaxmarl", "jaxmarl"),
    ],
)
def test_an_adapter_names_the_extra_of_its_library(module, library, extra, monkeypatch):
    monkeypatch.delitem(sys.modules, f"icrl4aht_generation.adapters.{module}", raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    for name in [name for name in sys.modules if name.startswith(f"{library}.")]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError) as caught:
        importlib.import_module(f"icrl4aht_generation.adapters.{module}")
    assert caught.value.msg.endswith(f" needs {caught.value.name}: {install_command(extra)}")
    assert (caught.value.name or "").partition(".")[0] == library
