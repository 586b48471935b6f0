"""A whole suite of learned teammates, and what it looks like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from generation.learners.resume import BusyError
from generation.populations.cross_play import EPISODES
from generation.populations.diversity import actions_on_common_states, between_families, hamming
from generation.populations.figures import plot_matrix
from generation.populations.select import Selection, layout_number, select, write_manifests
from generation.populations.train import Run, checkpoints, is_trained, play_matrix, train
from generation.profiles import Profile
from generation.progress import progress
from generation.teammates import learned
from generation.teammates.instances import published_thetas
from generation.teammates.registry import build
from icrl4aht_data.benchmark.facts import ALGORITHMS, EPISODE_STEPS, HEURISTIC_KINDS, TRACKS, track_of
from icrl4aht_data.errors import OptionError, unknown
from icrl4aht_data.overcooked.layouts import Layout, get_layout


def build_suite(
    profile: Profile,
    suite: Path,
    algorithms: Mapping[str, Sequence[str]],
    seed: int,
    console: Console,
) -> list[Selection]:
    """Train what is unfinished, then write manifests of tasks with the teammates of every finished population.

    `algorithms` has those of each layout. Populations that another process trains are left to it until nothing else is
    to do, then waited for.

    Returns:
        What the filter left of each population that was asked for.
    """
    for name in chain(*algorithms.values()):
        if name not in ALGORITHMS:
            raise unknown("algorithm", name, ALGORITHMS)
    config = profile.teammates
    todo = runs(profile, algorithms, seed)
    wanted = [(run.layout.name, run.algorithm) for run in todo]
    for wait in (False, True):
        todo = [run for run in todo if not _train(run, suite / run.layout.name / run.algorithm, wait, console)]
    selections = [
        select(suite, name, algorithm, config.train, config.heldout, seed)
        for name in training_layouts()
        for algorithm in ALGORITHMS
        if is_trained(suite, name, algorithm)
    ]
    for selection in selections:
        console.print(_in_words(selection, config.train))
    for path in write_manifests(suite, selections):
        console.print(f"wrote {path}")
    return [selection for selection in selections if (selection.layout, selection.algorithm) in wanted]


def runs(profile: Profile, algorithms: Mapping[str, Sequence[str]], seed: int) -> list[Run]:
    """The populations by these algorithms of each layout, each with a seed of its own."""
    config = profile.teammates
    return [
        Run(
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
    """The layouts of all training tasks."""
    return list(dict.fromkeys(name for splits in TRACKS.values() for name in splits["train"]))


def _names(layouts: Sequence[str]) -> list[str]:
    return list(dict.fromkeys(get_layout(name).name for name in layouts))


def _complete(suite: Path, layout: str) -> bool:
    return all(is_trained(suite, layout, algorithm) for algorithm in ALGORITHMS)


def _train(run: Run, folder: Path, wait: bool, console: Console) -> bool:
    """Whether the population is finished now; False if another process is at it."""
    label = f"{run.algorithm} on {run.layout.name}"
    last: dict[str, float] = {}
    with progress(console) as bars:
        bar = bars.add_task(label, total=run.updates, note="compiling")

        def report(update: int, updates: int, metrics: dict[str, float]) -> None:
            last.update(metrics)
            note = f"{metrics['steps_per_second']:,.0f} steps/s, self-play {last.get('self_play', 0.0):.1f}"
            bars.update(bar, completed=update, note=note)

        try:
            if not train(run, folder, report, wait=wait):
                console.print(f"{label}: finished before")
                return True
        except BusyError:
            console.print(f"{label}: another process is training it")
            return False
    console.print(
        f"{label}: {last['step']:,} steps a member at {last['steps_per_second']:,.0f} steps/s (all tables), "
        f"last self-play return {last.get('self_play', 0.0):.1f} (400 steps)"
    )
    return True


def _in_words(selection: Selection, wanted: int) -> str:
    few = f"; only {len(selection.train)} of {wanted}" if len(selection.train) < wanted else ""
    return (
        f"{selection.algorithm} on {selection.layout}: {selection.good} of {selection.candidates} checkpoints exceed "
        f"the threshold; {len(selection.train)} for training, {len(selection.heldout)} held out{few}"
    )


def report_diversity(
    suite: Path, layouts: Sequence[str], algorithms: Sequence[str], greedy: bool, console: Console
) -> None:
    """Print and draw, for each layout, self-play and cross-play of every population and the distances of families.

    Raises:
        OptionError: if a population was not finished, or no layout has all of them.
    """
    names = _names(layouts) or [name for name in training_layouts() if _complete(suite, name)]
    if not names:
        raise OptionError(
            f"{suite}: no layout has all its populations finished; `python -m generation teammates --suite {suite}` "
            f"trains them, or name a --layout"
        )
    for name in names:
        layout = get_layout(name)
        for algorithm in algorithms:
            _report_population(suite, layout, algorithm, greedy, console)
        _report_distances(suite, layout, algorithms, console)


def _report_population(suite: Path, layout: Layout, algorithm: str, greedy: bool, console: Console) -> None:
    returns = play_matrix(suite, layout, algorithm, greedy)
    members = [f"m{k}" for k in range(len(returns))]
    own = np.eye(len(returns), dtype=bool)
    title = f"{algorithm} on {layout.name}: mean return of {EPISODES} episodes of {EPISODE_STEPS} steps"
    console.print(_table(title, "seat 0 \\ seat 1", members, returns, ".1f"))
    across = returns[~own].mean() if len(returns) > 1 else float("nan")
    console.print(
        f"self-play {returns[own].mean():.1f}, cross-play {across:.1f}, gap {returns[own].mean() - across:.1f}"
    )
    path = suite / layout.name / algorithm / "cross_play.png"
    plot_matrix(returns, members, members, path, f"{algorithm}, {layout.name}: return", ("seat 0", "seat 1"))
    console.print(f"wrote {path}")


def _report_distances(suite: Path, layout: Layout, algorithms: Sequence[str], console: Console) -> None:
    policies, families = [], {}
    for algorithm in algorithms:
        points = list(checkpoints(suite, layout.name, algorithm))
        families[algorithm] = range(len(policies), len(policies) + len(points))
        policies += [learned.build(layout, suite / point.path) for point in points]
    for kind, short in HEURISTIC_KINDS.items():
        thetas = published_thetas(layout.name, kind)
        families[short] = range(len(policies), len(policies) + len(thetas))
        policies += [build(layout, {"family": kind, "theta": theta}) for theta in thetas]
    distances = between_families(hamming(actions_on_common_states(layout, policies)), families)
    labels = list(families)
    console.print(_table(f"{layout.name}: mean Hamming distance of families", "", labels, distances, ".2f"))
    path = suite / layout.name / "distances.png"
    plot_matrix(distances, labels, labels, path, f"{layout.name}: Hamming distance", ("family", "family"))
    console.print(f"wrote {path} ({track_of(layout.name)} track)")


def _table(title: str, corner: str, names: Sequence[str], values: np.ndarray, form: str) -> Table:
    """A square matrix, rows and columns by the same names."""
    table = Table(title=title)
    table.add_column(corner)
    for name in names:
        table.add_column(name, justify="right")
    for name, row in zip(names, values, strict=True):
        table.add_row(name, *(f"{value:{form}}" for value in row))
    return table
