"""Estimate the cost of generating a release: counts of steps and bytes, and hours.

If scripts play, bytes were right within 10 % (profiles `bundle` and `teach`), and hours within 30 % (profile `teach` on
two cores, `devices` = 2). Hours of training are right within a factor of about 2.

The network takes most of the time, so its forward pass is measured on this machine. The number of forward passes per
update follows from the hyper-parameters. Stored numbers give the speed of the environment and the time to compile.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from timeit import repeat
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich import filesize

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.format.schema import KINDS, Kind
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.overcooked.state import record_size
from icrl4aht_data.utils.system import usable_cores
from icrl4aht_generation.collection.scripted import scripted_bytes
from icrl4aht_generation.collection.task_folder import array_shapes, arrays_bytes
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.encoder import CompactView
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.populations.build import population_runs
from icrl4aht_generation.profiles import Profile
from icrl4aht_generation.profiles.noise_config import NoiseConfig

BYTES_PER_STEP: dict[tuple[Kind, str], float] = {
    ("lite", "ppo"): 1.92,
    ("full", "ppo"): 9.23,
    ("lite", "noise"): 2.3,
    ("full", "noise"): 12.01,
    ("lite", "search"): 1.85,
    ("full", "search"): 12.01,
}
"""Bytes of a transition in a release's shards, by kind and source, measured on the bundled release and on `teach`."""

BYTES_PER_HISTORY = {"search": 620}
"""Additional bytes of each history in shards, for sources with short histories (measured at 500 and 6,000 steps)."""

META_BYTES = {"transitions": 0.12, "histories": 900, "tasks": 1400}
"""Bytes of the index and the hashes of a release for each transition, history and task, measured on the bundled
release."""

ENVIRONMENT_STEPS_PER_SECOND = 180_000.0
"""Steps per second of the environment with a scripted teammate on 2 CPU cores."""

COMPILE_SECONDS = 30.0
"""Seconds to compile the functions of a task or a population on 2 CPU cores."""

SCRIPTED_STEPS_PER_SECOND = 470_000.0
"""Transitions of scripted histories per second on 2 CPU cores, including the release (from `teach` and `billion`)."""

SCRIPTED_SECONDS = 0.75
"""Additional seconds of each task with scripted histories, mostly compilation (from `teach` and `billion`)."""

_GRADIENT = 3.1  # ratio of the times of a gradient step and a forward pass, measured with profiles `smoke` and `paper`


