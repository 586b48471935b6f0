"""Constants of the benchmark: tracks, splits and their layouts, teammate families, episode lengths.

The constants have the values of the published benchmark. The functions also accept layouts and heuristic teammates
registered by other installed packages, see docs/extending.md.
"""

from __future__ import annotations

import hashlib
from typing import Any

from icrl4aht_data.errors import check_choice, unknown_name
from icrl4aht_data.overcooked.layouts import added_layout_names
from icrl4aht_data.utils.plugins import Plugins

_TEAMMATE_LAYOUTS = ("coord_simple", "coord_ring", "test_simple", "test_wide", "demo_simple", "demo_wide")
_LAYOUT_LAYOUTS = ("asymm_both", "cramped_up")

SPLITS = ("train", "validation", "test", "heldout")
"""Splits of the tasks. `validation` and `heldout` use training layouts. `validation`, for choosing models, has
heuristic teammates in neither `train` nor `test`; `heldout` has learned teammates not in `train` (paper, App. F)."""

TRACKS: dict[str, dict[str, tuple[str, ...]]] = {
    "teammate": dict.fromkeys(SPLITS, _TEAMMATE_LAYOUTS),
    "layout": dict.fromkeys(SPLITS, _LAYOUT_LAYOUTS) | {"test": ("asymm_right", "cramped_down")},
}
"""Short layout names of each track and split: track -> split -> layouts (paper, App. A)."""

SPREAD_SEED = 4
"""Value of `base_seed` in the entries of spread teammates, see `icrl4aht_generation.teammates.spread`."""

PREFERENCE = "preference"
"""Track of this project, not of the paper: all episodes of a task want the same dish, but no observation shows which
dish (see docs/preference.md)."""

PREFERENCE_LAYOUTS: dict[str, tuple[str, ...]] = {
    "train": (
        "asymm_both_plain",
        "test_wide_plain",
        "rooms-0-46",
        "rooms-0-271",
        "rooms-0-286",
        "templates-0-46",
        "templates-0-164",
        "rooms-0-67",
        "rooms-0-202",
        "templates-0-38",
        "templates-0-60",
        "templates-0-160",
    ),
    "test": (
        "cramped_down_plain",
        "templates-0-217",
        "templates-0-255",
        "templates-0-47",
        "templates-0-159",
        "templates-0-194",
    ),
}
"""Layouts of the track `PREFERENCE`. Training and validation tasks and half of the test tasks use the layouts "train",
the other test tasks use the layouts "test". No layout has indicators or buttons. A name that ends in "_plain" is a
published layout without them. The others are chosen from 90 generated layouts: on these, the returns of the scripted
searcher rise most with randomly drawn training teammates."""

PLAIN = "_plain"
"""Suffix of the name of a published layout whose indicators and buttons were removed."""

ALL_TRACKS = (*TRACKS, PREFERENCE)
"""Names of the benchmark's tracks and of the track that this project adds."""

TESTED_ON = {
    **{layout: layout for layout in _TEAMMATE_LAYOUTS},
    "asymm_both": "asymm_right",
    "cramped_up": "cramped_down",
}
"""Training layout -> the layout that its models are tested on (paper, Sec. 5.1 and 5.2)."""

LAYOUT_NAMES = tuple(dict.fromkeys(name for splits in TRACKS.values() for names in splits.values() for name in names))
"""Every layout of the benchmark, in the paper's order."""

FOUR_RECIPES = ((0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1))
"""Recipes used for the published results on the layout track; the layouts themselves have the first and the last."""

_OTHER_NUMBERS = 10_000  # number of possible values of `layout_number` for registered layouts

FAMILIES = ("rl", "H1", "H2", "H3", "H4")
"""Families of teammates: "rl" (learned policies) and the heuristics "H1".."H4" (paper, App. B)."""

HEURISTIC_KINDS = {
    "recipe_aware_button": "H1",
    "territory": "H2",
    "assembly_line": "H3",
    "utility_greedy": "H4",
}
"""teammate kind -> family, for the heuristics."""

ALGORITHMS = ("fcp", "brdiv", "lbrdiv", "comedi")
"""The teammate kinds of family `rl`: algorithms that train teammates (paper, App. B.1)."""

KIND_FAMILIES = dict.fromkeys(ALGORITHMS, "rl") | HEURISTIC_KINDS
"""teammate kind -> family, for algorithms and heuristics."""

TEAMMATE_PLUGINS = Plugins("icrl4aht.teammates", (*FAMILIES, *KIND_FAMILIES))
"""Heuristic teammates registered by other packages. Each is a separate family with the same name."""

SOURCES = ("ppo", "noise", "agent", "search", "human")
"""Ways to make histories. "ppo": an ego learns with PPO. "noise": a script plays, and its random actions become rarer
(noise distillation, Zisman et al. 2024). "agent": a trained agent plays, perhaps with random actions that become
rarer. "search": a script finds out which dish its teammate wants. "human": a person plays. Releases may name other
sources."""

