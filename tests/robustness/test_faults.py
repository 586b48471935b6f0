"""A sample of each family of `make bench-faults`, in which nothing may be lost, and faults that once lost something."""

from __future__ import annotations

import errno
import json
import shutil
import subprocess
import sys

import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.format.manifest import parse_manifest, write_manifest
from icrl4aht_data.utils.files import atomic_write
from tests.helpers.paths import ROOT
from tests.robustness.faults.series import FAMILIES, run
from tests.robustness.faults.workspace import Workspace
from tests.robustness.limits import file_size_limit

SLOW = {"cache build killed", "two readers at once", "two cache builds at once"}
"""Families of which one attempt takes more than a second."""
QUICK = {"bit flips": 9, "mutated index or manifest": 5, "disk full": 2, "damaged caches": 3}
"""Attempts in the default tests; one of every other family."""
LONG = {"bit flips": 1000, "damaged caches": 20, "mapped arrays' disk full": 1, "mutated index or manifest": 25}
"""Attempts in the slow tests; two of the families in `SLOW`, four of every other."""


@pytest.fixture(scope="module")
def workspace(tmp_path_factory) -> Workspace:
    return Workspace(tmp_path_factory.mktemp("faults"), seed=1)


def _attempts(name: str) -> int:
    return LONG.get(name, 2 if name in SLOW else 4)


@pytest.mark.parametrize(
    ("name", "count"),
    [(name, QUICK.get(name, 1)) for name in FAMILIES if name not in SLOW]
    + [pytest.param(name, _attempts(name), marks=pytest.mark.slow) for name in FAMILIES],
)
def test_nothing_is_lost(workspace, name, count, capsys):
    line = run(name, FAMILIES[name][0], workspace, count)
    assert (line["tried"], line["lost"]) == (count, 0), capsys.readouterr().err


@pytest.mark.slow
def test_no_full_disk_ends_a_process():
    """In a process of its own: writing to a map of a file on a full disk would end it by a signal."""
    command = [sys.executable, "-m", "tests.robustness.faults.series", "mapped arrays' disk full", "disk full"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [json.loads(line)["tried"] for line in done.stdout.splitlines()] == [20, 20, 40]


def test_episodes_one_step_shorter_by_a_flipped_bit(workspace, tmp_path):
    """15 steps become 14 by one bit, and 90 steps are six complete episodes of either length."""
    root = tmp_path / "release"
    shutil.copytree(workspace.small, root)
    info = root / "meta" / "info.json"
    info.write_text(info.read_text().replace('"kept_steps": 15', '"kept_steps": 14'))
    with pytest.raises(IndexFormatError, match=r"info\.json: expected sha256"):
        load_icrl4aht(root)
    write_manifest(root)
    dataset = load_icrl4aht(root, layout="demo_wide")
    with pytest.raises(OptionError, match="some history's episodes have not 14 steps; run `icrl4aht-data verify`"):
        dataset.ad(batch_size=4, length=5, episodes=(1, 4))


def test_a_manifest_without_its_last_byte_is_cut_off(workspace):
    text = (workspace.small / "MANIFEST.sha256").read_text()
    with pytest.raises(IndexFormatError, match=r"MANIFEST: cut off: its last line has no end"):
        parse_manifest(text[:-1], "MANIFEST")


def test_an_error_of_the_disk_names_the_file(tmp_path):
    path = tmp_path / "notes.json"
    with pytest.raises(OSError, match=r"notes\.json") as caught, file_size_limit(100), atomic_write(path) as partial:
        partial.write_bytes(bytes(200))
    assert caught.value.errno == errno.EFBIG
    assert not list(tmp_path.iterdir())
