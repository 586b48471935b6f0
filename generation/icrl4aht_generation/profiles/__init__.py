"""Profiles: TOML files with all settings for generating a release; unknown keys are errors."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct

from icrl4aht_data.benchmark.facts import ALGORITHMS, HEURISTIC_KINDS, PREFERENCE_LAYOUTS, REBUILT_SOURCES
from icrl4aht_data.benchmark.tasks import teammate_id
from icrl4aht_data.errors import OptionError, UnknownNameError, check_choice, unknown_name
from icrl4aht_data.format.info import check_version
from icrl4aht_data.overcooked.layouts import add_layouts, get_layout
from icrl4aht_data.utils.options import Count, Natural, replace_options
from icrl4aht_generation.layouts.families import generate_layouts
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.profiles.noise_config import SEARCH, NoiseConfig
from icrl4aht_generation.profiles.profile import Profile, SampledConfig, SpreadConfig, TeammateConfig, WorkUnit
from icrl4aht_generation.teammates.draws import find_draw

FOLDER = Path(__file__).parent

Value = TypeVar("Value")
Config = TypeVar("Config", PPOConfig, NoiseConfig)
_Names = tuple[str, ...]
_Return = Annotated[float, Meta(ge=-1e6, le=1e6)]  # bounds that exclude infinity


class _Release(Struct, forbid_unknown_fields=True):
    """Fields of the section [release] of a profile."""

    data_version: str
    keep: int = 0
    policies: bool = False
    oracle_actions: bool = False
    least_improvement: _Return | None = None
    least_rise: _Return | None = None


class _Spread(Struct, forbid_unknown_fields=True, kw_only=True):
    """Fields of the section [tasks.spread], each with one value for all layouts or a table with a value per layout."""

    per_layout: Natural | dict[str, Natural]
    ppo: Natural | dict[str, Natural] | None = None
    validation: Natural | dict[str, Natural] = 0


class _SampledTasks(_Spread, kw_only=True):
    """Fields of the section [tasks.sampled] of a profile."""

    families: _Names | dict[str, _Names]


class _Generated(Struct, forbid_unknown_fields=True):
    """Fields of one table [[tasks.generated]] of a profile, which adds generated layouts of one family.

    Attributes:
        family, seed, count, split: arguments of `generate_layouts`.
        teammates: number of sampled teammates of each layout, with one task each in the sources "ppo" and "noise".
    """

    family: str
    count: Count
    seed: Natural = 0
    split: str = "train"
    teammates: Annotated[int, Meta(ge=0, le=16)] = 0


class _Tasks(Struct, forbid_unknown_fields=True):
    """Fields of the section [tasks] of a profile."""

    layouts: _Names = ()
    generated: tuple[_Generated, ...] = ()
    sources: Annotated[_Names, Meta(min_length=1)] = ("ppo",)
    learners: Count = 1
    presets: _Names = ()
    sampled: _SampledTasks | None = None
    spread: _Spread | None = None
    algorithms: _Names | dict[str, _Names] = ()
    preference: _Names = ()
    all_dishes: bool = False


class _ProfileFile(Struct, forbid_unknown_fields=True):
    """Fields of a profile's TOML file; the classes of hyper-parameters validate their own values."""

    release: _Release
    tasks: _Tasks
    ego: dict[str, Any] = {}
    teammates: dict[str, Any] = {}
    noise: dict[str, Any] = {}
    search: dict[str, Any] = {}
    xla_threads: Count | None = None


_SECTIONS = {
    "": _ProfileFile,
    "release": _Release,
    "tasks": _Tasks,
    "tasks.generated": _Generated,
    "tasks.sampled": _SampledTasks,
    "tasks.spread": _Spread,
}
"""Name of a section of a profile -> class of its fields, for sections with fixed fields."""


