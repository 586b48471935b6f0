"""Test the trainer: steps, exact resumption, several devices and processes, held-out data, run folders."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.registry import get_method
from icrl4aht_baselines.training import trainer as training
from icrl4aht_baselines.training.histories import hold_out, prepare
from icrl4aht_baselines.training.options import HistoryOptions, TrainOptions
from icrl4aht_baselines.training.run_folder import CHECKPOINTS, format_versions, open_run, read_config
from icrl4aht_baselines.training.stopping import TrainingStopped, stop_signals
from icrl4aht_baselines.training.trainer import Trainer, TrainingData, TrainingTask, TrainState
from icrl4aht_generation.learners.resume import Checkpoints
from jax.experimental import multihost_utils

from icrl4aht_data import dataset as dataset_module
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import EmptySelectionError, LabelsMissingError, OptionError, UnknownNameError
from tests.helpers.commands import run_cli
from tests.helpers.random_releases import random_release
from tests.helpers.small_models import FLAT, TINY, ad_batch, random_parameters
from tests.helpers.tampered import read_lines
from tests.helpers.tiny import start_python
from tests.helpers.two_sources import two_source_release
from tests.helpers.xla_flags import add_xla_flag

OPTIONS = TrainOptions(
    steps=7, batch_size=4, context=7, log_every=2, validate_every=3, validation_batches=1, save_every=3, warmup=0.3
)
MODEL = dataclasses.replace(TINY, layers=1)


class TinySampler:
    """A sampler of batches with flat observations; a batch depends only on its number."""

    def __init__(self, seed: int = 0, die_at: int | None = None) -> None:
        self.seed, self.die_at = seed, die_at

    def batch(self, i: int, out: Any = None) -> Any:
        if i == self.die_at:
            raise KeyboardInterrupt
        return ad_batch(rows=4, seed=1000 * self.seed + i)

    def empty(self) -> Any:
        return self.batch(0)


@cache
def shared_trainer() -> Trainer:
    """Return a trainer that all tests share, for the method with the largest training state."""
    return Trainer(get_method("amago_offline")(MODEL, FLAT), OPTIONS)


def train_tiny(folder: Path, die_at: int | None = None, changes: Any = None, **options: Any) -> TrainState:
    data = TrainingData(TinySampler(0, die_at), {"held out": TinySampler(1)})
    settings = dataclasses.replace(OPTIONS, **(changes or {}))
    return TrainingTask(shared_trainer().method, data, settings, {}, shared_trainer()).train(folder, **options)


@pytest.fixture(scope="module")
def full_run(tmp_path_factory) -> tuple[Path, TrainState]:
    """Return the folder and the final state of an uninterrupted training run."""
    folder = tmp_path_factory.mktemp("runs") / "through"
    return folder, train_tiny(folder)


def assert_same(one: Any, two: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, two)


class TestResume:
    def test_killed_training_resumes_bit_for_bit(self, full_run, tmp_path):
        with pytest.raises(KeyboardInterrupt):
            # The run is killed after the checkpoint of step 3 and the logged line of step 4.
            train_tiny(tmp_path, die_at=5, log_to=["tensorboard"])
        assert Checkpoints(tmp_path / CHECKPOINTS).latest == 3
        with (tmp_path / "metrics.jsonl").open("a") as log:
            log.write('{"step": 5, "cut o')
        state = train_tiny(tmp_path, log_to=["tensorboard"])
        assert {path.name for path in (tmp_path / "tensorboard").iterdir()} == {"train", "held out"}
        assert_same(state, full_run[1])
        assert (tmp_path / "metrics.jsonl").read_bytes() == (full_run[0] / "metrics.jsonl").read_bytes()
        assert (tmp_path / "config.json").read_bytes() == (full_run[0] / "config.json").read_bytes()

    def test_training_a_finished_run_again_changes_nothing(self, full_run):
        log = (full_run[0] / "metrics.jsonl").read_bytes()
        assert_same(train_tiny(full_run[0]), full_run[1])
        assert (full_run[0] / "metrics.jsonl").read_bytes() == log

    def test_training_writes_log_curves_and_settings(self, full_run):
        folder, state = full_run
        lines = read_lines(folder / "metrics.jsonl")
        assert [(line["step"], line["part"]) for line in lines] == [
            (2, "train"),
            (3, "held out"),
            (4, "train"),
            (6, "train"),
            (6, "held out"),
            (7, "train"),
            (7, "held out"),
        ]
        assert {"loss", "actor_loss", "critic_loss", "gradient_norm", "learning_rate"} <= lines[0].keys()
        assert int(state.step) == 7
        assert (folder / "curves.png").stat().st_size > 5000
        config = read_config(folder)
        assert (config["train"]["steps"], config["method"]) == (7, "amago_offline")

    def test_missing_logging_library_raises_error_before_training(self, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "wandb", None)
        with pytest.raises(OptionError, match="needs wandb: pip install"):
            train_tiny(tmp_path / "run", log_to=["json", "wandb"])
        assert not (tmp_path / "run").exists()

    def test_training_with_other_settings_than_the_run_raises_error(self, full_run):
        with pytest.raises(OptionError, match=r"other settings \(train.seed: found 0, expected 3\); give another"):
            train_tiny(full_run[0], changes={"seed": 3})


def terminate_at_4(step: int, loss: float | None) -> None:
    """Send two SIGTERMs to this process after step 4, which is logged but has no checkpoint."""
    if step == 4:
        os.kill(os.getpid(), signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL  # the default handler would end the test process
        os.kill(os.getpid(), signal.SIGTERM)


class TestStopping:
    def test_checkpoints_are_saved_after_a_time_interval(self, tmp_path, monkeypatch):
        monkeypatch.setattr("icrl4aht_baselines.training.trainer.SAVE_MINUTES", 1e-9)
        with pytest.raises(KeyboardInterrupt):
            train_tiny(tmp_path, die_at=5)
        assert Checkpoints(tmp_path / CHECKPOINTS).steps == [4, 5]  # without SAVE_MINUTES, only step 3 would be saved

    def test_sigterm_saves_checkpoint_and_training_resumes_bit_for_bit(self, full_run, tmp_path):
        with pytest.raises(
            TrainingStopped, match=r"stopped by SIGTERM after step 4 of 7.* repeat the command to resume"
        ) as stopped:
            train_tiny(tmp_path, done=terminate_at_4)
        assert stopped.value.code == 143
        assert Checkpoints(tmp_path / CHECKPOINTS).latest == 4
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        assert_same(train_tiny(tmp_path), full_run[1])
        for name in ("metrics.jsonl", "config.json"):
            assert (tmp_path / name).read_bytes() == (full_run[0] / name).read_bytes()

    def test_second_sigint_stops_at_once(self):
        found = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore SIGINT
        try:
            with pytest.raises(KeyboardInterrupt), stop_signals() as stop:
                os.kill(os.getpid(), signal.SIGINT)
                assert TrainingStopped(stop[0], "").code == 130
                os.kill(os.getpid(), signal.SIGINT)
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        finally:
            signal.signal(signal.SIGINT, found)

    def test_signal_handlers_are_unchanged_outside_the_main_thread(self):
        def handler_in_other_thread() -> Any:
            with stop_signals():
                return signal.getsignal(signal.SIGINT)

        with ThreadPoolExecutor(1) as pool:
            assert pool.submit(handler_in_other_thread).result() is signal.getsignal(signal.SIGINT)

    def test_processes_agree_on_saving_and_stopping(self, monkeypatch):
        def decision(*every_process: tuple[int, int]) -> tuple[bool, int]:
            monkeypatch.setattr(jax, "process_count", lambda: len(every_process))
            monkeypatch.setattr(multihost_utils, "process_allgather", lambda own: np.array(every_process))
            return training.agree_on_stop(bool(every_process[-1][0]), every_process[-1][1])

        assert decision((1, 0), (0, 0)) == (True, 0)  # process 0 decides when to save
        assert decision((0, 0), (1, 0)) == (False, 0)
        assert decision((0, 0), (0, 15)) == decision((0, 15), (0, 0)) == (False, 15)
        assert decision((1, 2)) == (True, 2)


class TestRunFolder:
    def test_run_without_checkpoint_accepts_other_settings(self, full_run, tmp_path):
        """A run folder accepts other settings as long as it has no checkpoint."""
        first, corrected = ({**format_versions(), "train": {"batch_size": size}} for size in (10**9, 4))
        open_run(tmp_path / "run", first)
        assert open_run(tmp_path / "run", corrected) == corrected == read_config(tmp_path / "run")
        shutil.copytree(full_run[0] / CHECKPOINTS, tmp_path / "run" / CHECKPOINTS)
        with pytest.raises(OptionError, match=r"train.batch_size: found 4, expected 1000000000"):
            open_run(tmp_path / "run", first)

    def test_refused_training_leaves_no_folder_and_the_corrected_command_runs(self, tmp_path):
        small = "--layers 1 --width 16 --context 10 --steps 1"
        command = f"train ad --layout demo_wide {small} --out {tmp_path / 'big'} --batch-size"
        with pytest.raises(OptionError, match=r"batch_size = 1000000000, .* more than is free"):
            run_cli(f"{command} {10**9}")
        assert not list(tmp_path.iterdir())
        run_cli(f"{command} 2")
        assert Checkpoints(tmp_path / "big" / CHECKPOINTS).latest == 1

    def test_run_folder_with_other_files_raises_error(self, tmp_path):
        (tmp_path / "notes.txt").touch()
        with pytest.raises(OptionError, match=r"has other files \(notes.txt\), expected a run, or an empty or new"):
            train_tiny(tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
        with pytest.raises(OptionError, match="expected a folder, found a file"):
            train_tiny(tmp_path / "notes.txt")


class TestTrainingStep:
    @pytest.mark.slow
    def test_accumulated_gradient_equals_gradient_of_complete_batch(self):
        """The mean gradient of two micro-batches with unequal padding is the gradient of the complete batch."""
        method = get_method("ad")(dataclasses.replace(MODEL, dropout=0.0), FLAT)
        one, parts = (Trainer(method, dataclasses.replace(OPTIONS, accumulate=n)) for n in (1, 2))
        batch = TinySampler().batch(0)
        batch = batch._replace(attention_mask=np.arange(7) < np.array([7, 2, 5, 7])[:, None])
        params = random_parameters(method)

        def log_of(trainer: Trainer) -> dict[str, Any]:
            state = TrainState(params, None, training.training_optimizer(OPTIONS).init(params), jnp.int32(0))
            placed = jax.device_put(jax.tree.map(jnp.copy, state), trainer.everywhere)
            return trainer.step(placed, jax.device_put(batch, trainer.rows))[1]

        expected, found = log_of(one), log_of(parts)
        for name in expected:
            np.testing.assert_allclose(expected[name], found[name], rtol=1e-5, err_msg=name)

    def test_learning_rate_has_warmup_and_cosine_decay(self):
        schedule = training.learning_rate_schedule(TrainOptions(steps=100, warmup=0.05))
        rates = [np.asarray(schedule(t)) for t in (0, 3, 5, 50, 100)]
        cosine = 1e-3 * (1 + np.cos(np.pi * (50 - 5) / 95)) / 2
        np.testing.assert_allclose(rates, [0.0, 6e-4, 1e-3, cosine, 0.0], rtol=1e-5, atol=1e-9)

    def test_indivisible_batch_size_raises_error(self):
        with pytest.raises(OptionError, match=r"batch_size = 4: .* 3, the number of devices \(1\) x accumulate \(3\)"):
            Trainer(get_method("ad")(MODEL, FLAT), dataclasses.replace(OPTIONS, accumulate=3))


@pytest.fixture(scope="module")
def long_ppo_release(tmp_path_factory) -> Path:
    """Return a release with PPO histories of 7 episodes and noise histories of 6 episodes."""
    root = tmp_path_factory.mktemp("releases") / "both"
    two_source_release(root, ppo_episodes=7)
    return root


def training_job(
    root: Path | None, method: str = "ad", layout: str = "demo_wide", context: int = 7, **choice: Any
) -> Any:
    """Return a training job on histories of a release; `root=None` selects the bundled release."""
    options = dataclasses.replace(OPTIONS, context=context)
    return prepare(method, MODEL, options, HistoryOptions((layout,), root and str(root), **choice))


class TestHeldOut:
    def test_held_out_histories_and_teammates_are_not_in_training_data(self, tmp_path, monkeypatch):
        """If teammates have no description, each task counts as a separate teammate."""
        random_release(tmp_path / "r", layouts=("demo_wide",), teammates=5, streams=4, episodes=2)
        dataset = load_icrl4aht(tmp_path / "r", obs="state")
        monkeypatch.setattr(dataset_module, "teammate_ids", lambda dataset, ids: None)
        split: Any = hold_out(dataset, 0.25)
        parts = (split.train, split.histories, split.teammates)
        assert [len(part) for part in parts] == [12, 4, 4]
        assert sorted(np.concatenate([part.ids for part in parts]).tolist()) == list(range(20))
        tasks = [set(part.column("task_id").tolist()) for part in parts]
        assert len(tasks[0]) == 4
        assert tasks[1] <= tasks[0]
        assert not tasks[0] & tasks[2]
        again = hold_out(dataset.select(dataset.ids[::-1].copy()), 0.25)
        assert set(again.train.ids) == set(split.train.ids)

    def test_validation_split_is_used_as_the_data_of_held_out_teammates(self, two_sources):
        about = training_job(two_sources[0]).about
        assert about["histories"]["sizes"] == {"train": 13, "histories": 1, "teammates": 6}
        assert about["histories"]["teammates_split"] == "validation"
        assert {cell["split"] for cell in about["trained_on"]} == {"train"}
        assert {cell["source"] for cell in about["trained_on"]} == {"ppo", "noise"}
        # The release has no PPO histories in split `validation`.
        learned = training_job(two_sources[0], source=("ppo",)).about
        assert learned["histories"]["sizes"] == {"train": 3, "histories": 1, "teammates": 4}
        assert learned["histories"]["teammates_split"] == "train"

    def test_tasks_with_one_history_are_not_held_out(self, two_sources):
        dataset = load_icrl4aht(two_sources[0], source="ppo", layout="demo_wide")
        # The selection has a task with one history and a task with four histories.
        split: Any = hold_out(dataset[3:8], validation=dataset[:1])
        assert split.train.ids.tolist()[0] == dataset.ids[3]
        assert (len(split.train), len(split.histories)) == (4, 1)
        assert hold_out(dataset[3:5]).histories is None
        with pytest.raises(OptionError, match=r"every task of .* has one history: expected a task with two"):
            hold_out(dataset[3:4])

    def test_labels_default_to_expert_only_for_dpt(self, two_sources):
        for method, given, labels in (
            ("dpt", "oracle", "oracle"),
            ("dpt", None, "expert"),
            ("ad", "oracle", "oracle"),
            ("hybrid_ad", "expert", "expert"),
            ("ad", None, None),
            ("amago_offline", None, None),
        ):
            found = training_job(two_sources[0], method, labels=given)
            assert found.about["histories"]["labels"] == labels
            assert {cell["labels"] for cell in found.about["trained_on"]} == {labels}
            assert {sampler.labels for sampler in (found.data.train, *found.data.validation.values())} == {labels}

    def test_sampler_options_are_passed_on(self, two_sources):
        found = training_job(two_sources[0], context=40, every=3)
        assert {sampler.every for sampler in (found.data.train, *found.data.validation.values())} == {3}
        assert training_job(two_sources[0], at_start=0.5).data.train.at_start == 0.5
        dpt = training_job(two_sources[0], "dpt", context=40, queries=3)
        assert dpt.data.train[0].query_target.shape == (OPTIONS.batch_size, 3)

    def test_first_counts_the_episodes_of_each_history(self):
        """Histories of demo_wide have different lengths, and shorter ones do not limit longer ones."""
        sampler = training_job(None, layout="demo_wide", first=30).data.train
        assert len({*sampler.dataset.column("episodes").tolist()} - {*range(30)}) > 1
        assert min(sampler.dataset.column("episodes")) < 30
        assert sampler.options()["episodes"] == [0, 30]

    def test_balance_gives_all_sources_the_same_probability(self):
        sampler = training_job(None, layout="demo_wide", balance=True).data.train
        sources, weights = sampler.dataset.column("source"), np.array(sampler.options()["weights"])
        counts = {source: np.sum(sources == source) for source in ("ppo", "noise", "agent")}
        assert len({*counts.values()}) > 1
        np.testing.assert_allclose([np.sum(weights[sources == source]) for source in counts], 1)

    def test_a_single_teammate_is_not_held_out(self):
        dataset = load_icrl4aht(layout="asymm_both_plain")
        dataset = dataset.filter(task_id=dataset.entries[0].task_id)[:5]
        split: Any = hold_out(dataset)
        assert split.teammates is None
        assert [len(split.train), len(split.histories)] == [len(dataset) - 1, 1]

    def test_filters_select_histories_and_are_recorded(self):
        """Filter histories of demo_simple by the teammate's family and algorithm and by source."""
        everything = training_job(None, layout="demo_simple").about["trained_on"]
        learned = training_job(None, layout="demo_simple", teammate_family=("rl",)).about
        assert {cell["family"] for cell in everything} == {"rl", "H1", "H2", "H3", "H4"}
        assert {cell["family"] for cell in learned["trained_on"]} == {"rl"}
        assert learned["histories"]["teammate_family"] == ("rl",)
        one = "brdiv"  # with two histories, so that one can be held out
        (cell,) = training_job(None, layout="demo_simple", algorithm=(one,), source=("ppo",)).about["trained_on"]
        names = {"layout": "demo_simple", "split": "train", "family": "rl", "algorithm": one, "source": "ppo"}
        assert cell.items() >= names.items()
        # Some histories are held out.
        assert cell["histories"] < len(load_icrl4aht(layout="demo_simple", teammate_kind=one))

    @pytest.mark.parametrize(
        ("filters", "error", "message"),
        [
            (
                {"algorithm": ("fpc",)},
                UnknownNameError,
                r"unknown algorithm 'fpc'; valid: fcp, .*Did you mean 'fcp'",
            ),
            ({"source": ("ppo", "dqn")}, UnknownNameError, "unknown source 'dqn'; valid: ppo, noise"),
            (
                {"teammate_family": ("rl",), "algorithm": ("assembly_line",)},
                EmptySelectionError,
                r"no history has teammate_family=\('rl',\), algorithm=\('assembly_line',\)",
            ),
        ],
    )
    def test_filters_that_match_no_history_raise_error(self, filters, error, message):
        with pytest.raises(error, match=message):
            training_job(None, layout="asymm_both", **filters)

    @pytest.mark.parametrize(
        ("method", "context", "choice", "message"),
        [
            ("ad", 121, {}, r"context = 121: the shortest history of .* has 120 steps for a window"),
            ("ad", 41, {"every": 3}, "context = 41: .* has 40 steps .* every = 3 and first = all;"),
            ("ad", 61, {"first": 3}, "context = 61: .* has 60 steps .* every = 1 and first = 3;"),
            ("dpt", 7, {"every": 2}, "every = 2: dpt learns from contexts, but only windows can skip episodes"),
            ("dpt", 7, {"balance": True}, "balance = True: dpt draws tasks and contexts.*leave out --balance"),
            ("dpt", 7, {"at_start": 0.5}, "at_start = 0.5: dpt draws tasks and contexts.*leave out --at-start"),
            (
                "dpt",
                7,
                {"queries": 9},
                "queries = 9: a context of 7 transitions has 8 prefixes .* choose at most 8 queries",
            ),
            ("ad", 7, {"queries": 3}, "queries = 3: ad learns from windows without queries"),
            ("ad", 7, {"order": "random"}, "order = random: ad learns from windows in order"),
        ],
    )
    def test_training_options_that_do_not_fit_the_data_raise_errors(
        self, long_ppo_release, method, context, choice, message
    ):
        with pytest.raises(OptionError, match=message):
            training_job(long_ppo_release, method, context=context, **choice)

    def test_dpt_training_without_labels_raises_error(self, tmp_path):
        random_release(tmp_path / "r", layouts=("demo_wide",), labels=False)
        with pytest.raises(LabelsMissingError, match=r"/r: .*no expert actions.*: AD can learn the histories' own"):
            training_job(tmp_path / "r", "dpt")


