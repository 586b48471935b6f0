"""Test releases built for publication: files, card and machine-readable descriptions."""

from __future__ import annotations

import datetime
import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.errors import OptionError, ReleaseError
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.publishing.build import build_release
from icrl4aht_data.writing.convert import to_release
from tests.helpers.commands import run_cli
from tests.helpers.paths import ROOT
from tests.helpers.random_releases import random_release
from tests.helpers.tampered import read_lines

DAY = datetime.date(2026, 1, 2)


@pytest.fixture(scope="session")
def release(tmp_path_factory) -> Path:
    """Return a full release of random play with both tracks and the splits train and test (read-only)."""
    root = tmp_path_factory.mktemp("source") / "release"
    random_release(root, "full", ("coord_simple", "cramped_up", "cramped_down"), streams=2)
    return root


@pytest.fixture(scope="session")
def published_release(release, tmp_path_factory) -> Path:
    """Return the fixture `release`, built for publication (read-only)."""
    return build_release(release, tmp_path_factory.mktemp("published") / "release", published=DAY)


def front_matter(card: str) -> dict:
    return yaml.safe_load(card.split("---\n")[1])


def test_published_release_is_valid_and_contains_the_source_files(release, published_release):
    report = verify_release(published_release, level="deep")
    assert report.ok, report.findings
    old, new = read_manifest(release), read_manifest(published_release)
    assert {name for name in old if new[name] != old[name]} == {"README.md"}
    assert new.keys() - old.keys() == {
        "card.json",
        "CITATION.cff",
        "LICENSE",
        "croissant.json",
        "episodes/coord_simple/train-00000-of-00001.parquet",
        "episodes/cramped_down/test-00000-of-00001.parquet",
        "episodes/cramped_up/train-00000-of-00001.parquet",
        "figures/layouts.png",
        "figures/learning_curves.png",
        "index/coord_simple/train.parquet",
        "index/cramped_down/test.parquet",
        "index/cramped_up/train.parquet",
    }
    for name in ("LICENSE", "CITATION.cff"):
        assert (published_release / name).read_bytes() == (ROOT / name).read_bytes()


