"""Test the profiles of releases, the tasks that profiles list, and task files."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from icrl4aht_generation.collection.task_folder import artefact_settings
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.profiles import Profile, load_profile, profile_names
from icrl4aht_generation.profiles import profile as profile_module
from icrl4aht_generation.teammates import spread as spread_module
from icrl4aht_generation.teammates.registry import heuristic_teammate
from icrl4aht_generation.teammates.spread import LayoutSpread, SpreadTeammate, spread_teammates

from icrl4aht_data.benchmark.facts import ALGORITHMS, PREFERENCE_LAYOUTS, SCRIPTED_SOURCES, TRACKS
from icrl4aht_data.benchmark.tasks import Task, make_task, read_tasks, task_fields, task_id, write_tasks
from icrl4aht_data.errors import OptionError, TaskFormatError, UnknownNameError

VALID = """
[ego]
total_steps = 32000
environments = 8
rollout = 40
minibatches = 4
widths = { pointwise = [4], spatial = [4], dense = 8, gru = 8, head = 8 }

[release]
data_version = "0.2.0"
keep = 8

[tasks]
layouts = ["coord_simple", "cramped_room_up"]
presets = ["default", "high_inertia"]
"""


@pytest.fixture
def changed(tmp_path) -> Callable[[str, str], str]:
    """Return a function that replaces a string in a profile and returns the path of the written file."""

    def write(old: str, new: str) -> str:
        assert VALID.count(old) == 1
        path = tmp_path / "mine.toml"
        path.write_text(VALID.replace(old, new), encoding="utf-8")
        return str(path)

    return write


# Profile `teach` is left out, since its tasks are also tasks of profile `billion`.
@pytest.mark.parametrize("name", sorted({*profile_names()} - {"teach"}))
def test_shipped_profiles_list_valid_tasks(name):
    profile = load_profile(name)
    assert profile.name == name
    assert profile.ego.updates > 0
    assert "ppo" not in profile.sources or 0 < profile.keep <= profile.ego.environments * profile.learners
    for source in profile.sources:
        for layout in profile.layouts_of(source):
            assert profile.task_count(layout, source) > 0
    units = profile.units()
    assert len({work.name for work in units}) == len(units)
    for work in units:
        layouts = PREFERENCE_LAYOUTS if work.source == "search" else TRACKS[work.task.track]
        assert work.task.layout.name in (*layouts["train"], *profile.generated)
        assert work.task.split == "train" or (work.task.split == "validation" and work.source in SCRIPTED_SOURCES)
        assert (work.task.recipes is not None) == (work.source == "search")


def test_paper_profile_has_the_papers_numbers():
    profile = load_profile("paper")
    ego = profile.ego
    assert (ego.total_steps, ego.environments, ego.rollout) == (60_000_000, 1024, 256)
    assert (ego.epochs, ego.minibatches, ego.learning_rate, ego.warmup) == (4, 64, 2.5e-4, 0.1)
    assert (ego.discount, ego.gae_lambda, ego.clip, ego.max_grad_norm) == (0.99, 0.95, 0.2, 0.25)
    assert (ego.entropy, ego.value, ego.shaping_horizon) == (0.01, 0.5, 60_000_000)
    assert ego.widths == Widths((128, 128, 8), (16, 32, 32), 128, 128, 128)
    assert profile.keep == 128
    assert [profile.task_count(layout, "ppo") for layout in profile.layouts] == [80] * 8
    assert profile.algorithms == dict.fromkeys(profile.layouts, ALGORITHMS)
    assert set(profile.layouts) == {layout for splits in TRACKS.values() for layout in splits["train"]}


def test_artefact_settings_depend_on_task_learner_and_ego_only(changed):
    def settings(profile: Profile, learner: int = 0) -> dict:
        return artefact_settings(profile.units()[-1]._replace(learner=learner), profile)

    plain = load_profile(changed("keep = 8", "keep = 8"))
    assert settings(plain) == settings(load_profile(changed("keep = 8", "keep = 7")))
    assert settings(plain) != settings(load_profile(changed("rollout = 40", "rollout = 80")))
    assert settings(plain) != settings(load_profile(changed("dense = 8", "dense = 9")))
    assert settings(plain) != settings(plain, learner=1)
    other = load_profile(changed("[release]", "[ego.layouts.coord_simple]\nentropy = 0.02\n[release]"))
    assert (other.ego_config("coord_simple").entropy, other.ego_config("cramped_up").entropy) == (0.02, 0.01)
    assert settings(other) == settings(plain)
    assert artefact_settings(other.units()[0], other) != artefact_settings(plain.units()[0], plain)


def test_given_hyperparameters_replace_those_of_the_profile(changed):
    profile = load_profile(changed("keep = 8", "keep = 8"))
    assert profile.with_ego({}) == profile
    other = profile.with_ego({"learning_rate": 1e-3, "widths": {"gru": 4}})
    assert (other.ego.learning_rate, other.ego.widths.gru, other.ego.rollout) == (1e-3, 4, profile.ego.rollout)
    assert other.hash != profile.hash
    for given, message in (
        ({"minibatches": 3}, "not a multiple of minibatches = 3"),
        ({"environments": 4}, r"release\.keep = 8: expected 1\.\.4"),
    ):
        with pytest.raises(OptionError, match=rf"profile mine with the given options: .*{message}"):
            profile.with_ego(given)


def test_profile_is_loaded_from_a_path(changed):
    profile = load_profile(changed("keep = 8", "keep = 5"))
    assert (profile.name, profile.keep, profile.data_version) == ("mine", 5, "0.2.0")
    assert profile.layouts == ("coord_simple", "cramped_up")
    assert profile.ego.widths == Widths((4,), (4,), 8, 8, 8)
    assert (profile.ego.updates, profile.ego.episodes, profile.ego.epochs) == (100, 10, 4)
    tasks = [work.task for work in profile.units()]
    made = [(task.layout.name, task.track, task.teammate["theta"]["inertia"], task.seed) for task in tasks]
    assert made == [
        ("coord_simple", "teammate", 0.3, 0),
        ("coord_simple", "teammate", 0.7, 1),
        ("cramped_up", "layout", 0.3, 2),
        ("cramped_up", "layout", 0.7, 3),
    ]


def test_learned_teammates_can_be_limited_to_some_layouts(changed):
    learned = 'algorithms = { cramped_room_up = ["fcp", "comedi"], coord_simple = [] }\npresets ='
    profile = load_profile(changed("presets =", learned))
    assert profile.algorithms == {"cramped_up": ("fcp", "comedi")}
    assert profile.task_count("coord_simple", "ppo") == 2
    assert profile.task_count("cramped_up", "ppo") == 2 + 2 * profile.teammates.train


def test_sampled_teammates_are_used_by_ppo_and_noise_tasks(changed):
    sampled = 'families = { coord_simple = ["assembly_line", "recipe_aware_button"], cramped_up = ["assembly_line"] }'
    profile = load_profile(
        changed(
            'presets = ["default", "high_inertia"]',
            'sources = ["ppo", "noise"]\nlearners = 2\n[tasks.sampled]\n'
            f"{sampled}\nper_layout = {{ coord_simple = 3, cramped_up = 2 }}\nppo = 1\nvalidation = 1",
        )
    )
    units = profile.units()
    made = [(work.source, work.task.layout.name, work.task.split, work.learner) for work in units]
    of_ppo = [("ppo", layout, "train", learner) for layout in profile.layouts for learner in (0, 1)]
    of_noise = [("noise", "coord_simple", "train", 0)] * 3 + [("noise", "coord_simple", "validation", 0)]
    of_noise += [("noise", "cramped_up", "train", 0)] * 2 + [("noise", "cramped_up", "validation", 0)]
    assert made == of_ppo + of_noise
    assert len({work.name for work in units}) == len(units) == 11
    assert len({work.task.seed for work in units}) == 9  # two learners share a task's seed
    assert units[0].name + "-l1" == units[1].name
    teammates = [(w.task.layout, json.dumps(w.task.teammate["theta"])) for w in units if w.source == "noise"]
    assert len(set(teammates)) == len(teammates)
    assert {work.task.teammate["base_seed"] for work in units if work.task.split == "validation"} == {1}
    assert [work.task.teammate for work in units[:3:2]] == [units[4].task.teammate, units[8].task.teammate]
    learned = make_task("layout", "train", "cramped_up", LEARNED_ENTRY, 7)
    assert [work.task for work in profile.units([learned]) if work.task.teammate == LEARNED_ENTRY] == [
        learned,
        learned,
        make_task("layout", "train", "cramped_up", LEARNED_ENTRY, 2_500_007),
    ]


@pytest.fixture
def small_lists(monkeypatch) -> None:
    """Replace the shipped lists of spread teammates by five teammates (one for validation) on each of two layouts."""

    def layout_spread(layout: str) -> LayoutSpread:
        chosen = tuple(
            SpreadTeammate(split, "utility_greedy", k, {"w": k / 2}, "H4/t0", 0.5, "H1/t2", 0.4, 0.25, 0.0, 1.0, 30.0)
            for k, split in enumerate(["train"] * 4 + ["validation"])
        )
        return LayoutSpread(layout, 9, 6, 5, chosen)

    monkeypatch.setattr(
        spread_module, "_bundled_spreads", lambda: {k: layout_spread(k) for k in ("coord_simple", "cramped_up")}
    )


def spread_profile(changed, more: str, spread: str = "per_layout = 2\nppo = 1\nvalidation = 1") -> Profile:
    return load_profile(changed(PRESETS, f'sources = ["ppo", "noise"]\n{more}\n[tasks.spread]\n{spread}'))


def test_spread_teammates_are_used_by_ppo_and_noise_tasks(changed, small_lists):
    units = spread_profile(changed, "").units()
    for layout in ("coord_simple", "cramped_up"):
        own = [work for work in units if work.task.layout.name == layout]
        train, validation = (spread_teammates(layout, split, n) for split, n in (("train", 2), ("validation", 1)))
        assert [(work.source, work.task.split) for work in own] == [
            ("ppo", "train"),
            *[("noise", "train")] * 2,
            ("noise", "validation"),
        ]
        assert [work.task.teammate for work in own] == [train[0], *train, *validation]
    sampled = load_profile("noise").units() + load_profile("small").units()
    seeds = [work.task.seed for work in units + load_profile("mini").units()]
    assert len({*seeds}) == len(seeds)
    assert not {*seeds[: len(units)]} & {work.task.seed for work in sampled}


def test_profile_overrides_settings_of_its_base(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('base = "search"\n[search]\nepisodes = 12\n[search.layouts.asymm_both_plain]\nhistories = 3\n')
    mine, base = load_profile(str(path)), load_profile("search")
    assert mine.search == replace(base.search, episodes=12)
    assert mine.scripted_config("asymm_both_plain", "search") == replace(base.search, episodes=12, histories=3)
    assert mine.units() == base.units()
    path.write_text('base = "search"\n[tasks]\nall_dishes = true\n')
    more, fewer = (Counter(unit.task.split for unit in found.units()) for found in (load_profile(str(path)), base))
    assert more["train"] == 5 * fewer["train"] and more["validation"] == fewer["validation"]
    path.write_text('base = "noise"\n[tasks.sampled]\nper_layout = { demo_wide = 2 }\n')
    sampled = load_profile(str(path)).sampled
    assert sampled is not None
    counts = sampled.per_layout
    assert {name for name, count in counts.items() if count} == {"demo_wide"}, (
        "a table replaces a number for all layouts"
    )
    path.write_text('base = "serach"\n')
    with pytest.raises(OptionError, match=r"mine.toml: unknown base 'serach'.*Did you mean 'search'"):
        load_profile(str(path))


def test_sampled_and_spread_teammates_must_be_on_different_layouts(changed, small_lists):
    sampled = f"sampled = {{ {H3}, per_layout = {{ coord_simple = 1 }} }}"
    profile = spread_profile(changed, sampled, "per_layout = { cramped_up = 2 }")
    assert [profile.task_count(layout, "noise") for layout in profile.layouts] == [1, 2]
    with pytest.raises(OptionError, match=r"coord_simple: 1 teammates of tasks.sampled and 3 of tasks.spread"):
        spread_profile(changed, sampled)


def test_profile_with_too_many_spread_teammates_raises_error(changed, small_lists):
    with pytest.raises(OptionError, match=r"mine.toml: coord_simple: 5 train teammates requested from .* which has 4"):
        spread_profile(changed, "", "per_layout = 5")


def test_validation_teammate_that_is_also_a_training_teammate_raises_error(changed, monkeypatch):
    entry = heuristic_teammate("utility_greedy", "high_inertia", 3)
    monkeypatch.setattr(profile_module, "spread_teammates", lambda layout, split, count: [entry] * count)
    counts = "per_layout = 0\nvalidation = { coord_simple = 1 }"
    spread_profile(changed, 'presets = ["default"]', counts)
    with pytest.raises(
        OptionError, match=r"1 of 1 validation tasks have a teammate that acts like a training .*, such as team"
    ):
        spread_profile(changed, PRESETS, counts)


def test_preset_teammates_are_used_by_ppo_and_noise_tasks(changed):
    units = load_profile(changed("presets =", 'sources = ["ppo", "noise"]\npresets =')).units()
    assert [(work.source, work.task.seed) for work in units] == [
        *(("ppo", seed) for seed in range(4)),
        *(("noise", 2_500_000 + seed) for seed in range(4)),
    ]
    assert [work.task.teammate for work in units[:4]] == [work.task.teammate for work in units[4:]]


def test_given_tasks_keep_their_recorded_sources(changed):
    """The tasks of a release keep the sources that the release's provenance records."""
    profile = load_profile(changed("presets =", 'sources = ["ppo", "noise"]\nlearners = 2\npresets ='))
    tasks = [work.task for work in profile.units() if work.learner == 0][:3]
    first, second, third = (task.task_id for task in tasks)
    with pytest.raises(
        OptionError, match=rf"task {first}: its source is unknown, and profile mine has several: ppo, n"
    ):
        profile.units_of(tasks, {second: "noise", third: "ppo"})
    found = profile.units_of(tasks, {first: "ppo", second: "noise", third: "ppo"})
    assert [(work.task.task_id, work.source, work.learner) for work in found] == [
        (first, "ppo", 0),
        (first, "ppo", 1),
        (second, "noise", 0),
        (third, "ppo", 0),
        (third, "ppo", 1),
    ]
    of_ppo = load_profile(changed("keep = 8", "keep = 7"))
    with pytest.raises(OptionError, match=rf"task {second}: the source is noise, but profile mine only has ppo: "):
        of_ppo.units_of(tasks, {second: "noise"})
    assert {work.source for work in of_ppo.units_of(tasks, {})} == {"ppo"}


