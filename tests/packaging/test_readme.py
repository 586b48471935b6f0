"""Every command and snippet of the README runs."""

from __future__ import annotations

import importlib
import json
import re
import shlex
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from baselines.commands.cli import cli as baselines_cli
from baselines.report.headroom import published_table
from generation.cli import cli as generation_cli
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.info import read_info
from icrl4aht_data.utils.templates import card_file
from tests.helpers.paths import ROOT
from tests.servers.common import hub_server, uploads

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str, page: str = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)


def commands(start: str, page: str = README) -> list[list[str]]:
    """The arguments of every shell line that starts so."""
    lines = [line for block in blocks("sh", page) for line in block.splitlines() if line.startswith(start)]
    return [shlex.split(line, comments=True)[len(start.split()) :] for line in lines]


def understand(group: click.Group, arguments: list[str]) -> None:
    """The group has the command, and it takes the arguments."""
    name, command, rest = group.resolve_command(group.make_context("x", ["x"], resilient_parsing=True), arguments)
    assert command is not None
    command.make_context(name, rest)


@pytest.mark.parametrize("snippet", blocks("python"))
def test_python_snippets(snippet):
    exec(compile(snippet, "README.md", "exec"), {})


def of_a_remote(arguments: list[str]) -> bool:
    return any("icrl4aht" in argument for argument in arguments)


def publishes(arguments: list[str]) -> bool:
    return arguments[0] in ("release", "upload")


@pytest.mark.parametrize(
    "arguments", [a for a in commands("icrl4aht-data") if not (publishes(a) or of_a_remote(a))], ids=" ".join
)
def test_reader_commands(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output


def test_remote_commands(tmp_path, monkeypatch):
    """One after the other, from a hub of the test's own that has the bundled release."""
    monkeypatch.chdir(tmp_path)
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("you/icrl4aht", MINI, tag=f"v{read_info(MINI).data_version}")
        for arguments in (a for a in commands("icrl4aht-data") if of_a_remote(a) and not publishes(a)):
            result = CliRunner().invoke(cli, arguments)
            assert result.exit_code == 0, result.output


@uploads
def test_publishing_commands(tmp_path, monkeypatch):
    """One after the other, to a hub of the test's own."""
    monkeypatch.chdir(tmp_path)
    with hub_server(tmp_path / "hub") as hub:
        for arguments in filter(publishes, commands("icrl4aht-data")):
            result = CliRunner().invoke(cli, arguments)
            assert result.exit_code == 0, result.output
        assert "README.md" in hub.files("you/icrl4aht")


@pytest.mark.parametrize("arguments", commands("python -m generation"), ids=" ".join)
def test_generation_commands_are_understood(arguments):
    """Too long to run here; test_generate runs them on a tiny profile."""
    understand(generation_cli, arguments)


@pytest.mark.parametrize("arguments", commands("python -m baselines"), ids=" ".join)
def test_evaluation_commands_are_understood(arguments):
    """Too long to run here; test_evaluate runs them on one task."""
    understand(baselines_cli, arguments)


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = set(re.findall(r"(?:`|^    )make ([a-z-]+)", README, flags=re.MULTILINE))
    assert {"demo", "test", "help"} <= named
    for target in named:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_snippets_were_found():
    assert blocks("python")
    assert commands("icrl4aht-data")
    assert commands("python -m generation")


def mapped() -> set[Path]:
    """The files and folders of the map."""
    (table,) = re.findall(r"## Map\n(.*?)\n## ", README, flags=re.DOTALL)
    paths = set()
    for cell in re.findall(r"^\| `(.*?)` \|", table, flags=re.MULTILINE):
        stem, names, end = re.fullmatch(r"([^{]*)(?:\{(.*)\}(.*))?", cell).groups()  # type: ignore[union-attr]
        paths |= {ROOT / f"{stem}{name}{end or ''}" for name in (names.split(",") if names else [""])}
    return paths


def test_files_that_the_map_names_exist():
    assert mapped()
    assert [path for path in sorted(mapped()) if not path.exists()] == []


def test_the_map_has_every_file():
    """By itself or by a folder that it is in."""
    files = sorted(
        path for name in ("icrl4aht_data", "generation", "baselines") for path in (ROOT / name).rglob("*.py")
    )
    named = mapped()
    missing = [
        str(path.relative_to(ROOT))
        for path in files
        if not path.stem.startswith("__") and not named & {path, *path.parents}
    ]
    assert not missing, ", ".join(missing)


def test_the_table_of_published_numbers_is_what_the_command_writes():
    table = published_table(json.loads(card_file("headroom.json").read_text())["published"])
    assert table in README
    assert table in card_file("headroom.md").read_text()


def test_the_public_interface_exists():
    (table,) = re.findall(r"## Public interface\n(.*?)\n## ", README, flags=re.DOTALL)
    for cell in re.findall(r"^\| (.*?) \|", table, flags=re.MULTILINE)[2:]:
        for module, names in re.findall(r"`([\w.]+)`: ((?:`[\w.]+`(?:, )?)+)", cell):
            for name in re.findall(r"`([\w.]+)`", names):
                if name != "__all__":
                    path, _, attribute = f"{module}.{name}".rpartition(".")
                    assert hasattr(importlib.import_module(path), attribute), (module, name)
