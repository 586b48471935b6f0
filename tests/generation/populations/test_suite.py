"""Test the training of populations, their checkpoints and cards, the selection of teammates, and manifests.

Each algorithm is trained at most once, with the shipped profile `smoke` and one epoch: two members and six updates of
2,048 steps. Tests that are not marked slow train only LBRDiv.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path

import jax
import numpy as np
import pytest
from icrl4aht_generation.learners.checkpoint import POLICY_CARD, POLICY_WEIGHTS, load_policy, save_policy
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.learners.resume import BusyError, run_lock
from icrl4aht_generation.policy import stacked
from icrl4aht_generation.populations import cross_play
from icrl4aht_generation.populations import train as training
from icrl4aht_generation.populations.select import (
    make_tasks,
    select_teammates,
    write_manifests,
)
from icrl4aht_generation.populations.train import (
    PopulationJob,
    PopulationRun,
    SuiteCheckpoint,
    suite_checkpoints,
)
from icrl4aht_generation.profiles import load_profile
from icrl4aht_generation.releases.check import compare_rebuilds

from icrl4aht_data.benchmark.facts import ALGORITHMS, layout_number
from icrl4aht_data.benchmark.tasks import read_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import file_hash
from tests.helpers.damages import flip_bit
from tests.helpers.tiny import start_python
from tests.helpers.xla_flags import add_xla_flag

LAYOUT = get_layout("cramped_up")
SMOKE = load_profile("smoke").teammates
EACH_KIND = pytest.mark.parametrize("algorithm", ["lbrdiv", "comedi"])
"""LBRDiv trains pairs of policies, CoMeDi trains in stages; `test_generate.py` trains FCP and BRDiv."""
CONFIG, WIDTHS = replace(SMOKE.ppo, epochs=1), SMOKE.ppo.widths


TWO_DEVICES = """
import sys
import jax
import numpy as np
from tests.generation.populations import test_suite
from flax.traverse_util import flatten_dict

(population,) = test_suite.smoke_run("fcp").stages
state = jax.jit(population.init)(jax.random.fold_in(jax.random.key(0), 0))
update = jax.jit(population.update)
state, _ = update(state)
assert jax.device_count() == 2
used = {len(leaf.sharding.device_set) for leaf in jax.tree.leaves(state.params)}
assert used == {2}, used
np.savez(sys.argv[1], **flatten_dict(jax.tree.map(np.asarray, state.params), sep="/"))
"""


@cache
def smoke_run(algorithm: str) -> PopulationRun:
    return PopulationRun(LAYOUT, algorithm, SMOKE.members, CONFIG, seed=0)


def population_job(algorithm: str, suite: Path) -> PopulationJob:
    return PopulationJob(smoke_run(algorithm), suite)


short_cross_play = partial(cross_play.cross_play_returns, episodes=2)


@pytest.fixture(scope="module", autouse=True)
def few_episodes():
    """Evaluate checkpoints in 2 episodes, since 20 episodes take longer than the training in these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "cross_play_returns", short_cross_play)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Callable[..., Path]:
    """Return a function that trains populations of the given algorithms once and returns their suite (read-only)."""
    root = tmp_path_factory.mktemp("trained")

    def train(*algorithms: str) -> Path:
        for algorithm in algorithms:
            population_job(algorithm, root).run()
        return root

    return train


def population_folder(root: Path, algorithm: str) -> Path:
    return root / LAYOUT.name / algorithm


def weight_hashes(folder: Path) -> dict[str, str]:
    """Return the file hash of every policy of a population, by path."""
    return {str(path.relative_to(folder)): file_hash(path) for path in sorted(folder.rglob(POLICY_WEIGHTS))}


@pytest.mark.slow
@EACH_KIND
def test_population_has_five_checkpoints_of_each_member(trained, algorithm):
    found = list(suite_checkpoints(trained(algorithm), LAYOUT.name, algorithm))
    first = int(algorithm == "comedi")  # CoMeDi's policy 0 is trained only by self-play and is not a teammate
    names = [f"{LAYOUT.name}/{algorithm}/m{m}/c{c}" for m in range(first, first + 2) for c in range(5)]
    assert [point.path for point in found] == names
    folder = population_folder(trained(algorithm), algorithm)
    responses = ["m0", "m1"] if algorithm in ("brdiv", "lbrdiv") else []
    assert sorted(path.name for path in folder.glob("responses/*")) == responses
    assert len(set(weight_hashes(folder).values())) == 5 * first + 10 + len(responses), "all policies differ"
    assert population_job(algorithm, trained(algorithm)).is_finished()
    assert not list(folder.glob("resume*"))