def profile_names() -> list[str]:
    """Return the names of the shipped profiles."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_profile(name: str, prepare: Callable[[Profile], None] = lambda profile: None) -> Profile:
    """Return a profile by name, or by the path of a TOML file.

    Args:
        name: name of a shipped profile, or path of a TOML file.
        prepare: called with the profile before its teammates are drawn, because drawing teammates initializes JAX.

    Raises:
        UnknownNameError: if neither a shipped profile nor a TOML file has the name.
        OptionError: if keys are unknown or missing, or values are invalid; the message names the file and the key.
    """
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.is_file():
        if name.endswith(".toml"):
            raise UnknownNameError(f"{name}: no such file; expected a TOML file or one of {', '.join(profile_names())}")
        raise unknown_name("profile", name, profile_names())
    with _errors_with_path(path):
        profile = _build_profile(path.stem, _convert(_read_content(path)))
    prepare(profile)
    with _errors_with_path(path):
        units = profile.units()  # raises an error for unknown presets or too many sampled teammates
        if not units and not profile.algorithms:
            raise OptionError(
                "no tasks: expected teammates in tasks.presets, tasks.sampled, tasks.spread, tasks.algorithms or "
                "tasks.generated"
            )
        played = {work.task.layout.name for work in units}
        alone = [name for name in profile.generated if name not in {*played, *profile.algorithms}]
        if alone:
            raise OptionError(
                f"tasks.generated: {len(alone)} of {len(profile.generated)} layouts have no teammate, such as "
                f"{alone[0]}: expected teammates = 1 or more in its table"
            )
        _check_splits(units, profile.sampled, profile.spread)
    return profile


def _read_content(path: Path) -> dict[str, Any]:
    """Return the content of a profile's file; a file with a `base` overrides values of a shipped profile."""
    content = msgspec.toml.decode(path.read_bytes())
    base = content.pop("base", None)
    if base is None:
        return content
    check_choice("base", base, profile_names())
    inherited = _read_content(FOLDER / f"{base}.toml")
    merged = _merge_tables(inherited, content)
    # The base's values for layouts that the file leaves out would be errors in the file, which does not have them.
    return _merge_tables(_without_keys(inherited, _chosen_layouts(inherited) - _chosen_layouts(merged)), content)


def _chosen_layouts(content: Mapping[str, Any]) -> set[str]:
    """Return the short names in tasks.layouts and tasks.preference; empty if a value is malformed."""
    try:
        found = msgspec.convert(content, _ProfileFile).tasks
    except msgspec.ValidationError:
        return set()
    preference = PREFERENCE_LAYOUTS["train"] if found.preference == ("all",) else found.preference
    return {get_layout(name).name for name in (*found.layouts, *preference)}


def _without_keys(table: Mapping[str, Any], keys: set[str]) -> dict[str, Any]:
    """Return nested tables without some keys."""
    kept = {key: value for key, value in table.items() if key not in keys}
    return {key: _without_keys(value, keys) if isinstance(value, dict) else value for key, value in kept.items()}


def _convert(content: dict[str, Any]) -> _ProfileFile:
    """Check the structure of a profile.

    Raises:
        OptionError: if it is wrong; the message states the value that was found, or the valid keys.
    """
    try:
        return msgspec.convert(content, _ProfileFile)
    except msgspec.ValidationError as error:
        place = re.search(r" - at `\$(.*)`", str(error))
        keys = re.findall(r"\.(\w+)|\[(\d+)\]", place[1]) if place and "[...]" not in place[1] else []
        found: Any = content
        for name, number in keys:
            found = found[name or int(number)]
        unknown = re.search("unknown field `(.*?)`", str(error))
        section = ".".join(name for name, _ in keys if name)
        if unknown:
            known = [field.encode_name for field in msgspec.structs.fields(_SECTIONS[section])]
            prefix = section and section + "."
            raise unknown_name("key", prefix + unknown[1], [prefix + one for one in known]) from error
        raise OptionError(f"{error}, found {found!r:.100}" if keys else str(error)) from error


