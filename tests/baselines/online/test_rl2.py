"""Test RL^2: model outputs, training episodes, resumed training, and the choice of teammates and layouts."""

from __future__ import annotations

import collections
import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.evaluator import prepare_rollout
from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.methods.options import RL2_SETTINGS, ModelOptions
from icrl4aht_baselines.methods.registry import get_method, overcooked_world
from icrl4aht_baselines.methods.tokens import StepInput
from icrl4aht_baselines.methods.view_change import ViewChange
from icrl4aht_baselines.online.prepare import FLAT_SHARE, REARRANGED_SHARE, _shares, prepare_play
from icrl4aht_baselines.online.rl2 import (
    PLAY_REWARD_SCALE,
    PlayTask,
    PlayTrainer,
    _observation_filter,
    make_play_tasks,
    make_players,
)
from icrl4aht_baselines.online.teammates import BEHAVIOURS, MIXTURE, mixed_chances, with_behaviours
from icrl4aht_baselines.training.histories import read_trained
from icrl4aht_baselines.training.options import HistoryOptions, PlayOptions, TrainOptions
from icrl4aht_baselines.training.seen import parse_training_record
from icrl4aht_baselines.training.trainer import TrainingData, TrainingTask
from icrl4aht_generation.layouts.rearranged import rearranged_layouts
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.teammates.instances import published_task
from icrl4aht_generation.teammates.registry import build_teammate, sample_teammate

from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks, teammate_id
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.errors import EmptySelectionError, OptionError
from icrl4aht_data.overcooked.actions import EGO, STAY
from icrl4aht_data.overcooked.layouts import get_layout, with_recipes
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.state import initial_record
from tests.helpers.commands import run_cli
from tests.helpers.states import random_records
from tests.helpers.tampered import read_lines

LAYOUT = get_layout("cramped_up")
MODEL = ModelOptions(width=16, recurrent_layers=1, dropout=0.0, encoder="mlp", teammate_actions=True, reward_scale=0.05)
OPTIONS = TrainOptions(steps=6, batch_size=8, learning_rate=6e-3, warmup=0.0, log_every=1, save_every=3)
PLAY = PlayOptions(epochs=1, minibatches=2, episodes=2, task_end=0.5, imitation_end=1.0)
METHOD = get_method("rl2")(MODEL, overcooked_world([LAYOUT], "mlp", canonical=True))


def teammates(count: int) -> dict[str, Policy]:
    return {f"task {k}": build_teammate(LAYOUT, sample_teammate("assembly_line", k, "train")) for k in range(count)}


@pytest.fixture(scope="module")
def trainer() -> PlayTrainer:
    tasks = make_play_tasks({(LAYOUT, "assembly_line"): teammates(2)}, 8, {LAYOUT.name: 1.0})
    made = PlayTrainer(METHOD, OPTIONS, PLAY, [task._replace(searched=True) for task in tasks], mirror=True)
    made.init = jax.jit(made._initial_state)  # compiled once for several tests
    return made


@pytest.fixture(scope="module")
def compiled_episodes(trainer) -> Any:
    """Return the trainer's compiled function that plays two episodes."""
    state = trainer.init()
    return trainer.programs(state.params, state.tasks)[0]


@pytest.fixture(scope="module")
def full_run(trainer, compiled_episodes, tmp_path_factory) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("rl2") / "run"
    return folder, TrainingTask(METHOD, TrainingData(None, {}), OPTIONS, {}, trainer).train(folder)