@pytest.mark.slow
@EACH_KIND
def test_cards_describe_checkpoints_of_a_population(trained, algorithm):
    for number, point in enumerate(suite_checkpoints(trained(algorithm), LAYOUT.name, algorithm)):
        member, checkpoint = divmod(number + 5 * (algorithm == "comedi"), 5)
        card = point.card
        assert (card["algorithm"], card["layout"], card["seed"]) == (algorithm, "cramped_up", 0)
        assert (card["member"], card["checkpoint"]) == (member, checkpoint)
        assert card["step"] == 2048 * (checkpoint + 2)
        assert card["agents"] == ([1] if algorithm in ("brdiv", "lbrdiv") else [0, 1])
        assert card["shapes"]["params/actor/kernel"] == [16, 6]
        assert card["widths"] == json.loads(json.dumps(asdict(WIDTHS)))
        assert isinstance(card["return"], float)
        assert isinstance(card["teammate_return"], float)
        assert card["code_version"]


@pytest.mark.slow
def test_returns_on_cards_are_those_of_the_checkpoints(trained):
    """Evaluate the last checkpoints with their best responses again and compare with the stored returns."""
    folder = population_folder(trained("lbrdiv"), "lbrdiv")
    loaded = [load_policy(folder / f"m{m}/c4") for m in range(2)]
    members = stacked([params for _, params, _ in loaded])
    responses = stacked([load_policy(folder / f"responses/m{m}")[1] for m in range(2)])
    for name, greedy in (("return", False), ("teammate_return", True)):
        returns = short_cross_play(LAYOUT, loaded[0][0], responses, members, greedy=greedy, paired=True)
        assert [card[name] for _, _, card in loaded] == returns.tolist()


@pytest.mark.slow
@EACH_KIND
def test_population_log_has_a_line_for_each_update(trained, algorithm):
    folder = population_folder(trained(algorithm), algorithm)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    stages = 3 if algorithm == "comedi" else 1
    assert [(line["stage"], line["update"]) for line in lines] == [(s, u) for s in range(stages) for u in range(6)]
    for line in lines:
        assert line["step"] == 2048 * (line["update"] + 1)
        ended = line["update"] in (1, 3, 4)  # episodes (400 steps) end in these rollouts (256 steps)
        assert (line["episodes"] > 0, "self_play" in line) == (ended, ended)
        meets_others = algorithm in ("brdiv", "lbrdiv") or line["stage"] > 0
        assert ("cross_play" in line) == (ended and meets_others)
        np.testing.assert_allclose(line["shaping"], max(0, 1 - line["update"] * 2048 / 6144), atol=1e-6)
    timing = [json.loads(line) for line in (folder / "timing.jsonl").read_text().splitlines()]
    assert [(line["stage"], line["update"]) for line in timing] == [(line["stage"], line["update"]) for line in lines]
    assert all(line["steps_per_second"] > 0 for line in timing)


class StopTraining(Exception):
    pass


@pytest.fixture
def stopped_suite(tmp_path, monkeypatch) -> Path:
    """Return a suite in which LBRDiv training stopped at its last update, after its multipliers had changed."""

    def stop(updates: int, speed: float) -> None:
        if updates == smoke_run("lbrdiv").updates:
            raise StopTraining

    with pytest.raises(StopTraining):
        population_job("lbrdiv", tmp_path).run(stop, save_seconds=0.0)
    return tmp_path


@pytest.mark.slow
def test_stopped_population_resumes_only_with_the_same_settings(trained, stopped_suite):
    before = {path: path.read_bytes() for path in stopped_suite.rglob("*") if path.is_file()}
    with pytest.raises(
        OptionError,
        match=r"lbrdiv.resume\.safetensors: saved by a training run with other settings: seed was 0, now it is 1",
    ):
        PopulationJob(replace(smoke_run("lbrdiv"), seed=1), stopped_suite).run()
    assert {path: path.read_bytes() for path in stopped_suite.rglob("*") if path.is_file()} == before

    done: list[int] = []
    population_job("lbrdiv", stopped_suite).run(lambda updates, speed: done.append(updates))
    assert done == [6]
    folders = [population_folder(suite, "lbrdiv") for suite in (stopped_suite, trained("lbrdiv"))]
    assert weight_hashes(folders[0]) == weight_hashes(folders[1])
    assert not compare_rebuilds(*folders).differences


