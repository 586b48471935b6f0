"""Without JAX or an adapter's library, modules that need it name the command that installs it when imported."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys

import pytest

from icrl4aht_data.utils.installation import install_command
from tests.helpers.paths import ROOT

IMPORT_ALL = """
import importlib, json, pkgutil, sys

sys.modules.update(dict.fromkeys(("jax", "flax", "optax", "jaxtyping", "gymnasium"), None))
package, found = importlib.import_module(sys.argv[1]), {}
for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.", onerror=lambda name: None):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
            found[module.name] = "imported"
        except ModuleNotFoundError as error:
            found[module.name] = error.msg
print(json.dumps(found))
"""


@pytest.mark.parametrize(
    ("extra", "free", "needing"),
    [
        ("baselines", "icrl4aht_baselines.commands.train_commands", "icrl4aht_baselines.evaluate"),
        ("generation", "icrl4aht_generation.commands", "icrl4aht_generation.env"),
    ],
)
def test_every_module_imports_or_names_the_extra(extra, free, needing):
    command = [sys.executable, "-W", "error", "-c", IMPORT_ALL, f"icrl4aht_{extra}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found[free] == "imported"
    assert found[needing] == f"this needs jax, which is not installed: {install_command(extra)}"
    ends = tuple(f", which is not installed: {install_command(one)}" for one in (extra, "gym", "jaxmarl", "pettingzoo"))
    wrong = {name: message for name, message in found.items() if message != "imported" and not message.endswith(ends)}
    assert not wrong


def test_with_jax_imports_are_left_alone():
    code = "import sys; old = [*sys.meta_path]; import icrl4aht_baselines as b; print(old == sys.meta_path)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


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