def test_sequence_outputs_equal_step_by_step_outputs():
    """A sequence gives equal outputs in one call, in two halves and step by step."""
    rng = np.random.default_rng(0)
    steps = StepInput(
        jnp.asarray(rng.integers(0, 2, (6, 3, 5, 5, 46)), jnp.uint8),
        jnp.asarray(rng.integers(6, size=(6, 3))),
        jnp.asarray(rng.choice([-20.0, 0.0, 20.0], (6, 3))),
        jnp.asarray(rng.integers(6, size=(6, 3))),
    )
    model = dataclasses.replace(MODEL, recurrent_layers=2)
    method = get_method("rl2")(model, overcooked_world([LAYOUT], "mlp", canonical=True))
    params, start = method.init(jax.random.key(0)), jnp.zeros((3, 32))
    apply, act = jax.jit(partial(method.model.apply, {"params": params})), jax.jit(method.act)
    found: Any = apply(steps, start)
    output, end = found
    half, state = apply(jax.tree.map(lambda x: x[:3], steps), start)
    rest, last = apply(jax.tree.map(lambda x: x[3:], steps), state)
    np.testing.assert_allclose(output.logits, jnp.concatenate([half.logits, rest.logits]), atol=1e-5)
    np.testing.assert_allclose(np.asarray(end), np.asarray(last), atol=1e-5)
    memory = method.start(0, True)
    for t in range(6):
        logits, memory = act(params, jax.tree.map(lambda x, t=t: x[t, 1], steps), jnp.bool_(False), memory)
        np.testing.assert_allclose(logits, output.logits[t, 1], atol=1e-5)
    np.testing.assert_allclose(np.asarray(end[1]), np.asarray(memory), atol=1e-5)
    with pytest.raises(TypeError, match="trained by playing"):
        method.loss(params, None, None, None)


def test_training_sequences_match_the_played_episodes(trainer, compiled_episodes):
    """Training sequences contain the actions and rewards of two played episodes and the memory before them."""
    player, state = trainer.players[0], trainer.init()
    tasks, key = state.tasks[0], jax.random.key(3)
    refused = jnp.ones_like(tasks.ego.searcher.refused)
    tasks = tasks._replace(ego=tasks.ego._replace(searcher=tasks.ego.searcher._replace(refused=refused)))
    for number in range(3):  # a task that has not ended continues in the next episodes
        after, played, returns = compiled_episodes(state.params, player.mates, tasks, jax.random.fold_in(key, number))
        assert played.action.shape == (200, 8)
        np.testing.assert_array_equal(played.seen.prev_action[1:], played.action[:-1])
        by_episode = played.reward.reshape(2, 100, 8).sum(axis=1)
        np.testing.assert_allclose(by_episode.T / PLAY_REWARD_SCALE, returns, rtol=1e-5)
        ended = np.asarray(played.done[-1])
        assert not played.done[:-1].any()
        memory = np.asarray(after.ego.state)
        assert not memory[ended].any() and np.abs(memory[~ended]).sum() > 0
        np.testing.assert_array_equal(played.hidden[0], tasks.ego.state)
        remembered, earlier = np.asarray(after.ego.searcher.refused), np.asarray(tasks.ego.searcher.refused)
        assert not remembered[ended].any()
        assert (remembered | ~earlier)[~ended].all() and (number or remembered[~ended].all())
        for before in (after.before.prev_action, after.before.prev_reward, after.before.prev_teammate_action):
            assert ended.any() and not np.asarray(before)[ended].any()  # new tasks have no previous step
        tasks = after
    changes = np.asarray(tasks.ego.change.upside_down), np.asarray(tasks.ego.change.sideways)
    assert all(0 < flags.sum() < 8 for flags in changes)


def test_training_log_has_losses_and_falling_imitation_weight(full_run):
    lines = read_lines(full_run[0] / "metrics.jsonl")
    assert [line["step"] for line in lines] == list(range(1, 7))
    assert [line["imitation_weight"] for line in lines] == pytest.approx(1 - np.arange(6) / 6)
    assert {"return cramped_up assembly_line", "policy_loss", "value_loss", "entropy", "loss"} <= lines[0].keys()