def test_second_training_in_a_locked_folder_raises_error(tmp_path):
    with run_lock(population_folder(tmp_path, "fcp")), pytest.raises(BusyError, match="another process works in"):
        population_job("fcp", tmp_path).run()


@pytest.mark.slow
@pytest.mark.parametrize("name", [f"m0/c0/{POLICY_WEIGHTS}", f"m1/c4/{POLICY_CARD}", f"responses/m1/{POLICY_WEIGHTS}"])
def test_population_with_changed_or_missing_file_is_unfinished(trained, tmp_path, name):
    folder, job = population_folder(tmp_path, "lbrdiv"), population_job("lbrdiv", tmp_path)
    shutil.copytree(population_folder(trained("lbrdiv"), "lbrdiv"), folder)
    assert job.is_finished()
    flip_bit(folder / name)
    assert not job.is_finished()
    (folder / name).unlink()
    assert not job.is_finished()


def test_checkpoints_of_an_unfinished_population_raise_error(tmp_path):
    with pytest.raises(OptionError, match=r"fcp: no finished population; run .*--layout cramped_up"):
        list(suite_checkpoints(tmp_path, "cramped_up", "fcp"))


@pytest.mark.slow
def test_population_on_two_devices_learns_the_same_policies(tmp_path):
    """After one update with half of the policies on each device, parameters agree up to rounding."""
    (stage,) = smoke_run("fcp").stages
    state, _ = jax.jit(stage.update)(jax.jit(stage.init)(jax.random.fold_in(jax.random.key(0), 0)))
    flags = add_xla_flag("--xla_force_host_platform_device_count=2")
    process = start_python("-c", TWO_DEVICES, str(tmp_path / "weights.npz"), XLA_FLAGS=flags)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    found = np.load(tmp_path / "weights.npz")
    for path, leaf in jax.tree.leaves_with_path(state.params):
        name = "/".join(str(part.key) for part in path)
        np.testing.assert_allclose(found[name], leaf, rtol=0, atol=1e-4, err_msg=name)


def write_suite_with_returns(root: Path, returns: dict[tuple[int, int], float], algorithm: str = "fcp") -> Path:
    """Write a suite of checkpoints with different weights; `returns` has the return of each (member, checkpoint)."""
    folder = population_folder(root, algorithm)
    for (member, checkpoint), greedy in returns.items():
        params = {"params": {"x": np.array([member, checkpoint, ALGORITHMS.index(algorithm)], np.float32)}}
        card = {"algorithm": algorithm, "member": member, "seed": 7, "teammate_return": greedy, "return": -greedy}
        path = folder / f"m{member}" / f"c{checkpoint}"
        save_policy(path, ActorCritic(WIDTHS), params, card)
    (folder / "population.json").write_text("{}")
    return root


@pytest.fixture(scope="module")
def candidates(tmp_path_factory) -> Path:
    """Return a suite with 50 checkpoints of each algorithm: 40 with returns above 20, 5 at 20, 5 below."""
    root = tmp_path_factory.mktemp("candidates")
    for algorithm in ALGORITHMS:
        returns = {(m, c): 21.0 + m + c for m in range(10) for c in range(5)}
        returns |= {(m, 0): 20.0 for m in range(5)} | {(m, 1): -3.0 for m in range(5)}
        write_suite_with_returns(root, returns, algorithm)
    return root


def paths(points: list[SuiteCheckpoint]) -> list[str]:
    return [point.path for point in points]