def test_build_release_refuses_an_invalid_source(release_copy, tmp_path):
    shard = next(release_copy.rglob("*.h5"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"?")
    with pytest.raises(ReleaseError, match=r"release: not valid: .*\.h5: sha256: expected .*; see `icrl4aht"):
        build_release(release_copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(OptionError, match=r"release: overlaps the input folder .*release;"):
        build_release(release_copy, release_copy)


def test_changes_during_copying_are_detected(release_copy, tmp_path):
    def change_copied_file(what, done, total):
        if what == "copying" and done == total:
            (tmp_path / ".out.partial/meta/provenance.json").write_text("{}")

    with pytest.raises(ReleaseError, match=r"provenance\.json: changed while it was copied; sha256 is now"):
        build_release(release_copy, tmp_path / "out", advance=change_copied_file)
    assert not (tmp_path / "out").exists()


def test_hugging_face_datasets_loads_every_configuration(published_release, tmp_path):
    import datasets

    names = datasets.get_dataset_config_names(str(published_release))
    assert names == ["default", "coord_simple", "cramped_up", "cramped_down", "episodes"]
    found = {}
    for name in (None, "cramped_down"):
        loaded: Any = datasets.load_dataset(str(published_release), name, cache_dir=str(tmp_path))
        found[name] = {split: sorted(rows["history_id"]) for split, rows in loaded.items()}
    index = load_icrl4aht(published_release).index
    assert found == {
        None: {split: index.query(split=split).tolist() for split in ("train", "test")},
        "cramped_down": {"test": index.query(split="test", layout="cramped_down").tolist()},
    }


def test_croissant_file_is_valid_and_its_records_equal_the_index(published_release):
    import mlcroissant

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # dependencies of mlcroissant raise warnings
        described = mlcroissant.Dataset(str(published_release / "croissant.json"))
        records = list(described.records("histories"))
        episodes = list(described.records("episodes"))
    assert (described.metadata.ctx.issues.errors, described.metadata.ctx.issues.warnings) == (set(), set())
    lines = read_lines(published_release / "meta/histories.jsonl")
    assert len(records) == len(lines)
    for record in records:
        found = {name.removeprefix("histories/"): value for name, value in record.items()}
        plain: dict[str, Any] = {
            name: value.decode() if isinstance(value, bytes) else value for name, value in found.items()
        }
        line = lines[plain["history_id"]]
        assert plain.pop("h5_row") in (line.pop("h5_row"), None) or np.isnan(found["h5_row"])
        omitted = ("expert_return", "expert_return_sampled", "expert_step", "label_view", "teammate_of_episode")
        assert plain == dict.fromkeys(omitted) | line, "lines leave out these fields if they are None"
    history = load_icrl4aht(published_release).history(int(episodes[0]["episodes/history_id"]))
    np.testing.assert_array_equal(episodes[0]["episodes/actions"], history.episodes[0].actions)
    assert len(episodes) == 12 * 6
    content = json.loads((published_release / "croissant.json").read_text())
    assert content["datePublished"] == "2026-01-02"
    assert [text.rsplit("/", 1)[1] for text in content["conformsTo"]] == ["1.1", "1.0"]
    assert content["rai:personalSensitiveInformation"] == "None."
    assert content["rai:dataCollectionType"] == "Software Collection" and len(content["rai:dataUseCases"]) > 50
    hashed = {part["@id"]: part["sha256"] for part in content["distribution"] if "sha256" in part}
    listed = read_manifest(published_release)
    assert hashed == {name: listed[name] for name in listed if name != "croissant.json"}


def test_croissant_file_of_human_histories_is_true_and_valid(tmp_path):
    import mlcroissant

    source = tmp_path / "source"
    random_release(source, "lite", ("cramped_down",), teammates=1, streams=1, labels=False, sources=["human"])
    root = build_release(source, tmp_path / "built", published=DAY)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # dependencies of mlcroissant raise warnings
        described = mlcroissant.Dataset(str(root / "croissant.json"))
    assert (described.metadata.ctx.issues.errors, described.metadata.ctx.issues.warnings) == (set(), set())
    content = json.loads((root / "croissant.json").read_text())
    assert "1 history, 120 transitions" in content["description"] and "labels" not in content["description"]
    assert "There are no labels." in content["rai:dataAnnotationProtocol"]
    assert content["rai:dataPreprocessingProtocol"] == "Histories of human have all finished episodes."
    limits = content["rai:dataLimitations"]
    assert len(limits) > 2 and all(f"* {limit}\n" in (root / "README.md").read_text() for limit in limits)


def test_the_card_describes_the_release(published_release):
    card = (published_release / "README.md").read_text()
    facts = front_matter(card)
    assert facts["license"] == "mit"
    assert facts["task_categories"] == ["reinforcement-learning"]
    assert [config["config_name"] for config in facts["configs"] if config.get("default")] == ["default"]
    patterns = [file["path"] for config in facts["configs"] for file in config["data_files"]]
    assert all(list(published_release.glob(pattern)) for pattern in patterns)
    assert "12 histories of 6 tasks, 1,440 transitions; each history has 120 steps." in card
    assert re.search(r"\| coord_simple \| train \| \S+→\S+ \(4\) \|", card)
    assert "coord_simple/H4. `cards/headroom.md`" in card, "no cell of cramped_down"
    for name in re.findall(r"!\[.*?\]\((.*?)\)", card):
        assert (published_release / name).read_bytes().startswith(b"\x89PNG"), name
    assert len(re.findall(r"!\[", card)) == 2


def test_code_snippets_of_the_card_run(published_release, monkeypatch):
    snippets = re.findall(r"```python\n(.*?)```", (published_release / "README.md").read_text(), re.DOTALL)
    assert len(snippets) == 2
    for snippet in snippets:
        exec(snippet.replace("path/of/this/folder", str(published_release)), {})


def test_build_release_accepts_learned_teammates(tmp_path):
    part = load_icrl4aht(teammate_family="rl", teammate_kind="fcp")[:1]
    out = build_release(to_release(part, tmp_path / "source", "lite"), tmp_path / "out")
    report = verify_release(out, level="deep")
    assert report.ok, report
    assert [note.split(",")[0] for note in report.notes] == ["returns of reference egos", "nearest test teammates"]
    card = (out / "README.md").read_text()
    assert "policies learned by fcp, which act greedily" in card
    assert "in place of the learned teammates" not in card
    assert verify_release(build_release(out, tmp_path / "again")).ok


def test_release_build_command_accepts_releases_of_observations(release, tmp_path):
    source, out = to_release(load_icrl4aht(release), tmp_path / "source", "observations"), tmp_path / "out"
    summary = json.loads(run_cli("release", "build", "--json", source, "--out", out))
    assert set(summary["files"]) == set(read_manifest(out))
    assert summary["bytes"] > 10_000
    assert verify_release(out).ok
    card = (out / "README.md").read_text()
    assert "without state records nothing can be replayed" in card
    assert "there is no configuration `episodes`" in card
    assert not (out / "episodes").exists()
    assert [config["config_name"] for config in front_matter(card)["configs"]][-1] == "cramped_down"
    assert "`state`" not in card
