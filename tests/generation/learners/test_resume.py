"""Test saved states, logs and folder locks of training runs."""

from __future__ import annotations

import json
import os
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_generation.learners import resume
from icrl4aht_generation.learners.resume import (
    BusyError,
    Checkpoints,
    OtherSettingsError,
    RunLog,
    SaveInterval,
    StateFile,
    differing_settings,
    limit_xla_threads,
    run_lock,
    software_versions,
    xla_threads,
)
from jax.sharding import SingleDeviceSharding

from icrl4aht_data.errors import OptionError
from tests.helpers.commands import run_python


class State(NamedTuple):
    params: dict
    rest: tuple


SETTINGS = {"ego": {"rate": 0.1, "layers": (1, 2)}, "seed": 3}


def state() -> State:
    """Return a pytree with every kind of leaf and node that a training state can have."""
    params = {"kernel": jnp.arange(6.0).reshape(2, 3).T, "empty": jnp.zeros((0, 4)), "nothing": ()}
    keys = {"one": jax.random.key(5), "many": jax.random.split(jax.random.key(3), 4)}
    record, ended = jnp.arange(256, dtype=jnp.uint8), jnp.array([True, False])
    return State(params, (jnp.int32(7), record, ended, keys))


def assert_equal(found, expected) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for after, before in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (before.dtype, before.shape) == (after.dtype, after.shape)
        if jnp.issubdtype(before.dtype, jax.dtypes.prng_key):
            before, after = jax.random.key_data(before), jax.random.key_data(after)
        assert np.array_equal(before, after)


@pytest.fixture
def file(tmp_path) -> StateFile:
    return StateFile(tmp_path / "s.safetensors", SETTINGS)


@pytest.mark.parametrize(
    ("variables", "threads"),
    [
        ({}, len(os.sched_getaffinity(0))),
        ({"NPROC": "3"}, 3),
        ({"NPROC": "3", "PJRT_NPROC": "5"}, 5),
        ({"PJRT_NPROC": "many"}, len(os.sched_getaffinity(0))),
    ],
)
def test_number_of_xla_threads_follows_environment_variables(monkeypatch, variables, threads):
    for name in ("NPROC", "PJRT_NPROC"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert xla_threads() == threads
    assert software_versions()["xla_threads"] == threads


def test_changing_xla_threads_after_jax_was_used_raises_error(monkeypatch):
    jax.devices()
    monkeypatch.setenv("PJRT_NPROC", "3")
    limit_xla_threads(3)
    with pytest.raises(OptionError, match=r"3 threads in this process, expected 1: set PJRT_NPROC=1 before"):
        limit_xla_threads(1)
    assert xla_threads() == 3


@pytest.mark.slow
def test_xla_threads_are_limited_if_jax_was_not_used_yet():
    """Count the threads that XLA starts in a new process. With one thread, a call returns when its result is ready."""
    script = (
        "import os, jax\n"
        "from icrl4aht_generation.learners.resume import limit_xla_threads, xla_threads\n"
        "limit_xla_threads({0}); found = jax.jit(lambda x: x @ x @ x @ x)(jax.numpy.ones((1500, 1500)))\n"
        "ready = found.is_ready(); jax.block_until_ready(found)\n"
        "names = [open(f'/proc/self/task/{{task}}/comm').read() for task in os.listdir('/proc/self/task')]\n"
        "print(xla_threads(), sum('XLAEigen' in name for name in names), ready)"
    )
    for threads in (1, 3):
        found = run_python("-c", script.format(threads)).split()
        assert found == [str(threads), str(threads), str(threads == 1)]


class TestStateFile:
    def test_state_saved_with_another_number_of_threads_raises_error(self, file, monkeypatch):
        StateFile(file.path, SETTINGS | software_versions()).save({}, 1)
        monkeypatch.setenv("PJRT_NPROC", "17")
        again = StateFile(file.path, SETTINGS | software_versions())
        with pytest.raises(OtherSettingsError, match=r"xla_threads was (\d+), now it is \d+; set PJRT_NPROC=\1 "):
            again.load({})

    def test_saved_state_is_loaded_exactly(self, file):
        assert file.progress is None
        saved = state()
        file.save(saved, 7)
        again = StateFile(file.path, json.loads(json.dumps(SETTINGS)))
        assert again.progress == 7
        assert_equal(again.load(jax.eval_shape(lambda: saved)), saved)
        assert [path.name for path in file.path.parent.iterdir()] == ["s.safetensors"]

    def test_equal_states_give_equal_bytes(self, file):
        """Metadata is written in a fixed order; safetensors itself uses a random order."""
        contents = set()
        for _ in range(8):
            file.save(state(), 7)
            contents.add(file.path.read_bytes())
        assert len(contents) == 1
        assert int.from_bytes(contents.pop()[:8], "little") % 8 == 0

    def test_state_can_be_loaded_in_part_and_with_given_shardings(self, file):
        saved = state()
        file.save(saved, 7)
        shapes = jax.eval_shape(lambda: saved.params)
        assert_equal(file.load(shapes, "params"), saved.params)
        assert_equal(file.load(jax.eval_shape(lambda: saved.rest[3]["one"]), "rest/3/one"), saved.rest[3]["one"])
        device = SingleDeviceSharding(jax.devices()[0])
        placed = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device), jax.eval_shape(lambda: saved)
        )
        found = file.load(placed)
        assert_equal(found, saved)
        assert all(leaf.sharding == device for leaf in jax.tree.leaves(found))

    def test_interrupted_save_keeps_the_previous_state(self, file, monkeypatch):
        file.save(state(), 1)

        def write_half(path, content):
            path.write_text("half")
            raise KeyboardInterrupt

        monkeypatch.setattr(Path, "write_bytes", write_half)
        with pytest.raises(KeyboardInterrupt):
            file.save(state(), 2)
        assert file.progress == 1

    @pytest.mark.parametrize(
        ("like", "message"),
        [
            ({"count": jnp.float32(0)}, r"count: expected float32 \(\), found int32 \(\)"),
            ({"count": jnp.zeros(2, jnp.int32)}, r"count: expected int32 \(2,\), found int32 \(\)"),
            ({"count": jnp.int32(0), "more": jnp.int32(0)}, r"more: expected int32 \(\), found nothing"),
            ({}, r"count: expected nothing, found int32 \(\)"),
        ],
    )
    def test_state_with_unexpected_arrays_raises_error_with_their_names(self, file, like, message):
        file.save({"count": jnp.int32(7)}, 1)
        with pytest.raises(OptionError, match=rf"s\.safetensors: not a state of this training: {message}; restore"):
            file.load(like)

    def test_state_saved_with_other_settings_raises_error_with_the_difference(self, file):
        file.save({}, 1)
        other = StateFile(file.path, {"ego": {"rate": 0.2, "layers": [1, 2]}, "seed": 3})
        with pytest.raises(OtherSettingsError, match=r"s\.safetensors: .*ego\.rate was 0\.1, now it is 0\.2"):
            other.load({})
        assert StateFile(file.path).progress == 1

    def test_damaged_or_missing_state_file_raises_error_with_its_name(self, file):
        with pytest.raises(OptionError, match=r"s\.safetensors: .*no such file"):
            file.load({})
        file.path.write_bytes(b"not a state")
        for read in (lambda: file.progress, lambda: file.load({})):
            with pytest.raises(OptionError, match=r"s\.safetensors: not a state of this training: .*or remove it"):
                read()

    def test_saving_two_leaves_with_the_same_path_raises_error(self, file):
        with pytest.raises(
            ValueError, match="2 leaves of the state, but 1 different paths: give every leaf its own path"
        ):
            file.save({"a/b": jnp.int32(0), "a": {"b": jnp.int32(1)}}, 1)


