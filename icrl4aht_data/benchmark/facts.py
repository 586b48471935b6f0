"""Constants of the benchmark: tracks, splits and their layouts, teammate families, episode lengths.

The constants are those of the published benchmark. The functions also accept layouts and heuristic teammates
registered by other installed packages, see docs/extending.md.
"""

from __future__ import annotations

import hashlib
from typing import Any

from icrl4aht_data.errors import check_choice, unknown
from icrl4aht_data.overcooked.layouts import further_layout_names
from icrl4aht_data.utils.plugins import Plugins

_TEAMMATE_LAYOUTS = ("coord_simple", "coord_ring", "test_simple", "test_wide", "demo_simple", "demo_wide")
_LAYOUT_LAYOUTS = ("asymm_both", "cramped_up")

TRACKS: dict[str, dict[str, tuple[str, ...]]] = {
    "teammate": {
        "train": _TEAMMATE_LAYOUTS,
        "validation": _TEAMMATE_LAYOUTS,
        "test": _TEAMMATE_LAYOUTS,
        "heldout": _TEAMMATE_LAYOUTS,
    },
    "layout": {
        "train": _LAYOUT_LAYOUTS,
        "validation": _LAYOUT_LAYOUTS,
        "test": ("asymm_right", "cramped_down"),
        "heldout": _LAYOUT_LAYOUTS,
    },
}
"""Short layout names of each track and split: track -> split -> layouts (paper, App. A)."""

PREFERENCE = "preference"
"""A track of this project, not of the paper: each task wants one dish, which no observation shows (see
docs/preference.md)."""

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
"""Layouts of the track `PREFERENCE`: those of training, validation and of half of the test tasks, and those of the
other half. "plain": a published layout without indicators and buttons. The others are generated layouts without them,
those among 90 on which the returns of the scripted searcher rise most with drawn training teammates."""

PLAIN = "_plain"
"""End of the name of a published layout without its indicators and buttons."""

ALL_TRACKS = (*TRACKS, PREFERENCE)
"""The benchmark's tracks and the project's own."""

TESTED_ON = {
    **{layout: layout for layout in _TEAMMATE_LAYOUTS},
    "asymm_both": "asymm_right",
    "cramped_up": "cramped_down",
}
"""Training layout -> the layout that its models are tested on (paper, Sec. 5.1 and 5.2)."""

LAYOUT_NAMES = tuple(dict.fromkeys(name for splits in TRACKS.values() for names in splits.values() for name in names))
"""Every layout of the benchmark, in the paper's order."""

FOUR_RECIPES = ((0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1))
"""Recipes of the published numbers on the layout track; a layout's own are the first and the last."""

_OTHER_NUMBERS = 10_000  # number of possible `layout_number` values of registered layouts

SPLITS = ("train", "validation", "test", "heldout")
"""Splits of the tasks. Both of the following use training layouts: `validation`, for choosing models, has
heuristic teammates in neither `train` nor `test`; `heldout` has learned teammates not in `train` (paper, App. F)."""

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
"""How histories are made. "ppo": an ego learns with PPO. "noise": a script plays, and its random actions become rarer
(noise distillation, Zisman et al. 2024). "agent": a trained agent plays, perhaps with random actions that become
rarer. "search": a script finds out which dish its teammate wants. "human": a person plays. Releases may name other
sources."""

SCRIPTED_SOURCES = ("noise", "search")
"""Sources of histories that a script plays; its actions without noise label them."""

LABEL_VIEWS = ("ego", "state")
"""What the policy behind `expert_actions` could see: "ego", what an ego sees, or "state", the full state."""

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
"""Least difference between a best response and `stay` with a teammate that is kept."""

SAME_BEHAVIOUR = 0.02
"""Hamming distance below which two teammates count as one behaviour."""


def all_families() -> tuple[str, ...]:
    """Return all families of teammates: the benchmark's, then registered ones."""
    return (*FAMILIES, *TEAMMATE_PLUGINS.names)


def family_order(family: str) -> tuple[int, str]:
    """Return the sort key of a family: the benchmark's families in order, then others by name."""
    return (FAMILIES.index(family), "") if family in FAMILIES else (len(FAMILIES), family)


def kind_family(kind: str) -> str | None:
    """Return the family of a teammate kind; None for an unknown kind."""
    return KIND_FAMILIES.get(kind) or (kind if kind in TEAMMATE_PLUGINS.names else None)


def track_layouts(track: str, split: str) -> tuple[str, ...]:
    """Return the short names of a track's layouts in a split; further ones are in every split of `layout`."""
    if track == PREFERENCE:
        return PREFERENCE_LAYOUTS["train"] + (PREFERENCE_LAYOUTS["test"] if split == "test" else ())
    return (*TRACKS[track][split], *(further_layout_names() if track == "layout" else ()))


def track_of(layout: str) -> str:
    """Return the benchmark's track whose layouts include `layout` (short name).

    A published layout without indicators counts like the published one, generated and registered layouts as "layout".

    Raises:
        UnknownNameError: if no track includes it.
    """
    name = layout.removesuffix(PLAIN)
    for track, splits in TRACKS.items():
        if any(name in layouts for layouts in splits.values()):
            return track
    if layout in (*further_layout_names(), *PREFERENCE_LAYOUTS["train"], *PREFERENCE_LAYOUTS["test"]):
        return "layout"
    raise unknown("layout", layout, (*LAYOUT_NAMES, *further_layout_names()))


def layout_order(layout: str) -> tuple[int, str]:
    """Return the sort key of a layout (short name): the benchmark's layouts in order, then others by name."""
    return (LAYOUT_NAMES.index(layout), "") if layout in LAYOUT_NAMES else (len(LAYOUT_NAMES), layout)


def layout_number(layout: str) -> int:
    """Return the number of a layout (short name), for seeds: its position in `LAYOUT_NAMES`.

    The number of a registered layout is a hash of its name, so it does not depend on the packages installed.
    """
    if layout in LAYOUT_NAMES:
        return LAYOUT_NAMES.index(layout)
    digest = hashlib.sha256(layout.encode()).digest()
    return len(LAYOUT_NAMES) + int.from_bytes(digest[:4], "big") % _OTHER_NUMBERS


def check_family(family: object) -> None:
    """Check that a family of teammates exists.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    if family not in FAMILIES and family not in (families := all_families()):
        raise unknown("teammate_family", family, families)


def check_membership(track: Any, split: Any, layout: Any) -> None:
    """Check that a layout (short name) belongs to a split of a track.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    check_choice("track", track, ALL_TRACKS)
    check_choice("split", split, SPLITS)
    published = TRACKS.get(track, {}).get(split, ())
    if layout not in published and layout not in (names := track_layouts(track, split)):
        raise unknown(f"layout of the {split} split of track {track}", layout, names)
