"""Test the GPU benchmark: run tiny sizes on a CPU, and lower programs of full size for CUDA."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from functools import partial
from typing import Any

import jax
import pytest
from icrl4aht_baselines.agents.egos import trained_policy
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_baselines.evaluate.rollout import EvaluationRollout
from icrl4aht_baselines.training.options import TrainOptions
from icrl4aht_baselines.training.trainer import Trainer
from icrl4aht_generation.learners.ego import compiled_update
from icrl4aht_generation.teammates.registry import build_teammate

from benchmarks import bench_gpu
from benchmarks.bench_gpu import (
    CASES,
    FULL_SIZES,
    PARTS,
    SMALL_SIZES,
    context_length,
    ego_learner,
    h4_tasks,
    measure_training,
)
from benchmarks.bench_learn import ad_method
from benchmarks.harness import product_flops
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.overcooked.actions import TEAMMATE
from tests.helpers.commands import python_environment, run_cli
from tests.helpers.paths import ROOT

MEASURED = {
    "device": {"device", "jax", "commit", "date", "xla_threads"},
    "product": {"tflops_float32", "tflops_float32_highest", "tflops_bfloat16"},
    "learner": {"steps_per_second", "compile_seconds", "mfu", "program_gib"},
    "train": {"step_seconds", "transitions_per_second", "loader_wait_seconds_per_step", "mfu", "accumulate"},
    "act": {"steps_per_second", "streams"},
}
"""Keys that each benchmark case must print, by part of the benchmark."""


@pytest.fixture(autouse=True)
def optimizations():
    """Restore the compiler's optimizations, which the command disables on a CPU."""
    before = jax.config.values["jax_disable_most_optimizations"]
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def lines_by_case(output: str) -> dict[str, dict[str, Any]]:
    return {line["case"]: line for line in map(json.loads, re.findall("^{.*", output, re.MULTILINE))}


@pytest.mark.slow
def test_gpu_benchmark_prints_expected_keys_of_each_case(monkeypatch):
    """Run one case of each part of the benchmark."""
    cases = ["device", "product", "learner/mlp", "act/tiny", "train/tiny/mlp/bfloat16"]
    assert {case.split("/")[0] for case in cases} == set(PARTS)
    options = [word for case in cases for word in ("--case", case)]
    monkeypatch.chdir(ROOT)
    found = lines_by_case(run_cli(*options, "--seconds", 0.01, program=bench_gpu.main))
    assert list(found) == cases
    for case, line in found.items():
        assert MEASURED[case.split("/")[0]] <= line.keys(), case
    assert found["device"]["sizes"] == "small"
    assert found["learner/mlp"]["mfu"] > 0


@pytest.mark.slow
def test_command_ends_at_the_time_limit_with_a_line_for_each_case():
    command = [sys.executable, "-m", "benchmarks.bench_gpu", "--minutes", "0"]
    ended = subprocess.run(command, cwd=ROOT, env=python_environment(), capture_output=True, text=True, check=False)
    found = lines_by_case(ended.stdout)
    assert (ended.returncode, found.keys()) == (1, CASES.keys())
    assert all(line["error"] == "no time left" for line in found.values())


def test_error_of_a_case_is_reported_and_the_other_cases_are_measured(monkeypatch):
    monkeypatch.setitem(CASES, "device", lambda sizes: {"cores": 2})
    monkeypatch.setitem(CASES, "product", lambda sizes: 1 / 0)
    printed = run_cli("--part device --part product", code=1, program=bench_gpu.main)
    assert lines_by_case(printed) == {
        "device": {"benchmark": "gpu", "case": "device", "cores": 2},
        "product": {"benchmark": "gpu", "case": "product", "error": "ZeroDivisionError: division by zero"},
    }


def test_batch_that_does_not_fit_in_memory_is_split(monkeypatch):
    tried = []

    def fake_measure(sizes, size, encoder, dtype, parts):
        tried.append(parts)
        if parts < 4:
            raise (MemoryError("96 GiB"), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: .."))[parts - 1]
        return {"accumulate": parts}

    monkeypatch.setattr(bench_gpu, "_measure_training_steps", fake_measure)
    measure = partial(measure_training, size="small", encoder="paper", dtype="float32")
    assert measure(FULL_SIZES) == {"accumulate": 4}
    assert tried == [1, 2, 4]
    with pytest.raises(
        MemoryError, match="the batch does not fit into memory, even if divided into more parts: RESOURCE_EXHAUSTED"
    ):
        measure(SMALL_SIZES)  # a batch of 2 rows has at most 2 parts


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ["paper", "words", "mlp"])
def test_updates_of_ego_learners_can_be_lowered_for_cuda(encoder):
    """Programs with the sizes that the benchmark uses on a GPU are lowered, but not compiled."""
    learner = ego_learner(FULL_SIZES, encoder)
    update: Any = compiled_update(learner)
    traced = update.trace(jax.eval_shape(learner.init, jax.random.key(0)))
    traced.lower(lowering_platforms=("cuda",))
    assert product_flops(traced.jaxpr) > 1e6 * learner.config.steps_per_update


@pytest.mark.slow
@pytest.mark.parametrize("case", ["small/paper/bfloat16", "small/words/float32", "tiny/mlp/bfloat16"])
def test_training_steps_of_models_can_be_lowered_for_cuda(case):
    """Programs with the sizes that the benchmark uses on a GPU are lowered, but not compiled."""
    size, encoder, dtype = case.split("/")
    dataset, length = load_icrl4aht(layout="demo_wide", obs="state"), context_length(FULL_SIZES, size)
    method = ad_method(size, dataset.layouts, encoder=encoder, bfloat16=dtype == "bfloat16")
    trainer = Trainer(method, TrainOptions(batch_size=FULL_SIZES.batch, context=length))
    batch = dataset.ad(batch_size=1, length=length, seed=0)[0]

    def full_batch_shape(leaf: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((FULL_SIZES.batch, *leaf.shape[1:]), leaf.dtype)

    traced = trainer.step.trace(trainer.state_like(), jax.tree.map(full_batch_shape, batch))
    traced.lower(lowering_platforms=("cuda",))
    assert product_flops(traced.jaxpr) > 1e5 * FULL_SIZES.batch * length


def test_evaluation_episode_can_be_lowered_for_cuda():
    tasks = h4_tasks()[:2]
    method = ad_method("tiny", [tasks[0].layout], encoder="mlp")
    params = jax.eval_shape(method.init, jax.random.key(0))
    mates = [build_teammate(task.layout, task.teammate, TEAMMATE, "seeded") for task in tasks]
    rollout = EvaluationRollout(tasks[0].layout, trained_policy(method, params, 10), mates, PROTOCOLS["seeded"])
    params_and_keys = params, jax.eval_shape(lambda: jax.random.split(jax.random.key(0)))
    state = jax.eval_shape(lambda params, keys: rollout.start(keys), *params_and_keys)
    jax.jit(rollout.episode).trace(params, rollout.teammate_params, state).lower(lowering_platforms=("cuda",))
