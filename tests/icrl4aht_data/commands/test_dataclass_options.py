"""Command-line options made from dataclasses: types, bounds, flags, defaults, and which values reach the command."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import click
import pytest
from click.testing import CliRunner

from icrl4aht_data.commands.dataclass_options import dataclass_options, replace_given
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.utils.options import check_fields, option_field


@dataclass(frozen=True)
class Widths:
    hidden: int = option_field(64, "Hidden width.", at_least=1)


@dataclass(frozen=True)
class Options:
    steps: int = option_field(10, "Training steps.", at_least=1)
    learning_rate: float = option_field(1e-3, "Learning rate.", above=0)
    dropout: float = option_field(0.1, "Dropout rate.", at_least=0, below=1)
    discounts: tuple[float, ...] = option_field((0.9, 0.99), "Discount; repeatable.", at_least=0, below=1)
    positions: Literal["none", "rope"] = option_field("none", "Position embedding.")
    teammate_actions: bool = option_field(False, "Also input actions.", flags=("--ta",))
    normalize: bool = option_field(True, "Normalize.")
    limit: int | None = option_field(None, "Most steps.", at_least=1, default_text="no limit")
    folder: Path | None = option_field(None, "A folder.")
    internal: int = 3
    widths: Widths = field(default_factory=Widths)

    def __post_init__(self) -> None:
        check_fields(self)


@click.command(context_settings={"show_default": True})
@click.argument("name")
@dataclass_options(Options, "given", exclude=["folder"], default_text={"steps": "the size's"})
@click.option("--out", default="runs")
def command(name: str, given: dict[str, Any], out: str) -> None:
    click.echo(json.dumps({"given": given, "name": name, "out": out}))


def call(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(command, ["x", *words], terminal_width=200)
    return result.exit_code, result.output


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ("", {}),
        ("--steps 10 --out y", {"steps": 10}),  # a value that equals the default is given, too
        ("--learning-rate 0.5 --dropout 0", {"learning_rate": 0.5, "dropout": 0.0}),
        ("--discounts 0.5 --discounts 0.6", {"discounts": [0.5, 0.6]}),
        ("--ta --no-normalize", {"teammate_actions": True, "normalize": False}),
        ("--teammate-actions --normalize", {"teammate_actions": True, "normalize": True}),
        ("--positions rope --limit 3 --hidden 8", {"positions": "rope", "limit": 3, "hidden": 8}),
    ],
)
def test_given_values_alone_reach_the_command(words, given):
    code, output = call(*words.split())
    assert code == 0
    assert json.loads(output)["given"] == given


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--steps 0", "0 is not in the range x>=1"),
        ("--steps 1.5", "not a valid integer"),
        ("--learning-rate 0", "0.0 is not in the range x>0"),
        ("--learning-rate nan", "nan is not a finite number"),
        ("--learning-rate inf", "inf is not a finite number"),
        ("--dropout 1", "1.0 is not in the range 0<=x<1"),
        ("--discounts 0.5 --discounts 2", "2.0 is not in the range 0<=x<1"),
        ("--positions ropes", "'ropes' is not one of 'none', 'rope'"),
        ("--hidden 0", "0 is not in the range x>=1"),
        ("--folder x", "No such option"),
        ("--internal 1", "No such option"),
    ],
)
def test_invalid_values_are_a_misuse(words, message):
    code, output = call(*words.split())
    assert code == 2
    assert message in " ".join(output.split())


def test_help_shows_each_default_once():
    text = " ".join(call("--help")[1].split())
    assert "Training steps. [default: (the size's); x>=1]" in text
    assert "Discount; repeatable. [default: (0.9, 0.99); 0<=x<1]" in text
    assert "--teammate-actions, --ta Also input actions. -" in text
    assert "--normalize / --no-normalize Normalize. [default: (normalize)]" in text
    assert "Most steps. [default: (no limit); x>=1]" in text


def test_given_values_replace_fields_of_nested_dataclasses():
    base = Options(steps=7)
    changed = replace_given(base, {"dropout": 0.2, "hidden": 8, "discounts": (0.5,)})
    assert asdict(changed) == asdict(base) | {"dropout": 0.2, "widths": {"hidden": 8}, "discounts": (0.5,)}
    assert replace_given(base, {}) == base
    with pytest.raises(OptionError, match="steps = 0"):
        replace_given(base, {"steps": 0})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": 0}, "steps = 0: expected an integer at least 1"),
        ({"steps": 1.5}, "steps = 1.5: expected an integer at least 1"),
        ({"steps": True}, "steps = True"),
        ({"learning_rate": float("nan")}, "learning_rate = nan: expected a number above 0"),
        ({"dropout": 1}, "dropout = 1: expected a number at least 0 and below 1"),
        ({"discounts": ()}, r"discounts = \(\): expected one value or more"),
        ({"discounts": (0.5, -1.0)}, "discounts = -1.0"),
        ({"limit": 0}, "limit = 0"),
    ],
)
def test_a_dataclass_checks_its_own_values(values, message):
    with pytest.raises(OptionError, match=message):
        Options(**values)


def test_a_value_that_is_no_choice_is_an_unknown_name():
    with pytest.raises(UnknownNameError, match="unknown positions 'ropes'; valid: none, rope"):
        Options(positions="ropes")  # type: ignore[arg-type]
