"""Test command-line options generated from dataclasses: types, bounds, flags, defaults and given values."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal

import click
import pytest
from click.testing import CliRunner
from msgspec import Meta

from icrl4aht_data.commands.dataclass_options import TopicCommand, dataclass_options, topic
from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.utils.options import Count, Option, Positive, ShareBelowOne, check_options, replace_options


@dataclass(frozen=True)
class Widths:
    hidden: Annotated[Count, Option("Hidden width.")] = 64

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class Options:
    steps: Annotated[Count, Option("Training steps.")] = 10
    learning_rate: Annotated[Positive, Option("Learning rate.")] = 1e-3
    dropout: Annotated[ShareBelowOne, Option("Dropout rate.")] = 0.1
    discounts: Annotated[tuple[ShareBelowOne, ...], Meta(min_length=1), Option("Discount; repeatable.")] = (0.9, 0.99)
    positions: Annotated[Literal["none", "rope"], Option("Position embedding.")] = "none"
    teammate_actions: Annotated[bool, Option("Also input actions.", flags=("--ta",))] = False
    normalize: Annotated[bool, Option("Normalize.")] = True
    limit: Annotated[Count | None, Option("Most steps.", default="no limit")] = None
    excluded: Annotated[Count, Option("Not an option of this command.")] = 1
    internal: int = 3
    widths: Widths = field(default_factory=Widths)

    def __post_init__(self) -> None:
        check_options(self)


@click.command(cls=TopicCommand, context_settings={"show_default": True})
@click.argument("name")
@topic("Training", dataclass_options(Options, "given", exclude=["excluded"], default_text={"steps": "the size's"}))
@click.option("--out", default="runs")
def example_command(name: str, given: dict[str, Any], out: str) -> None:
    click.echo(json.dumps({"given": given, "name": name, "out": out}))


def run_command(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(example_command, ["x", *words], terminal_width=200)
    return result.exit_code, result.output


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ("", {}),
        ("--steps 10 --out y", {"steps": 10}),  # a value equal to the default counts as given
        ("--learning-rate 0.5 --dropout 0", {"learning_rate": 0.5, "dropout": 0.0}),
        ("--discounts 0.5 --discounts 0.6", {"discounts": [0.5, 0.6]}),
        ("--ta --no-normalize", {"teammate_actions": True, "normalize": False}),
        ("--teammate-actions --normalize", {"teammate_actions": True, "normalize": True}),
        ("--positions rope --limit 3 --hidden 8", {"positions": "rope", "limit": 3, "widths": {"hidden": 8}}),
    ],
)
def test_only_given_values_reach_the_command(words, given):
    code, output = run_command(*words.split())
    assert code == 0
    assert json.loads(output)["given"] == given


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--steps 0", "steps = '0': expected `int` >= 1"),
        ("--learning-rate inf", "learning_rate = 'inf': expected a finite number"),
        ("--dropout 1", "expected `float` < 1.0"),
        ("--discounts 0.5 --discounts 2", "discounts = '2': expected `float` < 1.0"),
        ("--positions ropes", "unknown positions 'ropes'; valid: none, rope"),
        ("--excluded 1", "No such option"),
        ("--internal 1", "No such option"),
    ],
)
def test_invalid_option_values_exit_with_code_2(words, message):
    code, output = run_command(*words.split())
    assert code == 2
    assert message in " ".join(output.split())


def test_replace_options_updates_fields_of_nested_dataclasses():
    base = Options(steps=7)
    changed = replace_options(base, {"dropout": 0.2, "widths": {"hidden": 8}, "discounts": [0.5]})
    assert asdict(changed) == asdict(base) | {"dropout": 0.2, "widths": {"hidden": 8}, "discounts": (0.5,)}
    assert replace_options(base, {}) == base
    for values, message in (
        ({"widths": {"hidden": 0}}, "ego.widths.hidden = 0: expected `int` >= 1"),
        ({"widths": 3}, "ego.widths = 3: expected a table"),
        ({"step": 3}, "unknown key 'ego.step'; .*Did you mean 'ego.steps'"),
        ({"widths": {"hiden": 8}}, "unknown key 'ego.widths.hiden'"),
    ):
        with pytest.raises((OptionError, UnknownNameError), match=message):
            replace_options(base, values, "ego.")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": 0}, "steps = 0: expected `int` >= 1"),
        ({"steps": True}, "steps = True: expected `int`, got `bool`"),
        ({"learning_rate": float("nan")}, "learning_rate = nan: expected"),
        ({"dropout": 1}, "dropout = 1: expected `float` < 1.0"),
        ({"discounts": (0.5, -1.0)}, r"discounts = \(0.5, -1.0\): expected `float` >= 0.0 - at `\$\[1\]`"),
    ],
)
def test_dataclass_refuses_invalid_values(values, message):
    with pytest.raises(OptionError, match=message):
        Options(**values)
