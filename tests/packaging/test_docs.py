"""The pages of docs/: snippets run and print what stands behind them, tables and names are those of the code."""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import re
import shutil
import subprocess
import sys
from functools import cache, reduce
from pathlib import Path
from typing import Any
from unittest import mock

import fsspec
import numpy as np
import pytest
from click.testing import CliRunner

from baselines.commands.cli import cli as baselines_cli
from baselines.methods.registry import METHODS
from generation.cli import cli as generation_cli
from generation.planning import plan
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.commands.cli import cli as reader_cli
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.schema import FIELDS, JSON_TYPES, Field, Kind
from icrl4aht_data.overcooked import state
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.writing.convert import to_release
from tests.helpers.random_play import play, random_release
from tests.helpers.tiny import start
from tests.packaging.test_readme import ROOT, blocks, commands, understand

PAGES = {path.stem: path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").glob("*.md"))}
GROUPS = {"python -m generation": generation_cli, "python -m baselines": baselines_cli, "icrl4aht-data": reader_cli}
EVERY_PAGE = pytest.mark.parametrize("page", PAGES)

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def run_snippets(page: str, names: dict[str, Any]) -> None:
    """From top to bottom, here; each prints what stands behind it. Tracebacks have the page's line numbers."""
    text = PAGES[page]
    for snippet in re.finditer(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", text, re.DOTALL):
        lines_before = "\n" * text.count("\n", 0, snippet.start(1))
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(lines_before + snippet[1], f"docs/{page}.md", "exec"), names)
        assert printed.getvalue() == (snippet[2] or "")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Runs a page's snippets from top to bottom, once, in a folder like a checkout; gives the names that they leave."""
    with contextlib.ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path_factory.mktemp("data")))
        stack.enter_context(mock.patch.dict(METHODS))
        stack.callback(lambda: fsspec.filesystem("memory").store.clear())

        @cache
        def run(page: str) -> dict[str, Any]:
            names: dict[str, Any] = {}
            folder = tmp_path_factory.mktemp(page)
            (folder / "icrl4aht_data").symlink_to(ROOT / "icrl4aht_data")
            with contextlib.chdir(folder):
                run_snippets(page, names)
            return names

        yield run


def rows(page: str, heading: str) -> list[list[str]]:
    """The cells of the table whose first heading this is, without code marks."""
    (table,) = re.findall(rf"^\| {heading} \|.*?\n\|[-|]+\n((?:\|.*\n)+)", PAGES[page], flags=re.MULTILINE)
    return [[cell.strip().replace("`", "") for cell in line.strip("| ").split(" | ")] for line in table.splitlines()]


@EVERY_PAGE
def test_snippets(run, page):
    assert run(page)


@EVERY_PAGE
def test_commands_are_understood(page, tmp_path, monkeypatch):
    """Most are too long to run here."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shared" / "lite").mkdir(parents=True)
    given = {prefix: commands(prefix, PAGES[page]) for prefix in (*GROUPS, "ray")}
    assert sum(map(len, given.values())) == sum(len(block.splitlines()) for block in blocks("sh", PAGES[page]))
    for prefix, group in GROUPS.items():
        for arguments in given[prefix]:
            understand(group, arguments)
        for name in re.findall(rf"`{prefix} ([a-z-]+)", PAGES[page]):  # in the text, without options
            assert name in group.commands, name
    for arguments in given["ray"]:  # not imported here: Ray reads the environment when it is
        ray = Path(sys.executable).with_name("ray")
        process = subprocess.run([ray, *arguments, "--help"], capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stderr


@EVERY_PAGE
def test_names_and_links_lead_somewhere(page):
    text = PAGES[page]
    for name in re.findall(r"`((?:icrl4aht_data|generation|baselines)(?:\.\w+)+)(?:\(.*?\))?`", text):
        module, *attributes = found(name)
        reduce(getattr, attributes, importlib.import_module(module))
    for path, test in re.findall(
        r"`((?:icrl4aht_data|generation|baselines|cards|tests)/[\w/]+\.\w+)(?:::(\w+))?`", text
    ):
        if path != "generation/teammates/waiter.py":  # which the page makes
            source = (ROOT / path).read_text(encoding="utf-8")
            assert not test or f"def {test}(" in source, test
    for target in re.findall(r"\]\((.*?)\)", text):
        path, _, anchor = target.partition("#")
        linked = (ROOT / "docs" / path).read_text(encoding="utf-8") if path else text
        titles = re.findall(r"^#+ (.*)$", linked, flags=re.MULTILINE)
        anchors = [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]
        assert not anchor or anchor in anchors, target


def found(name: str) -> list[str]:
    """A dotted name as its module and attributes."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(".".join(parts[:end]))
            return [".".join(parts[:end]), *parts[end:]]
    raise AssertionError(name)


