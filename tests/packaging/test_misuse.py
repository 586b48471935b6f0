"""Test that bad input on the command line gives an exit code and one message that names the fault and the remedy."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import click
import pytest
from icrl4aht_generation.jobs import ray_executor as on_ray
from icrl4aht_generation.jobs.options import QueueOptions

from icrl4aht_data.commands.cli import cli, run
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import OptionError
from tests.helpers.paths import ROOT


@pytest.fixture
def run_program(capsys, monkeypatch, tmp_path):
    """Return a function that runs the program in a folder of example files and returns the exit code and the output."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("hi")
    (tmp_path / "outer").mkdir()
    (tmp_path / "outer" / "lite").symlink_to(MINI)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ICRL4AHT_REMOTE", raising=False)

    def run_program(*words: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["x", *words])
        with pytest.raises(SystemExit) as stop:
            run(cli)
        printed = capsys.readouterr()
        assert "Traceback" not in printed.err
        return int(stop.value.code or 0), " ".join((printed.out + printed.err).split())

    return run_program


MISUSED = """
lst | unknown command 'lst'; valid: list, show,
list --layout demo_wied | unknown layout 'demo_wied'; valid: coord_simple,
verify --teammate-family h4 | unknown family 'h4'; valid: rl, H1, H2, H3, H4. Did you mean 'H4'?
show 158 | 158: no such folder; if this is a history's id, use --history 158
show --history 9999 | this selection has no history [9999], its ids are within 0..
browse --out page.txt | page.txt: expected a name that ends in .html
browse --out none/page.html | no folder none: make it first, or give another path
show --plot curves.jpg | curves.jpg: expected a name that ends in .png or .svg or .pdf
download | give the ADDRESS of a release, or set ICRL4AHT_REMOTE
download empty | empty: expected an address such as hf://datasets/<org>/<repo>
download s3://a/b --to file | 'file' is a file
convert --out out | give the format to convert to: --to full, lite, observations, published,
convert {MINI} --out out --to parquet --kept-steps 50 | --kept-steps is for published files
release build a b --out c | unexpected extra argument
generate --out g --address there:1 | --address needs --executor ray
train ad --layout demo_wide --coordinator x | x: expected HOST:PORT, such as 10.0.0.1:6000
train ad --layout demo_wide --process 1 | expected --coordinator HOST:PORT as well
train rl2 --layout demo_wide --size tiny | --size: cannot be used with rl2, which learns by playing
train rl2 --layout all --next-obs --context 5 | --context, --next-obs: cannot be used with rl2, which learns by playing
train hybrid_ad --layout all --heads 2 | --heads: cannot be used with hybrid_ad, which does not have these options
train ad --layout demo_wide --epochs 2 | --epochs: cannot be used with ad, only with rl2, which learns by playing
research reference --name rl2-reference --no-evaluate --bundle-as rl2-x | because the card states its results
research reference --name rl2-reference --track preference | no model of this track exists for rl2-reference
research reference --name rl2-reference --bundle-as Bad-Name | name = 'Bad-Name': expected lowercase words
results | Missing option '--out'
submit empty --out r.json --about a | Missing option '--data'
evaluate --agent ad-referenc --out e | Did you mean 'ad-reference'
evaluate --agent empty --out e | empty: expected a run folder, but config.json is missing
evaluate --agent stay --out e --suite none | none: no such folder; `icrl4aht-data teammates`
evaluate --agent stay --out e --split train | unknown split 'train'; valid: test, validation
evaluate --agent stay --out e --seed 1 --seeds 2 | --seed: cannot be used with --seeds; leave out one or the other
evaluate --agent stay --out e --manifest {MINI}/meta/tasks.jsonl --split test | --manifest: cannot be used with --split
watch --layout demo_wide --out e.png | e.png: expected a name that ends in .gif
train ad --layout demo_wide --manifest empty/x | 'empty/x' does not exist
"""

