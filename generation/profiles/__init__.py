"""Profiles: everything that sizes a rebuild, in TOML. Unknown keys fail."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, field, fields, replace
from math import inf
from pathlib import Path
from typing import Any

from generation.learners.network import Widths
from generation.learners.ppo import PPOConfig
from generation.teammates.registry import heuristic_teammate
from icrl4aht_data.benchmark.facts import ALGORITHMS, PAPER_TEAMMATE_STEPS, PAPER_TEAMMATES, track_of
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.format.info import check_version
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import json_hash

FOLDER = Path(__file__).parent

_FROM_ZERO_TO: dict[str, float] = {"entropy": inf, "value": inf, "warmup": 1, "discount": 1, "gae_lambda": 1}
"""The largest value of what may be zero; everything else is positive."""


@dataclass(frozen=True)
class TeammateConfig:
    """The suite of learned teammates of each layout; the defaults are the paper's tables (App. B.1)."""

    members: int = 10  # of each algorithm's population
    train: int = PAPER_TEAMMATES  # teammates of each algorithm for the training tasks
    heldout: int = 5  # others, for the in-distribution check
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            total_steps=PAPER_TEAMMATE_STEPS, environments=256, warmup=0.05, shaping_horizon=15_000_000
        )
    )


@dataclass(frozen=True)
class Profile:
    """How large a rebuild is."""

    name: str
    ego: PPOConfig
    teammates: TeammateConfig
    data_version: str  # of the release, SemVer
    keep: int  # streams of each task that the release keeps, best first
    layouts: tuple[str, ...]
    presets: tuple[str, ...] = ()  # teammates that are the heuristic H4 utility_greedy
    algorithms: dict[str, tuple[str, ...]] = field(default_factory=dict)  # of a layout's teammates that learned

    def heuristic_tasks(self) -> list[Task]:
        """One training task per layout and preset, each with a seed of its own."""
        pairs = [(layout, number, preset) for layout in self.layouts for number, preset in enumerate(self.presets)]
        return [
            make_task(track_of(layout), "train", layout, heuristic_teammate("utility_greedy", preset, number), seed)
            for seed, (layout, number, preset) in enumerate(pairs)
        ]

    @property
    def task_layouts(self) -> tuple[str, ...]:
        """The layout of each training task, if the populations have teammates enough."""
        learned = [
            layout for layout, names in self.algorithms.items() for _ in range(len(names) * self.teammates.train)
        ]
        return self.layouts * len(self.presets) + tuple(learned)

    @property
    def ego_hash(self) -> str:
        """Of what decides an artefact beyond its task; a change makes artefacts anew."""
        return json_hash(asdict(self.ego))

    @property
    def hash(self) -> str:
        """Of all of it."""
        return json_hash(asdict(self))