def _merge_tables(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested tables; values of `own` replace values of `base`."""
    tables = [key for key in base.keys() & own.keys() if isinstance(base[key], dict) and isinstance(own[key], dict)]
    both = {key: _merge_tables(base[key], own[key]) for key in tables}
    return {**base, **own, **both}


@contextmanager
def _errors_with_path(path: Path) -> Iterator[None]:
    """Context manager that adds the file's path to errors about its content."""
    try:
        yield
    except ValueError as error:  # includes errors of msgspec and of the TOML parser
        raise OptionError(f"{path}: {error}") from error


def _build_profile(name: str, content: _ProfileFile) -> Profile:
    release, tasks = content.release, content.tasks
    check_version(release.data_version)
    layouts, sources = _layout_names("tasks.layouts", tasks.layouts), _check_distinct("tasks.sources", tasks.sources)
    named, generated = layouts, dict[str, int]()
    for one in tasks.generated:
        found = add_layouts(generate_layouts(one.family, one.seed, one.count, split=one.split))
        names = _check_distinct("tasks.generated", [*generated, *(layout.name for layout in found)])
        generated |= dict.fromkeys(names[len(generated) :], one.teammates)
    layouts += tuple(generated)
    _check_known("source", "tasks.sources", sources, REBUILT_SOURCES)
    ignored = [name for name in ("layouts", "generated", "sampled", "spread", "algorithms") if getattr(tasks, name)]
    if sources == ("search",) and ignored:
        raise OptionError(
            f"tasks.sources = ['search'] with {', '.join(f'tasks.{name}' for name in ignored)}: search plays the "
            f"layouts in tasks.preference only; add another source, or leave out these keys, as in the profile search"
        )
    if not layouts and sources != ("search",):
        raise OptionError("tasks.layouts: expected layouts, found none; name layouts, or add tasks.generated")
    preference = PREFERENCE_LAYOUTS["train"] if tasks.preference == ("all",) else tasks.preference
    _check_known("layout of the track preference", "tasks.preference", preference, PREFERENCE_LAYOUTS["train"])
    if bool(preference) != ("search" in sources):
        raise OptionError(
            f"tasks.preference = {list(tasks.preference)}, tasks.sources = {list(sources)}: expected layouts in "
            f"tasks.preference if tasks.sources contains search, and none otherwise"
        )
    if tasks.all_dishes and not preference:
        raise OptionError("tasks.all_dishes = true: expected layouts in tasks.preference, found none; name layouts")
    if "ppo" not in sources:
        release.keep = 0
    ego, ego_layouts = _read_section("ego", content.ego, PPOConfig(), layouts)
    noise, noise_layouts = _read_section("noise", content.noise, NoiseConfig(), layouts)
    search, search_layouts = _read_section("search", content.search, SEARCH, preference)
    algorithms = _by_layout("tasks.algorithms", tasks.algorithms, layouts)
    for key, names in algorithms.items():
        _check_known("algorithm", "tasks.algorithms", _check_distinct(f"tasks.algorithms.{key}", names), ALGORITHMS)
    return Profile(
        name=name,
        ego=ego,
        ego_layouts=ego_layouts,
        teammates=_teammate_config(content.teammates),
        noise=noise,
        search=search,
        scripted_layouts={"noise": noise_layouts, "search": search_layouts},
        generated=generated,
        preference=_check_distinct("tasks.preference", preference),
        all_dishes=tasks.all_dishes,
        layouts=layouts,
        sources=sources,
        learners=tasks.learners,
        presets=_check_distinct("tasks.presets", tasks.presets),
        sampled=_sampled_config(tasks.sampled, named, sources) if tasks.sampled else None,
        spread=SpreadConfig(**_teammate_counts("tasks.spread", tasks.spread, named, sources)) if tasks.spread else None,
        algorithms={each: tuple(algorithms[each]) for each in layouts if algorithms.get(each)},
        xla_threads=content.xla_threads,
        **msgspec.structs.asdict(release),
    )


def _read_section(
    name: str, values: dict[str, Any], default: Config, layouts: tuple[str, ...]
) -> tuple[Config, dict[str, Config]]:
    """Return the settings of a section, and the settings of each layout in the section's table `layouts`."""
    common = replace_options(default, {key: value for key, value in values.items() if key != "layouts"}, f"{name}.")
    tables = values.get("layouts", {})
    if not isinstance(tables, dict):
        raise OptionError(f"{name}.layouts = {tables!r}: expected a table")
    own: dict[str, Any] = _by_layout(f"{name}.layouts", tables, layouts)
    return common, {each: replace_options(common, of, f"{name}.layouts.{each}.") for each, of in own.items()}


def _sampled_config(values: _SampledTasks, layouts: tuple[str, ...], sources: tuple[str, ...]) -> SampledConfig:
    counts = _teammate_counts("tasks.sampled", values, layouts, sources)
    chosen: dict[str, Any] = _by_layout("tasks.sampled.families", values.families, layouts)
    families = {name: _check_distinct("tasks.sampled.families", chosen.get(name, ())) for name in layouts}
    for name in layouts:
        _check_known("family", "tasks.sampled.families", families[name], HEURISTIC_KINDS)
        if (counts["per_layout"][name] or counts["validation"][name]) and not families[name]:
            raise OptionError(f"tasks.sampled.families: expected families for {name}, which has sampled teammates")
    return SampledConfig(**counts, families=families)


def _teammate_counts(
    section: str, values: _Spread, layouts: tuple[str, ...], sources: tuple[str, ...]
) -> dict[str, dict[str, int]]:
    """Return the requested numbers of teammates by field of `SpreadConfig` and by layout of `tasks.layouts`."""
    if not layouts:
        raise OptionError(
            f"{section}: expected layouts in tasks.layouts; teammates of generated layouts are set in tasks.generated"
        )
    given = {"per_layout": values.per_layout, "validation": values.validation}
    given["ppo"] = values.per_layout if values.ppo is None else values.ppo
    tables: dict[str, Any] = {key: _by_layout(f"{section}.{key}", value, layouts) for key, value in given.items()}
    counts = {key: {name: table.get(name, 0) for name in layouts} for key, table in tables.items()}
    for name in layouts:
        if counts["ppo"][name] > counts["per_layout"][name]:
            raise OptionError(
                f"{section}.ppo = {counts['ppo'][name]} on {name}: expected at most per_layout = "
                f"{counts['per_layout'][name]}"
            )
    if any(counts["validation"].values()) and "noise" not in sources:
        raise OptionError(f"{section}.validation: validation teammates need 'noise' among tasks.sources")
    return counts


def _check_splits(units: Sequence[WorkUnit], sampled: SampledConfig | None, spread: SpreadConfig | None) -> None:
    """Check that no teammate of a layout's validation split acts like a teammate of its training split.

    Raises:
        OptionError: if a behaviour is in both splits, or a layout has both sampled and spread teammates.
    """
    for name in spread.per_layout if spread and sampled else ():
        both = [config.per_layout[name] + config.validation[name] for config in (sampled, spread) if config]
        if all(both):
            raise OptionError(
                f"{name}: {both[0]} teammates of tasks.sampled and {both[1]} of tasks.spread: validation teammates of "
                f"one section may resemble training teammates of the other; use only one section for a layout"
            )

    trained = {_teammate_key(work) for work in units if work.task.split == "train"}
    checked = {work.task.task_id: _teammate_key(work) for work in units if work.task.split == "validation"}
    shared = [task for task, key in checked.items() if key in trained]
    if shared:
        raise OptionError(
            f"{len(shared)} of {len(checked)} validation tasks have a teammate that acts like a training teammate, "
            f"such as {min(shared)}: remove such teammates from tasks.presets, or request fewer validation teammates"
        )


def _teammate_key(work: WorkUnit) -> tuple[Any, ...]:
    """Return a key of a unit's layout, recipes and teammate. Teammates with the same behaviour have equal keys."""
    layout, teammate = work.task.layout.name, work.task.teammate
    draw = find_draw(layout, teammate) if "theta_id" in teammate else None
    acts: tuple[Any, ...] = (teammate_id(teammate),) if draw is None else (draw.family, draw.behaviour)
    return layout, work.task.recipes, acts


def _teammate_config(values: dict[str, Any]) -> TeammateConfig:
    """Split the section [teammates] into sizes of the suite and hyper-parameters of the policies."""
    sizes = {name: values[name] for name in ("members", "train", "heldout") if name in values}
    rest = {name: value for name, value in values.items() if name not in sizes}
    ppo = replace_options(TeammateConfig().ppo, rest, "teammates.")
    return replace_options(TeammateConfig(ppo=ppo), sizes, "teammates.")


def _by_layout(key: str, value: Mapping[str, Value] | Value, layouts: tuple[str, ...]) -> dict[str, Value]:
    """Return a value for each layout, from one value for all layouts or from a table of values by layout."""
    if not isinstance(value, Mapping):
        return dict.fromkeys(layouts, value)
    found = dict(zip(_layout_names(key, list(value)), value.values(), strict=True))
    for name in found:
        if name not in layouts:
            raise OptionError(f"{key}.{name}: expected one of the profile's layouts, {', '.join(layouts)}")
    return found


def _check_distinct(key: str, names: Sequence[str]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise OptionError(f"{key} = {names!r}: expected every name only once")
    return tuple(names)


def _check_known(what: str, key: str, names: Sequence[str], valid: Sequence[str] | Mapping[str, Any]) -> None:
    for name in names:
        if name not in valid:
            raise OptionError(f"{key}: {unknown_name(what, name, valid)}")


def _layout_names(key: str, names: Sequence[str]) -> tuple[str, ...]:
    return _check_distinct(key, [get_layout(name).name for name in names])