LEARNED_ENTRY = {
    "kind": "rl",
    "family": "fcp",
    "theta_id": 0,
    "base_seed": 0,
    "theta": {"checkpoint": "cramped_up/fcp/m0/c4", "sha256": "0" * 64},
}


PRESETS = 'presets = ["default", "high_inertia"]'
H3 = 'families = ["assembly_line"]'


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("[release]", "[releases]", "'?releases'?"),
        ("rollout = 40", "rolout = 40", "rolout"),
        (PRESETS, "", r"tasks\.presets"),
        (PRESETS, 'algorithms = ["fpc"]', "fpc.*'fcp'"),
        ('"coord_simple"', '"coord_simpel"', "coord_simpel.*'coord_simple'"),
        ("presets =", 'algorithms = { demo_wide = ["fcp"] }\npresets =', "demo_wide"),
        ("keep = 8", "keep = 9", r"keep = 9: expected 1\.\.8"),
        ("minibatches = 4", "minibatches = 3", "minibatches = 3"),
        ("presets =", 'sources = ["ppo", "nois"]\npresets =', "nois"),
        ("presets =", 'sources = ["ppo", "search"]\npresets =', r"tasks\.preference = \[\]"),
        ("presets =", 'preference = ["all"]\npresets =', r"tasks\.preference = \['all'\].*expected .* contains search"),
        (
            "presets =",
            "all_dishes = true\npresets =",
            r"tasks\.all_dishes = true: expected layouts in tasks\.preference",
        ),
        ("presets =", 'algorithms = { cramped_up = ["fcp", "fcp"] }\npresets =', "cramped_up"),
        ("[release]", "[noise]\nend = [0.3, 0.1]\n[release]", "end"),
        ("[release]", "[noise]\nbegin = [0, 0.7]\nfinish = 0.5\n[release]", "begin"),
        ("[release]", "[ego.layouts.demo_wide]\nentropy = 0.02\n[release]", "demo_wide"),
        ("presets =", 'sampled = { families = ["territori"], per_layout = 1 }\npresets =', "territori.*'territory'"),
        ("presets =", f"sampled = {{ {H3}, per_layout = 2, ppo = 3 }}\npresets =", r"tasks\.sampled\.ppo = 3"),
        ("presets =", f"spread = {{ {H3}, per_layout = 1 }}\npresets =", "families"),
        ("presets =", f"sampled = {{ {H3}, per_layout = 1, validation = 1 }}\npresets =", "validation"),
        ("total_steps = 32000", "total_steps = 13500", "total_steps"),
        ("[release]", "[teammates]\nmembers = 2\ntrain = 40\n[release]", "train = 40, .* at most 10 together"),
        ('"coord_simple"', '"asymm_right"', "train split of track layout 'asymm_right'; valid: asymm_both"),
        ("presets =", 'sources = ["agent"]\npresets =', "agent"),
        ("presets =", 'sources = ["ppo", "search"]\npreference = ["demo_wide"]\npresets =', "demo_wide"),
        ("[ego]", "[ego", r"Expected '\]' at the end of a table declaration \(at line 2"),
    ],
)
def test_invalid_profile_raises_error_with_its_name(changed, old, new, named):
    path = changed(old, new)
    with pytest.raises(OptionError, match=rf"(?s)mine.*{named}"):
        load_profile(path)


