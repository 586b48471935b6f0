"""Learning curves of the same tasks by the egos of several profiles: `make bench-curves`.

Every profile's ego learns with teammate H4 on some layouts, with several seeds and the first profile's number of
environment steps. A run's curve is the mean return of the episodes that ended in each fortieth of its steps. Bands are
95 % confidence intervals of the mean over seeds, from Student's t distribution.

Prints one JSON line per layout and profile and writes OUT/curves.png. Finished runs are kept in OUT, so the same
command resumes, and processes with the same OUT share the work.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import click
import jax
import numpy as np
from filelock import FileLock, Timeout
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.ego import compiled_update
from icrl4aht_generation.learners.resume import limit_xla_threads
from icrl4aht_generation.profiles import load_profile
from matplotlib.figure import Figure
from scipy.stats import t as student_t

from benchmarks.bench_learner import heuristic_learner
from benchmarks.common import print_line
from icrl4aht_data.commands.options import COUNT, LAYOUT, Folder
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.plotting import save_figure
from icrl4aht_data.utils.files import atomic_write, json_hash

_POINTS = 40
_LAYOUTS = ("demo_wide", "asymm_both", "cramped_up")


class Curves(NamedTuple):
    """Curves of all seeds.

    Attributes:
        returns: float64 (seeds, points), mean return of the episodes that ended in each part of the training; NaN where
            none did.
        steps_per_second: environment steps/s of each run, without compiling, float64 (seeds,).
    """

    returns: np.ndarray
    steps_per_second: np.ndarray

    def band(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean over seeds, and half the width of its confidence interval, float64 (points,) each."""
        return self._interval(self.returns)

    def end(self) -> tuple[float, float]:
        """Mean return in the last tenth of the training, and half the width of its interval."""
        mean, half = self._interval(np.nanmean(self.returns[:, -_POINTS // 10 :], axis=1, keepdims=True))
        return float(mean[0]), float(half[0])

    def _interval(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seeds = len(values)
        error = values.std(axis=0, ddof=1) / seeds**0.5 if seeds > 1 else np.zeros(values.shape[1])
        return values.mean(axis=0), error * student_t.ppf(0.975, max(seeds - 1, 1))


def train_once(layout: str, config: PPOConfig, seed: int) -> dict[str, Any]:
    """Train an ego; its curve and speed, as JSON."""
    learner = heuristic_learner(get_layout(layout), config)
    update, state = compiled_update(learner), jax.jit(learner.init)(jax.random.key(seed))
    state, _, first = jax.block_until_ready(update(state))
    log, started = [first], time.perf_counter()
    for _ in range(config.updates - 1):
        state, _, metrics = update(state)
        log.append(metrics)
    ended, returns = (np.array([float(line[name]) for line in log]) for name in ("episodes", "return"))
    seconds = time.perf_counter() - started
    part = np.arange(len(log)) * _POINTS // len(log)
    totals, counts = (np.bincount(part, weights, _POINTS) for weights in (ended * returns, ended))
    return {
        "returns": np.where(counts > 0, totals / np.maximum(counts, 1), np.nan).tolist(),
        "steps_per_second": (config.updates - 1) * config.steps_per_update / seconds,
    }


def shortened(config: PPOConfig, steps: int) -> PPOConfig:
    """The hyper-parameters of a training of this length; shaped rewards end at the same share of it."""
    return replace(
        config, total_steps=steps, shaping_horizon=max(1, config.shaping_horizon * steps // config.total_steps)
    )


def collect(
    out: Path, configs: dict[str, PPOConfig], layouts: tuple[str, ...], seeds: int
) -> dict[tuple[str, str], Curves]:
    """Train the runs that OUT does not have, and read all: (layout, profile) -> curves."""
    paths: dict[tuple[str, str], list[Path]] = {}
    for seed, layout, name in product(range(seeds), layouts, configs):
        path = out / f"{name}-{json_hash(repr(configs[name]))[:8]}" / f"{layout}-{seed}.json"
        paths.setdefault((layout, name), []).append(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(Timeout), FileLock(f"{path}.lock", timeout=0):  # another process may train it
            if not path.exists():
                result = train_once(layout, configs[name], seed)
                with atomic_write(path) as target:
                    target.write_text(json.dumps(result), encoding="utf-8")
                click.echo(f"{name} on {layout}, seed {seed}: {result['returns'][-1]:.1f}", err=True)
    found = {}
    for cell, of_cell in paths.items():
        runs = [json.loads(path.read_text(encoding="utf-8")) for path in of_cell if path.exists()]
        if runs:
            found[cell] = Curves(*(np.array([run[name] for run in runs]) for name in Curves._fields))
    return found


def draw_curves(curves: dict[tuple[str, str], Curves], layouts: tuple[str, ...], steps: int, path: Path) -> None:
    """Draw a panel per layout with the mean and band of every profile."""
    figure = Figure(figsize=(4.2 * len(layouts), 3.4), layout="constrained")
    axes_of: Any = figure.subplots(1, len(layouts), squeeze=False)[0]
    middle = (np.arange(_POINTS) + 0.5) * steps / _POINTS
    for axes, layout in zip(axes_of, layouts, strict=True):
        for (where, name), found in curves.items():
            if where == layout:
                mean, half = found.band()
                seen = np.isfinite(mean)  # environments that start together end together, so some parts have no end
                mean, half, steps_of = mean[seen], half[seen], middle[seen]
                (line,) = axes.plot(steps_of, mean, label=f"{name} ({len(found.returns)} seeds)")
                axes.fill_between(steps_of, mean - half, mean + half, alpha=0.25, linewidth=0, color=line.get_color())
        axes.set_title(f"{layout}, teammate H4", fontsize=9)
        axes.set_xlabel("environment steps")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, frameon=False)
    axes_of[0].set_ylabel("return of an episode (400 steps)")
    save_figure(figure, path)


@click.command()
@click.option("--out", type=Folder(), default="build/curves", show_default=True, help="Folder of runs and figure.")
@click.option("--profile", "names", multiple=True, default=("mini", "cpu"), show_default=True, help="To compare.")
@click.option(
    "--layout",
    "layouts",
    type=LAYOUT,
    multiple=True,
    default=_LAYOUTS,
    show_default=True,
)
@click.option("--seeds", type=COUNT, default=8, show_default=True)
def main(out: Path, names: tuple[str, ...], layouts: tuple[str, ...], seeds: int) -> None:
    """Compare the learning curves of profiles; one JSON line per layout and profile."""
    profiles = [load_profile(name) for name in names]
    first = profiles[0]
    if first.xla_threads:
        limit_xla_threads(first.xla_threads)
    configs = {profile.name: shortened(profile.ego, first.ego.total_steps) for profile in profiles}
    curves = collect(out, configs, layouts, seeds)
    for (layout, name), found in curves.items():
        (mean, half), (first_mean, first_half) = found.band(), curves.get((layout, first.name), found).band()
        overlaps = np.abs(mean - first_mean) <= half + first_half
        end, width = found.end()
        print_line(
            "curves",
            layout=layout,
            profile=name,
            seeds=len(found.returns),
            steps_per_second=round(float(np.median(found.steps_per_second))),
            return_at_end=round(end, 1),
            interval=[round(end - width, 1), round(end + width, 1)],
            mean_return=round(float(np.nanmean(found.returns)), 1),
            share_of_points_overlapping=round(float(overlaps[np.isfinite(mean + first_mean)].mean()), 3),
        )
    draw_curves(curves, layouts, first.ego.total_steps, out / "curves.png")
    click.echo(f"wrote {out / 'curves.png'}", err=True)


if __name__ == "__main__":
    main()
