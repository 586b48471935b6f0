"""Facts of the benchmark: tracks, splits, teammate families, lengths, and which layouts belong to which split."""

from __future__ import annotations

from icrl4aht_data.errors import unknown

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
"""Every layout of the benchmark, in the paper's order; the position in this tuple enters seeds."""

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


def track_of(layout: str) -> str:
    """The track whose train or test layouts include `layout` (short name).

    Raises:
        UnknownNameError: if there is none.
    """
    for track, splits in TRACKS.items():
        if any(layout in layouts for layouts in splits.values()):
            return track
    raise unknown("layout", layout, LAYOUT_NAMES)


def check_membership(track: object, split: object, layout: object) -> None:
    """Check that a layout (short name) belongs to a split of a track.

    Raises:
        UnknownNameError: lists the valid names and the nearest.
    """
    if not isinstance(track, str) or track not in TRACKS:
        raise unknown("track", track, TRACKS)
    if not isinstance(split, str) or split not in SPLITS:
        raise unknown("split", split, SPLITS)
    if layout not in TRACKS[track][split]:
        raise unknown(f"layout of the {split} split of track {track}", layout, TRACKS[track][split])
