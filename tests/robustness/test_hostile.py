"""Test that hostile releases, servers and files of the published code cause package errors or findings.

The errors and findings name the fault. All cases run in one separate process with bounded memory, see `hostile.run`.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
import pytest
from icrl4aht_generation.learners.checkpoint import POLICY_CARD, POLICY_WEIGHTS, load_policy
from safetensors.numpy import save_file

from icrl4aht_data.checking.report import Report
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError, OptionError, UnsafePathError
from icrl4aht_data.format.manifest import parse_manifest, write_manifest
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.utils.files import atomic_write, parse_json, resolve_inside
from tests.helpers.commands import run_cli
from tests.robustness.hostile.cases import CASES, TERABYTE
from tests.robustness.hostile.run import limit_process, make_valid_inputs, run_case

SECONDS = 400
"""Time for one case."""
DISK_BYTES = 64 * 2**20
"""Most that the steps of a case may write."""


@pytest.fixture(scope="module")
def run_hostile_case(tmp_path_factory) -> Iterator[Callable[[str], dict[str, Any]]]:
    """Yield a function that runs the case of a given name in a process with bounded memory."""
    folder = tmp_path_factory.mktemp("hostile")
    make_valid_inputs(folder)
    context = multiprocessing.get_context("spawn")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPENBLAS_NUM_THREADS", "1")
        with ProcessPoolExecutor(1, context, initializer=limit_process) as pool:
            yield lambda name: pool.submit(run_case, folder, name).result(SECONDS)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if n % 8 == 0 else pytest.mark.slow) for n, name in enumerate(CASES)]
)
def test_hostile_input_causes_package_errors_without_side_effects(run_hostile_case, name):
    found = run_hostile_case(name)
    foreign = {step: outcome["said"] for step, outcome in found["steps"].items() if not outcome["ours"]}
    assert not foreign, foreign
    assert not found["touched"], "a file of the release or outside of it was changed"
    assert not found["leaked"], f"a secret outside of the release was read: {found['leaked']}"
    assert found["taken"] < DISK_BYTES
    said = [outcome["said"] for outcome in found["steps"].values()]
    assert any(re.search(CASES[name].message, text) for text in said), said


def policy_card(**changes: Any) -> str:
    return json.dumps({"widths": {"gru": 8}, "partners": 0, "shapes": {"params/a": [2]}} | changes)


@pytest.mark.parametrize(
    ("policy", "weights", "message"),
    [
        (policy_card(widths={"gru": 2**40}), None, "gru = 1099511627776: expected `int` <= 8192"),
        (policy_card(widths={"spatial": [1] * 10**6}), None, "expected `array` of length <= 16"),
        (policy_card(shapes={"params/a": [2**40]}), None, "the card states"),
        ("[]", None, "policy.json is not a JSON object"),
        (policy_card(), (2**63 - 1).to_bytes(8, "little") + b"{}", "not a checkpoint"),
        (
            policy_card(),
            (50).to_bytes(8, "little") + b'{"a":{"dtype":"F32","shape":[1000000000],"data_offsets":[0,4000000000]}}',
            "not a",
        ),
        (policy_card(), {"a": 1, "a/b": 1}, "not a checkpoint|the card states"),
        (policy_card(), TERABYTE, "expected at most"),
    ],
)
def test_hostile_checkpoints_are_refused(tmp_path, policy, weights, message):
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


def test_checkpoint_that_is_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / POLICY_CARD)
    with pytest.raises(OptionError, match="not a regular file"):
        load_policy(tmp_path)


def test_atomic_write_does_not_follow_links(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / ".file.partial").symlink_to(tmp_path / "mine")
    with atomic_write(tmp_path / "file") as partial:
        partial.write_text("new")
    assert ((tmp_path / "mine").read_text(), (tmp_path / "file").read_text()) == ("mine", "new")


def test_names_are_printed_without_interpreting_markup(release_copy):
    path = release_copy / "meta" / "histories.jsonl"
    path.write_text(path.read_text().replace("_coord_", "[/b][link=file:///]_coord_"))
    write_manifest(release_copy)
    assert "[/b][link=file:///]" in run_cli("list", release_copy)


def test_parse_json_limits_the_depth_of_nesting():
    assert parse_json('{"a": [[1]]}') == {"a": [[1]]}
    with pytest.raises(IndexFormatError, match="levels, found more"):
        parse_json("[" * 65 + "]" * 65)


def test_file_names_reserved_by_microsoft_windows_are_refused(tmp_path):
    for name in ("con", "meta/NUL.json", "com1.h5/x", "a./b", "a /b", "data/teammate/aux/train.h5"):
        with pytest.raises(Icrl4ahtError, match="points outside"):
            parse_manifest(f"{'0' * 64}  {name}\n", "MANIFEST")
        with pytest.raises(Icrl4ahtError, match="points outside"):
            resolve_inside(tmp_path, name)


FOREIGN = (
    *(".git/config", ".gitattributes", ".ssh/authorized_keys", ".env", "meta/.hidden.json", "data/.git/config/x.h5"),
    *("sitecustomize.py", "conftest.py", "evil.pth", "meta/__pycache__/info.pyc", "Makefile", "setup.cfg", "a.so"),
    *("meta/new.json", "meta/info.json/x", "data/teammate/x.py", "figures/x.html", "MANIFEST.sha256"),
    *(f"teammates/{'0' * 64}/policy.pt", "teammates/m0/policy.json", "index/x/../../x/a.parquet"),
    *("episodes/a.parquet", "episodes/demo_wide/train.py", "episodes/demo_wide/x/train.parquet"),
)


@pytest.mark.parametrize("name", FOREIGN)
def test_unknown_file_names_in_a_manifest_are_refused(release_copy, name):
    line = f"{'0' * 64}  {name}\n"
    with pytest.raises(UnsafePathError, match=r"not a file that a release may contain|points outside"):
        parse_manifest(line, "MANIFEST")
    with (release_copy / MANIFEST).open("a") as stream:
        stream.write(line)
    assert MANIFEST in verify_release(release_copy).files_at_fault
    (release_copy / "sitecustomize.py").write_text("")
    with pytest.raises(UnsafePathError, match=r"'sitecustomize\.py' is not a file that a release may .*; remove it"):
        write_manifest(release_copy)


@pytest.mark.parametrize(
    "name",
    [
        *("README.md", "LICENSE", "CITATION.cff", "croissant.json", "meta/source_card.md", "figures/layouts.png"),
        *("index/demo_wide/train.parquet", f"experts/{'a' * 64}/policy.safetensors", f"teammates/{'a' * 64}/README.md"),
        "episodes/demo_wide/train-00000-of-00002.parquet",
        *("data/layout/coord_ring/train-00000-of-00010.h5", "meta/chunks/layout/coord_ring/train-00000-of-00010.npy"),
    ],
)
def test_known_file_names_in_a_manifest_are_accepted(name):
    assert list(parse_manifest(f"{'0' * 64}  {name}\n", "MANIFEST")) == [name]


def test_findings_are_escaped_and_limited_in_number_and_length():
    report = Report("r")
    report.add("a\x1b[2J\udcff", "x" * 10_000)
    for _ in range(100_009):
        report.add("a", "x")
    assert len(report.findings) == 100_001
    assert report.findings[0].file == r"a\x1b[2J\udcff"
    assert len(report.findings[0].problem) < 3000
