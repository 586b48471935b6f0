"""The demo on the bundled release, with a tiny model."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from baselines import demo
from baselines.evaluate.protocols import get_protocol
from baselines.methods.options import ModelOptions
from baselines.report import episode_gifs
from baselines.training.options import TrainOptions
from icrl4aht_data.checking.verify import verify_release

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def run_tiny_demo(out: Path, episodes: int) -> tuple[str, Path]:
    """Text and report of a demo with a tiny model."""
    text = StringIO()
    page = demo.run_demo(
        out,
        Console(file=text, width=300),
        model=ModelOptions(layers=1, width=16, heads=2),
        options=TrainOptions(steps=2, batch_size=2, context=10),
        families=["H4"],
        protocol=get_protocol("seeded", episodes),
    )
    return text.getvalue(), page


def test_every_step_is_taken(tmp_path, monkeypatch):
    """All steps, without the reference egos and without replaying the release, which other tests do."""
    monkeypatch.setattr(demo, "AGENTS", ())
    monkeypatch.setattr(demo, "verify_release", lambda root, **level: verify_release(root, layout="demo_wide"))
    monkeypatch.setattr(episode_gifs, "episode_gif", lambda path, *args, **named: path.write_bytes(b"GIF89a"))
    text, page = run_tiny_demo(tmp_path, episodes=1)
    for expected in ("1/6", "target_actions", "context_next_obs", "no problem in", "6/6", "done in", str(page)):
        assert expected in text, expected
    returns = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.count(" ") > 3}
    assert returns["AD"][1:] == ["†"], "it was trained with H4"
    assert "† the agent was trained with teammates of this family" in text
    assert (tmp_path / "learning_curves.png").stat().st_size > 5_000
    assert (tmp_path / "episode.gif").read_bytes()[:6] == b"GIF89a"
    assert "<h1>ICRL4AHT report</h1>" in page.read_text()


@pytest.mark.slow
def test_the_complete_demo(tmp_path):
    text, page = run_tiny_demo(tmp_path, episodes=2)
    assert "transitions replayed" in text
    returns = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.count(" ") > 3}
    assert returns["stay"] == ["0.0"]
    assert float(returns["oracle"][0]) > 20
    assert "data:image/gif" in page.read_text()
