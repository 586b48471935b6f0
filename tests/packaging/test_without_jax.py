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
from icrl4aht_data.commands.cli import main

for words in sys.argv[1:]:
    sys.argv = ["icrl4aht-data", *words.split()]
    try:
        main()
    except SystemExit as stop:
        print("exit", stop.code or 0, file=sys.stderr)
"""


def test_commands_explain_themselves_or_name_the_extra(tmp_path):
    out = f"--out {tmp_path}/out"
    lines = ["train --help", "generate --help", "list"]
    lines += [f"evaluate --agent stay {out}", f"train ad --layout demo_wide {out}", "plan"]
    done = subprocess.run([sys.executable, "-c", PROGRAM, *lines], cwd=ROOT, capture_output=True, text=True)
    needed = re.escape(f", which is not installed: {install_command('baselines')}")
    assert re.fullmatch(rf"(exit 0\n){{3}}(error: this needs \w+{needed}\nexit 1\n){{3}}", done.stderr), done.stderr
    assert not list(tmp_path.iterdir())


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