@pytest.mark.parametrize(
    ("own", "named"),
    [
        (
            'base = "noise"\n[tasks.sampled]\nvalidation = 4',
            r"4 drawn validation .*there are only 1 .*the 3 behaviours",
        ),
        ('base = "search"\n[tasks]\nlayouts = ["demo_wide"]', r"\['search'\] with tasks.layouts: .*preference only"),
        ('base = "bundle"\n[noise.layouts]\ndemo_wide = 3', r"noise.layouts.demo_wide = 3: expected a table"),
        ('base = "bundle"\n[ego]\nlayouts = 3', r"ego.layouts = 3: expected a table"),
        (
            'base = "bundle"\n[[tasks.generated]]\nfamily = "rooms"\ncount = 2',
            "2 of 2 layouts .*rooms-0-0: expected teammates",
        ),
        ('base = "bundle"\n[tasks.spread]\nper_layout = -1', r"tasks.spread.per_layout`, found -1"),
        ('base = "bundle"\n[tasks.spread]\nper_layout = { demo_wide = -1 }', r"per_layout\[...\]`"),
        ('base = "bundle"\n[tasks]\nlayout = ["demo_wide"]', r"'tasks.layout'; valid: .* Did you mean 'tasks.layouts'"),
        ('base = "bundle"\n[[tasks.generated]]\nmates = 2', r"'tasks.generated.mates'; valid: tasks.generated.family"),
        ("", "missing required field `release`"),
    ],
)
def test_profile_that_extends_another_names_wrong_values(tmp_path, own, named):
    path = tmp_path / "mine.toml"
    path.write_text(own)
    with pytest.raises(OptionError, match=rf"(?s)mine.toml: .*{named}"):
        load_profile(str(path))