def test_imitation_loss_makes_the_actions_of_the_script_likelier(trainer, compiled_episodes):
    """On fixed episodes, only a positive imitation weight makes the actions of the imitated script likelier."""
    state = trainer.init()
    _, played, _ = compiled_episodes(state.params, trainer.players[0].mates, state.tasks[0], jax.random.key(0))
    fallen = {}
    for weight in (0.0, 5.0):
        params, optimizer = jax.tree.map(jnp.copy, (state.params, state.optimizer))
        losses = []
        for _ in range(6):
            learned = trainer._learn(params, optimizer, (played,), jax.random.key(1), jnp.asarray(weight))
            params, optimizer, log = learned
            losses.append(float(log["imitation_loss"]))
        fallen[weight] = losses[0] - losses[-1]
    assert fallen[5.0] > 0.05, "in the six updates before the learning rate is 0"
    assert fallen[0.0] < fallen[5.0] / 4


def test_stopped_rl2_training_resumes_bit_for_bit(trainer, full_run, tmp_path):
    def stop(step: int, loss: float | None) -> None:
        if step == 4:
            raise KeyboardInterrupt

    task = TrainingTask(METHOD, TrainingData(None, {}), OPTIONS, {}, trainer)
    with pytest.raises(KeyboardInterrupt):
        task.train(tmp_path, done=stop)
    state = task.train(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, state.params, full_run[1].params)
    assert (tmp_path / "metrics.jsonl").read_bytes() == (full_run[0] / "metrics.jsonl").read_bytes()


def test_previous_actions_of_a_first_step_are_not_mirrored():
    """Zeros at the first step of a task mean "no previous action", so mirroring does not change these zeros."""
    flags = jnp.array([True, True])
    change = ViewChange(~flags, flags, flags)
    zero = jnp.zeros(2, jnp.int32)
    steps = StepInput(jnp.zeros((2, 5, 5, 46), jnp.uint8), zero, jnp.zeros(2), zero)
    seen = change.steps(steps, jnp.array([False, True]))
    assert seen.prev_action.tolist() == [0, 1]
    assert seen.prev_teammate_action is not None and seen.prev_teammate_action.tolist() == [0, 1]


def test_entries_are_removed_only_from_unchanged_observations_of_the_encoders_layouts():
    obs = observe(LAYOUT, random_records(LAYOUT, 400, np.random.default_rng(0)), EGO, canonical=True)
    found = _observation_filter(METHOD, [LAYOUT, with_recipes(LAYOUT, LAYOUT.recipes[:1])], False)(obs)
    assert 0 < found.values.shape[-1] < obs[0].size / 2
    np.testing.assert_array_equal(METHOD.model.tokens.encoder.view.observations(found), obs)
    for layouts, changes in (([LAYOUT], True), ([LAYOUT, get_layout("demo_wide")], False)):
        assert _observation_filter(METHOD, layouts, changes)(obs) is obs
    (mate,) = teammates(1).values()
    tasks = [PlayTask(LAYOUT, kind, mate, hidden, "") for kind, hidden in (("a", False), ("b", True))]
    assert all(player._compact(obs) is obs for player in make_players(tasks, METHOD, PLAY, mirror=False))


@pytest.mark.slow
def test_batch_of_several_layouts_gives_the_same_results_as_single_layouts():
    """Tasks of a layout give equal results in a batch of several layouts and in a batch of this layout alone."""
    layouts = rearranged_layouts(LAYOUT, 3)[::2]
    mate = build_teammate(None, sample_teammate("assembly_line", 0, "train"))
    first, second = (PlayTask(layout, "assembly_line", mate, True, layout.name) for layout in layouts)
    (player,) = make_players([first, second, second], METHOD, PLAY, mirror=False)
    (alone,) = make_players([second] * 3, METHOD, PLAY, mirror=False)
    params, key = METHOD.init(jax.random.key(0)), jax.random.key(1)
    (after, found, returns), (alone_after, expected, alone_returns) = (
        jax.jit(one.episodes)(params, one.mates, jax.jit(one.start)(key), key) for one in (player, alone)
    )
    np.testing.assert_array_equal(returns[1:], alone_returns[1:])
    np.testing.assert_array_equal(after.env.record[1:], alone_after.env.record[1:])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[:, 1:], b[:, 1:], atol=1e-5), found, expected)
    assert (np.asarray(found.seen.obs[:, 0]) != np.asarray(expected.seen.obs[:, 0])).any()