FAILED = """
train rl2 --layout all --balance | balance = True: rl2 learns by playing, not from histories; leave out this option
list none | none: no release here, expected the file meta/info.json; give the folder of a release
list empty | empty: no release here, expected the file meta/info.json; give the folder of a release
verify none | none: no such folder; give the folder or the address of a release none: 1 problem; checked
list --split test | no history has split=['test']. This release has split train, validation; layout coord_simple,
list --split test | others; teammate_family H
list htps://x | not an address that fsspec opens: Protocol not known: htps; expected hf://datasets/
convert {MINI} --out file/x --to lite | file: File exists; expected a folder, found a file
convert {MINI} --out index.csv --to parquet | index.csv: expected a name that ends in .parquet
convert {MINI} --out none/index.parquet --to parquet | none/index.parquet: No such file or directory; check the path;
combine --out out {MINI} --data-version banana | data version 'banana': expected a SemVer version such as 1.0.0
research diversity --suite empty | empty: no layout has all its populations finished; train
train ad --layout asymm_right | no history has split='train', layout=['asymm_right']. This release
train ad --layout demo_wide --mirror --channels own | expected state records and canonical channels
collect --agent stay --layout coord_simple --source agent --out c | no history of this selection has source = 'agent'
collect --agent stay --out c --manifest {MINI}/meta/info.json | meta/info.json, line 1: not JSON
results none.json --out r | none.json: No such file or directory; check the path
submit empty --out r.json --about a --data b --labels c | empty: no results in empty/tasks
train ad --layout all --channels own | channels = own: the layouts coord_simple,
report empty | empty: no results in empty/tasks; run `icrl4aht-data evaluate --out empty`
evaluate --agent stay --out e --layout cramped_up | no task on cramped_up in
evaluate --agent stay --out e --track teammate --layout demo_wide --layout asymm_right | no task on asymm_right in the
evaluate --agent stay --out e --layout demo_wide --family H4 --family rl | no task on demo_wide with rl in the tasks
train ad --layout demo_wide --layout cramped_down | no chosen history is on cramped_down, only on demo_wide;
collect --agent stay --layout demo_wide --layout asymm_right --out c | no chosen history is on asymm_right, only on
best-response --layout demo_wide --init rl2-reference --width 64 --out b | width = 64: rl2-reference has width 128
"""


def parse_cases(text: str, code: int) -> Iterator[tuple[str, str, int]]:
    """Yield the arguments, the expected message and `code` for each line, which has the form "arguments | message"."""
    for line in text.strip().splitlines():
        arguments, _, message = line.partition(" | ")
        yield arguments.replace("{MINI}", str(MINI)), message, code


@pytest.mark.parametrize(("arguments", "message", "code"), [*parse_cases(MISUSED, 2), *parse_cases(FAILED, 1)])
def test_bad_input_gives_a_message_and_an_exit_code(run_program, arguments, message, code):
    found, said = run_program(*arguments.split())
    assert message in said
    assert found == code


def run_failing(error: Exception) -> None:
    """Run a command that raises an error."""

    @click.command()
    def failing_command() -> None:
        raise error

    with mock.patch.object(sys, "argv", ["x"]):
        run(failing_command)


def test_empty_arguments_are_refused(run_program):
    assert run_program("list", "")[1].endswith("expected a folder, found an empty text")
    assert run_program("release", "build", "--out", "")[1].endswith("expected a folder, found an empty text")


@pytest.mark.parametrize(
    ("number", "name", "message"),
    [
        (errno.EACCES, "out/.x.png.partial", "error: out/x.png: Permission denied; give a folder that you may write"),
        (errno.ENOSPC, "out/.lite.lock", "error: out/lite: No space left on device; free some space"),
        (errno.EROFS, "/disc/x", "error: /disc/x: Read-only file system; give a folder that can be written to"),
        (errno.EIO, "x.h5", "error: x.h5: Input/output error\n"),
    ],
)
def test_disk_errors_name_the_file_that_the_user_gave(capsys, number, name, message):
    with pytest.raises(SystemExit) as stop:
        run_failing(OSError(number, "in other words", name))
    assert stop.value.code == 1
    assert capsys.readouterr().err.startswith(message)


def test_errors_caused_by_bugs_are_raised():
    with pytest.raises(ModuleNotFoundError):
        run_failing(ModuleNotFoundError("No module named 'nowhere'", name="nowhere"))


def test_unreachable_ray_is_reported():
    with (
        pytest.raises(OptionError, match=r"Ray at 127\.0\.0\.1:1 cannot be reached: .*; check the address"),
        on_ray._ray_connection(QueueOptions("ray", "127.0.0.1:1")),
    ):
        pass


def test_invalid_data_version_in_a_profile_is_refused(tmp_path: Path, run_program):
    profile = tmp_path / "mine.toml"
    smoke = (ROOT / "generation" / "icrl4aht_generation" / "profiles" / "smoke.toml").read_text(encoding="utf-8")
    profile.write_text(smoke.replace('data_version = "0.0.1"', 'data_version = "new"'), encoding="utf-8")
    code, said = run_program("plan", "--profile", str(profile))
    assert (code, "mine.toml: data version 'new': expected a SemVer version such as 1.0.0" in said) == (1, True)
