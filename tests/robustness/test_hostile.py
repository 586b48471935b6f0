"""Hostile releases, published files and servers: an error of ours that names the fault, or a finding, and nothing else.

The cases of a kind run in one process of their own, whose memory is bounded: see `hostile_run`.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from safetensors.numpy import save_file

from generation.learners.checkpoint import POLICY_CARD, POLICY_WEIGHTS, load_policy
from icrl4aht_data.checking.report import Report
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError, OptionError
from icrl4aht_data.format.manifest import parse_manifest
from icrl4aht_data.remote.download import ORIGIN, repair
from icrl4aht_data.utils.files import atomic_write, parse_json
from tests.helpers.paths import ROOT
from tests.robustness.hostile_folders import CASES, TERABYTE
from tests.robustness.hostile_published import PUBLISHED_CASES
from tests.robustness.hostile_served import SERVED

TOGETHER = 480  # seconds for all cases of a kind
TAKEN = 64 * 2**20  # bytes of disk


def outcomes(kind: str, folder: Path) -> dict[str, dict[str, Any]]:
    """What came of each case; a case that is missing killed the process, or held it up."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.robustness.hostile_run", kind, str(folder)]
    with (folder / "out.jsonl").open("wb") as out, (folder / "errors.txt").open("wb") as errors:
        process = subprocess.Popen(command, stdout=out, stderr=errors, env=environment)
        try:
            process.wait(TOGETHER)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    lines = [json.loads(line) for line in (folder / "out.jsonl").read_text().splitlines()]
    found = {line["case"]: line for line in lines}
    return found | {"": {"died": (folder / "errors.txt").read_text()[-2000:]}}


@pytest.fixture(scope="module")
def releases(tmp_path_factory) -> dict[str, dict[str, Any]]:
    return outcomes("releases", tmp_path_factory.mktemp("hostile"))


@pytest.fixture(scope="module")
def published(tmp_path_factory) -> dict[str, dict[str, Any]]:
    return outcomes("published", tmp_path_factory.mktemp("hostile"))


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> dict[str, dict[str, Any]]:
    return outcomes("served", tmp_path_factory.mktemp("hostile"))


def check(found: dict[str, dict[str, Any]], name: str, message: str) -> None:
    assert name in found, f"the process ended before: {found['']['died']}"
    came = found[name]
    foreign = {step: outcome["said"] for step, outcome in came["steps"].items() if not outcome["ours"]}
    assert not foreign, foreign
    assert not came["touched"], "something outside, or of the release, was changed"
    assert not came["leaked"], f"what lies outside was read: {came['leaked']}"
    assert came["taken"] < TAKEN
    said = [outcome["said"] for outcome in came["steps"].values()]
    assert any(re.search(message, text) for text in said), said


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_release(releases, name):
    check(releases, name, CASES[name][1])


@pytest.mark.parametrize("name", PUBLISHED_CASES)
def test_hostile_published_files(published, name):
    check(published, name, PUBLISHED_CASES[name][1])


@pytest.mark.parametrize("name", SERVED)
def test_a_hostile_server(served, name):
    check(served, name, SERVED[name][1])


def card(**changes: Any) -> str:
    return json.dumps({"widths": {"gru": 8}, "partners": 0, "shapes": {"params/a": [2]}} | changes)


@pytest.mark.parametrize(
    ("policy", "weights", "message"),
    [
        (card(widths={"gru": 2**40}), None, "positive whole numbers up to"),
        (card(widths={"spatial": [1] * 10**6}), None, "positive whole numbers up to"),
        (card(widths=[8]), None, "not a checkpoint"),
        (card(shapes={"params/a": [2**40]}), None, "the card states"),
        ("[]", None, "expected an object"),
        ("[" * 10**5, None, "not a checkpoint"),
        (card(), (2**63 - 1).to_bytes(8, "little") + b"{}", "not a checkpoint"),
        (
            card(),
            (50).to_bytes(8, "little") + b'{"a":{"dtype":"F32","shape":[1000000000],"data_offsets":[0,4000000000]}}',
            "not a",
        ),
        (card(), {"a": 1, "a/b": 1}, "not a checkpoint|the card states"),
        (card(), TERABYTE, "expected at most"),
    ],
)
def test_a_hostile_checkpoint(tmp_path, policy, weights, message):
    (tmp_path / POLICY_CARD).write_text(policy)
    path = tmp_path / POLICY_WEIGHTS
    if isinstance(weights, bytes):
        path.write_bytes(weights)
    elif isinstance(weights, int):
        with path.open("wb") as stream:
            stream.truncate(weights)
    else:
        save_file({name: np.zeros(2, np.float32) for name in weights or {"params/a": 1}}, path)
    with pytest.raises(OptionError, match=message):
        load_policy(tmp_path)


def test_a_pipe_for_a_checkpoint(tmp_path):
    os.mkfifo(tmp_path / POLICY_CARD)
    with pytest.raises(OptionError, match="not a plain file"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    "url", ["local:///etc", "reference://x", "simplecache::https://host/x", "memory://x", "git://x/y", "python://"]
)
def test_a_note_does_not_choose_a_protocol(damaged, url):
    (damaged / ORIGIN).write_text(json.dumps({"url": url, "files": []}))
    with pytest.raises(OptionError, match="give --from"):
        repair(damaged, ["README.md"])


def test_a_link_is_not_written_through(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / ".file.partial").symlink_to(tmp_path / "mine")
    with atomic_write(tmp_path / "file") as partial:
        partial.write_text("new")
    assert ((tmp_path / "mine").read_text(), (tmp_path / "file").read_text()) == ("mine", "new")


def test_names_are_no_markup(damaged):
    path = damaged / "meta" / "histories.jsonl"
    path.write_text(path.read_text().replace("_coord_", "[/b][link=file:///]_coord_"))
    result = CliRunner().invoke(cli, ["list", str(damaged)], catch_exceptions=False)
    assert "[/b][link=file:///]" in result.output


def test_depth_of_json():
    assert parse_json('{"a": [[1]]}') == {"a": [[1]]}
    with pytest.raises(IndexFormatError, match="levels deep"):
        parse_json("[" * 65 + "]" * 65)


def test_names_that_windows_keeps(tmp_path):
    for name in ("con", "meta/NUL.json", "com1.h5/x", "a./b", "a /b"):
        with pytest.raises(Icrl4ahtError, match="leads out"):
            parse_manifest(f"{'0' * 64}  {name}\n", "MANIFEST")
    assert list(parse_manifest(f"{'0' * 64}  console/null.json\n", "MANIFEST")) == ["console/null.json"]


def test_findings_are_bounded_and_fit_for_a_terminal():
    report = Report("r")
    for _ in range(100_010):
        report.add("a\x1b[2J\udcff", "x" * 10_000)
    assert len(report.findings) == 100_001
    assert report.findings[0].file == r"a\x1b[2J\udcff"
    assert len(report.findings[0].problem) < 3000