def names() -> list[str]:
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_profile(name: str) -> Profile:
    """A profile by name, or by the path of a TOML file.

    Raises:
        UnknownNameError: for a name that is neither.
        OptionError: for unknown or missing keys and for values that do not fit; names the file and the key.
    """
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.is_file():
        raise unknown("profile", name, names())
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        _only(content, "", {"ego", "teammates", "release", "tasks"})
        _only(content["release"], "release.", {"keep", "data_version"})
        _only(content["tasks"], "tasks.", {"layouts", "presets", "algorithms"})
        tasks = content["tasks"]
        layouts = _layouts("tasks.layouts", tasks["layouts"])
        profile = Profile(
            name=path.stem,
            ego=_ppo("ego", content["ego"], PPOConfig()),
            teammates=_teammates(content.get("teammates", {})),
            data_version=check_version(_typed("release.data_version", content["release"]["data_version"], str)),
            keep=_typed("release.keep", content["release"]["keep"], int),
            layouts=layouts,
            presets=_names("tasks.presets", tasks.get("presets", [])),
            algorithms=_algorithms("tasks.algorithms", tasks.get("algorithms", []), layouts),
        )
        profile.heuristic_tasks()
    except tomllib.TOMLDecodeError as error:
        raise OptionError(f"{path}: not TOML: {error}") from error
    except KeyError as error:
        raise OptionError(f"{path}: missing key {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise OptionError(f"{path}: {error}") from error
    if not profile.task_layouts:
        raise OptionError(
            f"{path}: expected at least one of tasks.layouts, and one of tasks.presets or tasks.algorithms"
        )
    if not 0 < profile.keep <= profile.ego.environments:
        raise OptionError(f"{path}: release.keep = {profile.keep}: expected 1..{profile.ego.environments}")
    if profile.ego.episodes < 5:
        raise OptionError(
            f"{path}: ego.total_steps gives {profile.ego.episodes} episodes a stream, expected at least 5"
        )
    return profile


def _teammates(table: dict[str, Any]) -> TeammateConfig:
    sizes = ("members", "train", "heldout")
    rest = {name: value for name, value in table.items() if name not in sizes}
    counts = {name: _typed(f"teammates.{name}", table[name], int) for name in sizes if name in table}
    for name, count in counts.items():
        if count < (name != "heldout"):
            raise OptionError(f"teammates.{name} = {count}: expected a positive number")
    return TeammateConfig(**counts, ppo=_ppo("teammates", rest, TeammateConfig().ppo))


def _ppo(section: str, table: dict[str, Any], defaults: PPOConfig) -> PPOConfig:
    table = dict(table)
    _only(table, f"{section}.", {field.name for field in fields(PPOConfig)})
    if "widths" in table:
        _only(table["widths"], f"{section}.widths.", {field.name for field in fields(Widths)})
        table["widths"] = Widths.from_table(table["widths"])
    for known in fields(PPOConfig):
        if known.name in table and known.name != "widths":
            key = f"{section}.{known.name}"
            value = _typed(key, table[known.name], int if known.type == "int" else float)
            _check_range(key, value, _FROM_ZERO_TO.get(known.name))
    return replace(defaults, **table)


def _check_range(key: str, value: float, most: float | None) -> None:
    """`most` is the largest value of what may be zero; None of what may not."""
    if most is None:
        fits, expected = value > 0, "a positive number"
    else:
        fits, expected = 0 <= value <= most, "0 or more" if most == inf else f"0 to {most}"
    if not fits:
        raise OptionError(f"{key} = {value}: expected {expected}")


def _names(key: str, value: Any) -> tuple[str, ...]:
    """A list of names, none twice."""
    names = _typed(key, value, list)
    if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise OptionError(f"{key} = {names!r}: expected names, none twice")
    return tuple(names)


def _algorithms(key: str, value: Any, layouts: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """By layout, in the order of the layouts; a list is for all of them."""
    if isinstance(value, dict):
        names_of = dict(zip(_layouts(key, list(value)), value, strict=True))
        found = {name: _names(f"{key}.{typed}", value[typed]) for name, typed in names_of.items()}
    else:
        found = dict.fromkeys(layouts, _names(key, value))
    for name, algorithms in found.items():
        if name not in layouts:
            raise OptionError(f"{key}.{name}: expected one of tasks.layouts, {', '.join(layouts)}")
        for algorithm in algorithms:
            if algorithm not in ALGORITHMS:
                raise OptionError(f"{key}: {unknown('algorithm', algorithm, ALGORITHMS)}")
    return {name: found[name] for name in layouts if found.get(name)}


def _layouts(key: str, value: Any) -> tuple[str, ...]:
    layouts = [get_layout(name).name for name in _names(key, value)]
    return _names(key, layouts)


def _typed(key: str, value: Any, kind: type) -> Any:
    """The value, if it is of that type; a whole number will do where a float is expected."""
    if isinstance(value, bool) or not isinstance(value, (int, float) if kind is float else kind):
        raise OptionError(f"{key} = {value!r}: expected {kind.__name__}")
    return value


def _only(table: dict[str, Any], prefix: str, known: set[str]) -> None:
    for key in table:
        if key not in known:
            raise unknown("key", prefix + key, [prefix + name for name in sorted(known)])
