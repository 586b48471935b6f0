"""Profiles: everything that sizes a rebuild, in TOML. Unknown keys are errors."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from generation.learners.config import PPOConfig, Widths
from generation.teammates.registry import heuristic_teammate
from icrl4aht_data.benchmark.facts import ALGORITHMS, PAPER_TEAMMATE_STEPS, PAPER_TEAMMATES, track_of
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.commands.dataclass_options import replace_given
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.format.info import check_version
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import json_hash
from icrl4aht_data.utils.option_fields import check_fields, option_field

FOLDER = Path(__file__).parent

_LEAST_EPISODES = 5
"""Episodes of a stream: its start and its end are means over five."""


@dataclass(frozen=True)
class TeammateConfig:
    """The suite of learned teammates of each layout; the defaults are the paper's tables (App. B.1).

    Attributes:
        members: policies of each algorithm's population.
        train: teammates of each algorithm for the training tasks.
        heldout: further ones, for the in-distribution check.
        ppo: hyper-parameters of every policy.
    """

    members: int = option_field(10, "Policies of each population.", at_least=1)
    train: int = option_field(PAPER_TEAMMATES, "Teammates of each algorithm for training tasks.", at_least=1)
    heldout: int = option_field(5, "Held-out teammates of each algorithm.", at_least=0)
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            total_steps=PAPER_TEAMMATE_STEPS, environments=256, warmup=0.05, shaping_horizon=15_000_000
        )
    )

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Profile:
    """The size of a rebuild.

    Attributes:
        name: of the profile's file.
        ego: hyper-parameters of the egos.
        teammates: the learned teammates.
        data_version: version of the release, SemVer.
        keep: streams of each task that the release keeps, best first.
        layouts: names of the layouts.
        presets: teammates by the heuristic H4 `utility_greedy`, on every layout.
        algorithms: layout -> algorithms of its learned teammates.
        policies: whether the release has the policies that label its histories.
        xla_threads: threads of XLA on a CPU, so that every machine computes the same bits; None for all cores.

    Raises:
        OptionError: if there is no task, or the ego's sizes do not fit.
    """

    name: str
    ego: PPOConfig
    teammates: TeammateConfig
    data_version: str
    keep: int
    layouts: tuple[str, ...]
    presets: tuple[str, ...] = ()
    algorithms: dict[str, tuple[str, ...]] = field(default_factory=dict)
    policies: bool = False
    xla_threads: int | None = None

    def __post_init__(self) -> None:
        if self.xla_threads is not None and self.xla_threads < 1:
            raise OptionError(f"xla_threads = {self.xla_threads}: expected at least 1")
        if not self.task_layouts:
            raise OptionError("expected at least one of tasks.layouts, and one of tasks.presets or tasks.algorithms")
        if not 0 < self.keep <= self.ego.environments:
            raise OptionError(f"release.keep = {self.keep}: expected 1..{self.ego.environments}")
        if self.ego.episodes < _LEAST_EPISODES:
            raise OptionError(
                f"ego.total_steps gives {self.ego.episodes} episodes a stream, expected at least {_LEAST_EPISODES}"
            )

    def with_ego(self, given: Mapping[str, Any]) -> Profile:
        """Returns the profile with some of the ego's hyper-parameters replaced, at any depth.

        Raises:
            OptionError: if they do not fit.
        """
        try:
            return replace(self, ego=replace_given(self.ego, given))
        except ValueError as error:
            raise OptionError(f"profile {self.name} with the given options: {error}") from error

    def heuristic_tasks(self) -> list[Task]:
        """One training task per layout and preset, each with a seed of its own."""
        pairs = [(layout, number, preset) for layout in self.layouts for number, preset in enumerate(self.presets)]
        return [
            make_task(track_of(layout), "train", layout, heuristic_teammate("utility_greedy", preset, number), seed)
            for seed, (layout, number, preset) in enumerate(pairs)
        ]

    @property
    def task_layouts(self) -> tuple[str, ...]:
        """The layout of each training task, if every population has enough good teammates."""
        learned = [
            layout for layout, names in self.algorithms.items() for _ in range(len(names) * self.teammates.train)
        ]
        return self.layouts * len(self.presets) + tuple(learned)

    @property
    def ego_hash(self) -> str:
        """Hash of the ego's hyper-parameters, which with the task decide an artefact."""
        return json_hash(asdict(self.ego))

    @property
    def hash(self) -> str:
        """Hash of the profile."""
        return json_hash(asdict(self))


