"""A release made ready for other people: what is in it, that its card and descriptions are true and valid."""

from __future__ import annotations

import datetime
import hashlib
import json
import re
import shutil
import tomllib
import warnings
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import IndexFormatError, OptionError, ReleaseError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import read_manifest, write_manifest
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import FIELDS, JSON_TYPES
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.publishing.build import build_release, teammate_card
from icrl4aht_data.utils.templates import card_file, fill
from icrl4aht_data.writing.card_texts import card_texts
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.dataset_card import dataset_card, evaluated_on, size_category
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from tests.helpers.paths import ROOT
from tests.helpers.random_play import play, random_release

DAY = datetime.date(2026, 1, 2)


@pytest.fixture(scope="session")
def release(tmp_path_factory) -> Path:
    """Random play on layouts of both tracks, of the training and the test split, one of them full. Read only."""
    root = tmp_path_factory.mktemp("source") / "release"
    random_release(root, "full", ("coord_simple", "cramped_up", "cramped_down"), streams=2)
    return root


@pytest.fixture(scope="session")
def published(release, tmp_path_factory) -> Path:
    """What is built of it. Read only."""
    return build_release(release, tmp_path_factory.mktemp("published") / "release", published=DAY)


@pytest.fixture(scope="session")
def beside_learned(tmp_path_factory) -> Path:
    """A release of one task beside a learned teammate, with a checkpoint. Read only."""
    folder = tmp_path_factory.mktemp("learned")
    weights = folder / "policy.safetensors"
    weights.write_bytes(b"weights")
    digest = hashlib.sha256(b"weights").hexdigest()
    facts = {
        "algorithm": "fcp",
        "layout": "demo_wide",
        "member": 1,
        "checkpoint": 4,
        "step": 4000,
        "seed": 0,
        "code_version": "0.1.0",
        "seats": [0, 1],
        "return": 40.0,
        "teammate_return": 35.5,
        "return_of": "16 episodes",
        "widths": {"pointwise": [4], "gru": 8},
    }
    (folder / "policy.json").write_text(json.dumps(facts))
    theta = {"checkpoint": "demo_wide/fcp/m1/c4", "sha256": digest}
    teammate = {"kind": "rl", "family": "fcp", "theta_id": 0, "base_seed": 0, "theta": theta}
    task = make_task("teammate", "train", "demo_wide", teammate, 0)
    arrays = play(get_layout("demo_wide"), 6, 20, np.random.default_rng(0))
    files = {f"teammates/{digest}/{path.name}": path for path in (weights, folder / "policy.json")}
    new = NewTask(task, Provenance(), 1, lambda: [NewHistory(0, arrays)], files)
    return write_release(folder / "release", "lite", [new], data_version="0.0.1", kept_steps=20)


def front_matter(card: str) -> dict:
    return yaml.safe_load(card.split("---\n")[1])