def estimate_cost(profile: Profile, devices: int) -> dict[str, Any]:
    """Estimate the cost of generating a profile's release, from measured network speeds and stored numbers.

    Hours include learning, playing and recording. One process trains the populations one after another; then `devices`
    devices share the tasks, and each runs one task at a time.

    Args:
        profile: profile of the release.
        devices: number of devices that share the tasks.

    Returns:
        profile: name of the profile.
        populations: number of populations of learned teammates.
        teammate_steps: environment steps of all populations.
        tasks: number of tasks.
        learners: number of egos that learn.
        environment_steps: environment steps of all egos that learn.
        scripted_histories: number of histories that a script plays.
        scripted_transitions: number of transitions in scripted histories.
        recorded_transitions: transitions of all histories of egos and scripts, before histories are selected.
        kept_transitions: maximum number of transitions after histories are selected.
        artefact_bytes: size of the artefacts of all tasks.
        lite_bytes, full_bytes: sizes of a lite and of a full release.
        device: device on which the networks were measured.
        steps_per_second: mean speed of egos that learn; None without such egos.
        teammate_hours: hours to train all populations on one device.
        scripted_hours: hours to play all scripted histories on one device.
        hours_on_one: total hours on one device.
        devices: number of devices.
        hours_on_devices: total hours on this number of devices.
    """
    egos: list[tuple[Layout, PPOConfig]] = []
    scripted: list[tuple[Layout, NoiseConfig]] = []
    tasks, kept, histories = 0, Counter[str](), Counter[str]()
    for source in profile.sources:
        for name in profile.layouts_of(source):
            layout, count = get_layout(name), profile.task_count(name, source)
            tasks += count
            if source == "ppo":
                egos += [(layout, profile.ego_config(name))] * (count * profile.learners)
                histories[source] += count * profile.keep
                kept[source] += count * profile.keep * profile.ego_config(name).episodes * KEPT_STEPS
            else:
                config = profile.scripted_config(name, source)
                scripted += [(layout, config)] * count
                histories[source] += count * config.histories
                kept[source] += count * config.histories * config.episodes * KEPT_STEPS
    runs = population_runs(profile, profile.algorithms, 0)

    steps = sum(ego.updates * ego.steps_per_update for _, ego in egos)
    playing = [ego.updates * ego.steps_per_update * step_seconds(ego) for _, ego in egos]
    transitions = [config.histories * config.episodes * KEPT_STEPS for _, config in scripted]
    scripted_seconds = [count / SCRIPTED_STEPS_PER_SECOND + SCRIPTED_SECONDS for count in transitions]
    seconds = [played + COMPILE_SECONDS for played in playing] + scripted_seconds
    teammate_seconds = sum(run.steps * step_seconds(run.config) + COMPILE_SECONDS for run in runs)
    counts = {"transitions": kept.total(), "histories": histories.total(), "tasks": tasks}
    extra = sum(histories[source] * more for source, more in BYTES_PER_HISTORY.items())
    extra += sum(count * META_BYTES[name] for name, count in counts.items())
    sizes = {kind: round(extra + sum(kept[each] * BYTES_PER_STEP[kind, each] for each in kept)) for kind in KINDS}
    device = jax.devices()[0]
    return {
        "profile": profile.name,
        "populations": len(runs),
        "teammate_steps": sum(run.steps for run in runs),
        "tasks": tasks,
        "learners": len(egos),
        "environment_steps": steps,
        "scripted_histories": sum(config.histories for _, config in scripted),
        "scripted_transitions": sum(transitions),
        "recorded_transitions": sum(ego.environments * ego.episodes * KEPT_STEPS for _, ego in egos) + sum(transitions),
        "kept_transitions": sum(kept.values()),
        "artefact_bytes": sum(arrays_bytes(array_shapes(at, ego.environments, ego.episodes)) for at, ego in egos)
        + sum(scripted_bytes(layout, config) for layout, config in scripted),
        "lite_bytes": sizes["lite"],
        "full_bytes": sizes["full"],
        "device": f"{usable_cores()} CPU cores" if device.platform == "cpu" else device.device_kind,
        "steps_per_second": round(steps / sum(playing), 1) if egos else None,
        "teammate_hours": round(teammate_seconds / 3600, 2),
        "scripted_hours": round(sum(scripted_seconds) / 3600, 2),
        "hours_on_one": round((teammate_seconds + sum(seconds)) / 3600, 2),
        "devices": devices,
        # Each round of tasks takes as long as its longest task.
        "hours_on_devices": round((teammate_seconds + sum(sorted(seconds, reverse=True)[::devices])) / 3600, 2),
    }


def cost_rows(cost: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the rows (quantity, value) of the printed table of a cost estimate."""
    for key, value in cost.items():
        name = key.replace("_", " ")
        if key.endswith("_bytes"):
            yield f"disk, {name.removesuffix(' bytes')}", filesize.decimal(value)
        elif key == "hours_on_devices":
            yield f"hours on {cost['devices']} devices", f"{value:,.1f}"
        elif value and key != "devices":
            yield name, value if isinstance(value, str) else f"{value:,}"


def step_seconds(config: PPOConfig) -> float:
    """Return a learner's seconds per environment step, for acting, the environment, and all epochs of learning."""
    passes = 1 + _GRADIENT * config.epochs
    # One layout is enough: layouts differ in the number of channels, which only affects the network's first layer.
    return passes * forward_seconds(get_layout("demo_wide"), config) + 1 / ENVIRONMENT_STEPS_PER_SECOND


@lru_cache(maxsize=16)
def forward_seconds(layout: Layout, config: PPOConfig) -> float:
    """Measure the forward pass of a learner's network on one minibatch, and return the seconds per step."""
    steps, count = config.rollout, config.environments // config.minibatches
    view = CompactView(config.widths.encoder, (layout,))
    network = ActorCritic(config.widths, view=view)
    shapes = jax.eval_shape(lambda key: network.untrained(key, layout.channels), jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    # Repeated records imitate training, where most observations repeat, and equal ones are encoded only once.
    record = np.random.default_rng(0).integers(0, 256, (steps, 1, record_size(layout)), np.uint8)
    records = jnp.asarray(np.repeat(record, count, axis=1))
    reset = jnp.zeros((steps, count), bool)

    @jax.jit
    def forward(params: Any, records: jax.Array) -> Any:
        return network.apply(params, network.initial_hidden(count), view(records), reset)

    def call() -> None:
        jax.block_until_ready(forward(params, records))

    call()  # the first call compiles
    # Take the fastest of a few calls, because other programs may slow down some calls.
    return min(repeat(call, number=1, repeat=3)) / (steps * count)
