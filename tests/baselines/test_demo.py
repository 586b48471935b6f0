"""The whole way on the bundled release, at its smallest."""

from __future__ import annotations

import dataclasses
from io import StringIO

import pytest
from rich.console import Console

from baselines.demo import run_demo
from baselines.evaluate.protocols import PROTOCOLS
from baselines.methods.options import ModelOptions
from baselines.training.options import TrainOptions

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def test_the_whole_way(tmp_path):
    said = StringIO()
    options = TrainOptions(steps=2, batch_size=2, context=10)
    page = run_demo(
        tmp_path,
        Console(file=said, width=300),
        model=ModelOptions(1, 16, heads=2),
        options=options,
        families=["H4"],
        protocol=dataclasses.replace(PROTOCOLS["seeded"], episodes=2),
    )
    for expected in ("1/6", "target_actions", "context_next_obs", "transitions replayed", "6/6", "done in", str(page)):
        assert expected in said.getvalue(), expected
    table = {line.split()[0]: line.split()[1:] for line in said.getvalue().splitlines() if line.count(" ") > 3}
    assert table["stay"] == ["0.0"]
    assert float(table["oracle"][0]) > 20
    assert "AD" in table
    assert (tmp_path / "learning_curves.png").stat().st_size > 5_000
    assert (tmp_path / "episode.gif").read_bytes()[:6] == b"GIF89a"
    assert "<h1>ICRL4AHT report</h1>" in page.read_text()