def test_extended_profile_can_leave_layouts_and_sources_out(tmp_path):
    """Values of the base for layouts that the profile leaves out have no effect."""
    path = tmp_path / "mine.toml"
    path.write_text('base = "bundle"\n[tasks]\nlayouts = ["demo_cook_wide"]\nsources = ["noise"]\npreference = []\n')
    mine, base = load_profile(str(path)), load_profile("bundle")
    noise = [work.task for work in base.units() if work.source == "noise"]
    kept = [task.task_id for task in noise if task.layout.name in mine.layouts]
    assert [work.task.task_id for work in mine.units()] == kept
    assert mine.layouts == ("demo_wide", *base.generated)


def test_unknown_profile_name_raises_error():
    with pytest.raises(UnknownNameError, match=r"unknown profile 'smoek'; valid: .*Did you mean 'smoke'"):
        load_profile("smoek")
    with pytest.raises(UnknownNameError, match=r"nothere.toml: no such file; expected a TOML file or one of billion"):
        load_profile("nothere.toml")


def test_task_id_depends_on_every_field_of_the_task():
    def suffix(track="teammate", split="train", layout="demo_cook_wide", preset="default", theta_id=0, seed=0) -> str:
        teammate = heuristic_teammate("utility_greedy", preset, theta_id)
        return task_id(Task("", track, split, layout, seed, teammate))[-8:]

    others = [suffix("layout"), suffix(split="test"), suffix(layout="demo_cook_simple"), suffix(preset="high_inertia")]
    others += [suffix(theta_id=1), suffix(seed=1)]
    assert len({suffix(), *others}) == 7


