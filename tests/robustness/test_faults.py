"""Every family of `make bench-faults` a few times: nothing is lost; and what each fault that was once lost needs."""

from __future__ import annotations

import errno
import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from filelock import FileLock

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.format.manifest import parse_manifest
from icrl4aht_data.utils.cache import cached_arrays
from icrl4aht_data.utils.files import atomic_write
from tests.robustness.faults.here import small_files
from tests.robustness.faults.scene import LostError, Scene
from tests.robustness.faults.series import FAMILIES, main, run

TRIES = {
    "429 with Retry-After": 3,
    "version changed": 2,
    "bit flips": 36,
    "mutated index or manifest": 25,
    "download killed": 2,
    "cache build killed": 2,
    "two downloads at once": 1,
    "two readers at once": 1,
    "s3: connection cut": 2,
    "s3: bursts of 5xx": 1,
    "s3: wrong bytes": 1,
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("faults"), seed=1)


@pytest.mark.parametrize("name", FAMILIES)
def test_nothing_is_lost(scene, name, capsys):
    count = TRIES.get(name, 4)
    line = run(name, FAMILIES[name][0], scene, count)
    assert (line["tried"], line["lost"]) == (count, 0), capsys.readouterr().err


def test_what_is_lost_is_counted(monkeypatch):
    def lose() -> None:
        raise LostError("a shard")

    monkeypatch.setitem(FAMILIES, "ranges ignored", (lambda scene, n: iter([lose, lambda: "odd", lambda: None]), 3))
    result = CliRunner().invoke(main, ["ranges ignored"])
    assert result.exit_code == 1
    line, total = (json.loads(line) for line in result.stdout.splitlines())
    assert (line["fault"], line["tried"], line["survived"], line["lost"], line["odd"]) == ("ranges ignored", 3, 2, 1, 1)
    assert (total["fault"], total["tried"], total["lost"]) == ("total", 3, 1)
    assert "LostError: a shard" in result.stderr


def test_the_command():
    result = CliRunner().invoke(main, ["ranges ignored", "--scale", "0.25"], catch_exceptions=False)
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout.splitlines()[0])["tried"] == 1


def test_episodes_shorter_than_they_are_by_one_bit(scene, tmp_path):
    """15 steps are 14 by one bit, and 90 steps have six whole episodes of either."""
    root = tmp_path / "release"
    shutil.copytree(scene.small, root)
    info = root / "meta" / "info.json"
    info.write_text(info.read_text().replace('"kept_steps": 15', '"kept_steps": 14'))
    dataset = load_icrl4aht(root, layout="demo_wide")
    with pytest.raises(OptionError, match="some history's episodes have not 14 steps; run `icrl4aht-data verify`"):
        dataset.ad(batch_size=4, length=5, episodes=(1, 4))


def test_a_manifest_without_its_last_byte_is_cut_off(scene):
    text = (scene.small / "MANIFEST.sha256").read_text()
    with pytest.raises(IndexFormatError, match=r"MANIFEST: cut off: its last line has no end"):
        parse_manifest(text[:-1], "MANIFEST")


def test_what_killed_builds_left_is_swept(tmp_path, monkeypatch):
    monkeypatch.setenv("ICRL4AHT_CACHE_DIR", str(tmp_path))
    for name in (".one.partial", ".two.removed-1", ".building.partial"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.npy").write_bytes(bytes(100))
    with FileLock(tmp_path / ".building.lock"):
        cached_arrays("three", 8, lambda folder: np.save(folder / "b.npy", np.zeros(1)))
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {".building.partial", "three"}


def test_an_error_of_the_disk_names_the_file(tmp_path):
    path = tmp_path / "notes.json"
    with pytest.raises(OSError, match=r"notes\.json") as caught, small_files(100), atomic_write(path) as partial:
        partial.write_bytes(bytes(200))
    assert caught.value.errno == errno.EFBIG
    assert not list(tmp_path.iterdir())
