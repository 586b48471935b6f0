"""Test `train`, `evaluate` and `report` with learned teammates that a suite holds out of training."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import pandas as pd
import pytest
from icrl4aht_baselines.methods.options import SIZES, ModelSize
from icrl4aht_baselines.report.gifs import family_gifs
from icrl4aht_baselines.report.results import read_run
from icrl4aht_generation.learners.checkpoint import POLICY_WEIGHTS, save_policy
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic

from icrl4aht_data.benchmark.tasks import make_task, write_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import file_hash
from tests.helpers.commands import run_cli
from tests.helpers.random_releases import random_release
from tests.servers.http import http_server


@pytest.fixture
def suite(tmp_path) -> Path:
    """Write a suite with one untrained policy on layout cramped_up, which is kept out of training."""
    root, layout = tmp_path / "suite", get_layout("cramped_up")
    network, where = ActorCritic(Widths((4,), (4,), 8, 8, 8)), "cramped_up/fcp/m0/c0"
    shapes = jax.eval_shape(lambda: network.untrained(jax.random.key(0), layout.channels))
    # Random initialization would be slow.
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    save_policy(root / where, network, zeros, {"seed": 0})
    entry = {"kind": "rl", "family": "fcp", "theta_id": 0, "base_seed": 0}
    entry["theta"] = {"checkpoint": where, "sha256": file_hash(root / where / POLICY_WEIGHTS)}
    write_tasks(root / "heldout.jsonl", [make_task("layout", "heldout", "cramped_up", entry, 1)])
    return root


@pytest.mark.slow
def test_model_is_trained_evaluated_and_reported_with_held_out_teammates(suite, tmp_path, monkeypatch):
    """The release with the training data is read over HTTP."""
    release, trained, results = tmp_path / "release", tmp_path / "run", tmp_path / "results"
    random_release(release, layouts=("cramped_up",))
    monkeypatch.setitem(SIZES, "tiny", ModelSize({"layers": 1, "width": 8, "heads": 2, "encoder": "mlp"}, {"steps": 5}))
    monkeypatch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path / "data"))
    with http_server(release) as server:
        small = "--steps 1 --context 8 --batch-size 2 --validation-batches 1 --next-obs"
        train = f"train dpt --root {server.url} --layout cramped_up {small} --out {trained}"
        printed = run_cli(f"{train} --ta")
        with pytest.raises(OptionError, match=r"model\.teammate_actions: found True, expected False"):
            run_cli(train)
    assert "size tiny, the default on a CPU: layers 1, width 8, encoder mlp" in printed
    assert "K = 8, steps 1, batch size 2" in printed and "1 step in" in printed
    config = json.loads((trained / "config.json").read_text())
    assert config["model"].items() >= {"layers": 1, "width": 8, "heads": 2, "encoder": "mlp"}.items()
    assert (config["train"]["steps"], config["train"]["batch_size"]) == (1, 2)
    assert config["histories"]["sizes"] == {"train": 2, "histories": 1, "teammates": 3}
    assert (config["histories"]["data_version"], config["histories"]["root"]) == ("0.0.1", server.url)
    (cell,) = config["trained_on"]
    named = {"layout": "cramped_up", "split": "train", "family": "H4", "algorithm": "utility_greedy", "source": "ppo"}
    assert cell.items() >= (named | {"tasks": 1, "histories": 2}).items()
    losses = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert {"prior_accuracy", "next_obs_loss"} <= losses[-1].keys()
    run_cli(
        f"evaluate --agent {trained} --manifest {suite / 'heldout.jsonl'} --suite {suite} --episodes 2 --out {results}"
    )
    about = json.loads((results / "run.json").read_text())
    assert about["config"]["histories"]["layouts"] == ["cramped_up"]
    assert about["manifest_sha256"] == file_hash(release / "MANIFEST.sha256")

    run_cli(f"report {results} --html {tmp_path / 'report.html'} --suite {suite}")
    table = pd.read_csv(results / "report" / "report.csv")
    assert table[["agent", "protocol", "layout", "family", "kind"]].drop_duplicates().to_numpy().tolist() == [
        ["DPT+TA+next_obs+mlp", "seeded", "cramped_up", "rl", "held out"]
    ]
    text = (results / "report" / "report.md").read_text()
    assert "## Held out tasks, seeded" in text and "| rl | DPT+TA+next_obs+mlp |" in text
    page = (tmp_path / "report.html").read_text()
    assert "cramped_up, learned (held out)" in page
    assert "<h4>DPT+TA+next_obs+mlp with rl/t0 (held out) on cramped_up</h4>" in page
    assert page.count("data:image/gif") == 2

    other = shutil.copytree(trained, tmp_path / "other")
    (other / "config.json").write_text(json.dumps(config | {"package_version": "0.0.0"}))
    (results / "run.json").write_text(json.dumps(about | {"run": str(other)}))
    (pair,) = family_gifs([read_run(results)], tmp_path, suite, lambda *shown: None)
    assert pair.episodes == () and pair.caption.startswith(f"No picture: {other} holds another model: expected")