def profile_names() -> list[str]:
    """Names of the shipped profiles."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_profile(name: str) -> Profile:
    """A profile by name, or by the path of a TOML file.

    Raises:
        UnknownNameError: for a name that is neither.
        OptionError: for unknown or missing keys and for values that do not fit; names the file and the key.
    """
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.is_file():
        raise unknown("profile", name, profile_names())
    try:
        profile = _profile(path.stem, tomllib.loads(path.read_text(encoding="utf-8")))
        profile.heuristic_tasks()  # raises for unknown presets
    except tomllib.TOMLDecodeError as error:
        raise OptionError(f"{path}: not TOML: {error}") from error
    except KeyError as error:
        raise OptionError(f"{path}: missing key {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise OptionError(f"{path}: {error}") from error
    return profile


def _profile(name: str, content: dict[str, Any]) -> Profile:
    _check_keys(content, "", {"xla_threads", "ego", "teammates", "release", "tasks"})
    _check_keys(content["release"], "release.", {"keep", "data_version", "policies"})
    _check_keys(content["tasks"], "tasks.", {"layouts", "presets", "algorithms"})
    tasks = content["tasks"]
    layouts = _layouts("tasks.layouts", tasks["layouts"])
    return Profile(
        name=name,
        ego=_options(PPOConfig(), "ego", content["ego"]),
        teammates=_teammates(content.get("teammates", {})),
        data_version=check_version(_typed("release.data_version", content["release"]["data_version"], str)),
        keep=_typed("release.keep", content["release"]["keep"], int),
        layouts=layouts,
        presets=_names("tasks.presets", tasks.get("presets", [])),
        algorithms=_algorithms("tasks.algorithms", tasks.get("algorithms", []), layouts),
        policies=_switch("release.policies", content["release"].get("policies", False)),
        xla_threads=_typed("xla_threads", content["xla_threads"], int) if "xla_threads" in content else None,
    )


def _teammates(values: dict[str, Any]) -> TeammateConfig:
    """[teammates] holds the sizes of the suite next to the hyper-parameters of its policies."""
    sizes = {name: values[name] for name in ("members", "train", "heldout") if name in values}
    rest = {name: value for name, value in values.items() if name not in sizes}
    defaults = TeammateConfig()
    return replace(_options(defaults, "teammates", sizes), ppo=_options(defaults.ppo, "teammates", rest))


def _options(defaults: Any, section: str, values: dict[str, Any]) -> Any:
    """Hyper-parameters with the values of a TOML section, whose checks name the key."""
    known = {known.name for known in fields(defaults)}
    _check_keys(values, f"{section}.", known)
    values = dict(values)
    if "widths" in values:
        _check_keys(values["widths"], f"{section}.widths.", {known.name for known in fields(Widths)})
        try:
            values["widths"] = Widths.from_json(values["widths"])
        except OptionError as error:
            raise OptionError(f"{section}.widths.{error}") from error
    try:
        return replace(defaults, **values)
    except OptionError as error:
        raise OptionError(f"{section}.{error}") from error


def _names(key: str, value: Any) -> tuple[str, ...]:
    """A list of different names."""
    names = _typed(key, value, list)
    if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise OptionError(f"{key} = {names!r}: expected names, none twice")
    return tuple(names)


def _algorithms(key: str, value: Any, layouts: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Layout -> algorithms, in the order of the layouts; a list applies to all of them."""
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
    if isinstance(value, bool) or not isinstance(value, kind):
        raise OptionError(f"{key} = {value!r}: expected {kind.__name__}")
    return value


def _switch(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise OptionError(f"{key} = {value!r}: expected true or false")
    return value


def _check_keys(section: dict[str, Any], prefix: str, known: set[str]) -> None:
    for key in section:
        if key not in known:
            raise unknown("key", prefix + key, [prefix + name for name in sorted(known)])
