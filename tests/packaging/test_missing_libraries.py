"""Test that a missing optional library is reported before work starts, with the command that installs the library."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from icrl4aht_baselines.demo import run_demo
from icrl4aht_baselines.training.loggers import LOGGER_NAMES, check_loggers
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases.build import build_releases
from rich.console import Console

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.environments import make_environment
from icrl4aht_data.interop import hf_index, torch_loader
from icrl4aht_data.overcooked.render import draw_frame
from icrl4aht_data.plotting import new_figure
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.writing.minari import to_minari
from icrl4aht_data.writing.parquet import to_parquet
from tests.helpers.commands import run_cli, run_python

QUIET = Console(quiet=True)


def adapter_import(name: str) -> Callable[[Any], object]:
    """Return a function that imports an adapter again, even if other tests imported the adapter before."""

    def import_again(dataset: Any) -> object:
        sys.modules.pop(f"icrl4aht_generation.adapters.{name}", None)
        return importlib.import_module(f"icrl4aht_generation.adapters.{name}")

    return import_again


USES: list[tuple[str, str, Callable[[Any], object]]] = [
    ("datasets", "hf", hf_index),
    ("torch.utils.data", "torch", lambda dataset: torch_loader(dataset.ad(batch_size=2, length=5))),
    ("pandas", "pandas", lambda dataset: dataset.to_pandas()),
    ("pyarrow", "hf", lambda dataset: to_parquet(dataset, Path("never.parquet"))),
    ("minari", "minari", lambda dataset: to_minari(dataset, Path("some-v0"))),
    ("PIL.Image", "plot", lambda dataset: draw_frame(dataset.layouts[0], dataset[0].state[0])),
    ("matplotlib.figure", "plot", lambda dataset: new_figure(1, 1)),
    *((library, "plot", lambda dataset: run_demo(Path("out"))) for library in ("matplotlib", "PIL")),
    *(
        (library, "plot", lambda dataset: build_releases(load_profile("smoke"), Path("out"), ("lite",), QUIET))
        for library in ("matplotlib", "PIL")
    ),
    ("gymnasium", "gym", lambda dataset: make_environment(task={})),
    ("gymnasium", "gym", adapter_import("gymnasium_env")),
    ("pettingzoo", "pettingzoo", adapter_import("pettingzoo_env")),
    ("gymnasium", "pettingzoo", adapter_import("pettingzoo_env")),
    ("jaxmarl", "jaxmarl", adapter_import("jaxmarl_env")),
    ("uvicorn", "play", lambda dataset: run_cli("play")),
    ("tensorboardX", "tensorboard", lambda dataset: check_loggers(LOGGER_NAMES)),
    ("wandb", "wandb", lambda dataset: check_loggers(["wandb"])),
    ("trackio", "trackio", lambda dataset: check_loggers(["trackio"])),
]
"""Library that cannot be imported, extra that installs it, use."""


@pytest.mark.parametrize(("library", "extra", "use"), USES)
def test_missing_library_raises_error_with_install_command(lite, tmp_path, monkeypatch, library, extra, use):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, library, None)
    for name in [name for name in sys.modules if name.startswith(f"{library}.")]:
        monkeypatch.setitem(sys.modules, name, None)
    needs = f"needs {library.partition('.')[0]}.*: |needs matplotlib and Pillow: |needs Pillow: "
    with pytest.raises(Exception, match=rf"({needs}){re.escape(install_command(extra))}"):
        use(dataset)
    assert not list(tmp_path.iterdir())


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


def test_commands_without_jax_show_help_or_the_install_command(tmp_path):
    out = f"--out {tmp_path}/out"
    lines = ["train --help", "generate --help", "list"]
    lines += [f"evaluate --agent stay {out}", f"train ad --layout demo_wide {out}", "plan"]
    needed = re.escape(f", which is not installed: {install_command('baselines')}")
    said = run_python("-c", PROGRAM, *lines)
    assert re.search(rf"(exit 0\n){{3}}(error: this needs \w+{needed}\nexit 1\n){{3}}$", said), said
    assert not list(tmp_path.iterdir())
