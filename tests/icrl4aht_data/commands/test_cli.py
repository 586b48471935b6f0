"""Test the commands `list` and `show`, the option `--version`, error output, and that no data is overwritten."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import version

import pytest
from click.testing import CliRunner

from icrl4aht_data import get_layout, load_icrl4aht
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.commands.cli import run as run_command
from icrl4aht_data.commands.summaries import id_ranges
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.schema import FORMAT_VERSION
from tests.helpers.commands import run_cli
from tests.helpers.paths import ROOT


def test_show_describes_a_release_or_a_history(lite):
    release = json.loads(run_cli("show", "--json", lite[0]))
    assert (release["kind"], release["histories"], release["format_version"]) == ("lite", 12, FORMAT_VERSION)
    history = json.loads(run_cli("show", "--json", "--history", "7", lite[0]))
    assert (history["history_id"], history["layout"], history["T"]) == (7, "demo_wide", 120)
    assert history["teammate"]["family"] == "utility_greedy"
    assert "12 histories" in run_cli("show", lite[0])


def test_list_and_show_print_sources_learners_and_labels(two_sources):
    root = str(two_sources[0])

    rows = json.loads(run_cli("list", root, "--json", "--layout", "demo_wide"))
    assert {row["layout"] for row in rows} == {"demo_wide"}
    names = ("split", "source", "learners", "histories", "transitions", "expert_return")
    facts = [tuple(row[name] for name in names) for row in rows]
    noise = [(split, "noise", 1, 3, 360, 5.0) for split in ("train", "validation") for _ in range(2)]
    assert facts == [("train", "ppo", 2, 4, 480, None)] * 2 + noise
    assert {tuple(row["labels"]) for row in rows} == {("expert", "oracle")}
    text = run_cli("list", root, "--source", "noise", "--split", "validation")
    names, *lines = [line.split("\t") for line in text.splitlines()]
    found = [dict(zip(names, line, strict=True)) for line in lines]
    assert [(row["source"], row["labels"], row["expert_return"]) for row in found] == [
        ("noise", '["expert", "oracle"]', "5.0")
    ] * 4
    shown = json.loads(run_cli("show", root, "--json"))
    assert (shown["splits"], shown["sources"]) == ({"train": 28, "validation": 12}, {"ppo": 16, "noise": 24})
    assert (shown["learners"], shown["labels"]) == (2, {"expert": 40, "oracle": 40})
    assert "sources ppo (16), noise (24)" in run_cli("show", root)


@pytest.fixture
def run_on_terminal(monkeypatch):
    """Return a function that runs a command on a simulated terminal of 80 columns and returns the printed lines."""

    def run(*arguments: str) -> list[str]:
        monkeypatch.setenv("COLUMNS", "80")
        monkeypatch.setattr("icrl4aht_data.commands.release_commands.is_terminal", lambda: True)
        printed = run_cli(*arguments)
        return printed.splitlines()

    return run


def test_list_and_show_fit_a_terminal_of_80_columns(two_sources, run_on_terminal):
    root = str(two_sources[0])
    tasks = load_icrl4aht(root).counts("task_id")
    listed = run_on_terminal("list", root)
    for task_id in tasks:
        assert sum(line.rstrip().endswith(f" {task_id[-8:]}") for line in listed) == 1
    assert [line.split() for line in listed[-2:]] == [[str(len(tasks)), "tasks", "40"], ["4,800"]]
    assert any("H4 utility_greedy" in line for line in listed), "names as the filters take them"
    ids = load_icrl4aht(root, task_id=next(iter(tasks))).ids.tolist()
    assert listed[3].split()[-1] == id_ranges(ids) == f"{ids[0]}-{ids[-1]}"
    assert all(" 5.0" in line for line in listed if line.startswith(("coord_simple", "demo_wide")) and "noise" in line)
    shown = run_on_terminal("show", root)
    paragraph = " ".join(" ".join(shown[: shown.index("")]).split())
    assert paragraph.startswith("Dataset(40 histories of 12 tasks on demo_wide, coord_simple; ")
    assert "sources ppo (16), noise (24)" in paragraph and "lite release" in paragraph
    (total,) = [line.split() for line in shown if line.startswith("total")]
    assert total[1:5] == [str(len(tasks)), "40", "240", "4,800"]
    one = run_on_terminal("show", root, "--history", "3")
    assert "history id" in " ".join(one) and "seed" in " ".join(one)
    assert f"return start: {load_icrl4aht(root)[3].entry.return_start}" in one
    assert f"    {get_layout('demo_wide').rows[0]}" in one
    for line in (*listed, *shown, *one):
        assert len(line) <= 80, line


def test_id_ranges_joins_consecutive_ids():
    assert [id_ranges(ids) for ids in ([7], [5, 4, 3], [1, 2, 5, 9, 8])] == ["7", "3-5", "1-2,5,8-9"]


def test_verify_and_convert_accept_the_source_filter(two_sources, tmp_path):
    """Regression: the option `--source` once clashed with arguments of `verify` and `convert`."""
    root, out = str(two_sources[0]), str(tmp_path / "noise")
    for command in (
        ["verify", root, "--source", "noise"],
        ["convert", root, "--source", "noise", "--to", "lite", "--out", out],
        ["verify", out, "--deep"],
    ):
        run_cli(*command)
    assert read_info(tmp_path / "noise").histories == 24


def test_show_plot_writes_a_figure_of_learning_curves(lite, tmp_path):
    from matplotlib.image import imread

    run_cli("show", lite[0], "--plot", tmp_path / "curves.png")
    assert [path.name for path in tmp_path.iterdir()] == ["curves.png"]
    for suffix in (".png", ".svg", ".pdf"):
        for _ in range(2):  # a picture is replaced by a picture
            run_cli("show", lite[0], "--plot", tmp_path / f"curves{suffix}", "--overwrite")
    picture = imread(tmp_path / "curves.png")
    assert picture.shape[0] > 200
    assert len({tuple(pixel) for pixel in picture[::7, ::7].reshape(-1, picture.shape[-1])}) > 5


def test_commands_do_not_overwrite_existing_data(lite, full, tmp_path):
    """Run commands with an existing release, a user's file or the source itself as the target."""
    shutil.copytree(full[0], tmp_path / "cb")
    shutil.copytree(lite[0], tmp_path / "ca")
    (tmp_path / "mine").mkdir()
    for name in ("thesis.txt", "index.parquet", "curves.png", "page.html"):
        (tmp_path / "mine" / name).write_text("years")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    ca, cb, mine = (str(tmp_path / name) for name in ("ca", "cb", "mine"))
    commands = [
        ("combine", ca, cb),  # regression: this command once overwrote the release `ca`
        ("release", "build", ca, cb),  # regression: this command once overwrote the release `cb`
        ("convert", ca, cb, "--to", "full"),
        *(("combine", ca, "--out", target, *more) for target in (ca, cb, mine) for more in ((), ("--overwrite",))),
        *(("release", "build", ca, "--out", target) for target in (ca, cb, mine)),
        *(("convert", ca, "--to", form, "--out", cb) for form in ("full", "published", "parquet")),
        *(("convert", ca, "--to", form, "--out", mine, "--overwrite") for form in ("full", "published", "parquet")),
        *(
            ("convert", ca, "--to", "parquet", "--out", f"{mine}/index.parquet", *more)
            for more in ((), ("--overwrite",))
        ),
        ("convert", ca, "--to", "parquet", "--out", f"{mine}/page.html", "--overwrite"),
        ("convert", ca, "--to", "parquet", "--out", f"{ca}/index.parquet"),
        *(("show", ca, "--plot", f"{mine}/curves.png", *more) for more in ((), ("--overwrite",))),
        *(("browse", ca, "--out", f"{mine}/page.html", *more) for more in ((), ("--overwrite",))),
    ]
    commands.remove(("combine", ca, "--out", cb, "--overwrite"))  # `--overwrite` may replace the release `cb`
    for command in commands:
        result = CliRunner().invoke(cli, command)
        assert result.exit_code != 0, command
        assert isinstance(result.exception, (SystemExit, OptionError)), (command, result.exception)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before, command
    run_cli("combine", ca, "--out", cb, "--overwrite", "-q")
    assert read_info(tmp_path / "cb").kind == "lite"


@pytest.mark.parametrize(("arguments", "code"), [(["list"], 0), (["show", "--json"], 0), (["list", "--nope"], 2)])
def test_commands_run_without_stdout(lite, monkeypatch, arguments, code):
    """Regression: with closed stdout, `list` failed with an AttributeError."""
    monkeypatch.setattr(sys, "argv", ["icrl4aht-data", *arguments, str(lite[0])])
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    with pytest.raises(SystemExit) as stopped:
        run_command(cli)
    assert stopped.value.code == code
    for stream in (sys.stdout, sys.stderr):
        assert stream.name == os.devnull
        stream.close()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["list", "--help"])
def test_command_exits_silently_if_its_output_pipe_is_closed(command):
    reader, writer = os.pipe()
    os.close(reader)
    arguments = [sys.executable, "-m", "icrl4aht_data", command]
    result = subprocess.run(arguments, stdout=writer, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    os.close(writer)
    assert (result.returncode, result.stderr) == (1, "")


def test_version_option_prints_the_installed_version():
    assert run_cli("--version") == f"icrl4aht-data {version('icrl4aht-data')}\n"
