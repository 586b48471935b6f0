"""Build a suite of learned teammates, and report how much the teammates differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pandas as pd
from rich.console import Console

from icrl4aht_data.benchmark.facts import (
    ALGORITHMS,
    EPISODE_STEPS,
    HEURISTIC_KINDS,
    TRACKS,
    layout_number,
    track_layouts,
)
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_data.utils.text import markdown_table
from icrl4aht_data.writing.splits import played_teammates, teammates_hash
from icrl4aht_generation.env import Environment
from icrl4aht_generation.jobs.options import QueueOptions
from icrl4aht_generation.jobs.queue import run_jobs
from icrl4aht_generation.learners.rollout import init_rollout, policy_player, roll_out
from icrl4aht_generation.policy import Policy
from icrl4aht_generation.populations.cross_play import EPISODES_PER_PAIR
from icrl4aht_generation.populations.select import TeammateSelection, select_teammates, write_manifests
from icrl4aht_generation.populations.train import (
    PopulationJob,
    PopulationRun,
    cross_play_matrix,
    is_trained,
    suite_checkpoints,
)
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.teammates.distances import act_on_records, hamming_distances, split_distances
from icrl4aht_generation.teammates.instances import published_teammates
from icrl4aht_generation.teammates.learned import build_learned
from icrl4aht_generation.teammates.references import REFERENCE_EGOS, stacked_policy_groups
from icrl4aht_generation.teammates.registry import build_teammate

_EPISODES = 2  # number of episodes of each policy from which the compared states are taken


def build_suite(
    profile: Profile,
    suite: Path,
    algorithms: Mapping[str, Sequence[str]],
    seed: int,
    console: Console,
    options: QueueOptions,
) -> list[TeammateSelection]:
    """Train unfinished populations, then write manifests of tasks with teammates of every finished population.

    Populations that another process is training are skipped at first, and awaited at the end.

    Args:
        profile: profile with the sizes of the populations.
        suite: the suite's folder.
        algorithms: names of the algorithms for each layout.
        seed: seed of the suite.
        console: where progress is printed.
        options: options of the queue that trains the populations.

    Returns:
        The selected teammates of each population in `algorithms`.

    Raises:
        FailedJobsError: if a population could not be trained.
    """
    config = profile.teammates
    runs = population_runs(profile, algorithms, seed)
    # The path is absolute, as workers have other working directories.
    jobs = [PopulationJob(run, suite.resolve(), profile.xla_threads) for run in runs]
    run_jobs(jobs, suite, console, options)
    wanted = [(run.layout.name, run.algorithm) for run in runs]
    selections = [
        select_teammates(suite, name, algorithm, config.train, config.heldout, seed)
        for name in training_layouts()
        for algorithm in ALGORITHMS
        if is_trained(suite, name, algorithm)
    ]
    for selection in selections:
        few = f"; only {len(selection.train)} of {config.train}" if len(selection.train) < config.train else ""
        console.print(
            f"{selection.algorithm} on {selection.layout}: {selection.good} of {selection.candidates} checkpoints "
            f"exceed the threshold; {len(selection.train)} for training, {len(selection.heldout)} held out{few}"
        )
    for path in write_manifests(suite, selections):
        console.print(f"wrote {path}")
    return [selection for selection in selections if (selection.layout, selection.algorithm) in wanted]


def population_runs(profile: Profile, algorithms: Mapping[str, Sequence[str]], seed: int) -> list[PopulationRun]:
    """Return the populations to train for each layout and algorithm, with different seeds."""
    config = profile.teammates
    return [
        PopulationRun(
            get_layout(name),
            algorithm,
            config.members,
            config.ppo,
            seed + 1000 * layout_number(name) + 100 * ALGORITHMS.index(algorithm),
        )
        for name, wanted in algorithms.items()
        for algorithm in wanted
    ]


def training_layouts() -> list[str]:
    """Return the names of all layouts with training tasks, registered layouts included."""
    return list(dict.fromkeys(name for track in TRACKS for name in track_layouts(track, "train")))


def report_diversity(
    suite: Path, layouts: Sequence[str], algorithms: Sequence[str], greedy: bool, console: Console
) -> None:
    """Print self-play and cross-play returns of populations, and distances between families, for each layout.

    Args:
        suite: the suite's folder.
        layouts: names of layouts; by default all layouts with a finished population of each of `algorithms`.
        algorithms: algorithms of the populations.
        greedy: whether teammates take their most probable actions.
        console: where to print.

    Raises:
        OptionError: if a population is not finished, or no layout has all populations.
    """
    names = list(dict.fromkeys(get_layout(name).name for name in layouts)) or [
        name for name in training_layouts() if all(is_trained(suite, name, algorithm) for algorithm in algorithms)
    ]
    if not names:
        raise OptionError(
            f"{suite}: no layout has all its populations finished; train populations with "
            f"`icrl4aht-data teammates --suite {suite}`, or choose a --layout"
        )
    for name in names:
        layout = get_layout(name)
        for algorithm in algorithms:
            _report_population(suite, layout, algorithm, greedy, console)
        _report_distances(suite, layout, algorithms, console)


def report_splits(root: Path, stored: Path | None, console: Console) -> None:
    """Print, for each training layout of a release, the smallest distance of validation to training teammates.

    Args:
        root: folder of the release.
        stored: file for the distances, which the release's dataset card shows; None to write no file.
        console: where to print.

    Raises:
        OptionError: if no training layout of the release has teammates in both splits.
    """
    dataset = load_icrl4aht(root)
    with progress_bars(unit="layouts") as show:
        found = split_distances(dataset, lambda done, total, name: show("distances", done, total, name))
    if not found:
        raise OptionError(f"{root}: no training layout has training and validation teammates; nothing to compare")
    rows = [[name, str(one.train), str(one.validation), f"{one.least:.3f}"] for name, one in found.items()]
    header = ["layout", "training teammates", "validation teammates", "smallest distance"]
    console.print(markdown_table(header, rows, right=3))
    if stored:
        played = played_teammates(dataset.tasks.values(), dataset.provenance)
        content = {"teammates": teammates_hash(played), "layouts": msgspec.to_builtins(found)}
        write_json(stored, content)


def _report_population(suite: Path, layout: Layout, algorithm: str, greedy: bool, console: Console) -> None:
    returns = cross_play_matrix(suite, layout, algorithm, greedy)
    diagonal = np.eye(len(returns), dtype=bool)
    title = (
        f"{algorithm} on {layout.name}: mean return of {EPISODES_PER_PAIR} episodes of {EPISODE_STEPS} steps, egos in "
        f"rows, teammates in columns"
    )
    console.print(title, _matrix_text([f"m{k}" for k in range(len(returns))], returns), sep="\n")
    self_play = returns[diagonal].mean()
    cross_play = returns[~diagonal].mean() if len(returns) > 1 else float("nan")
    console.print(f"self-play {self_play:.1f}, cross-play {cross_play:.1f}, gap {self_play - cross_play:.1f}")


def _report_distances(suite: Path, layout: Layout, algorithms: Sequence[str], console: Console) -> None:
    policies, families = [], {}
    for algorithm in algorithms:
        points = list(suite_checkpoints(suite, layout.name, algorithm))
        families[algorithm] = range(len(policies), len(policies) + len(points))
        policies += [build_learned(layout, suite / point.path) for point in points]
    for kind, short in HEURISTIC_KINDS.items():
        entries = published_teammates(layout.name, kind)
        families[short] = range(len(policies), len(policies) + len(entries))
        policies += [build_teammate(layout, entry) for entry in entries]
    distances = family_distances(hamming_distances(actions_on_common_states(layout, policies)), families)
    title = f"{layout.name}: mean Hamming distance of families"
    console.print(title, _matrix_text(list(families), distances), sep="\n")


def _matrix_text(names: list[str], values: np.ndarray) -> str:
    """Return a square matrix as text, with the same names for rows and columns."""
    return pd.DataFrame(values, names, names).to_string(float_format="{:.2f}".format)


def actions_on_common_states(
    layout: Layout, policies: Sequence[Policy], seed: int = 0, steps: int = EPISODE_STEPS
) -> np.ndarray:
    """Return the actions that each policy takes, as the teammate, in the same states.

    The states are from two episodes of each policy with a uniformly random ego. Every policy acts on every state, with
    the memory of a teammate that observed the episode up to this state.

    Returns:
        Actions int8 (policies, states), with states = policies x 2 x steps.
    """
    env, key = Environment(layout, steps), jax.random.key(seed)
    played = [_visited_records(env, *family, key) for family in stacked_policy_groups(policies)]
    records = jnp.concatenate(played, axis=1)  # (T, episodes, S)
    return act_on_records(layout, policies, records, seed).reshape(len(policies), -1)


def family_distances(distances: np.ndarray, families: Mapping[str, Sequence[int]]) -> np.ndarray:
    """Return the mean distance of each pair of F families over all pairs of their policies, float64 of shape (F, F).

    Within a family, pairs of a policy with itself also count, as in the paper's formula.
    """
    return np.array([[distances[np.ix_(a, b)].mean() for b in families.values()] for a in families.values()])


def _visited_records(env: Environment, numbers: list[int], family: Policy, key: Any) -> jax.Array:
    """Return state records of shape (T, policies x 2, S) from episodes of a random ego with each policy of a family."""
    n = len(numbers) * _EPISODES

    @jax.jit
    def play(params, key):
        own = jax.tree.map(lambda leaf: jnp.repeat(leaf, _EPISODES, axis=0), params)
        ego = policy_player(env, REFERENCE_EGOS["random"], (), EGO, n)
        players = [ego, policy_player(env, family, own, TEAMMATE, n, own_params=True)]
        carry = init_rollout(env, players, jax.random.split(key, n))
        return roll_out(env, players, carry, env.max_steps, key)[1].record

    return play(family.params, jax.random.fold_in(key, numbers[0]))
