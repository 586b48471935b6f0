"""Test models that are trained with canonical channels, and evaluated on a layout with other channels."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines import reference
from icrl4aht_baselines.agents.egos import find_agent, with_channels
from icrl4aht_baselines.agents.host import EgoInput, from_host
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_baselines.evaluate.rollout import EvaluationRollout, RolloutState
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.reference import ReferenceJob, write_bundled_card
from icrl4aht_baselines.report.results import write_run_and_tasks
from icrl4aht_baselines.training.histories import prepare, read_trained
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_generation.env import EnvState
from icrl4aht_generation.learners.encoder import CompactView
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.instances import published_task

from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from tests.helpers.commands import run_cli
from tests.helpers.host_agents import HostRecorder
from tests.helpers.layout_params import layout_params
from tests.helpers.random_releases import random_release
from tests.helpers.states import random_records

SHORT = dataclasses.replace(PROTOCOLS["seeded"], episodes=1, steps=5)
MODEL = ModelOptions(layers=1, width=8, heads=2)
OPTIONS = TrainOptions(steps=1, batch_size=2, context=6)
THIRD = get_layout("cramped_down")
"""A layout whose observations have 35 channels; the training layouts have 40 and 45 channels."""


@pytest.fixture(scope="module")
def trained_run(lite, tmp_path_factory) -> tuple[Path, str]:
    """Train on all layouts of a release; return the run folder and the printed output."""
    out = tmp_path_factory.mktemp("canonical") / "run"
    sizes = ["--steps", "1", "--batch-size", "4", "--context", "6", "--layers", "1", "--width", "8", "--heads", "2"]
    arguments = ["train", "ad", "--layout", "all", "--root", str(lite[0]), "--out", str(out)]
    printed = run_cli(*arguments, *sizes, "--validation-batches", "0")
    return out, printed


def test_training_on_all_layouts_uses_canonical_channels(trained_run):
    folder, printed = trained_run
    summary = "training on coord_simple, demo_wide; canonical channels, observations of 5 x 5 x 46"
    assert summary in printed
    histories = json.loads((folder / "config.json").read_text())["histories"]
    expected = {"layouts": ["coord_simple", "demo_wide"], "channels": "canonical", "obs_shape": [5, 5, 46]}
    assert histories.items() >= (expected | {"obs": "state"}).items()
    run = read_trained(folder)
    assert (run.channels, run.obs_shape, run.layouts) == ("canonical", (5, 5, 46), ("coord_simple", "demo_wide"))


def test_model_is_evaluated_on_a_layout_without_training_data(trained_run, tmp_path, monkeypatch):
    folder, _ = trained_run
    agent = find_agent(str(folder))
    task = published_task(THIRD.name, "H4/t0")
    results = evaluate(agent.name, agent.make, [task], SHORT, details=agent.details, out=tmp_path)
    assert np.shape(results[0].returns) == (1, 1)
    write_run_and_tasks(tmp_path, folder)
    monkeypatch.setattr(ReferenceJob, "results", lambda job, kind: tmp_path)
    monkeypatch.setattr(reference, "_CONTROLLED", ("test-seeded",))  # the other folder would have the same results
    (tmp_path / "x-y").mkdir()
    card = write_bundled_card("x-y", [ReferenceJob("x-y", "layout", 0, folder)], tmp_path).read_text(encoding="utf-8")
    assert "| cramped_down | `" in card and ", manifest with SHA-256 `" in card


@pytest.mark.parametrize("name", layout_params(["coord_ring", "test_wide", "cramped_down"]))
def test_jax_egos_receive_canonical_channels_on_every_layout(name):
    """The policy returns its input instead of an action, so the test can compare observations."""
    layout = get_layout(name)
    shown = Policy((), lambda params, key: (), lambda params, memory, ego_input, key: (ego_input, memory), "ego_input")
    (record,), key = random_records(layout, 1, np.random.default_rng(4)), jax.random.split(jax.random.key(0), 1)
    zero = jnp.zeros(1, jnp.int32)
    before = EgoInput(zero, zero + 1, jnp.array([2.0]), zero + 3, zero > 0)
    state = RolloutState(EnvState(key, zero, zero, jnp.asarray(record[None])), (), before)
    for channels in ("own", "canonical"):
        rollout = EvaluationRollout(layout, with_channels(shown, channels), [], PROTOCOLS["seeded"])
        seen: Any = jax.jit(rollout.ego_actions)((), state, key)[0]
        np.testing.assert_array_equal(seen.obs[0], observe(layout, record, 0, canonical=channels == "canonical"))
        assert seen._replace(obs=0) == before._replace(obs=0)


def test_host_agents_receive_canonical_channels():
    agent = HostRecorder()
    agent.reset(3)
    records = random_records(THIRD, 3, np.random.default_rng(5))
    zero = jnp.zeros(3, jnp.int32)
    ego_input = EgoInput(jnp.asarray(observe(THIRD, records, 0)), zero, zero, zero, zero)
    for channels in ("own", "canonical"):
        policy = from_host(agent, channels)(THIRD)
        jax.block_until_ready(policy.act((), (), ego_input, jax.random.split(jax.random.key(0), 3))[0])
        expected = observe(THIRD, records, 0, canonical=channels == "canonical")
        np.testing.assert_array_equal(agent.seen[0][-1].obs, expected, strict=True)
    with pytest.raises(UnknownNameError, match="unknown channels 'union'; valid: own, canonical"):
        from_host(agent, "union")  # type: ignore[arg-type]


def test_layout_numbers_of_a_batch_determine_the_layouts_of_observations(lite):
    """Validation data contains only the second layout, which has the same number as in training data."""
    job = prepare("ad", MODEL, dataclasses.replace(OPTIONS, batch_size=8), HistoryOptions(("all",), str(lite[0])))
    names = job.about["histories"]["layouts"]
    view = CompactView("paper", tuple(map(get_layout, names)), canonical=True)
    found = {}
    for part, sampler in {"train": job.data.train, **job.data.validation}.items():
        batch = sampler.batch(0)
        rendered: Any = view(jnp.asarray(batch.obs), jnp.asarray(batch.layouts))
        stored = sampler.dataset.with_options(obs="uint8").ad(batch_size=8, length=6)[0]
        np.testing.assert_array_equal(np.asarray(rendered), stored.obs, strict=True, err_msg=part)
        found[part] = [layout.name for layout in sampler.dataset.layouts]
    assert found["train"] == names
    assert found["histories"] == [names[1]]


@pytest.mark.parametrize(
    ("layouts", "given", "channels", "size"),
    [
        (("demo_wide",), None, "own", 45),
        (("demo_wide",), "canonical", "canonical", 46),
        (("demo_wide", "coord_simple"), None, "canonical", 46),
    ],
)
def test_canonical_channels_are_default_for_several_layouts(lite, layouts, given, channels, size):
    about = prepare("ad", MODEL, OPTIONS, HistoryOptions(layouts, str(lite[0]), channels=given)).about["histories"]
    assert (about["channels"], about["obs_shape"]) == (channels, [5, 5, size])


def test_layout_name_all_selects_every_layout_of_the_release(lite, tmp_path):
    random_release(tmp_path, layouts=("asymm_both", "cramped_up"), teammates=1)
    about = prepare("ad", MODEL, OPTIONS, HistoryOptions(("all",), str(tmp_path))).about["histories"]
    assert (about["layouts"], about["channels"]) == (["asymm_both", "cramped_up"], "canonical"), "of one shape, 35"
    own = HistoryOptions(("asymm_both", "cramped_up"), str(tmp_path))
    assert prepare("ad", MODEL, OPTIONS, own).about["histories"]["channels"] == "own"
    with pytest.raises(OptionError, match="layouts = all, demo_wide: expected names of layouts, or all alone"):
        HistoryOptions(("all", "demo_wide"))
    with pytest.raises(UnknownNameError, match="unknown channels 'mine'; valid: own, canonical"):
        HistoryOptions(("all",), channels="mine")  # type: ignore[arg-type]
