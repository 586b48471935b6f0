"""Test plugins registered by entry points: lookup by name, import on demand, and errors of broken plugins."""

from __future__ import annotations

from pathlib import Path

import pytest
from icrl4aht_baselines.methods.options import ModelOptions
from icrl4aht_baselines.methods.registry import all_methods, get_method, overcooked_world
from icrl4aht_generation.teammates.registry import heuristic_teammate

from icrl4aht_data import get_layout, load_icrl4aht, verify_release
from icrl4aht_data.benchmark.facts import LAYOUT_NAMES, layout_number, layout_track
from icrl4aht_data.benchmark.tasks import make_task
from icrl4aht_data.commands import doctor
from icrl4aht_data.errors import OptionError, PluginError, UnknownNameError
from icrl4aht_data.overcooked.channels import CANONICAL_CHANNELS, canonical_positions
from icrl4aht_data.overcooked.layouts import LAYOUTS
from tests.helpers.plugins import installed_plugins, write_package
from tests.helpers.random_releases import random_release

MAPS = """
from icrl4aht_data import Layout

ROWS = ("WW0WWWW", "W     W", "W APA B", "W     W", "WW1RXWW")
PLAIN = Layout("plain_room", "plain_room", ROWS)
OTHER_ALIAS = Layout("other_alias", "other_alias_v1", ROWS)
SPICY = Layout("spicy_room", "spicy_room", ("WW0WWWW", "W     W", "W APA B", "W     W", "WW7RXWW"), ((0, 0, 7),))
NAME = "plain_room"
"""
METHODS = """
import dataclasses

from icrl4aht_baselines.methods.ad import ad
from icrl4aht_generation.teammates.heuristics.utility_greedy import UTILITY_GREEDY as GREEDY


def renamed(options, world):
    return dataclasses.replace(ad(options, world), name="my_ad")


def nothing(options, world):
    return None


number = 3
"""
POINTS = {
    "icrl4aht.layouts": {
        "plain_room": "rooms.maps:PLAIN",
        "spicy_room": "rooms.maps:SPICY",
        "broken_room": "rooms.missing:ROOM",
        "text_room": "rooms.maps:NAME",
        "other_alias": "rooms.maps:OTHER_ALIAS",
    },
    "icrl4aht.teammates": {"greedy_too": "rooms.methods:GREEDY"},
    "icrl4aht.methods": {
        "my_ad": "rooms.methods:renamed",
        "their_ad": "rooms.methods:renamed",
        "no_ad": "rooms.methods:nothing",
        "three": "rooms.methods:number",
    },
}


@pytest.fixture(scope="module")
def plugin_folder(tmp_path_factory) -> Path:
    """Return the folder of a package with layouts, a teammate and methods, some of which are broken."""
    return write_package(tmp_path_factory.mktemp("site"), "rooms", {"maps": MAPS, "methods": METHODS}, POINTS)


def test_registered_layout_can_be_used_by_name(plugin_folder, tmp_path):
    with installed_plugins(plugin_folder):
        layout = get_layout("plain_room")
        assert layout is get_layout("plain_room")
        task = make_task("layout", "test", "plain_room", heuristic_teammate("utility_greedy", "default", 0), 0)
        assert task.layout is layout
        random_release(tmp_path / "release", layouts=("plain_room",))
        assert verify_release(tmp_path / "release", level="deep").ok
        assert load_icrl4aht(tmp_path / "release", layout="plain_room").ad(batch_size=2, length=10)[0].obs.shape[0] == 2
    # The release stores the layout, so a process without the plugin package can read the release.
    assert load_icrl4aht(tmp_path / "release").layouts[0].rows == layout.rows


def test_plugins_do_not_change_the_benchmark(plugin_folder):
    before = CANONICAL_CHANNELS, tuple(LAYOUTS), [layout_track(name) for name in LAYOUT_NAMES]
    with installed_plugins(plugin_folder):
        assert before == (CANONICAL_CHANNELS, tuple(LAYOUTS), [layout_track(name) for name in LAYOUT_NAMES])
        assert [layout_number(name) for name in LAYOUT_NAMES] == list(range(10))
        assert 10 <= layout_number("plain_room") == layout_number("plain_room") < 20_000


def test_layout_with_unknown_ingredients_has_no_canonical_channels(plugin_folder):
    with (
        installed_plugins(plugin_folder),
        pytest.raises(OptionError, match=r"layout spicy_room: channels .*ingredient_7"),
    ):
        canonical_positions(get_layout("spicy_room"))


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("broken_room", r"= rooms.missing:ROOM: cannot be imported \(ModuleNotFoundError: No module named"),
        ("text_room", "= rooms.maps:NAME: expected a Layout, found str: 'plain_room'"),
        ("other_alias", "expected name and alias 'other_alias', found name 'other_alias' and alias 'other_alias_v1'"),
    ],
)
def test_broken_layout_plugin_raises_error_when_used(plugin_folder, name, problem):
    with installed_plugins(plugin_folder):
        with pytest.raises(UnknownNameError, match=name):
            get_layout("missing")
        with pytest.raises(PluginError, match=f"^package rooms 0.1, entry point icrl4aht.layouts: {name} .*{problem}"):
            get_layout(name)


def test_broken_teammate_and_method_plugins_raise_errors(plugin_folder):
    world = overcooked_world([LAYOUTS["demo_wide"]])
    with installed_plugins(plugin_folder):
        with pytest.raises(PluginError, match=r"rooms 0.1.*expected kind 'greedy_too', found 'utility_greedy'"):
            heuristic_teammate("greedy_too", "default", 0)
        assert get_method("my_ad")(ModelOptions(), world).label == get_method("ad")(ModelOptions(), world).label
        for name, problem in {
            "three": "expected a Callable, found int: 3",
            "their_ad": r"a Method with name 'their_ad' and data 'ad' or 'dpt', found Method\(name='my_ad'",
            "no_ad": "expected a function that returns a Method with name 'no_ad' .*, found None",
        }.items():
            with pytest.raises(PluginError, match=f"rooms 0.1, entry point icrl4aht.methods: {name} .*{problem}"):
                get_method(name)(ModelOptions(), world)
        with pytest.raises(UnknownNameError, match="no_ad"):
            get_method("mine")
        assert all_methods()[:2] == ["ad", "dpt"]


@pytest.mark.parametrize(
    ("registered", "message"),
    [
        ({"one": "demo_wide"}, "package one 0.1, .*: demo_wide: icrl4aht-data itself uses this name: rename"),
        ({"one": "demo_cook_wide"}, "demo_cook_wide: icrl4aht-data itself uses this name"),
        ({"one": "room", "two": "room"}, "room: package (one|two) 0.1 also registers this name"),
        ({"one": "a room"}, "a room: expected a name of letters"),
    ],
)
def test_plugins_with_clashing_or_invalid_names_raise_errors(registered, message, tmp_path):
    for name, layout in registered.items():
        write_package(tmp_path, name, {}, {"icrl4aht.layouts": {layout: "json:loads"}})
    with installed_plugins(tmp_path):
        with pytest.raises(PluginError, match=message):
            get_layout("elsewhere")
        assert get_layout("demo_wide") is LAYOUTS["demo_wide"]
        problems: dict[str, str] = {}
        doctor._plugins(problems)
        assert any("icrl4aht.layouts" in problem for problem in problems)