class TestTaskGroups:
    def test_tasks_of_a_layout_follow_its_share_and_are_split_evenly_over_families(self):
        wide = get_layout("demo_wide")
        mates = {(LAYOUT, "a"): teammates(1), (LAYOUT, "b"): teammates(1), (wide, "a"): teammates(3)}
        tasks = make_play_tasks(mates, 40, {LAYOUT.name: 1.0, wide.name: 0.25}, hidden=[wide.name])
        assert collections.Counter((task.name, task.hidden) for task in tasks) == {
            ("cramped_up a", False): 16,
            ("cramped_up b", False): 16,
            ("demo_wide a", True): 8,
        }

    def test_teammates_are_used_about_equally_often_and_show_several_behaviours(self):
        eight, four, group = (
            make_play_tasks({(LAYOUT, "a"): teammates(mates)}, tasks, {LAYOUT.name: 1.0})
            for mates, tasks in ((3, 8), (10, 4), (3, 60))
        )
        assert sorted(collections.Counter(task.id for task in eight).values()) == [2, 3, 3]
        assert len({task.id for task in four}) == 4
        found: dict[bytes, set[bytes]] = {}
        for mate in (task.teammate for task in group):
            theta = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(mate.params["script"]))
            found.setdefault(theta, set()).add(np.asarray(mate.params["chances"]).tobytes())
        assert all(len(behaviours) >= 3 for behaviours in found.values())

    def test_fewer_tasks_than_minibatches_raise_error(self):
        tasks = make_play_tasks({(LAYOUT, "a"): teammates(1)}, 3, {LAYOUT.name: 1.0})
        with pytest.raises(OptionError, match=r"minibatches = 4: expected at most the 3 tasks .* --minibatches"):
            PlayTrainer(METHOD, OPTIONS, PlayOptions(minibatches=4), tasks)

    def test_mixture_of_behaviours_has_the_declared_shares(self):
        chances = mixed_chances(100)
        assert chances.shape == (100, len(BEHAVIOURS)) and np.allclose(chances.sum(axis=1), 1)
        assert (chances[:, 0] == 1).sum() == 100 * MIXTURE[0][0]
        assert mixed_chances(1)[0].tolist() == [1.0, 0.0, 0.0, 0.0]

    def test_behaviours_change_the_actions_of_a_teammate(self):
        """The behaviour `stay` never moves; the behaviour `script` plays the unchanged teammate."""
        (base,) = teammates(1).values()
        mates = with_behaviours([base] * len(BEHAVIOURS), np.eye(len(BEHAVIOURS), dtype=np.float32))
        (plain,), taken = played_actions([base]), dict(zip(BEHAVIOURS, played_actions(mates), strict=True))
        assert (taken["stay"] == STAY).all()
        np.testing.assert_array_equal(taken["script"], plain)
        for behaviour in ("random", "noisy"):
            assert 0.05 < (taken[behaviour] != plain).mean() < 1.0


def played_actions(mates: list[Policy]) -> list[np.ndarray]:
    """Return 40 actions of each teammate, all chosen in the start state of an episode."""
    cells, facings = np.array(LAYOUT.agent_cells, np.uint8), np.zeros(2, np.uint8)
    record = jnp.asarray(initial_record(LAYOUT, cells, facings, LAYOUT.recipe_items[0]))
    act = jax.jit(mates[0].act)
    found = []
    for mate in mates:
        memory, actions = mate.init(mate.params, jax.random.key(0)), []
        for t in range(40):
            action, memory = act(mate.params, memory, record, jax.random.fold_in(jax.random.key(1), t))
            actions.append(int(action))
        found.append(np.array(actions))
    return found