SCRIPTED_SOURCES = ("noise", "search")
"""Sources of histories played by a script; the script's actions without noise are the expert actions."""

LABEL_VIEWS = ("ego", "state")
"""Input of the policy that chose `expert_actions`: "ego" for the ego's observation, "state" for the full state."""

REBUILT_SOURCES = ("ppo", *SCRIPTED_SOURCES)
"""Sources of histories that `generate` can make without a trained agent."""

EPISODE_STEPS = 400
"""Steps of an episode in training (paper, App. C)."""

KEPT_STEPS = 100
"""Steps kept of each training episode, and steps of an evaluation episode (paper, App. C and Sec. 4.3)."""

LABEL_EPISODES = 200
"""Episodes of `KEPT_STEPS` steps over which the returns of the policy behind expert actions are measured."""

PAPER_EGO_STEPS = 60_000_000
"""Environment steps for which an ego learns (paper, App. C.2.2)."""

PAPER_TEAMMATE_STEPS = 30_000_000
"""Environment steps for which a member of a population of teammates learns (paper, App. B.1)."""

PAPER_TEAMMATES = 20
"""Training teammates of each algorithm and layout (paper, App. B.1)."""

LEAST_HEADROOM = 5.0
"""Minimum difference between the returns of a best response and of `stay`; teammates with less are left out."""

SAME_BEHAVIOUR = 0.02
"""Hamming distance between the actions of two teammates below which they count as one behaviour."""


def all_families() -> tuple[str, ...]:
    """Return all families of teammates: first those of the benchmark, then the registered ones."""
    return (*FAMILIES, *TEAMMATE_PLUGINS.names)


def family_sort_key(family: str) -> tuple[int, str]:
    """Return the sort key of a family: the benchmark's families come first, then other families by name."""
    return (FAMILIES.index(family), "") if family in FAMILIES else (len(FAMILIES), family)


def kind_family(kind: str) -> str | None:
    """Return the teammate family that a teammate kind belongs to; None for an unknown kind."""
    return KIND_FAMILIES.get(kind) or (kind if kind in TEAMMATE_PLUGINS.names else None)


def track_layouts(track: str, split: str) -> tuple[str, ...]:
    """Return short names of a track's layouts in a split; registered and generated layouts belong to track `layout`."""
    if track == PREFERENCE:
        return PREFERENCE_LAYOUTS["train"] + (PREFERENCE_LAYOUTS["test"] if split == "test" else ())
    return (*TRACKS[track][split], *(added_layout_names() if track == "layout" else ()))


def layout_track(layout: str) -> str:
    """Return the benchmark's track whose layouts include `layout` (short name).

    A published layout without its indicators and buttons (suffix `PLAIN`) keeps its track; the track of generated and
    registered layouts is "layout", also if they belong to the track `PREFERENCE`.

    Raises:
        UnknownNameError: if no track includes the layout.
    """
    name = layout.removesuffix(PLAIN)
    for track, splits in TRACKS.items():
        if any(name in layouts for layouts in splits.values()):
            return track
    if layout in (*added_layout_names(), *PREFERENCE_LAYOUTS["train"], *PREFERENCE_LAYOUTS["test"]):
        return "layout"
    raise unknown_name("layout", layout, (*LAYOUT_NAMES, *added_layout_names()))


def layout_sort_key(layout: str) -> tuple[int, str]:
    """Return the sort key of a layout (short name): the benchmark's layouts come first, then others by name."""
    return (LAYOUT_NAMES.index(layout), "") if layout in LAYOUT_NAMES else (len(LAYOUT_NAMES), layout)


def layout_number(layout: str) -> int:
    """Return the number of a layout (short name) for making seeds: its position in `LAYOUT_NAMES`.

    A registered layout's number is a hash of its name, so the number does not depend on the installed packages.
    """
    if layout in LAYOUT_NAMES:
        return LAYOUT_NAMES.index(layout)
    digest = hashlib.sha256(layout.encode()).digest()
    return len(LAYOUT_NAMES) + int.from_bytes(digest[:4], "big") % _OTHER_NUMBERS


def check_family(family: object) -> None:
    """Check that a family of teammates exists.

    Raises:
        UnknownNameError: for an unknown family; the message lists the valid names and suggests the nearest.
    """
    if family not in FAMILIES and family not in (families := all_families()):
        raise unknown_name("teammate_family", family, families)


def check_layout_in_split(track: Any, split: Any, layout: Any) -> None:
    """Check that a layout (short name) belongs to a split of a track.

    Raises:
        UnknownNameError: if one of the names is wrong; the message lists the valid names and suggests the nearest.
    """
    check_choice("track", track, ALL_TRACKS)
    check_choice("split", split, SPLITS)
    published = TRACKS.get(track, {}).get(split, ())
    if layout not in published and layout not in (names := track_layouts(track, split)):
        raise unknown_name(f"layout of the {split} split of track {track}", layout, names)