def test_tasks_accept_short_and_long_names_of_layouts_of_their_track_only():
    teammate = heuristic_teammate("utility_greedy", "default", 0)
    short, long = (make_task("teammate", "train", name, teammate, 0) for name in ("coord_ring", "grounded_coord_ring"))
    assert short == long
    assert (short.layout_name, short.layout.name) == ("grounded_coord_ring", "coord_ring")
    assert (short.teammate_kind, short.teammate_family) == ("utility_greedy", "H4")
    with pytest.raises(UnknownNameError, match=r"asymm_right.*valid: asymm_both, cramped_up"):
        make_task("layout", "train", "asymm_right", teammate, 0)


def test_task_file_is_read_as_written(tmp_path):
    tasks = [work.task for work in load_profile("mini").units()]
    path = tmp_path / "tasks.jsonl"
    write_tasks(path, tasks)
    assert read_tasks(path) == tasks
    lines = path.read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines] == [task_fields(task) for task in tasks]
    assert list(json.loads(lines[0])) == ["task_id", "track", "split", "layout_name", "seed", "teammate"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": "blue"}, r".*unknown field `color`; expected the fields task_id, "),
        (lambda one, two: one, r"task_id 'teammate_train_grounded_coord_simple_utility_greedy_t0_s0_.* occurs"),
        ({"seed": 9}, r"task_id '.*_s1_.*' does not match .*expected '.*_s9_"),
        ({"track": "teammates"}, r"unknown track 'teammates'; .*mean 'teammate'\?"),
        (
            {"teammate": {"kind": "heuristic"}},
            r"teammate: Object missing required field `family`; expected the fields ",
        ),
        (lambda one, two: two[:-1], r"not JSON: "),
        (lambda one, two: "[1, 2]", r"expected `object`, got `array`; expected the fields .*, found \[1, 2\]"),
    ],
)
def test_invalid_task_file_raises_error_with_line_number(tmp_path, change, message):
    first, second = (json.dumps(task_fields(work.task)) for work in load_profile("mini").units()[:2])
    changed = json.dumps(json.loads(second) | change) if isinstance(change, dict) else change(first, second)
    path: Path = tmp_path / "tasks.jsonl"
    path.write_text(f"{first}\n{changed}\n", encoding="utf-8")
    with pytest.raises(TaskFormatError, match=rf"^{re.escape(str(path))}, line 2: {message}"):
        read_tasks(path)


def test_number_of_threads_is_set_before_teammates_are_drawn(monkeypatch):
    """Drawing teammates starts JAX, and JAX's number of threads cannot change afterwards."""
    calls: list[str] = []
    units = Profile.units
    monkeypatch.setattr(Profile, "units", lambda profile: calls.append("units") or units(profile))
    load_profile("smoke", lambda profile: calls.append(f"threads {profile.xla_threads}"))
    assert calls == ["threads 1", "units"]