def test_only_checkpoints_with_returns_above_the_threshold_are_selected(candidates):
    """CoMeDi's first policy, which is trained only by self-play, is not a candidate."""
    for algorithm, first, counts in (("fcp", 0, (50, 40)), ("comedi", 1, (45, 37))):
        found = paths(list(suite_checkpoints(candidates, LAYOUT.name, algorithm)))
        assert found == [f"{LAYOUT.name}/{algorithm}/m{m}/c{c}" for m in range(first, 10) for c in range(5)]
        chosen = select_teammates(candidates, LAYOUT.name, algorithm, train=1000, heldout=0)
        assert (chosen.candidates, chosen.good) == counts
        assert len({*paths(chosen.train)}) == len(chosen.train + chosen.heldout) == chosen.good
        assert {*paths(chosen.train)} < {*found}
        assert all(point.card["teammate_return"] > 20 for point in chosen.train)


def test_selection_depends_on_seed_and_algorithm(candidates):
    draws = {
        (a, s): select_teammates(candidates, LAYOUT.name, a, 20, 5, seed=s) for a in ("fcp", "brdiv") for s in (0, 1)
    }
    again = select_teammates(candidates, LAYOUT.name, "fcp", 20, 5, seed=0)
    assert (paths(again.train), paths(again.heldout)) == (paths(draws["fcp", 0].train), paths(draws["fcp", 0].heldout))
    names = [[path.partition("/m")[2] for path in paths(draw.train)] for draw in draws.values()]
    assert len({tuple(own) for own in names}) == 4
    assert names[0] != sorted(names[0])


@pytest.mark.parametrize("seed", range(5))
def test_members_are_selected_in_turn(tmp_path, seed):
    """Member 0 has four good checkpoints, members 1 and 2 have two each."""
    write_suite_with_returns(tmp_path, {(m, c): 30.0 for m, count in enumerate((4, 2, 2)) for c in range(count)})
    chosen = select_teammates(tmp_path, LAYOUT.name, "fcp", 6, 1, seed=seed)
    members = [point.card["member"] for point in chosen.heldout + chosen.train]
    assert len(members) == 7
    assert sorted(members[:3]) == sorted(members[3:6]) == [0, 1, 2]
    assert members[6] == 0
    assert len(set(paths(chosen.heldout + chosen.train))) == 7


@pytest.mark.parametrize(
    ("good", "train", "heldout"),
    [(0, 0, 0), (1, 1, 0), (4, 4, 0), (5, 4, 1), (10, 8, 2), (22, 18, 4), (24, 20, 4), (25, 20, 5), (50, 20, 5)],
)
def test_few_candidates_are_split_four_to_one_into_training_and_held_out(tmp_path, good, train, heldout):
    """The test asks for 20 teammates for training and 5 held-out teammates."""
    write_suite_with_returns(tmp_path, {(k // 5, k % 5): 30.0 if k < good else 5.0 for k in range(50)})
    chosen = select_teammates(tmp_path, LAYOUT.name, "fcp", 20, 5)
    assert (chosen.good, len(chosen.train), len(chosen.heldout)) == (good, train, heldout)
    assert not {*paths(chosen.train)} & {*paths(chosen.heldout)}


def test_written_manifests_contain_the_selected_teammates(candidates, tmp_path):
    root = tmp_path / "suite"
    shutil.copytree(candidates, root)
    selections = [select_teammates(root, LAYOUT.name, algorithm, 20, 5) for algorithm in ALGORITHMS]
    written = write_manifests(root, selections)
    assert [path.name for path in written] == ["layout_train.jsonl", "layout_heldout.jsonl"]
    for path, split, count in zip(written, ("train", "heldout"), (20, 5), strict=True):
        tasks = read_tasks(path)
        assert tasks == make_tasks(root, selections, split)
        first = 20 if split == "heldout" else 0
        layout = layout_number(LAYOUT.name) + 1
        numbers = [10_000 * layout + 1_000 * a + first + n for a in range(4) for n in range(count)]
        assert [task.seed for task in tasks] == numbers
        assert {task.split for task in tasks} == {split}
        assert [task.teammate_kind for task in tasks] == [a for a in ALGORITHMS for _ in range(count)]
        chosen = [point for own in selections for point in (own.train if split == "train" else own.heldout)]
        for task, point in zip(tasks, chosen, strict=True):
            assert (task.layout_name, task.teammate_family) == ("cramped_room_up", "rl")
            hashed = file_hash(root / point.path / POLICY_WEIGHTS)
            assert task.teammate["theta"] == {"checkpoint": point.path, "sha256": hashed}
            assert task.teammate["base_seed"] == 7
