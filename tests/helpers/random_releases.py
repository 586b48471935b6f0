"""Write releases of random play, simulated by the NumPy rules: states and rewards are valid, but no agent learns."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import TRACKS, layout_track
from icrl4aht_data.benchmark.tasks import Dish, Task, make_task
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.provenance import ExpertLabels, Provenance, TeammateSwaps
from icrl4aht_data.format.schema import LAYOUTS_FILE, Entry, Kind
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.rules import step
from icrl4aht_data.overcooked.state import initial_record
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

SHARD = "data/teammate/coord_simple/train-00000-of-00001.h5"
"""Path of the first shard of a release that `random_release` writes."""


def random_history(layout: Layout, episodes: int, length: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the arrays of one history of random actions; about half of the actions are `interact`."""
    rooms = layout.rooms
    positions = np.stack([rng.choice(room, episodes) for room in rooms], axis=1)
    clash = positions[:, 0] == positions[:, 1]
    positions[clash] = rooms[0][0], rooms[1][-1]
    facings = rng.integers(0, 4, (episodes, 2)).astype(np.uint8)
    state = initial_record(layout, positions, facings, rng.choice(layout.recipe_items, episodes))
    actions = np.where(rng.random((length, episodes, 2)) < 0.4, 5, rng.integers(0, 6, (length, episodes, 2)))
    states, rewards = [], []
    for row in actions:
        outcome = step(layout, state, row, rng.choice(layout.recipe_items, episodes))
        states.append(state)
        rewards.append(outcome.reward)
        state = outcome.state
    steps = episodes * length
    done = np.zeros((episodes, length), bool)
    done[:, -1] = True
    return {
        "state": np.stack(states, axis=1).reshape(steps, -1),
        "actions": actions[..., 0].T.reshape(-1),
        "teammate_actions": actions[..., 1].T.reshape(-1),
        "rewards": np.stack(rewards, axis=1).reshape(-1),
        "dones": done.reshape(-1),
        "expert_actions": rng.integers(0, 6, steps),
        "episode_end_state": state,
    }


def make_tasks(layouts: list[str], teammates: int = 1, recipes: Sequence[Dish] | None = None) -> list[Task]:
    """Return tasks with different heuristic teammates; the split is "train" on training layouts, "test" on others."""
    return [
        make_task(
            layout_track(layout),
            "train" if layout in TRACKS[layout_track(layout)]["train"] else "test",
            layout,
            {"kind": "heuristic", "family": "utility_greedy", "theta_id": t, "base_seed": 0, "theta": {"x": t}},
            seed,
            recipes,
        )
        for seed, (layout, t) in enumerate((layout, t) for layout in layouts for t in range(teammates))
    ]


def random_release(
    root: Path,
    kind: Kind = "lite",
    layouts: tuple[str, ...] = ("coord_simple", "demo_wide"),
    *,
    teammates: int = 2,
    streams: int = 3,
    episodes: int = 6,
    length: int = 20,
    labels: bool = True,
    oracle: bool = False,
    learners: int = 1,
    seed: int = 0,
    shard_histories: int = 1024,
    experts: Sequence[ExpertLabels | None] = (),
    sources: Sequence[str] = (),
    recipes: Sequence[Dish] | None = None,
    swap: int | None = None,
    overwrite: bool = False,
) -> dict[int, dict[str, np.ndarray]]:
    """Write a release of random actions; return the written arrays by history id.

    `experts` and `sources` say where each task's labels and histories come from; `oracle` adds oracle actions, equal to
    the labels if the source is "noise". Every learner has `streams` histories; a noise task has one learner. With
    `swap`, the metadata say that the layout's teammates play in turn, each for `swap` episodes.
    """
    rng = np.random.default_rng(seed)
    written: dict[int, dict[str, np.ndarray]] = {}
    tasks = []
    every = make_tasks(list(layouts), teammates, recipes)
    for number, task in enumerate(every):
        histories = []
        source, expert = sources[number] if sources else None, experts[number] if experts else None
        trained = 1 if source == "noise" else learners
        for learner, stream in itertools.product(range(trained), range(streams)):
            arrays = random_history(task.layout, episodes, length, rng)
            if oracle:
                same = source == "noise"
                arrays["oracle_actions"] = arrays["expert_actions"] if same else rng.integers(0, 6, episodes * length)
            if not labels:
                del arrays["expert_actions"]
            written[len(written)] = arrays
            histories.append(NewHistory(stream, arrays, learner))
        made = Provenance(seed=task.seed, source=source, expert=expert, learners=None if trained == 1 else trained)
        if swap is not None:
            others = [one.teammate for one in every if one.layout == task.layout and one is not task]
            made = msgspec.structs.replace(made, swaps=TeammateSwaps(swap, [task.teammate, *others]))
        tasks.append(NewTask(task, made, len(histories), lambda histories=histories: histories))
    options: dict[str, Any] = {"shard_histories": shard_histories, "overwrite": overwrite}
    write_release(root, kind, tasks, data_version="0.0.1", card="# test\n", kept_steps=length, **options)
    return written


def one_history_release(
    root: Path,
    change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]] = dict,
    kind: Kind = "lite",
    provenance: Provenance | None = None,
    learner: int = 0,
) -> Path:
    """Write a release of one history on demo_simple; `change` alters the arrays before their hashes are computed."""
    (task,) = make_tasks(["demo_simple"])
    arrays = change(random_history(task.layout, 6, 20, np.random.default_rng(5)))
    new = NewTask(task, provenance or Provenance(), 1, lambda: [NewHistory(0, arrays, learner)])
    return write_release(root, kind, [new], data_version="0.0.1", card="", kept_steps=20)


def write_long_index(root: Path, lines: int = 3000) -> list[Entry]:
    """Write the metadata of a release of `lines` histories, without shards; return the index entries."""
    source = load_icrl4aht(MINI).entries
    rng = np.random.default_rng(0)
    made = []
    for number in range(lines):
        line = source[(5 * (number // 40)) % len(source)].to_json()
        line |= {"history_id": number, "env_idx": int(rng.integers(1024)), "score": float(rng.normal()), "h5_row": None}
        line["task_id"] += f"_{number // 40}"
        line["shard"] = line["shard"].replace("00000-of-00001", f"{number // 500:05}-of-00006")
        if number % 2:
            line |= {"source": f"source_{number % 3}", "expert_step": number, "expert_return": -1.0}
            line["expert_return_sampled"] = float(rng.normal())
        made.append(line | ({"h5_row": number % 500} if number % 3 else {}))
    (root / "meta").mkdir(parents=True)
    shutil.copy(MINI / LAYOUTS_FILE, root / LAYOUTS_FILE)
    (root / "meta" / "info.json").write_text(
        json.dumps(json.loads((MINI / "meta" / "info.json").read_text()) | {"histories": lines})
    )
    (root / "meta" / "histories.jsonl").write_text("".join(json.dumps(line) + "\n" for line in made))
    return [msgspec.convert(line, Entry) for line in made]