DEVICES = """
import os, sys
from pathlib import Path
import jax
import jax.experimental.multihost_utils
root, out, *address = sys.argv[1:]
out = Path(out)
number = int(os.environ.get("PROCESS", 0))
if address:
    jax.distributed.initialize(*address, num_processes=2, process_id=number)
    # Connect before compiling: a process that compiles for over 30 seconds makes the other fail to connect.
    jax.experimental.multihost_utils.sync_global_devices("start")
from icrl4aht_baselines.training.stopping import TrainingStopped
from tests.baselines.training.test_trainer import Checkpoints, read_lines, small_job
assert jax.device_count() == 2
def stop(step, loss):
    if number == 1 and step == 1:
        os.kill(os.getpid(), 15)
try:
    small_job(root).train(out, done=stop)
except TrainingStopped as stopped:
    steps = [line["step"] for line in read_lines(out / "metrics.jsonl")]
    print(stopped.code, Checkpoints(out / "checkpoints").steps, steps, flush=True)
    jax.experimental.multihost_utils.sync_global_devices("stopped")
    small_job(root).train(out)
"""


def small_job(root: Path) -> TrainingTask:
    """Return a training job with dropout, gradient accumulation and validation."""
    options = TrainOptions(steps=3, batch_size=4, context=6, log_every=1, validation_batches=1, accumulate=2)
    model = ModelOptions(layers=1, width=8, heads=2)
    return prepare("ad", model, options, HistoryOptions(("demo_wide",), str(root)))


