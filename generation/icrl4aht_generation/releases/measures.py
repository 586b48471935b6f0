"""Measurements of a release's teammates: returns of reference egos with each teammate, and the nearest test teammate.

The measurements of sampled and spread teammates are in `teammates/draws.jsonl` and `teammates/spread.jsonl`. The
provenance of an existing release contains the measurements of its teammates. Other teammates are measured once, and
their measurements are stored next to the artefacts, in hidden files `.<layout>.teammates.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import msgspec
import numpy as np

from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS, KEPT_STEPS, TESTED_ON
from icrl4aht_data.benchmark.tasks import Task
from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.format.checkpoints import checkpoint_folder
from icrl4aht_data.format.info import LeftOutTask
from icrl4aht_data.format.provenance import NearestTestTeammate, Provenance, ReferenceEgos, read_provenance
from icrl4aht_data.format.schema import PROVENANCE, TEAMMATES
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.files import read_text, write_atomically
from icrl4aht_data.utils.groups import grouped
from icrl4aht_generation.env import Environment
from icrl4aht_generation.learners.resume import software_versions
from icrl4aht_generation.learners.rollout import init_rollout, policy_player, roll_out
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.populations.train import RESPONSES
from icrl4aht_generation.teammates.distances import nearest_test
from icrl4aht_generation.teammates.draws import unusable_reason, usable_families
from icrl4aht_generation.teammates.learned import build_learned
from icrl4aht_generation.teammates.references import REFERENCE_EPISODES, reference_egos, reference_returns
from icrl4aht_generation.teammates.registry import HEURISTIC_FAMILIES, build_teammate
from icrl4aht_generation.teammates.spread import find_measured, read_spread

T = TypeVar("T")


_SEED = 12  # seed of episodes of a learned teammate with its training partner


def learned_reference_returns(tasks: Sequence[Task], suite: Path) -> dict[str, ReferenceEgos]:
    """Measure the returns of reference egos with learned teammates.

    Args:
        tasks: tasks with learned teammates.
        suite: folder of the teammates' checkpoints.

    Returns:
        Returns of the reference egos by task id.
    """
    found = {}
    for layout, own in grouped(tasks, lambda task: task.layout).items():
        folders = [checkpoint_folder(suite, task.teammate) for task in own]
        mates = [build_learned(layout, folder) for folder in folders]
        partners = [build_learned(layout, _training_partner_folder(folder), "sampled") for folder in folders]
        for task, ego, mate, returns in zip(own, partners, mates, reference_returns(layout, mates), strict=True):
            play = _compiled_self_play(layout, ego._replace(params=()), mate._replace(params=()))
            self_play = float(np.asarray(play(ego.params, mate.params)).mean())
            found[task.task_id] = reference_egos(returns, self_play)
    return found


def _training_partner_folder(folder: Path) -> Path:
    """Return the training partner's folder for a checkpoint folder m<k>/c<n>: a best response, or the same folder."""
    response = folder.parent.parent / RESPONSES / folder.parent.name
    return response if response.is_dir() else folder


@lru_cache(maxsize=8)
def _compiled_self_play(layout: Layout, ego: Policy, mate: Policy) -> Callable[[Any, Any], jax.Array]:
    """Return a compiled function of both policies' parameters that returns an array with the return of each episode."""
    env = Environment(layout, KEPT_STEPS)

    @jax.jit
    def play(ego_params: Any, mate_params: Any) -> jax.Array:
        players = [
            policy_player(env, ego, ego_params, EGO, REFERENCE_EPISODES),
            policy_player(env, mate, mate_params, TEAMMATE, REFERENCE_EPISODES),
        ]
        episodes, actions = jax.random.split(jax.random.key(_SEED))
        carry = init_rollout(env, players, jax.random.split(episodes, REFERENCE_EPISODES))
        return roll_out(env, players, carry, KEPT_STEPS, actions)[1].reward.sum(axis=0)

    return play


class TeammateFacts(NamedTuple):
    """Measurements of the teammate of a task.

    Attributes:
        references: returns of the reference egos with the teammate.
        nearest: the test teammate that behaves most similarly, from all families; None if unknown.
    """

    references: ReferenceEgos
    nearest: NearestTestTeammate | None


