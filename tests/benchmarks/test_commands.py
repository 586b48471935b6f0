"""Test that the benchmark commands run at the smallest scale and print consistent numbers."""

from __future__ import annotations

import json
import sys
from functools import partial
from typing import Any

import numpy as np
import pytest
from icrl4aht_baselines.methods.options import SIZES, ModelSize
from icrl4aht_generation.teammates.instances import published_tasks

from benchmarks import bench_collect, bench_env, bench_learn, bench_loader
from benchmarks.bench_learn import published_batches
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import to_published
from tests.helpers.commands import run_cli
from tests.helpers.tiny import TINY


def run_benchmark(module: Any, options: str) -> list[dict[str, Any]]:
    """Run a benchmark's command and return the JSON lines that it prints."""
    printed = run_cli(options, program=module.main)
    return [json.loads(line) for line in printed.splitlines() if line.startswith("{")]


def check_ratio(line: dict[str, Any], peer: str) -> None:
    """Check the speed ratio to another implementation in a benchmark of one round."""
    assert line["ratio_min"] == line["ratio"] == line["ratio_max"]
    assert line["ratio"] == pytest.approx(line["steps_per_second"] / line[f"{peer}_steps_per_second"], rel=2e-3)


@pytest.mark.slow
def test_collection_benchmark_measures_speed_and_size(tmp_path, monkeypatch):
    """The stored sizes are measured on the histories of one layout."""
    root = to_release(load_icrl4aht(layout="coord_simple"), tmp_path / "part", "lite")
    monkeypatch.setattr(bench_collect, "load_icrl4aht", partial(load_icrl4aht, root))
    (tmp_path / "tiny.toml").write_text(TINY)
    speed, size = run_benchmark(bench_collect, f"speed bytes --profile {tmp_path}/tiny.toml --updates 3 --streams 1")
    assert speed["recorded_transitions_per_second"] > 0
    assert 0 < speed["recording_and_writing_share"] < 1
    assert size["paper_bytes_per_transition"] > size["full_bytes_per_transition"] > size["lite_bytes_per_transition"]


@pytest.mark.slow
def test_environment_benchmark_compares_with_jaxmarl(monkeypatch):
    monkeypatch.setattr(bench_env, "STEPS", 8)
    lines = run_benchmark(
        bench_env, "--layout cramped_up --environments 2 --rounds 1 --written state --written float32"
    )
    facts = [(line["part"], line["written"]) for line in lines]
    assert facts == [("layouts", "uint8"), ("steps", "state"), ("steps", "float32")]
    for line in lines:
        check_ratio(line, "jaxmarl")


SCRIPT = """
import hydra, jax, jaxmarl, wandb
from omegaconf import OmegaConf

def make_train(config):
    env = jaxmarl.make(config["ENV_NAME"], **config["ENV_KWARGS"])
    print("training", env.name, config["TOTAL_TIMESTEPS"], config["NUM_ENVS"])

    def train(rng):
        obs, state = env.reset(rng)
        return env.step(rng, state, dict.fromkeys(env.agents, 0))[2]["agent_0"]

    return train

@hydra.main(version_base=None)
def main(config):
    wandb.log(OmegaConf)
"""


@pytest.mark.slow
def test_jaxmarl_script_is_run_with_both_environments(tmp_path, monkeypatch):
    """A small script replaces JaxMARL's training script, which JaxMARL's package does not contain."""
    monkeypatch.setattr("jaxmarl.make", None)  # monkeypatch restores `jaxmarl.make` after the test
    script = tmp_path / "ippo.py"
    script.write_text(SCRIPT)
    options = ["--layout", "cramped_up", "--environments", "2", "--rollout", "4", "--rounds", "1", "--peer", script]
    before = [sys.modules.get(name) for name in ("hydra", "omegaconf", "wandb")]
    printed = run_cli(*options, program=bench_env.main).splitlines()
    assert [sys.modules.get(name) for name in ("hydra", "omegaconf", "wandb")] == before
    *said, last = [line for line in printed if line.startswith(("training", "{"))]
    assert said == ["training icrl4aht_cramped_up 80 2", "training Overcooked V2 80 2"]
    check_ratio(json.loads(last), "jaxmarl")


@pytest.mark.slow
def test_reading_benchmark_compares_with_other_readers(tmp_path):
    options = "--histories 2 --batch 3 --length 100 --rounds 1 --threads 1"
    read = run_benchmark(bench_loader, f"--folder {tmp_path} {options}")
    assert len(read) == 2 * (4 + 3 + 3)
    for line in read:
        check_ratio(line, line["peer"])
    assert {line["least_ratio"] for line in read if "least_ratio" in line} == {8000, 400, 200, None}


def test_reader_of_the_published_format_gives_the_same_windows(lite, tmp_path):
    dataset = load_icrl4aht(lite[0], layout="demo_wide")
    to_published(dataset, tmp_path / "published", states=False)
    sampler = dataset.ad(batch_size=8, length=100, seed=3)
    for i, batch in zip(range(3), published_batches(tmp_path / "published", sampler), strict=False):
        ours = sampler[i]
        for name in ("obs", "target_actions", "dones", "attention_mask", "is_first"):
            np.testing.assert_array_equal(getattr(batch, name), getattr(ours, name), err_msg=name)
        np.testing.assert_array_equal(batch.prev_actions[:, 1:], ours.prev_actions[:, 1:])
        assert not batch.prev_rewards[:, 0].any()


@pytest.mark.slow
def test_learning_benchmark_compares_ego_profiles(tmp_path):
    options = "--part ego --rounds 1"
    for encoder in ("paper", "mlp"):
        path = tmp_path / f"{encoder}.toml"
        path.write_text(TINY.replace("widths = {", f'widths = {{ encoder = "{encoder}",'))
        options += f" --profile {path}"
    first, second = run_benchmark(bench_learn, options)
    assert [(line["profile"], line["encoder"]) for line in (first, second)] == [("paper", "paper"), ("mlp", "mlp")]
    assert first["ratio"] == 1
    check_ratio(second, "paper")


@pytest.mark.slow
def test_learning_benchmark_measures_sequence_models(monkeypatch):
    monkeypatch.setitem(
        SIZES, "tiny", ModelSize({"layers": 1, "width": 8, "heads": 2, "encoder": "mlp"}, {"steps": 5, "context": 6})
    )
    tasks = [task for task in published_tasks("teammate") if task.layout.name == "demo_wide"][:1]
    monkeypatch.setattr(bench_learn, "published_tasks", lambda track: tasks)
    parts = "--part ad --part act --part tasks --encoder mlp --batch 2 --length 6 --steps 1"
    training, acting, all_tasks = run_benchmark(
        bench_learn, f"{parts} --acting-steps 2 --episodes 1 --tasks 1 --rounds 1"
    )
    check_ratio(training, "published")
    check_ratio(acting, "exact")
    assert (all_tasks["tasks"], all_tasks["episodes"]) == (2, 1)


def test_jaxmarl_benchmark_without_script_file_fails():
    assert "--peer FILE" in run_cli("--part jaxmarl", code=2, program=bench_learn.main)