@pytest.fixture
def reader(run) -> dict[str, Any]:
    """What the page on the format defines."""
    return run("format")


class TestFormat:
    def assert_read(self, reader, root: Path, histories=None) -> None:
        dataset = load_icrl4aht(root, obs="uint8")
        for number in range(len(dataset)) if histories is None else histories:
            history = dataset[number]
            for field in history.entry.stored_fields(dataset.info.kind):
                ours = history.read(field.name)
                theirs = reader["read"](root, number, field.name)
                assert theirs.dtype == field.element(LAYOUTS[history.entry.layout], dataset.info.kind).base
                np.testing.assert_array_equal(theirs, ours)

    def test_the_bundled_release(self, reader):
        self.assert_read(reader, MINI, (0, 31, 79, 80))

    def test_every_kind(self, reader, lite, full, tmp_path):
        to_release(load_icrl4aht(full[0]), tmp_path / "observations", "observations")
        for root in (lite[0], full[0], tmp_path / "observations"):
            self.assert_read(reader, root)

    def test_several_shards_without_labels(self, reader, tmp_path):
        random_release(tmp_path / "r", labels=False, shard_histories=4)
        self.assert_read(reader, tmp_path / "r")
        with pytest.raises(KeyError):
            reader["read"](tmp_path / "r", 0, "expert_actions")

    def test_a_damaged_byte_is_noticed(self, reader, damaged):
        shard = damaged / load_icrl4aht(damaged).entries[0].shard
        table = np.load(damaged / "meta/chunks" / shard.relative_to(damaged / "data").with_suffix(".npy"))
        content = bytearray(shard.read_bytes())
        content[int(table["offset"][0]) + 5] ^= 1
        shard.write_bytes(content)
        with pytest.raises(ValueError, match="are damaged"):
            reader["read"](damaged, 0, "state")

    def test_chunk_tables_cover_every_byte_once(self, lite):
        for path in (lite[0] / "data").rglob("*.h5"):
            stored = lite[0] / "meta/chunks" / path.relative_to(lite[0] / "data").with_suffix(".npy")
            table, header = np.load(stored), 10 + int.from_bytes(stored.read_bytes()[8:10], "little")
            assert header + 20 * len(table) == stored.stat().st_size
            assert table["size"][table["rows"] == 0].max() <= 2048
            table.sort(order="offset")
            ends = np.cumsum(table["size"], dtype=np.int64)
            assert table["offset"].tolist() == [0, *ends[:-1].tolist()]
            assert ends[-1] == path.stat().st_size

    @pytest.mark.parametrize("layout", LAYOUTS.values(), ids=str)
    def test_records_and_observations(self, reader, layout):
        kitchen = reader["study"]({"map": layout.rows, "obs_shape": layout.obs_shape})
        assert (kitchen["S"], *(tuple(kitchen[part]) for part in ("pots", "buttons", "counters"))) == (
            state.record_size(layout),
            layout.pots,
            layout.buttons,
            layout.counters,
        )
        records = play(layout, 3, 60, np.random.default_rng(0))["state"][::4]
        parts = state.unpack(layout, records)
        for number, record in enumerate(records):
            theirs = reader["unpack"](kitchen, record)
            for ours, values in zip(parts, theirs.values(), strict=True):
                np.testing.assert_array_equal(values, np.atleast_1d(ours[number]))
            for seat in (0, 1):
                np.testing.assert_array_equal(reader["observe"](kitchen, record, seat), observe(layout, record, seat))

    def test_tables_are_the_schema(self, lite):
        arrays = [cells[:5] for cells in rows("format", "array")]
        assert arrays == [
            [field.name, field.axis, str(field.chunk), type_of(field, "full"), type_of(field, "lite")]
            for field in FIELDS.values()
        ]
        fields = [(name, cells[1]) for cells in rows("format", "field") for name in cells[0].split(", ")]
        assert fields == [(name, JSON_NAMES[frozenset(types)]) for name, types in JSON_TYPES.items()]
        keys = {name for cells in rows("format", "key") for name in cells[0].split(", ")}
        assert keys == load_icrl4aht(lite[0]).info.to_json().keys()

    def test_every_file_of_a_release_is_named(self):
        pieces = [re.sub("<.*?>", "*", name) for cells in rows("format", "path") for name in re.split(", ", cells[0])]
        for path in (path for path in MINI.rglob("*") if path.is_file()):
            assert any(path.match(piece) for piece in pieces), path

    @pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
    def test_the_manifest_is_sha256sums(self):
        (command,) = re.findall(r"`(sha256sum .*?)`", PAGES["format"])
        subprocess.run([*command.split(), "--quiet"], cwd=MINI, check=True)


