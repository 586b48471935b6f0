"""Test the pages of docs/: snippets print the shown output, commands are valid, tables and names match the code."""

from __future__ import annotations

import contextlib
import io
import json
import pydoc
import re
import runpy
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from icrl4aht_baselines.headroom import published_table
from icrl4aht_baselines.methods.registry import METHODS

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.commands.cli import all_verbs, cli
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.schema import FIELDS, Field, Kind
from icrl4aht_data.overcooked import state
from icrl4aht_data.overcooked.channels import canonical_positions
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.utils.text import card_file
from icrl4aht_data.writing.convert import to_release
from tests.helpers.commands import run_cli
from tests.helpers.damages import flip_bit
from tests.helpers.paths import ROOT
from tests.helpers.plugins import installed_plugins, write_package
from tests.helpers.random_releases import random_history, random_release
from tests.helpers.tiny import TINY
from tests.packaging.test_readme import check_arguments, code_blocks, shell_calls
from tests.servers.hub import hub_server
from tests.servers.process import uploads

DOCS = ROOT / "docs"
PAGES = {
    path.relative_to(DOCS).with_suffix("").as_posix(): path.read_text(encoding="utf-8")
    for path in sorted(DOCS.rglob("*.md"))
}
EVERY_PAGE = pytest.mark.parametrize("page", PAGES)
WORDS = 15_000
"""Limit of the words on all pages."""
COMPILING = ("adapters", "evaluating", "protocol")
"""Pages whose snippets compile environments and models."""


def test_documentation_is_short():
    assert sum(len(text.split()) for text in PAGES.values()) <= WORDS


def run_snippets(page: str, folder: Path) -> dict[str, Any]:
    """Run a page's snippets in order in a folder with a link to the package; return the variables of the snippets.

    What a snippet prints must equal the text block that follows it. "..." in this block means the repository's path.
    Line numbers in tracebacks count the lines of the page.
    """
    names: dict[str, Any] = {}
    (folder / "icrl4aht_data").symlink_to(ROOT / "icrl4aht_data")
    with contextlib.chdir(folder):
        for snippet in re.finditer(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", PAGES[page], re.DOTALL):
            lines_before = "\n" * PAGES[page].count("\n", 0, snippet.start(1))
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(lines_before + snippet[1], f"docs/{page}.md", "exec"), names)
            assert printed.getvalue().replace(str(ROOT), "...") == (snippet[2] or "")
    return names


def table_rows(page: str, heading: str) -> list[list[str]]:
    """Return the rows of the Markdown table whose first column has the given heading, as cells without backticks."""
    (table,) = re.findall(rf"^\| {heading} \|.*?\n\|[-|]+\n((?:\|.*\n)+)", PAGES[page], flags=re.MULTILINE)
    return [[cell.strip().replace("`", "") for cell in line.strip("| ").split(" | ")] for line in table.splitlines()]


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page in COMPILING else ())
        for page in PAGES
        if code_blocks("python", PAGES[page]) and page != "extending"
    ],
)
def test_snippets_print_the_shown_output(page, tmp_path, monkeypatch):
    monkeypatch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))  # a snippet changes this variable
    monkeypatch.setattr(MemoryFileSystem, "store", {})
    assert run_snippets(page, tmp_path)


