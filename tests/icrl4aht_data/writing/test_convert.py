"""Test conversion of releases to other forms and back."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import h5py
import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.actions import ACTIONS, PUBLISHED_ACTIONS
from icrl4aht_data.publishing.build import build_release
from icrl4aht_data.publishing.upload import upload_release
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.minari import to_minari
from icrl4aht_data.writing.parquet import to_parquet
from icrl4aht_data.writing.published import PUBLISHED_FIELDS, from_published, to_published
from tests.helpers.batches import batches_digest


@pytest.fixture(scope="module")
def published_files(lite, tmp_path_factory):
    """Return the release `lite`, converted to files of the published code (read-only)."""
    return to_published(load_icrl4aht(lite[0]), tmp_path_factory.mktemp("published") / "files")


@pytest.mark.parametrize(("start", "kind"), [("lite", "full"), ("full", "lite"), ("full", "full")])
def test_full_and_lite_releases_convert_into_each_other(request, tmp_path, start, kind):
    root, _ = request.getfixturevalue(start)
    to_release(load_icrl4aht(root), tmp_path / "out", kind)
    assert verify_release(tmp_path / "out", level="deep").ok
    assert load_icrl4aht(tmp_path / "out").info.kind == kind
    assert batches_digest(tmp_path / "out") == batches_digest(root)
    assert (tmp_path / "out" / "meta" / "tasks.jsonl").read_text() == (root / "meta" / "tasks.jsonl").read_text()


def test_selection_of_histories_can_be_converted(lite, tmp_path):
    part = load_icrl4aht(lite[0]).select([7, 2])
    to_release(part, tmp_path / "out", "lite")
    out = load_icrl4aht(tmp_path / "out")
    assert verify_release(tmp_path / "out", level="deep").ok
    for old, new in zip(part, out, strict=True):
        np.testing.assert_array_equal(new.state[:], old.state[:])


def test_published_files_have_the_format_of_the_paper(lite, published_files):
    root, written = lite
    with h5py.File(published_files / "histories.h5") as file:
        for line in (published_files / "histories_index.jsonl").read_text().splitlines():
            entry = json.loads(line)
            assert tuple(entry) == PUBLISHED_FIELDS
            group: Any = file[entry["h5_group"]]
            arrays = written[entry["history_id"]]
            for name, dtype in (("actions", "int32"), ("teammate_actions", "int32"), ("expert_actions", "int32")):
                assert group[name].dtype == dtype
                theirs = [PUBLISHED_ACTIONS[a] for a in group[name][()]]
                assert theirs == [ACTIONS[a] for a in arrays[name]]
            assert (group["rewards"].dtype, group["dones"].dtype, group["obs"].dtype) == ("float32", "bool", "float32")
            assert (group["obs"].compression, group["obs"].compression_opts) == ("gzip", 6)
            assert group["obs"].chunks == (120, *entry["obs_shape"])
            np.testing.assert_array_equal(group["obs"][()], load_icrl4aht(root).history(entry["history_id"]).obs[:])


def test_published_files_convert_back_to_the_same_release(lite, published_files, tmp_path):
    from_published(published_files, tmp_path / "back", "lite", data_version="0.0.1", kept_steps=20)
    assert verify_release(tmp_path / "back", level="deep").ok
    assert batches_digest(tmp_path / "back") == batches_digest(lite[0])
    for name in ("meta/histories.jsonl", "meta/tasks.jsonl", "meta/provenance.json", "meta/info.json"):
        assert (tmp_path / "back" / name).read_text() == (lite[0] / name).read_text()


@pytest.mark.parametrize("write", [to_published, partial(to_release, kind="full")])
def test_a_release_is_not_written_over_its_source(lite, write):
    dataset = load_icrl4aht(lite[0])
    for target, message in (
        (lite[0], r"lite: overlaps the input folder .*lite;"),
        (lite[0].parent, r": overlaps the input folder .*lite;"),
        (lite[0] / "out", r"out: overlaps the input folder .*lite;"),
    ):
        with pytest.raises(OptionError, match=message):
            write(dataset, target, overwrite=True)


@pytest.mark.parametrize(
    "call",
    [
        lambda ds: to_release(ds, 3, "lite"),  # type: ignore[arg-type]
        lambda ds: to_release(ds, "out", "heavy"),  # type: ignore[arg-type]
        lambda ds: to_published(ds, None),  # type: ignore[arg-type]
        lambda ds: to_minari(ds, b"out-v0"),  # type: ignore[arg-type]
        lambda ds: to_parquet(ds, 3.5),  # type: ignore[arg-type]
        lambda ds: from_published(None, "out"),  # type: ignore[arg-type]
        lambda ds: from_published("files", "out", kept_steps="many"),  # type: ignore[arg-type]
        lambda ds: combine_releases("out", str(ds.root)),
        lambda ds: combine_releases("out", [ds.root], 5),  # type: ignore[arg-type]
        lambda ds: combine_releases(["out"], [ds.root]),  # type: ignore[arg-type]
        lambda ds: build_release(ds.root, 5),  # type: ignore[arg-type]
        lambda ds: upload_release(ds.root, None),  # type: ignore[arg-type]
        lambda ds: verify_release(ds.root, level=3),  # type: ignore[arg-type]
    ],
)
def test_wrong_arguments_raise_package_errors(lite, tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((OptionError, UnknownNameError)):
        call(load_icrl4aht(lite[0]))
    assert not list(tmp_path.iterdir())


def test_output_path_may_be_a_string(lite, tmp_path):
    assert to_release(load_icrl4aht(lite[0])[:1], str(tmp_path / "out"), "lite") == tmp_path / "out"