class TestPreparation:
    """Test which teammates and layouts RL^2 training uses, given histories, manifests and rearranged layouts."""

    MODEL = dataclasses.replace(ModelOptions(**RL2_SETTINGS["model"]), width=8)
    CHOICE = HistoryOptions(("cramped_up",), source=("noise",), hide_recipe=("cramped_up",))

    def prepare(self, play: PlayOptions, tasks: Any = (), choice: HistoryOptions = CHOICE, batch: int = 64) -> Any:
        return prepare_play("rl2", self.MODEL, TrainOptions(steps=1, batch_size=batch), play, choice, tasks)

    def test_options_for_histories_are_refused(self):
        for change in ({"first": 3}, {"every": 2}, {"labels": "expert"}):
            (name,) = change
            with pytest.raises(OptionError, match=f"{name} = .*: rl2 learns by playing, not from histories"):
                self.prepare(PlayOptions(), choice=dataclasses.replace(self.CHOICE, **change))

    def test_teammates_of_manifest_tasks_are_added_and_recorded(self):
        tasks = read_tasks(manifest_path("layout", "train", "diverse"))
        plain, job = (self.prepare(PlayOptions(), of, batch=128) for of in ((), tasks))
        assert plain.about["trained_on"] == [cell for cell in job.about["trained_on"] if cell["source"] != "tasks"]
        added = {cell["algorithm"]: cell for cell in job.about["trained_on"] if cell["source"] == "tasks"}
        here = [task for task in tasks if task.layout.name == "cramped_up"]  # only tasks on this layout are added
        assert sum(cell["tasks"] for cell in added.values()) == len(here)
        assert {cell["layout"] for cell in added.values()} == {"cramped_up"}
        ids = {teammate_id(task.teammate) for task in here}
        assert {one for cell in added.values() for one in cell["teammates"]} == ids
        seen = parse_training_record(job.about["trained_on"], "here")
        assert seen.layouts == ("cramped_up",) and set(seen.teammates) >= set(added)
        assert sum(job.about["histories"]["groups"].values()) == len(job.trainer.tasks)

    def test_rearranged_and_four_recipe_layouts_are_added_in_proportion(self):
        """The rearranged versions of a layout have nearly equal numbers of tasks, which differ by at most one."""
        play = PlayOptions(rearranged=6, four_recipes=True)
        trainer = self.prepare(play).trainer
        families = {task.family for task in trainer.tasks}
        assert len(trainer.players) == len(families)
        assert all(task.hidden for task in trainer.tasks)
        tasks = collections.Counter(task.label for task in trainer.tasks)
        assert tasks["cramped_up rearranged"] == pytest.approx(REARRANGED_SHARE * tasks["cramped_up"], abs=3)
        assert 0 < tasks["cramped_up four recipes"] < tasks["cramped_up"]
        rearranged = [task for task in trainer.tasks if task.label == "cramped_up rearranged"]
        # Teammates of the kind fcp can only play their training layout.
        assert {task.family for task in rearranged} == families - {"fcp"}
        played = collections.Counter(task.layout for task in rearranged)
        assert {one.rows for one in played} == {one.rows for one in rearranged_layouts(LAYOUT, 6)}
        assert max(played.values()) - min(played.values()) <= 1

    def test_layout_without_histories_needs_tasks_of_a_manifest(self):
        choice = HistoryOptions(("cramped_down",))
        with pytest.raises(EmptySelectionError, match="cramped_down"):
            self.prepare(PlayOptions(), (), choice)
        tasks = read_tasks(manifest_path("layout", "test"))
        job = self.prepare(PlayOptions(), tasks, choice, 8)
        assert {cell["layout"] for cell in job.about["trained_on"]} == {"cramped_down"}
        assert job.about["histories"]["layouts"] == ["cramped_down"]

    def test_tasks_keep_the_recipe_that_their_teammate_prefers(self):
        """Tasks from histories or a manifest have only the recipe that their teammate prefers."""
        name = "asymm_both_plain"
        tasks = [one for one in read_tasks(manifest_path("preference", "train")) if one.layout.name == name]
        of_histories = self.prepare(PlayOptions(), (), HistoryOptions((name,), source=("search",)), 256)
        of_tasks = self.prepare(PlayOptions(), tasks, HistoryOptions((name,)), 256)
        for job in (of_histories, of_tasks):
            dishes = {task.layout.recipes for task in job.trainer.tasks}
            assert dishes == {task.layout.recipes for task in tasks}
            assert all(len(of_task) == 1 for of_task in dishes)
            assert all(task.searched for task in job.trainer.tasks), "no indicator shows the dish"
            assert job.about["histories"]["searched"] == [name]

    @pytest.mark.slow
    def test_teammates_on_rearranged_layouts_are_recorded(self):
        """In a small batch, some teammates appear only on rearranged layouts."""
        tasks = read_tasks(manifest_path("layout", "train", "diverse"))
        few = self.prepare(PlayOptions(minibatches=1), tasks, batch=2)
        job = self.prepare(PlayOptions(rearranged=6, minibatches=1), tasks, batch=2)
        counts = [sum(cell["tasks"] for cell in one.about["trained_on"]) for one in (few, job)]
        assert counts[0] < counts[1]

    def test_shares_of_layouts_depend_on_the_measured_oracle_gain(self):
        """With diverse teammates, the oracle earns more than `stay` on demo_simple but not on coord_simple."""
        tasks = read_tasks(manifest_path("teammate", "train", "diverse"))
        assert _shares(None, [task for task in tasks if task.layout.name in ("demo_simple", "coord_simple")]) == {
            "coord_simple": FLAT_SHARE,
            "demo_simple": 1.0,
        }
        release = load_icrl4aht(split="train", layout=["demo_simple", "coord_simple"])
        assert _shares(release, tasks)["demo_simple"] == 1.0
        assert _shares(load_icrl4aht(split="train", layout="coord_simple"), ()) == {"coord_simple": FLAT_SHARE}
        assert _shares(None, read_tasks(manifest_path("layout", "test"))) == {"asymm_right": 1.0, "cramped_down": 1.0}

    @pytest.mark.parametrize(
        ("play", "choice", "manifest", "message"),
        [
            (
                PlayOptions(),
                HistoryOptions(("cramped_up", "asymm_right"), source=("noise",)),
                ("layout", "train", "diverse"),
                "asymm_right: no chosen history and no task of a manifest",
            ),
            (PlayOptions(), CHOICE, ("layout", "test"), "expected tasks on cramped_up, found 40 on asymm_right, "),
            (PlayOptions(), HistoryOptions(("cramped_up",), queries=7), None, "queries = 7: rl2 learns by playing"),
            (
                PlayOptions(rearranged=6),
                HistoryOptions(("asymm_both_plain",), source=("search",)),
                None,
                "asymm_both_plain has tasks with a fixed dish",
            ),
        ],
    )
    def test_invalid_choices_of_teammates_raise_errors(self, play, choice, manifest, message):
        tasks = read_tasks(manifest_path(*manifest)) if manifest else ()
        with pytest.raises(OptionError, match=message):
            self.prepare(play, tasks, choice)


@pytest.mark.slow
def test_train_command_writes_a_model_that_can_be_loaded(tmp_path):
    out = tmp_path / "run"
    choice = "--layout cramped_up --source noise --teammate-family H3 --hide-recipe cramped_up"
    sizes = "--steps 1 --batch-size 2 --width 8 --epochs 1 --minibatches 1"
    printed = run_cli(f"train rl2 {choice} {sizes} --out {out}")
    assert "in each 2 tasks of 1 episode" in printed
    trained = read_trained(out)
    assert (trained.label, trained.step, trained.channels) == ("RL2+TA+mlp", 1, "canonical")
    assert {cell["labels"] for cell in trained.trained_on} == {"oracle"}
    agent = find_agent(out, greedy=False)
    assert agent.details and agent.details["sampled"] is True
    assert trained.hide_recipe == ("cramped_up",)
    task = published_task("cramped_down", "H1/t0")
    prepare_rollout(agent.make, [task], get_protocol("seeded", 1))  # an unsuitable policy would raise an error
