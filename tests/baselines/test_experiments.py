"""Experiments: training, evaluation, reports, resume and held-out teammates."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pandas as pd
import pytest
from icrl4aht_baselines import experiments
from icrl4aht_baselines.evaluate import protocols
from icrl4aht_baselines.evaluate.results import read_result
from icrl4aht_baselines.experiments import (
    CONTEXTS,
    EXPERIMENTS,
    TESTED_ON,
    ExperimentOutcome,
    ExperimentPlan,
    held_out_tasks,
    run_experiment,
)
from icrl4aht_baselines.report.gifs import family_gifs
from icrl4aht_baselines.report.results import TEST_LAYOUTS, read_run
from icrl4aht_baselines.training.run_folder import CHECKPOINTS
from icrl4aht_generation.learners.checkpoint import POLICY_WEIGHTS, save_policy
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.resume import Checkpoints

from icrl4aht_data.benchmark.tasks import make_task, read_tasks, write_tasks
from icrl4aht_data.errors import EmptySelectionError, LabelsMissingError, OptionError, UnknownNameError
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.hashes import file_hash
from tests.helpers.commands import run_cli
from tests.helpers.random_releases import random_release

MODEL: dict[str, Any] = {"layers": 1, "width": 8, "heads": 2}
TRAIN: dict[str, Any] = {"steps": 2, "batch_size": 2, "validation_batches": 1}
SMALL = ExperimentPlan(train=TRAIN, model=MODEL, methods=("ad",), families=("H4",), tasks=1, episodes=2, gifs=False)


@pytest.fixture(scope="module")
def release(tmp_path_factory) -> Path:
    """Return a release of random play long enough for K = 500."""
    root = tmp_path_factory.mktemp("experiments") / "release"
    random_release(root, layouts=("demo_wide", "cramped_up"), teammates=1, streams=2, episodes=6, length=100)
    return root


def test_the_settings_are_the_papers():
    assert [entry.train["context"] for entry in EXPERIMENTS["sweep context"].entries] == [*CONTEXTS]
    sizes = EXPERIMENTS["sweep size"].entries
    found = [(e.name, e.model["layers"], e.model["width"], e.train["steps"]) for e in sizes]
    assert found == [("small", 4, 256, 20_000), ("medium", 8, 512, 50_000), ("large", 12, 768, 100_000)]
    auxiliary = [
        (e.model.get("teammate_actions", False), e.model.get("next_obs", False))
        for e in EXPERIMENTS["ablate ta"].entries
    ]
    assert auxiliary == [(False, False), (True, False), (False, True), (True, True)]
    assert {TESTED_ON[layout] for layout in EXPERIMENTS["tracks"].layouts} == {*TEST_LAYOUTS}
    assert TESTED_ON["demo_wide"] == "demo_wide"
    assert (TESTED_ON["asymm_both"], TESTED_ON["cramped_up"]) == ("asymm_right", "cramped_down")


def test_models_are_evaluated_on_validation_tasks_of_their_own_layout(release, tmp_path, monkeypatch):
    """In the layout track, validation tasks use the training layouts, test tasks use others."""
    entry = {"kind": "heuristic", "family": "utility_greedy", "theta_id": 7, "base_seed": 1, "theta": {}}
    tasks = {track: [make_task(track, "validation", name, entry, 0) for name in names] for track, names in (
        ("teammate", ("demo_wide", "demo_simple")), ("layout", ("cramped_up",)))}  # fmt: skip
    monkeypatch.setattr(protocols, "manifest_path", lambda track, split: (track, split))
    monkeypatch.setattr(protocols, "read_tasks", lambda path: tasks[path[0]] if path[1] == "validation" else [])
    monkeypatch.setattr(experiments, "_train_entry", lambda *arguments: None)
    played = []
    monkeypatch.setattr(experiments, "_evaluate_entry", lambda experiment, entry, tasks, *others: played.append(tasks))
    monkeypatch.setattr(experiments, "read_run", lambda folder: 1 / 0)
    plan = dataclasses.replace(SMALL, root=str(release), split="validation")
    with pytest.raises(ZeroDivisionError):
        run_experiment("tracks", plan, tmp_path)
    assert played == [[tasks["teammate"][0]], tasks["layout"]]
    with pytest.raises(EmptySelectionError, match="no test tasks on demo_wide: choose another --layout"):
        run_experiment("tracks", dataclasses.replace(plan, split="test"), tmp_path)
    with pytest.raises(UnknownNameError, match="unknown split to evaluate on 'heldout'; valid: test, validation"):
        run_experiment("tracks", dataclasses.replace(plan, split="heldout"), tmp_path)
    with pytest.raises(OptionError, match="split = validation: this experiment has tasks of its own"):
        run_experiment("heldout-rl", plan, tmp_path)


def test_a_sweep_over_contexts_acts_exactly_by_default(release, tmp_path, monkeypatch):
    """Cached acting drops to 4/5 K steps and would blur the comparison of K."""
    chosen = []
    monkeypatch.setattr(experiments.TrainingTask, "train", lambda *arguments, **options: None)

    def find_agent(folder: Path, *, acting: str) -> None:
        chosen.append(acting)
        raise KeyboardInterrupt

    monkeypatch.setattr(experiments, "find_agent", find_agent)
    plan = dataclasses.replace(SMALL, root=str(release), values=("K250",))
    for experiment, changed in (
        ("sweep context", plan),
        ("sweep context", dataclasses.replace(plan, acting="cached")),
        ("sweep size", dataclasses.replace(plan, values=("small",), model={"heads": 2})),
    ):
        with pytest.raises(KeyboardInterrupt):
            run_experiment(experiment, changed, tmp_path)
    assert chosen == ["exact", "cached", "cached"]


def interrupt_after(what: str):
    """Return a progress callback that raises when the given part is done."""

    def progress(task: str, done: int, total: int) -> None:
        if what in task and done == total:
            raise KeyboardInterrupt

    return progress


@pytest.fixture(scope="module")
def swept(release, tmp_path_factory) -> tuple[Path, ExperimentPlan]:
    """Return an experiment that was interrupted twice and then completed."""
    out = tmp_path_factory.mktemp("swept")
    plan = dataclasses.replace(SMALL, root=str(release), values=("K250",))
    for what in ("K250 on demo_wide: training steps", "K250 on demo_wide: episodes"):
        with pytest.raises(KeyboardInterrupt):
            run_experiment("sweep context", plan, out, interrupt_after(what))
    assert Checkpoints(out / "ad-K250" / "demo_wide" / "run" / CHECKPOINTS).latest == 2
    done = run_experiment("sweep context", plan, out)
    assert done.notes[1] == "left out, the release has no training histories of them: test_wide"
    return out, plan


@pytest.mark.slow
def test_a_sweep_ends_in_a_report(swept):
    out, _ = swept
    page = (out / "report" / "report.html").read_text()
    assert "Context length" in page
    assert "left out, the release has no training histories of them: test_wide" in page
    assert "2 episodes of 100 steps, exact acting; 1 instance in a cell" in (out / "report" / "report.md").read_text()
    table = pd.read_csv(out / "report" / "report.csv")
    assert set(table["agent"]) == {"AD, K = 250"} and set(table["layout"]) == {"demo_wide"}


@pytest.mark.slow
def test_finished_work_is_kept(swept, monkeypatch):
    out, plan = swept
    results = sorted(out.rglob("tasks/*.json"))
    before = [(path, path.stat().st_mtime_ns) for path in results]
    assert len(results) == 1
    steps: list[tuple[str, int, int]] = []
    monkeypatch.setattr(experiments, "write_page_with_episodes", lambda *a, **k: out)
    run_experiment("sweep context", plan, out, lambda what, *counts: steps.append((what.split(": ")[1], *counts)))
    assert [(path, path.stat().st_mtime_ns) for path in results] == before
    assert steps == [("training steps", 0, 2), ("training steps", 2, 2), ("episodes", 0, 2), ("episodes", 2, 2)]
    with pytest.raises(OptionError, match=r"train\.seed: it has 0, expected 3"):
        run_experiment("sweep context", dataclasses.replace(plan, train=TRAIN | {"seed": 3}), out)


@pytest.fixture(scope="module")
def ablated(release, tmp_path_factory) -> Path:
    """Return an experiment with DPT and all of its options."""
    out = tmp_path_factory.mktemp("ablated")
    chosen: dict[str, Any] = {"methods": ("dpt",), "layouts": ("demo_wide",), "values": ("ta-next_obs",)}
    chosen |= {"gifs": True, "train": TRAIN | {"context": 8}}
    run_experiment("ablate ta", dataclasses.replace(SMALL, root=str(release), **chosen), out)
    return out


@pytest.mark.slow
def test_dpt_is_trained_evaluated_and_shown(ablated, tmp_path):
    where = ablated / "dpt-ta-next_obs" / "demo_wide"
    losses = [json.loads(line) for line in (where / "run" / "metrics.jsonl").read_text().splitlines()]
    assert {"prior_accuracy", "next_obs_loss"} <= losses[-1].keys()
    table = pd.read_csv(ablated / "report" / "report.csv")
    assert table[["agent", "protocol", "layout", "family"]].drop_duplicates().to_numpy().tolist() == [
        ["DPT+TA+next_obs", "seeded", "demo_wide", "H4"]
    ]

    (result,) = (read_result(path) for path in where.rglob("tasks/*.json"))
    page = (ablated / "report" / "report.html").read_text()
    assert "<h4>DPT+TA+next_obs with H4/t0 on demo_wide</h4>" in page
    assert f"Task {result.task_id}, protocol seeded, seed 0." in page
    for number, earned in enumerate(result.returns[0], start=1):
        assert f"<figcaption>Episode {number}: return {earned:.0f}</figcaption>" in page
    assert page.count("data:image/gif") == 2

    other = shutil.copytree(where, tmp_path / "other")
    config, about = (json.loads((other / name).read_text()) for name in ("run/config.json", "results/run.json"))
    (other / "run" / "config.json").write_text(json.dumps(config | {"package_version": "0.0.0"}))
    (other / "results" / "run.json").write_text(json.dumps(about | {"run": str(other / "run")}))
    (pair,) = family_gifs([read_run(other / "results")], tmp_path)
    assert pair.episodes == () and pair.title.endswith("on demo_wide")
    assert pair.caption.startswith(f"No picture: {other / 'run'} holds another model than these results")


def test_invalid_trainings_fail_before_the_first_run(release, tmp_path):
    random_release(tmp_path / "plain", layouts=("demo_wide",), teammates=1, streams=2, episodes=6, labels=False)
    plan = dataclasses.replace(SMALL, root=str(tmp_path / "plain"), methods=("ad", "dpt"))
    with pytest.raises(LabelsMissingError, match=r"dpt none on demo_wide: labels = expert: .* leave it out, by"):
        run_experiment("ablate ta", dataclasses.replace(plan, train=TRAIN | {"context": 8}), tmp_path / "out")
    with pytest.raises(OptionError, match=r"ad K1000 on demo_wide: context = 1000: .*shortest history of .* has 600"):
        run_experiment("sweep context", dataclasses.replace(plan, root=str(release)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_commands_pass_their_options_on(release, tmp_path, monkeypatch):
    calls = []

    def note_call(name, plan, out, progress):
        calls.append((name, plan, out))
        return ExperimentOutcome([tmp_path / "report.html"], ["left out: nothing"])

    monkeypatch.setattr(experiments, "run_experiment", note_call)
    small = f"--root {release} --steps 1 --batch-size 2 --tasks 1 --episodes 3 --family H4 --no-gifs --layers 2 "
    small += "--warmup 0.5 --teammate-family rl --algorithm fcp --algorithm brdiv"
    for command in (
        "ablate ta --method ad --layout cramped_up --only ta",
        "tracks --size tiny --layout all --channels own",
    ):
        printed = run_cli(f"research {command} {small}")
        assert "left out: nothing" in printed
    (name, plan, out), (other, tracks, folder) = calls
    assert (name, out, other, folder) == ("ablate ta", Path("runs/ablate-ta"), "tracks", Path("runs/tracks"))
    assert (plan.size, tracks.size) == ("small", "tiny")
    assert (tracks.layouts, tracks.histories["channels"]) == (("all",), "own")
    assert plan == dataclasses.replace(
        SMALL,
        root=str(release),
        layouts=("cramped_up",),
        values=("ta",),
        histories={"teammate_family": ("rl",), "algorithm": ("fcp", "brdiv")},
        batch_size=8,  # the CPU's default; a given value overrides it
        train={"steps": 1, "batch_size": 2, "warmup": 0.5},
        model={"layers": 2},
        episodes=3,
    )


def test_a_size_applies_to_all_entries_and_sweeps_vary_it(release, tmp_path, monkeypatch):
    seen = []

    def prepare(method, model, options, histories):
        seen.append((model, options))
        raise OptionError("enough")

    monkeypatch.setattr(experiments, "prepare", prepare)
    plan = dataclasses.replace(SMALL, root=str(release), layouts=("demo_wide",), size="tiny", model={}, train={})
    for name in ("tracks", "sweep context"):
        with pytest.raises(OptionError, match="enough"):
            run_experiment(name, plan, tmp_path)
    (model, options), (_, swept) = seen
    assert (model.layers, model.width, model.encoder, model.positions) == (2, 64, "mlp", "rope")
    assert (options.context, swept.context) == (200, 250)
    with pytest.raises(OptionError, match=r"size = tiny: `sweep size` sets it; choose by --only, such as small"):
        run_experiment("sweep size", plan, tmp_path)


# Held-out teammates.


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> Path:
    """Write a suite of one untrained checkpoint that is held out on cramped_up."""
    root = tmp_path_factory.mktemp("suite")
    layout = get_layout("cramped_up")
    network = ActorCritic(Widths((4,), (4,), 8, 8, 8))
    where = "cramped_up/fcp/m0/c0"
    shapes = jax.eval_shape(lambda: network.untrained(jax.random.key(0), layout.channels))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)  # skips compiling the initialisation
    save_policy(root / where, network, zeros, {"seed": 0})
    entry = {"kind": "rl", "family": "fcp", "theta_id": 0, "base_seed": 0}
    entry["theta"] = {"checkpoint": where, "sha256": file_hash(root / where / POLICY_WEIGHTS)}
    (root / "manifests").mkdir()
    write_tasks(root / "manifests" / "layout_heldout.jsonl", [make_task("layout", "heldout", "cramped_up", entry, 1)])
    return root


@pytest.mark.slow
def test_held_out_teammates_are_played_and_reported(release, suite, tmp_path):
    command = f"research heldout-rl --suite {suite} --method ad --layout cramped_up --root {release} --out {tmp_path} "
    command += "--steps 1 --context 8 --batch-size 2 --tasks 1 --episodes 2 --layers 1 --width 8 --heads 2"
    run_cli(*command)
    assert "AD,0,seeded,,cramped_up,rl,held out," in (tmp_path / "report" / "report.csv").read_text()
    page = (tmp_path / "report" / "report.html").read_text()
    assert "cramped_up, learned (held out)" in page
    assert "<h4>AD with rl/t0 (held out) on cramped_up</h4>" in page
    text = (tmp_path / "report" / "report.md").read_text()
    assert "## Held out tasks, seeded" in text and "| rl | AD |" in text
    about = json.loads((tmp_path / "ad-plain" / "cramped_up" / "results" / "run.json").read_text())
    assert about["config"]["histories"]["layouts"] == ["cramped_up"]
    assert about["manifest_sha256"] == file_hash(release / "MANIFEST.sha256")


def test_suites_without_held_out_teammates(release, suite, tmp_path):
    with pytest.raises(OptionError, match=r"teammate_heldout\.jsonl: missing: the suite has no held-out teammates"):
        held_out_tasks(suite, "demo_wide", str(release))
    (tmp_path / "manifests").mkdir()
    (tmp_path / "manifests" / "layout_heldout.jsonl").touch()
    with pytest.raises(OptionError, match="no held-out teammate on cramped_up; train that layout's populations"):
        held_out_tasks(tmp_path, "cramped_up", str(release))
    with pytest.raises(OptionError, match="expected a suite, found none; give --suite"):
        held_out_tasks(None, "cramped_up", str(release))


def test_training_teammates_are_refused_as_held_out(suite, tmp_path):
    random_release(tmp_path, layouts=("cramped_up",), teammates=1, streams=2, episodes=2)
    (task,) = read_tasks(suite / "manifests" / "layout_heldout.jsonl")
    met = make_task("layout", "train", "cramped_up", task.teammate, 0)
    write_tasks(tmp_path / "meta" / "tasks.jsonl", [met])
    write_manifest(tmp_path)
    with pytest.raises(OptionError, match=f"has the teammate of {met.task_id} in .*expected teammates that are not"):
        held_out_tasks(suite, "cramped_up", str(tmp_path))


def test_invalid_plans(release, tmp_path):
    def fails(error, match, name="ablate ta", **changes):
        with pytest.raises(error, match=match):
            run_experiment(name, dataclasses.replace(SMALL, **{"root": str(release), **changes}), tmp_path)

    fails(UnknownNameError, "unknown experiment 'sweep contexts'.*Did you mean 'sweep context'", "sweep contexts")
    fails(UnknownNameError, "unknown setting of ablate ta 'tb'; valid: none, ta, next_obs", values=("tb",))
    fails(UnknownNameError, "unknown training layout 'asymm_right'", layouts=("asymm_right",))
    absent = "no training histories on coord_ring; it has cramped_up, demo_wide"
    fails(EmptySelectionError, absent, layouts=("coord_ring",))
    fails(UnknownNameError, "unknown teammate family of these tasks 'rl'; valid: H1, H2, H3, H4", families=("rl",))
    fails(OptionError, "tasks = 0: expected at least 1", tasks=0)
    absent = "algorithm = fcp: none of .* on .*; these have utility_greedy: choose among them"
    fails(EmptySelectionError, absent, histories={"algorithm": ("utility_greedy", "fcp")})
    learned: dict[str, Any] = {"root": None, "histories": {"teammate_family": ("rl",)}, "layouts": ("coord_simple",)}
    absent = "no training histories of teammate_family rl on coord_simple; it has asymm_both, coord_ring, cramped_up"
    fails(EmptySelectionError, absent, **learned)
    with pytest.raises(OptionError, match="context = 9: `sweep context` sets it; choose by --only, such as K250"):
        run_cli("research sweep context --context 9")
    assert "unknown sweep 'sizes'; valid: context, size. Did you mean 'size'" in run_cli("research sweep sizes", code=2)