def teammate_facts(
    tasks: Iterable[Task], artefacts: Path, suite: Path, headroom: Mapping[str, ReferenceEgos] | None = None
) -> dict[str, TeammateFacts]:
    """Return the recorded or new measurements of the teammates of tasks; each teammate is measured only once.

    Args:
        tasks: tasks with the teammates.
        artefacts: folder of the artefacts, where measurements are stored.
        suite: folder of the learned teammates: a suite, or the folder `teammates` of a release with measurements
            in its provenance.
        headroom: existing measurements of learned teammates by task id.

    Returns:
        Measurements of each task's teammate by task id.
    """
    headroom, recorded = headroom or {}, recorded_provenance(suite)
    groups = grouped(tasks, lambda task: task.teammate_key)
    found: dict[tuple[str, str], TeammateFacts] = {}
    for key, members in groups.items():
        draw, made = find_measured(key[0], members[0].teammate), recorded.get(members[0].task_id)
        if draw is not None:
            distance, _, name = min((draw.distance, 0, draw.nearest), (draw.other_distance, 1, draw.other))
            egos = ReferenceEgos(draw.stay, draw.random, draw.oracle, REFERENCE_EPISODES)
            found[key] = TeammateFacts(egos, NearestTestTeammate(name, distance, draw.behaviour))
        elif made is not None and made.references is not None:
            found[key] = TeammateFacts(made.references, made.nearest_test)
    unknown = (key for key in groups if key not in found)
    for layout, keys in grouped(unknown, lambda key: key[0]).items():
        chosen = [next((task for task in groups[key] if task.task_id in headroom), groups[key][0]) for key in keys]
        kept = artefacts / f".{layout}.teammates.json"
        settings = software_versions() | {
            "layout": layout,
            "teammates": [[task.teammate, task.recipes] for task in chosen],
            "episodes": REFERENCE_EPISODES,
        }
        measured = cached_measurement(kept, settings, list[TeammateFacts], partial(_measure, chosen, suite, headroom))
        found |= dict(zip(keys, measured, strict=True))
    return {task.task_id: found[key] for key, members in groups.items() for task in members}


def cached_measurement(path: Path, settings: dict[str, Any], kind: type[T], measure: Callable[[], T]) -> T:
    """Return measurements from a JSON file; measure and write the file if its settings differ.

    Args:
        path: path of the file.
        settings: settings that the measurements depend on.
        kind: type of the measurements, which msgspec validates.
        measure: function that returns new measurements.
    """
    try:
        content = msgspec.json.decode(read_text(path))  # unlike `json`, msgspec refuses NaN
        if content["settings"] == json.loads(json.dumps(settings)):
            return msgspec.convert(content["measured"], kind)
    except (IndexFormatError, KeyError, TypeError, msgspec.MsgspecError):
        pass  # the file is missing, damaged or from another version
    measured = measure()
    write_atomically(path, msgspec.json.encode({"settings": settings, "measured": measured}))
    return measured


def release_provenance(root: Path) -> dict[str, Provenance]:
    """Return the provenance of a release by task id; empty if the folder is not a release."""
    path = root / PROVENANCE
    return read_provenance(path) if path.is_file() else {}


def recorded_provenance(suite: Path) -> dict[str, Provenance]:
    """Return the provenance, by task id, of the release that a folder of learned teammates belongs to.

    The result is empty for a suite, which belongs to no release.
    """
    return release_provenance(suite.parent) if suite.name == TEAMMATES else {}


def _measure(tasks: Sequence[Task], suite: Path, headroom: Mapping[str, ReferenceEgos]) -> list[TeammateFacts]:
    """Measure the returns with teammates of one layout, and the distances of learned teammates to the test teammates.

    Distances of heuristics such as presets are not measured, because this would take longer than generating a small
    release. The card warns against claims of generalization to new teammates of these families.
    """
    learned = [task for task in tasks if task.teammate_family == "rl"]
    heuristics = [task for task in tasks if task.teammate_family != "rl"]
    missing = [task for task in learned if task.task_id not in headroom]
    returns = {task.task_id: headroom[task.task_id] for task in learned if task not in missing}
    returns |= learned_reference_returns(missing, suite)
    for task in heuristics:  # one at a time, because tasks may have different recipes
        (egos,) = reference_returns(task.layout, [build_teammate(None, task.teammate)])
        returns[task.task_id] = reference_egos(egos)
    nearest: dict[str, NearestTestTeammate] = {}
    layout = tasks[0].layout
    if learned and layout.name in TESTED_ON:  # other layouts have no test teammates to compare with
        mates = [build_teammate(layout, task.teammate, suite=suite) for task in learned]
        nearest = dict(zip((task.task_id for task in learned), nearest_test(layout, mates), strict=True))
    return [TeammateFacts(returns[task.task_id], nearest.get(task.task_id)) for task in tasks]


def unusable_families(layouts: Iterable[str]) -> list[LeftOutTask]:
    """Return heuristic families without usable sampled training teammates, with the reasons, for each layout."""
    return [
        _left_out(layout, HEURISTIC_KINDS[family], unusable_reason(layout, family))
        for layout in layouts
        if layout in TESTED_ON
        for family in HEURISTIC_FAMILIES
        if family not in usable_families(layout)
    ]


def few_spread_teammates(per_layout: Mapping[str, int]) -> list[LeftOutTask]:
    """Return training layouts with fewer spread teammates than others, with the reasons; none without headroom.

    Args:
        per_layout: number of spread training teammates in a release, by layout, see `teammates.spread`.
    """
    most = max(per_layout.values(), default=0)
    spreads = (read_spread(layout) for layout in TESTED_ON if per_layout.get(layout, most) < most)
    return [
        _left_out(
            spread.layout,
            "spread",
            f"{spread.unlike_tests} of {spread.tried} candidates act unlike test teammates, {spread.headroom} of these "
            "have headroom",
        )
        for spread in spreads
        if spread.headroom
    ]


def _left_out(layout: str, teammate: str, reason: str) -> LeftOutTask:
    """Return an entry for teammates of a layout for which no task was planned."""
    return LeftOutTask("", layout, teammate, "", 0, 0, None, None, reason)