def test_only_the_latest_checkpoints_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", SETTINGS, keep=2)
    assert checkpoints.latest is None
    with pytest.raises(OptionError, match="expected a checkpoint, found none"):
        checkpoints.load({})
    for step in (5, 10, 100):
        checkpoints.save({"step": jnp.int32(step)}, step)
    assert checkpoints.steps == [10, 100]
    like = {"step": jnp.int32(0)}
    found, step = checkpoints.load(like)
    assert (int(found["step"]), step) == (100, 100)
    assert int(checkpoints.state_file(10).load(like)["step"]) == 10


def test_resumed_log_drops_lines_after_the_saved_state(tmp_path):
    with closing(RunLog(tmp_path, lambda line: False)) as log:
        for update in range(4):
            log.write({"update": update}, {"update": update, "part": "b"}, timing={"update": update})
        log.sync()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"update": 4, "half a li')
    with closing(RunLog(tmp_path, lambda line: line["update"] < 2)) as log:
        log.write({"update": 2})
    metrics, timing = ((tmp_path / name).read_text().splitlines() for name in ("metrics.jsonl", "timing.jsonl"))
    assert [json.loads(line)["update"] for line in metrics] == [0, 0, 1, 1, 2]
    assert [json.loads(line)["update"] for line in timing] == [0, 1]


def test_states_are_saved_at_intervals_of_seconds_or_updates_and_at_the_end(monkeypatch):
    clock = iter([0.0, 1.0, 2.0, 4.0, 4.5, 5.0])
    monkeypatch.setattr(resume.time, "monotonic", lambda: next(clock))
    interval = SaveInterval(5, seconds=2.0)
    assert [interval.due(update) for update in range(1, 6)] == [False, True, True, False, True]
    monkeypatch.undo()
    interval = SaveInterval(7, updates=3)
    assert [update for update in range(1, 8) if interval.due(update)] == [3, 6, 7]


def test_locking_a_run_folder_twice_raises_error(tmp_path):
    with run_lock(tmp_path / "run"):
        with pytest.raises(BusyError, match="run: another process works in this folder"), run_lock(tmp_path / "run"):
            pass
        assert not (tmp_path / "run").exists()
    with run_lock(tmp_path / "run"):
        pass
    assert not list(tmp_path.iterdir()), "expected the lock's file to be removed"


def test_differing_settings_returns_old_and_new_values():
    assert not differing_settings({"a": (1, 2)}, {"a": [1, 2]})
    assert differing_settings({"a": {"b": 1}, "c": 2}, {"a": {"b": 3}}) == {"a.b": (1, 3), "c": (2, None)}