def test_processes_split_the_rows_of_a_batch(lite, monkeypatch):
    """The rows of two processes together equal the batch of one process."""

    def rows(index: int, count: int) -> Any:
        monkeypatch.setattr(jax, "process_index", lambda: index)
        monkeypatch.setattr(jax, "process_count", lambda: count)
        options = TrainOptions(steps=1, batch_size=4, context=6)
        return prepare("ad", MODEL, options, HistoryOptions(("demo_wide",), str(lite[0]))).data.train.batch(1)

    both = jax.tree.map(lambda *parts: np.concatenate(parts), rows(0, 2), rows(1, 2))
    assert_same(both, rows(0, 1))


@pytest.fixture(scope="module")
def one_device_log(lite, tmp_path_factory) -> list[dict[str, Any]]:
    folder = tmp_path_factory.mktemp("one")
    small_job(lite[0]).train(folder)
    return read_lines(folder / "metrics.jsonl")


def check_two_devices(
    log: list[dict[str, Any]], root: Path, folder: Path, environments: list[dict[str, str]], *arguments: str
) -> list[str]:
    """Train in a process for each dict of environment variables, check the log, and return each process's output."""
    processes = [start_python("-c", DEVICES, str(root), str(folder), *arguments, **one) for one in environments]
    outputs = [process.communicate(timeout=240) for process in processes]
    for process, (_, error) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, error
    found = read_lines(folder / "metrics.jsonl")
    assert [(line["step"], line["part"]) for line in found] == [(line["step"], line["part"]) for line in log]
    for a, b in zip(found, log, strict=True):
        for name in a.keys() - {"part"}:
            np.testing.assert_allclose(a[name], b[name], rtol=2e-5, atol=1e-7, err_msg=name)
    return [out for out, _ in outputs]


@pytest.mark.slow
def test_two_devices_give_the_log_of_one_device(lite, tmp_path, one_device_log):
    flags = add_xla_flag("--xla_force_host_platform_device_count=2")
    check_two_devices(one_device_log, lite[0], tmp_path, [{"XLA_FLAGS": flags}])


@pytest.mark.slow
def test_two_processes_stop_together_and_give_the_log_of_one_device(lite, tmp_path, one_device_log):
    """After a SIGTERM to process 1, both processes save a checkpoint; the same call resumes training."""
    with socket.socket() as held:  # reserves a port that JAX's coordinator can share
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        held.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{held.getsockname()[1]}"
        both = [{"PROCESS": "0"}, {"PROCESS": "1"}]
        outputs = check_two_devices(one_device_log, lite[0], tmp_path, both, address)
    assert [out.splitlines()[-1] for out in outputs] == ["143 [1] [1]"] * 2
