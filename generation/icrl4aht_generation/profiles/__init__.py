"""Profiles: everything that sizes a rebuild, in TOML. Unknown keys are errors."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from icrl4aht_data.benchmark.facts import ALGORITHMS, HEURISTIC_KINDS, REBUILT_SOURCES
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.format.info import check_version
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_generation.learners.config import PPOConfig, Widths
from icrl4aht_generation.profiles.noise_config import NoiseConfig
from icrl4aht_generation.profiles.profile import Profile, SampledConfig, TeammateConfig

FOLDER = Path(__file__).parent

_LEAST = ("least_improvement", "least_rise")


def profile_names() -> list[str]:
    """Names of the shipped profiles."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_profile(name: str, prepare: Callable[[Profile], None] = lambda profile: None) -> Profile:
    """A profile by name, or by the path of a TOML file.

    Args:
        name: the name or the path.
        prepare: called with the profile before its teammates are drawn, which starts JAX.

    Raises:
        UnknownNameError: for a name that is neither.
        OptionError: for unknown or missing keys and for values that do not fit; names the file and the key.
    """
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.is_file():
        raise unknown("profile", name, profile_names())
    with _named_errors(path):
        profile = _profile(path.stem, tomllib.loads(path.read_text(encoding="utf-8")))
    prepare(profile)
    with _named_errors(path):
        works = profile.works()  # raises for unknown presets, and for more sampled teammates than there are
        if not works and not profile.algorithms:
            raise OptionError("no tasks: expected teammates in tasks.presets, tasks.sampled or tasks.algorithms")
    return profile


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    """Name the file in errors about its content."""
    try:
        yield
    except tomllib.TOMLDecodeError as error:
        raise OptionError(f"{path}: not TOML: {error}") from error
    except KeyError as error:
        raise OptionError(f"{path}: missing key {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise OptionError(f"{path}: {error}") from error


def _profile(name: str, content: dict[str, Any]) -> Profile:
    _check_keys(content, "", {"xla_threads", "ego", "teammates", "noise", "release", "tasks"})
    for section in content.keys() - {"xla_threads"}:
        _typed(section, content[section], dict)
    release, tasks = content["release"], content["tasks"]
    _check_keys(release, "release.", {"keep", "data_version", "policies", "oracle_actions", *_LEAST})
    _check_keys(tasks, "tasks.", {"layouts", "sources", "learners", "presets", "sampled", "algorithms"})
    layouts = _layouts("tasks.layouts", tasks["layouts"])
    sources = _names("tasks.sources", tasks.get("sources", ["ppo"]))
    for source in sources:
        if source not in REBUILT_SOURCES:
            raise OptionError(f"tasks.sources: {unknown('source', source, REBUILT_SOURCES)}")
    if not sources:
        raise OptionError(f"tasks.sources = []: expected at least one of {', '.join(REBUILT_SOURCES)}")
    ego = dict(content["ego"]) if "ppo" in sources else dict(content.get("ego", {}))
    of_layouts = _tables("ego.layouts", ego.pop("layouts", {}), layouts)
    egos = _options(PPOConfig(), "ego", ego)
    return Profile(
        name=name,
        ego=egos,
        ego_layouts={each: _options(egos, f"ego.layouts.{each}", values) for each, values in of_layouts.items()},
        teammates=_teammates(content.get("teammates", {})),
        noise=_options(NoiseConfig(), "noise", content.get("noise", {})),
        data_version=check_version(_typed("release.data_version", release["data_version"], str)),
        keep=_typed("release.keep", release["keep"], int) if "ppo" in sources else 0,
        layouts=layouts,
        sources=sources,
        learners=_typed("tasks.learners", tasks.get("learners", 1), int),
        presets=_names("tasks.presets", tasks.get("presets", [])),
        sampled=_sampled(tasks["sampled"], layouts, sources) if "sampled" in tasks else None,
        algorithms=_algorithms("tasks.algorithms", tasks.get("algorithms", []), layouts),
        policies=_switch("release.policies", release.get("policies", False)),
        oracle_actions=_switch("release.oracle_actions", release.get("oracle_actions", False)),
        **{name: _number(f"release.{name}", release.get(name)) for name in _LEAST},
        xla_threads=_typed("xla_threads", content["xla_threads"], int) if "xla_threads" in content else None,
    )


def _sampled(values: dict[str, Any], layouts: tuple[str, ...], sources: tuple[str, ...]) -> SampledConfig:
    """[tasks.sampled], where every value holds for all layouts or is a table of them."""
    _typed("tasks.sampled", values, dict)
    _check_keys(values, "tasks.sampled.", {"families", "per_layout", "ppo", "validation"})
    for key in ("families", "per_layout"):
        if key not in values:
            raise OptionError(f"missing key 'tasks.sampled.{key}'")

    def names(key: str, value: Any) -> tuple[str, ...]:
        families = _names(key, value)
        for family in families:
            if family not in HEURISTIC_KINDS:
                raise OptionError(f"{key}: {unknown('family', family, HEURISTIC_KINDS)}")
        return families

    def count(key: str, value: Any) -> int:
        if _typed(key, value, int) < 0:
            raise OptionError(f"{key} = {value}: expected at least 0")
        return value

    families = _by_layout("tasks.sampled.families", values["families"], layouts, names, ())
    per_layout = _by_layout("tasks.sampled.per_layout", values["per_layout"], layouts, count, 0)
    ppo = _by_layout("tasks.sampled.ppo", values.get("ppo", per_layout), layouts, count, 0)
    validation = _by_layout("tasks.sampled.validation", values.get("validation", 0), layouts, count, 0)
    for name in layouts:
        if (per_layout[name] or validation[name]) and not families[name]:
            raise OptionError(f"tasks.sampled.families: none for {name}, which has teammates in tasks.sampled")
        if ppo[name] > per_layout[name]:
            raise OptionError(
                f"tasks.sampled.ppo = {ppo[name]} on {name}: expected at most per_layout = {per_layout[name]}"
            )
    if any(validation.values()) and "noise" not in sources:
        raise OptionError("tasks.sampled.validation: validation teammates need 'noise' among tasks.sources")
    return SampledConfig(families, per_layout, ppo, validation)


def _by_layout(
    key: str, value: Any, layouts: tuple[str, ...], check: Callable[[str, Any], Any], absent: Any
) -> dict[str, Any]:
    """Layout -> value, which is one for all layouts, or a table of them."""
    if not isinstance(value, dict):
        return dict.fromkeys(layouts, check(key, value))
    found = _tables(key, value, layouts)
    return {name: check(f"{key}.{name}", found[name]) if name in found else absent for name in layouts}


def _tables(key: str, value: Any, layouts: tuple[str, ...]) -> dict[str, Any]:
    """A table of some of the profile's layouts, by short name."""
    typed = _typed(key, value, dict)
    found = dict(zip(_layouts(key, list(typed)), typed.values(), strict=True))
    for name in found:
        if name not in layouts:
            raise OptionError(f"{key}.{name}: expected one of tasks.layouts, {', '.join(layouts)}")
    return found


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
    found = _by_layout(key, value, layouts, _names, ())
    for algorithms in found.values():
        for algorithm in algorithms:
            if algorithm not in ALGORITHMS:
                raise OptionError(f"{key}: {unknown('algorithm', algorithm, ALGORITHMS)}")
    return {name: found[name] for name in layouts if found[name]}


def _layouts(key: str, value: Any) -> tuple[str, ...]:
    layouts = [get_layout(name).name for name in _names(key, value)]
    return _names(key, layouts)


def _typed(key: str, value: Any, kind: type) -> Any:
    if isinstance(value, bool) or not isinstance(value, kind):
        raise OptionError(f"{key} = {value!r}: expected {'a table' if kind is dict else kind.__name__}")
    return value


def _number(key: str, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    raise OptionError(f"{key} = {value!r}: expected a finite number")


def _switch(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise OptionError(f"{key} = {value!r}: expected true or false")
    return value


def _check_keys(section: dict[str, Any], prefix: str, known: set[str]) -> None:
    for key in section:
        if key not in known:
            raise unknown("key", prefix + key, [prefix + name for name in sorted(known)])