def test_it_holds_the_source_and_is_whole(release, published):
    report = verify_release(published, level="deep")
    assert report.ok, report.findings
    made_anew = {"README.md"}
    old, new = read_manifest(release), read_manifest(published)
    assert {name: new[name] for name in old if name not in made_anew} == {
        name: digest for name, digest in old.items() if name not in made_anew
    }
    assert new.keys() - old.keys() == {
        "CITATION.cff",
        "LICENSE",
        "croissant.json",
        "figures/headroom.png",
        "figures/layouts.png",
        "figures/learning_curves.png",
        "index/coord_simple/train.parquet",
        "index/cramped_down/test.parquet",
        "index/cramped_up/train.parquet",
        "meta/source_card.md",
    }
    assert (published / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert (published / "CITATION.cff").read_bytes() == (ROOT / "CITATION.cff").read_bytes()


def test_built_of_a_built_one_it_is_the_same(published, tmp_path):
    again = build_release(published, tmp_path / "again", published=DAY)
    assert (again / "MANIFEST.sha256").read_bytes() == (published / "MANIFEST.sha256").read_bytes()


def test_a_combination_of_built_ones_says_of_what(published, tmp_path):
    random_release(tmp_path / "other", "full", ("demo_wide",))
    both = combine_releases(tmp_path / "both", [published, tmp_path / "other"])
    card = (both / "README.md").read_text()
    tasks = len((both / "meta/tasks.jsonl").read_text().splitlines())
    assert f"* {len(load_icrl4aht(both)):,} histories of {tasks} tasks" in card
    assert "![" not in card
    sources = (both / "meta/source_card.md").read_text()
    assert sources.count("SHA-256 of its manifest") == 2
    kept = (published / "meta/source_card.md").read_text()
    assert kept in sources
    assert "# test\n" in sources and "12 histories of 6 tasks" in sources
    assert "pretty_name" not in sources and "![" not in sources
    assert verify_release(both).ok
    out = build_release(both, tmp_path / "out")
    assert verify_release(out).ok
    assert (out / "meta/source_card.md").read_text() == sources


def test_links_are_not_written_through(published, tmp_path):
    """A built release whose card somebody rewrote."""
    source = tmp_path / "source"
    shutil.copytree(published, source)
    (source / "README.md").write_text("# mine\n")
    write_manifest(source)
    build_release(source, tmp_path / "linked", link=True)
    assert verify_release(source).ok
    assert verify_release(tmp_path / "linked").ok


def test_links_cost_no_space(release, tmp_path):
    linked = build_release(release, tmp_path / "linked", link=True)
    shard = load_icrl4aht(release).entries[0].shard
    assert (linked / shard).stat().st_ino == (release / shard).stat().st_ino
    assert verify_release(linked).ok


def test_a_source_that_is_not_whole_is_refused(damaged, tmp_path):
    shard = next(damaged.rglob("*.h5"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"?")
    with pytest.raises(ReleaseError, match=r"release: not valid: .*\.h5: sha256: expected .*; see `icrl4aht"):
        build_release(damaged, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(OptionError, match="the release itself"):
        build_release(damaged, damaged)


def test_what_changes_while_it_is_copied_is_noticed(damaged, tmp_path):
    def change(what, done, total):
        if what == "copying" and done == total:
            (tmp_path / ".out.partial/meta/provenance.json").write_text("{}")

    with pytest.raises(ReleaseError, match=r"provenance\.json: changed while it was copied, sha256 now"):
        build_release(damaged, tmp_path / "out", advance=change)
    assert not (tmp_path / "out").exists()


def test_the_index_and_its_twin_say_the_same(published):
    import pyarrow.parquet as pq

    lines = [json.loads(line) for line in (published / "meta/histories.jsonl").read_text().splitlines()]
    tables = [pq.read_table(path) for path in sorted((published / "index").glob("*/*.parquet"))]
    assert len({str(table.schema) for table in tables}) == 1
    rows = [row for table in tables for row in table.to_pylist()]
    assert sorted(rows, key=lambda row: row["history_id"]) == lines


def test_datasets_loads_every_configuration(published, tmp_path):
    import datasets

    names = datasets.get_dataset_config_names(str(published))
    assert names == ["default", "coord_simple", "cramped_up", "cramped_down"]
    found = {}
    for name in (None, "cramped_down"):
        loaded: Any = datasets.load_dataset(str(published), name, cache_dir=str(tmp_path))
        found[name] = {split: sorted(rows["history_id"]) for split, rows in loaded.items()}
    index = load_icrl4aht(published).index
    for name, asked in ((None, {}), ("cramped_down", {"layout": "cramped_down"})):
        splits = {"train", "test"} if name is None else {"test"}
        assert found[name] == {split: index.query(split=split, **asked).tolist() for split in splits}


def test_croissant_is_valid_and_its_records_are_the_index(published):
    import mlcroissant

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what mlcroissant is built on
        described = mlcroissant.Dataset(str(published / "croissant.json"))
        records = list(described.records("histories"))
    assert (described.metadata.ctx.issues.errors, described.metadata.ctx.issues.warnings) == (set(), set())
    lines = [json.loads(line) for line in (published / "meta/histories.jsonl").read_text().splitlines()]
    assert len(records) == len(lines)
    for record in records:
        found = {name.removeprefix("histories/"): value for name, value in record.items()}
        plain: dict[str, Any] = {
            name: value.decode() if isinstance(value, bytes) else value for name, value in found.items()
        }
        line = lines[plain["history_id"]]
        assert plain.pop("h5_row") in (line.pop("h5_row"), None) or np.isnan(found["h5_row"])
        assert plain == line
    content = json.loads((published / "croissant.json").read_text())
    assert content["datePublished"] == "2026-01-02"
    assert content["conformsTo"].endswith("/1.1")
    hashed = {part["@id"]: part["sha256"] for part in content["distribution"] if "sha256" in part}
    listed = read_manifest(published)
    assert hashed == {name: listed[name] for name in listed if name != "croissant.json"}


def test_the_card_says_what_the_release_is(published):
    card = (published / "README.md").read_text()
    facts = front_matter(card)
    assert facts["license"] == "mit"
    assert facts["task_categories"] == ["reinforcement-learning"]
    assert facts["size_categories"] == ["1K<n<10K"]
    assert [config["config_name"] for config in facts["configs"] if config.get("default")] == ["default"]
    files = {name for config in facts["configs"] for name in config["data_files"] for name in [name["path"]]}
    assert all(list(published.glob(pattern)) for pattern in files)
    assert "12 histories of 6 tasks, 1,440 transitions; each history has 120 steps." in card
    assert "| coord_simple | train | utility_greedy | 2 | 4 |" in card
    assert "| teammate | train | coord_simple | 2 | 4 | 480 |" in card
    assert "On coord_simple the ego's room shares nothing" in card
    assert "| family | coord_simple | cramped_down |" in card
    assert "`meta/source_card.md`" in card
    assert (published / "meta/source_card.md").read_text() == "# test\n"
    for name in re.findall(r"!\[.*?\]\((.*?)\)", card):
        assert (published / name).read_bytes().startswith(b"\x89PNG"), name
    assert len(re.findall(r"!\[", card)) == 3


def test_the_cards_snippet_runs(published, monkeypatch):
    (snippet,) = re.findall(r"```python\n(.*?)```", (published / "README.md").read_text(), re.DOTALL)
    exec(snippet.replace("path/of/this/folder", str(published)), {})


def test_a_release_that_nobody_published_has_a_card_without_pictures(release):
    card = dataset_card(release)
    assert "figures/" not in card
    assert "configs" not in front_matter(card)
    assert "Not recorded" in card


@pytest.mark.parametrize(
    "provenance",
    ['{"a": 1}', '{"a": {"ego": 3}}', "[]", '{"a": {"ego": {"total_steps": "many", "environments": 2}}}'],
)
def test_a_provenance_of_another_form_is_named(damaged, provenance):
    (damaged / "meta/provenance.json").write_text(provenance)
    with pytest.raises(IndexFormatError, match=r"provenance\.json: not as `generation` writes it"):
        dataset_card(damaged)


@pytest.mark.parametrize(
    "algorithms", [{"algorithms": {"demo_wide": ["fcp"]}}, {"algorithms": ["fcp"], "layouts": ["demo_wide"]}]
)
def test_the_card_says_where_learned_teammates_are_missing(damaged, algorithms):
    """Also of a combination, whose tasks come from several suites."""
    suite = algorithms | {"members": 2, "train": 3, "total_steps": 10**6, "threshold": 20.0}
    path = damaged / "meta/provenance.json"
    suites = chain([suite | {"train": 1}], repeat(suite))
    path.write_text(json.dumps({task: {"suite": next(suites)} for task in json.loads(path.read_text())}))
    card = dataset_card(damaged)
    assert "Learned teammates on demo_wide: populations of 2 by fcp, 1,000,000 steps per member" in card
    others = ", ".join(name for name in read_info(damaged).layouts if name != "demo_wide")
    assert f"* No learned teammates on {others}: the profile trains only with presets of H4 there." in card
    assert "fewer training teammates than its profile asks for: fcp on demo_wide (0 of 3)." in card


def test_sizes_have_the_hubs_names():
    names = [size_category(rows) for rows in (0, 999, 1000, 10**6 - 1, 10**6, 10**12)]
    assert names == ["n<1K", "n<1K", "1K<n<10K", "100K<n<1M", "1M<n<10M", "n>1T"]


def test_those_who_learn_on_a_layout_are_tested_on_these():
    assert evaluated_on(["demo_wide", "asymm_both"]) == ["demo_wide", "asymm_right", "cramped_down"]
    assert evaluated_on(["cramped_up", "cramped_down"]) == ["cramped_down"]


def test_every_field_is_described():
    assert list(card_texts("arrays")) == list(FIELDS)
    assert list(card_texts("index")) == list(JSON_TYPES)


def test_learned_teammates_have_cards(beside_learned, tmp_path):
    out = build_release(beside_learned, tmp_path / "out")
    (folder,) = (out / "teammates").iterdir()
    card = (folder / "README.md").read_text()
    assert front_matter(card)["tags"][-1] == "fcp"
    assert "member 1 of a\npopulation trained with fcp, checkpoint 4, after 4,000 environment steps" in card
    assert "| mean return as a teammate | 35.5 |" in card
    assert folder.name in card
    report = verify_release(out, level="deep")
    assert report.ok and not report.notes, report
    assert not (out / "meta/source_card.md").exists()
    card = (out / "README.md").read_text()
    assert "policies learned by fcp, which act greedily" in card
    assert "in place of the learned teammates" not in card
    assert verify_release(build_release(out, tmp_path / "again")).ok


@pytest.mark.parametrize(
    ("name", "value"),
    [("algorithm", "x\nlicense: none"), ("layout", "nowhere"), ("step", "many"), ("widths", 3), ("seed", None)],
)
def test_a_teammate_that_is_not_one_is_named(beside_learned, tmp_path, name, value):
    shutil.copytree(beside_learned / "teammates", tmp_path / "teammates")
    (path,) = tmp_path.glob("teammates/*/policy.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}))
    with pytest.raises(IndexFormatError, match=r"policy\.json: not the card of a learned teammate"):
        teammate_card(path.parent)


def test_observations_alone_are_published_too(release, tmp_path):
    from icrl4aht_data.writing.convert import to_release

    source = to_release(load_icrl4aht(release), tmp_path / "source", "observations")
    out = build_release(source, tmp_path / "out")
    assert verify_release(out).ok
    card = (out / "README.md").read_text()
    assert "without state records nothing can be replayed" in card
    assert "`state`" not in card


def test_the_card_of_a_baseline_takes_what_it_names():
    names = set(re.findall(r"\$([a-z_]+)", card_file("baseline.md").read_text()))
    card = fill("baseline.md", **{name: f"<{name}>" for name in names})
    assert front_matter(card)["license"] == "mit"
    assert "| method | <method> |" in card


def test_cards_are_found_in_a_checkout_and_in_an_installed_package(tmp_path):
    names = ("dataset.md", "teammate.md", "headroom.json", "citation.bib", "LICENSE", "CITATION.cff")
    assert {card_file(name).relative_to(ROOT).as_posix() for name in names} == {
        *(f"cards/{name}" for name in names[:4]),
        *names[4:],
    }
    included = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    for source, target in included["force-include"].items():  # as the wheel is packed
        (tmp_path / target).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (ROOT / source).is_dir() else shutil.copyfile
        copy(ROOT / source, tmp_path / target)
    for name in names:
        assert card_file(name, tmp_path / "icrl4aht_data") == tmp_path / "icrl4aht_data/cards" / name
    with pytest.raises(OptionError, match=r"cards/nothing\.md: missing; install icrl4aht-data again"):
        card_file("nothing.md")


def test_both_forms_of_the_citation_agree():
    cited = yaml.safe_load(card_file("CITATION.cff").read_text())["preferred-citation"]
    text = " ".join(card_file("citation.bib").read_text().split())
    authors = " and ".join(f"{author['family-names']}, {author['given-names']}" for author in cited["authors"])
    assert f"author = {{{authors}}}" in text
    assert f"title = {{{cited['title']}}}" in text
    assert f"year = {{{cited['year']}}}" in text


def test_the_command_builds(release, tmp_path):
    out = tmp_path / "out"
    result = CliRunner().invoke(cli, ["release", "build", "--json", str(release), str(out)])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.output)
    assert set(summary["files"]) == set(read_manifest(out))
    assert summary["bytes"] > 10_000
    result = CliRunner().invoke(cli, ["release", "build", str(release), str(release), str(out)])
    assert result.exit_code == 2


def test_without_its_libraries_it_says_what_to_install(release, tmp_path, monkeypatch):
    monkeypatch.setattr("icrl4aht_data.publishing.build.find_spec", lambda name: None if name == "pyarrow" else name)
    with pytest.raises(OptionError, match=r"needs pyarrow: pip install 'icrl4aht-data\[plot,hf\]'"):
        build_release(release, tmp_path / "out")


def test_a_manifest_that_is_none_is_named(damaged):
    (damaged / "MANIFEST.sha256").write_text("abc  meta/info.json\n")
    with pytest.raises(IndexFormatError, match=r"MANIFEST\.sha256, line 1: expected '<sha256>  <path>'"):
        read_manifest(damaged)
    write_manifest(damaged)
    assert verify_release(damaged).ok
