"""Test the `repr` of objects, and run an example of a user's script."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest

from icrl4aht_data import ADBatch, Dataset, Report, load_icrl4aht
from icrl4aht_data.checking.report import Finding
from icrl4aht_data.interop import torch_loader


@pytest.fixture(scope="module")
def bundled_dataset() -> Dataset:
    return load_icrl4aht()


def test_repr_of_objects_fits_one_screen(bundled_dataset):
    sampler, history = bundled_dataset.filter(layout="demo_wide").ad(batch_size=2, length=30), bundled_dataset[0]
    report = Report("release", findings=[Finding(f"file {number}", "x" * 1000) for number in range(300)])
    objects = [
        bundled_dataset,
        bundled_dataset.index,
        bundled_dataset.info,
        bundled_dataset.provenance,
        bundled_dataset.cache,
        history,
        history.entry,
    ]
    objects += [history.actions, history.plot(), history.episodes, history.episodes[0], sampler, sampler[0], report]
    for value in objects:
        text = repr(value)
        lines = sum(-(-len(line) // 80) for line in text.splitlines())
        assert 1 <= lines <= 24 and " object at 0x" not in text, text


def test_repr_of_batches_shows_dtypes_and_shapes(bundled_dataset):
    sampler = bundled_dataset.filter(layout="demo_wide").with_options(obs="uint8").ad(batch_size=2, length=30)
    lines = repr(sampler[0]).splitlines()
    assert lines[0] == "ADBatch("
    assert [line.split() for line in lines[1:3]] == [
        ["obs", "uint8", "(2,", "30,", "5,", "5,", "45)"],
        ["prev_actions", "int32", "(2,", "30)"],
    ]
    with sampler.batches(stop=1, device=jax.devices()[0]) as batches:
        (on_device,) = batches
    assert repr(on_device) == repr(sampler[0]).replace("int64", "int32")
    (tensors,) = torch_loader(sampler, stop=1)
    assert repr(tensors) == repr(sampler[0]).replace("int32", "int64")
    spec = jax.sharding.PartitionSpec("data")
    assert f"obs             {spec!r}" in repr(ADBatch(*[spec] * 6))


SCRIPT = Path(__file__).with_name("user_script.py")


@pytest.mark.slow
def test_user_script_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(SCRIPT.read_text(), str(SCRIPT), "exec"), {})
    assert (tmp_path / "episode.gif").read_bytes().startswith(b"GIF89a")