@pytest.fixture
def example_package(tmp_path) -> Iterator[None]:
    """Install the example package docs/my_overcooked during a test."""
    source = DOCS / "my_overcooked"
    project = tomllib.loads((source / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    modules = {path.stem: path.read_text(encoding="utf-8") for path in (source / "my_overcooked").glob("*.py")}
    with installed_plugins(write_package(tmp_path / "site", project["name"], modules, project["entry-points"])):
        yield


@EVERY_PAGE
def test_commands_of_pages_are_accepted(page, request, tmp_path, monkeypatch):
    """Check only the arguments, because running the commands would take too long."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shared" / "lite").mkdir(parents=True)
    (tmp_path / "icrl4aht_data").symlink_to(ROOT / "icrl4aht_data")
    if page == "extending":
        request.getfixturevalue("example_package")
        (tmp_path / "mine.jsonl").touch()
    for line in "".join(code_blocks("sh", PAGES[page])).splitlines():
        assert line.startswith(("icrl4aht-data", "ray "))
    for arguments in shell_calls(PAGES[page]):
        check_arguments(cli, arguments)
    for words in re.findall(r"`icrl4aht-data ((?:research )?[a-z][a-z-]*)", PAGES[page]):
        assert words in all_verbs(), words


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(arguments, marks=[pytest.mark.slow] * ("--deep" in arguments), id=" ".join(arguments))
        for arguments in shell_calls(PAGES["start"])
    ],
)
def test_commands_of_the_start_page_run(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_cli(*arguments)


@pytest.mark.slow
@uploads
def test_upload_and_download_commands_of_pages_run(tmp_path, monkeypatch):
    """Run the commands of two pages: upload a part of the bundled release to a local hub, then read it from the hub."""
    part = load_icrl4aht(layout=("coord_simple", "demo_wide"), teammate_family="H3", source="ppo")
    monkeypatch.setattr("icrl4aht_data.publishing.build.MINI", to_release(part, tmp_path / "part", "lite"))
    monkeypatch.chdir(tmp_path)
    with hub_server(tmp_path / "hub") as hub:
        for page in ("publishing", "remote"):
            for arguments in shell_calls(PAGES[page]):
                run_cli(*arguments)
        assert "README.md" in hub.files("you/icrl4aht")


@EVERY_PAGE
def test_names_in_pages_exist(page):
    text = PAGES[page]
    for name in re.findall(r"`((?:icrl4aht_data|generation|baselines)(?:\.\w+)+)(?:\(.*?\))?`", text):
        assert pydoc.locate(name) is not None, name
    files = r"`((?:icrl4aht_data|generation|baselines|cards|tests)/[\w/]+\.\w+)(?:::(\w+))?`"
    for path, test in re.findall(files, text):
        source = (ROOT / path).read_text(encoding="utf-8")
        assert not test or f"def {test}(" in source, test


@pytest.fixture(scope="module")
def reader_functions() -> dict[str, Any]:
    """Return the functions of docs/read_release.py, by name."""
    return runpy.run_path(str(DOCS / "read_release.py"))


class TestFormatPage:
    def test_read_release_script_returns_the_arrays_of_the_package(self, reader_functions, lite, full, tmp_path):
        to_release(load_icrl4aht(full[0]), tmp_path / "observations", "observations")
        random_release(tmp_path / "shards", labels=False, shard_histories=4)
        random_release(tmp_path / "oracle", layouts=("coord_simple",), oracle=True)
        for root in (MINI, lite[0], full[0], *sorted(tmp_path.iterdir())):
            dataset = load_icrl4aht(root, obs="uint8")
            for number in (0, 31, 79, 80) if root is MINI else range(len(dataset)):
                history = dataset[number]
                for field in history.entry.stored_fields(dataset.info.kind):
                    array = reader_functions["read"](root, number, field.name)
                    assert array.dtype == field.element(LAYOUTS[history.entry.layout], dataset.info.kind).base
                    np.testing.assert_array_equal(array, history.read(field.name))
        with pytest.raises(KeyError):
            reader_functions["read"](tmp_path / "shards", 0, "expert_actions")

    def test_read_release_script_raises_error_on_damaged_bytes(self, reader_functions, release_copy):
        shard = release_copy / load_icrl4aht(release_copy).entries[0].shard
        table = np.load(release_copy / "meta/chunks" / shard.relative_to(release_copy / "data").with_suffix(".npy"))
        flip_bit(shard, int(table["offset"][0]) + 5)
        with pytest.raises(ValueError, match="are damaged"):
            reader_functions["read"](release_copy, 0, "state")

    @pytest.mark.parametrize("layout", LAYOUTS.values(), ids=str)
    def test_read_release_script_unpacks_and_observes_like_the_package(self, reader_functions, layout):
        parsed = reader_functions["parse_layout"]({"map": layout.rows, "obs_shape": layout.obs_shape})
        assert parsed["S"] == state.record_size(layout)
        assert reader_functions["canonical_positions"](parsed) == canonical_positions(layout).tolist()
        for part in ("pots", "buttons", "counters"):
            assert tuple(parsed[part]) == getattr(layout, part)
        records = random_history(layout, 3, 60, np.random.default_rng(0))["state"][::4]
        parts = state.unpack(layout, records)
        for number, record in enumerate(records):
            for ours, values in zip(parts, reader_functions["unpack"](parsed, record).values(), strict=True):
                np.testing.assert_array_equal(values, np.atleast_1d(ours[number]))
            for agent in (0, 1):
                np.testing.assert_array_equal(
                    reader_functions["observe"](parsed, record, agent), observe(layout, record, agent)
                )

    def test_format_page_lists_the_arrays_of_the_schema(self):
        arrays = [cells[:5] for cells in table_rows("format", "array")]
        assert arrays == [
            [field.name, field.axis, str(field.chunk), stored_type(field, "full"), stored_type(field, "lite")]
            for field in FIELDS.values()
        ]

    def test_format_page_lists_every_file_of_a_release(self):
        patterns = [
            re.sub("<.*?>", "*", name) for cells in table_rows("format", "path") for name in cells[0].split(", ")
        ]
        for path in (path for path in MINI.rglob("*") if path.is_file()):
            assert any(path.match(pattern) for pattern in patterns), path

    @pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
    def test_sha256sum_command_accepts_the_manifest(self):
        (command,) = re.findall(r"`(sha256sum .*?)`", PAGES["format"])
        subprocess.run([*command.split(), "--quiet"], cwd=MINI, check=True)


TYPE_NAMES = {"int32": "i4", "int8": "i1", "float32": "f4", "bool": "bool"}


def stored_type(field: Field, kind: Kind) -> str:
    """Return the stored element type of an array in the notation of docs/format.md; "-" for arrays not stored."""
    if kind in field.absent:
        return "-"
    if field.row != "scalar":
        return {"state": "u1 [S]", "obs": "u1 [5, 5, C]"}[field.row]
    return TYPE_NAMES[field.compact if kind == "lite" else field.dtype]


SMALL = "--steps 3 --width 16 --heads 2 --batch-size 2 --context 40"
"""Options of a training run that takes seconds."""


@pytest.mark.slow
@pytest.mark.usefixtures("example_package")
def test_snippets_and_commands_in_extending_md_run(tmp_path, monkeypatch):
    """The commands must find the method of the example package, so the method that a snippet registers is removed."""
    with mock.patch.dict(METHODS):
        names = run_snippets("extending", tmp_path)
    assert names["task"].teammate_family == "waiter"
    (tmp_path / "tiny.toml").write_text(TINY, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for line in code_blocks("sh", PAGES["extending"])[0].splitlines():
        line = line.replace("--profile smoke", "--profile tiny.toml").replace("--steps 2000", SMALL)
        run_cli(*line.split()[1:])
    report = (tmp_path / "runs/oracle/report/report.md").read_text(encoding="utf-8")
    assert "## Training tasks" in report and "| waiter | oracle |" in report
    assert json.loads((tmp_path / "runs/mean_open/config.json").read_text(encoding="utf-8"))["method"] == "mean_ad"


def test_scale_page_lists_the_environment_variables_of_the_code():
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "icrl4aht_data").rglob("*.py"))
    used = set(re.findall(r'"((?:ICRL4AHT|HF)_[A-Z_]+)"', sources))
    listed = {name for cells in table_rows("scale", "variable") for name in cells[0].split(", ")}
    assert used <= listed
    assert {name for name in listed if name.startswith("ICRL4AHT")} <= used


def test_published_returns_in_pages_equal_headroom_json():
    table = published_table(json.loads(card_file("headroom.json").read_text())["published"])
    assert table in PAGES["evaluating"] and table in card_file("headroom.md").read_text()