JSON_NAMES = {
    frozenset({int}): "int",
    frozenset({str}): "string",
    frozenset({bool}): "bool",
    frozenset({list}): "3 ints",
    frozenset({int, type(None)}): "int or null",
    frozenset({float, int}): "number",
}


def type_of(field: Field, kind: Kind) -> str:
    """What such a release stores, as the page writes it."""
    if kind in field.absent:
        return "-"
    if field.row != "scalar":
        return "u1 [S]" if field.row == "state" else "u1 [5, 5, C]"
    return {"int32": "i4", "int8": "i1", "float32": "f4", "bool": "bool"}[
        field.compact if kind == "lite" else field.dtype
    ]


class TestExtending:
    def test_what_is_named_as_the_page_says_is_known_everywhere(self, tmp_path):
        """The page's lines, in a copy: a task beside the new teammate on the new layout, played and reported."""
        for folder in ("icrl4aht_data", "generation", "baselines", "cards"):
            shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("mini", "__pycache__"))
        for block in blocks("diff", PAGES["extending"]):
            for change in block.split("--- ")[1:]:
                name, *lines = change.splitlines()
                apply(tmp_path / name, lines)
        (module,) = (block for block in blocks("python", PAGES["extending"]) if block.startswith('"""`waiter`'))
        (tmp_path / "generation" / "teammates" / "waiter.py").write_text(module, encoding="utf-8")
        process = start("-c", NAMED, str(tmp_path), str(ROOT / "tests"), JAX_DISABLE_MOST_OPTIMIZATIONS="true")
        out, error = process.communicate(timeout=240)
        assert process.returncode == 0, error
        assert ast.literal_eval(out.splitlines()[-1]) == ("H5", "open_kitchen", 1, True)


NAMED = """
import os, sys
sys.path[:0] = sys.argv[1:]
os.chdir(sys.argv[1])
import dataclasses
from pathlib import Path
from tests.helpers.random_play import random_release
from baselines.agents import stay
from baselines.evaluate import evaluate, get_protocol
from baselines.report import as_run, markdown, rows
from generation.teammates.registry import heuristic_teammate, sample_teammate
from icrl4aht_data import __file__, verify_release
from icrl4aht_data.benchmark.tasks import make_task, read_tasks, write_tasks
assert __file__.startswith(sys.argv[1])
made = make_task("layout", "train", "open_kitchen", heuristic_teammate("waiter", "lazy", 0), 0)
write_tasks(Path("mine.jsonl"), [made, make_task("layout", "train", "open_kitchen", sample_teammate("waiter", 1, "test"), 1)])
tasks = read_tasks(Path("mine.jsonl"))
short = dataclasses.replace(get_protocol("seeded"), episodes=1, steps=10)
run = as_run(evaluate("stay", stay, tasks[:1], short), tasks=tasks)
assert "| H5 |" in markdown([run])
(row,) = rows(run)
random_release(Path("release"), layouts=("open_kitchen",))
whole = verify_release("release", deep=True).ok
print((row["family"], row["layout"], row["instances"], whole))
"""


def apply(path: Path, lines: list[str]) -> None:
    """Make the change that some lines of a diff say, each run of them where the file has what they begin with."""
    text = path.read_text(encoding="utf-8")
    hunks: list[list[str]] = []
    for before, line in zip([" ", *lines], lines, strict=False):
        if (before[0] == "+" and line[0] != "+") or not hunks:
            hunks.append([])
        hunks[-1].append(line)
    for hunk in hunks:
        old, new = ("\n".join(line[1:] for line in hunk if line[0] in signs) for signs in (" -", " +"))
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")


class TestScale:
    def test_the_plan_of_the_paper_is_the_printed_one(self, monkeypatch):
        """But for what is measured."""
        monkeypatch.setattr(plan, "calibrate", lambda config, make: plan.LearnerSpeed(1000.0, 1.0))
        monkeypatch.setattr(plan, "bytes_per_transition", lambda kind: 1.0)
        (arguments,) = (a for a in commands("python -m generation", PAGES["scale"]) if a[0] == "plan")
        result = CliRunner().invoke(generation_cli, arguments)
        assert result.exit_code == 0, result.output
        (written,) = (block for block in blocks("text", PAGES["scale"]) if block.startswith("profile"))
        both = [text.splitlines() for text in (result.output, written)]
        for ours, theirs in zip(*both, strict=True):
            measured = re.match("disk, release|measured|compiling|hours", ours)
            assert ours[:29] == theirs[:29] if measured else ours == theirs

    def test_the_variables_are_those_that_are_read(self):
        sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "icrl4aht_data").rglob("*.py"))
        read = set(re.findall(r'"((?:ICRL4AHT|HF)_[A-Z_]+)"', sources))
        written = {name for cells in rows("scale", "variable") for name in cells[0].split(", ")}
        assert read <= written
        assert {name for name in written if name.startswith("ICRL4AHT")} <= read
