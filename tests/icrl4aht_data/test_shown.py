"""Displayed texts: `repr`, `help()`, and types in a user's script."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import jax
import pytest

import icrl4aht_data
from icrl4aht_data import ADBatch, Curriculum, Dataset, Report, get_layout, load_icrl4aht
from icrl4aht_data.checking.report import Finding
from icrl4aht_data.interop import torch_loader


@pytest.fixture(scope="module")
def bundled() -> Dataset:
    return load_icrl4aht()


def shown(dataset: Dataset) -> dict[str, object]:
    """Return an object of every public class, including attributes."""
    selection = dataset.filter(layout="demo_wide")
    sampler, contexts, history = (
        selection.ad(batch_size=2, length=30),
        selection.dpt(batch_size=2, context=20),
        dataset[0],
    )
    report = Report("release", findings=[Finding(f"file {number}", "x" * 1000) for number in range(300)])
    return {
        "ADBatch": sampler[0],
        "ADSampler": sampler,
        "Batches": sampler.batches(stop=3),
        "Curriculum": Curriculum(10),
        "DPTBatch": contexts[0],
        "DPTSampler": contexts,
        "Dataset": dataset,
        "Episode": history.episodes[0],
        "Episodes": history.episodes,
        "History": history,
        "Layout": get_layout("demo_wide"),
        "Report": report,
        "actions": history.actions,
        "cache": dataset.cache,
        "entry": history.entry,
        "index": dataset.index,
        "info": dataset.info,
        "picture": history.plot(),
        "provenance": dataset.provenance,
        "storage": dataset[:1].with_options(cache="ram").storage,
        "streamed storage": dataset[:1].with_options(cache="stream").storage,
    }


def test_every_public_object_fits_one_screen(bundled):
    objects = shown(bundled)
    public = [name for name in icrl4aht_data.__all__ if inspect.isclass(getattr(icrl4aht_data, name))]
    assert set(public) - {"Icrl4ahtError"} <= set(objects)
    for name, value in objects.items():
        text = repr(value)
        lines = sum(-(-len(line) // 80) for line in text.splitlines())
        assert 1 <= lines <= 24, f"{name}: {lines} lines of 80 columns"
        assert not re.search(r" object at 0x", text), name


def test_batches_print_shapes_wherever_their_arrays_are(bundled):
    sampler = bundled.filter(layout="demo_wide").with_options(obs="uint8").ad(batch_size=2, length=30)
    lines = repr(sampler[0]).splitlines()
    assert lines[0] == "ADBatch("
    assert [line.split() for line in lines[1:3]] == [
        ["obs", "uint8", "(2,", "30,", "5,", "5,", "45)"],
        ["prev_actions", "int32", "(2,", "30)"],
    ]
    with sampler.batches(stop=1, device=jax.devices()[0]) as batches:
        (on_device,) = batches
    assert repr(on_device) == repr(sampler[0])
    (tensors,) = torch_loader(sampler, stop=1)
    assert repr(tensors).replace("int64", "int32") == repr(sampler[0])
    assert "obs             P('data',)" in repr(ADBatch(*[jax.sharding.PartitionSpec("data")] * 6))


SCRIPT = Path(__file__).with_name("user_script.py")


def test_the_users_script_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(SCRIPT.read_text(), str(SCRIPT), "exec"), {})
    assert (tmp_path / "episode.gif").read_bytes().startswith(b"GIF89a")
