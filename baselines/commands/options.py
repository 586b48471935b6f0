"""What the commands of `python -m baselines` take in common: types of their arguments, and options."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from icrl4aht_data.commands.options import COUNT, FAMILY, LAYOUT, Folder, Names, Root
from icrl4aht_data.errors import unknown


def found_in(module: str, name: str) -> Callable[[], Any]:
    """What a module holds, imported when it is asked for: JAX takes its time."""
    return lambda: getattr(import_module(module), name)


class Agent(Names):
    """An ego's name, or the folder of a run."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return value


def agent_of(option: str, value: str, acting: Any = "cached") -> Any:
    """The ego that an option names."""
    from baselines.agents.egos import AGENTS, find_agent
    from baselines.training.run_folder import CONFIG

    if value not in AGENTS and not Path(value).is_dir():
        folder = "A trained model is named by its folder, which `python -m baselines train` makes."
        raise click.UsageError(f"{option}: {unknown('agent', value, AGENTS)} {folder}")
    if value not in AGENTS and not (Path(value) / CONFIG).is_file():
        raise click.UsageError(f"{option}: {value}: no run: {CONFIG} is missing; `python -m baselines train` makes one")
    return find_agent(value, acting)


class HostPort(click.ParamType):
    """Where a process listens."""

    name = "host:port"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        host, _, port = value.rpartition(":")
        if not (host and port.isdecimal() and int(port) < 2**16):
            self.fail(f"{value}: expected HOST:PORT, such as 10.0.0.1:6000", param, ctx)
        return value


AGENT = Agent("agent", found_in("baselines.agents.egos", "AGENTS"))
METHOD = Names("method", found_in("baselines.methods.registry", "METHODS"))
PROTOCOL = Names("protocol", found_in("baselines.evaluate.evaluator", "PROTOCOLS"))

protocol_option = click.option(
    "--protocol",
    type=PROTOCOL,
    default="seeded",
    help="Teammates' noise: seeded, drawn anew in every episode, or published, as for the paper's numbers.",
)
acting_option = click.option(
    "--acting",
    type=Names("acting", found_in("baselines.agents.egos", "ACTING")),
    default="cached",
    help="How a trained model remembers: cached, or exact and slower.",
)
seeds_option = click.option("--seeds", type=COUNT, default=1, help="How often every task is played.")
suite_option = click.option(
    "--suite", type=Folder("`python -m generation teammates`"), metavar="FOLDER", help="Where learned teammates are."
)
tensorboard_option = click.option(
    "--tensorboard", is_flag=True, help="Also log for TensorBoard, into the run's folder."
)
films_option = click.option("--films/--no-films", default=True, help="A GIF per teammate family on the page.")
root_option = click.option(
    "--root", type=Root(), metavar="ROOT", help="A release: folder or address.", show_default="the bundled mini release"
)
STEPS: dict[str, Any] = {"type": COUNT, "help": "Training steps."}
CONTEXT: dict[str, Any] = {"type": COUNT, "help": "K: steps of a window, or transitions of a context."}

batch_size_option = click.option(
    "--batch-size", type=COUNT, help="Windows, or contexts.", show_default="1024 as in the paper, or 8 on a CPU"
)


def variants(of: str) -> Names:
    """What an experiment's name goes on with."""
    every = found_in("baselines.experiments", "EXPERIMENTS")
    return Names(of, lambda: [name.removeprefix(f"{of} ") for name in every() if name.startswith(f"{of} ")])


def experiment_options(command: Any) -> Any:
    """What all experiments take."""
    out = f"runs/{command.__name__.replace('_', '-')}" + ("-WHAT" if command.__name__ in ("sweep", "ablate") else "")
    options = [
        click.option(
            "--method",
            "methods",
            type=METHOD,
            multiple=True,
            default=("ad", "dpt"),
            help="ad, dpt, hybrid_ad or amago_offline; again for more.",
        ),
        click.option(
            "--layout",
            "layouts",
            type=LAYOUT,
            multiple=True,
            help="To train on; again for more.",
            show_default="the paper's that the release has",
        ),
        root_option,
        click.option(
            "--only",
            "values",
            metavar="SETTING",
            multiple=True,
            help="Only this setting, such as K250, medium or ta; again for more.",
        ),
        click.option("--steps", **STEPS, show_default="the paper's"),
        click.option("--context", **CONTEXT, show_default="500; varied by `sweep context`"),
        batch_size_option,
        click.option(
            "--family",
            "families",
            type=FAMILY,
            multiple=True,
            help="Only teammates of this family, such as H4; again for more.",
        ),
        click.option("--tasks", type=COUNT, help="At most so many teammates of each family and layout."),
        click.option("--episodes", type=COUNT, help="Episodes of a task.", show_default="100"),
        seeds_option,
        protocol_option,
        acting_option,
        films_option,
        tensorboard_option,
        click.option("--out", type=Folder(), metavar="FOLDER", help="Write all of it here.", show_default=out),
    ]
    for option in reversed(options):
        command = option(command)
    return command
