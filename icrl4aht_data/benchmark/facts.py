"""Facts of the benchmark: tracks, splits, teammate families, lengths, and which layouts belong to which split.

The constants are those of the published benchmark. The functions also know the layouts and heuristic teammates that
other installed packages register, see docs/extending.md.
"""

from __future__ import annotations

import hashlib

from icrl4aht_data.errors import unknown
from icrl4aht_data.overcooked.layouts import LAYOUT_PLUGINS
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

TESTED_ON = {
    **{layout: layout for layout in _TEAMMATE_LAYOUTS},
    "asymm_both": "asymm_right",
    "cramped_up": "cramped_down",
}
"""Training layout -> the layout that its models are tested on (paper, Sec. 5.1 and 5.2)."""

LAYOUT_NAMES = tuple(dict.fromkeys(name for splits in TRACKS.values() for names in splits.values() for name in names))
"""Every layout of the benchmark, in the paper's order."""

_OTHER_NUMBERS = 10_000  # different numbers of layouts that are not among these

SPLITS = ("train", "validation", "test", "heldout")
"""Splits of the tasks. `validation` combines training layouts with heuristic teammates that are neither in `train`
nor in `test`, for choosing models; `heldout` with learned teammates that are not in `train` (paper, App. F)."""

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
"""Heuristic teammates of other installed packages. Each is a family of its own, of the same name."""

SOURCES = ("ppo", "noise", "student")
"""How histories are made: by an ego that learns with PPO; by a script whose actions are replaced by random ones, ever
more rarely (noise distillation, Zisman et al. 2024); by a trained agent, whose actions may be replaced in the same way.
Releases may name others."""

REBUILT_SOURCES = SOURCES[:2]
"""The sources that a release is rebuilt from nothing with."""

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
"""Difference of the reference egos' returns with a teammate from which the ego matters."""

SAME_BEHAVIOUR = 0.02
"""Hamming distance below which two teammates count as one behaviour."""


def all_families() -> tuple[str, ...]:
    """Families of teammates: those of the benchmark, then registered ones."""
    return (*FAMILIES, *TEAMMATE_PLUGINS.names)


def family_order(family: str) -> tuple[int, str]:
    """Sort key of a family: those of the benchmark come first, in its order, then others by name."""
    return (FAMILIES.index(family), "") if family in FAMILIES else (len(FAMILIES), family)


def kind_family(kind: str) -> str | None:
    """Family of a teammate kind; None for a kind that is neither of the benchmark nor registered."""
    return KIND_FAMILIES.get(kind) or (kind if kind in TEAMMATE_PLUGINS.names else None)


def track_layouts(track: str, split: str) -> tuple[str, ...]:
    """Short names of the layouts of a track and split; registered layouts belong to every split of track `layout`."""
    return (*TRACKS[track][split], *(LAYOUT_PLUGINS.names if track == "layout" else ()))


def track_of(layout: str) -> str:
    """The track whose train or test layouts include `layout` (short name).

    Raises:
        UnknownNameError: if there is none.
    """
    for track, splits in TRACKS.items():
        if any(layout in layouts for layouts in splits.values()):
            return track
    if layout in LAYOUT_PLUGINS.names:
        return "layout"
    raise unknown("layout", layout, (*LAYOUT_NAMES, *LAYOUT_PLUGINS.names))


def layout_order(layout: str) -> tuple[int, str]:
    """Sort key of a layout (short name): those of the benchmark come first, in its order, then others by name."""
    return (LAYOUT_NAMES.index(layout), "") if layout in LAYOUT_NAMES else (len(LAYOUT_NAMES), layout)


def layout_number(layout: str) -> int:
    """Number of a layout (short name), for seeds: its position in `LAYOUT_NAMES`.

    The number of a layout that is not there follows from its name alone, so that it does not depend on which other
    packages are installed.
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


def check_membership(track: object, split: object, layout: object) -> None:
    """Check that a layout (short name) belongs to a split of a track.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    if not isinstance(track, str) or track not in TRACKS:
        raise unknown("track", track, TRACKS)
    if not isinstance(split, str) or split not in SPLITS:
        raise unknown("split", split, SPLITS)
    if layout not in TRACKS[track][split] and layout not in (names := track_layouts(track, split)):
        raise unknown(f"layout of the {split} split of track {track}", layout, names)
