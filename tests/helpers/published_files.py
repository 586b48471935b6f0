"""Write small files in the published format, for tests that convert them."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from icrl4aht_data.overcooked.actions import ACTIONS, PUBLISHED_ACTIONS
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe
from tests.helpers.random_releases import random_history

KEPT = 20
"""Number of steps of an episode."""
SHARD = "data/teammate/demo_wide/train-00000-of-00001.h5"
"""Path of the demo_wide shard in the release converted from the published files."""

_IDS = {name: number for number, name in enumerate(PUBLISHED_ACTIONS)}


def write_published_files(folder: Path) -> list[dict[str, np.ndarray]]:
    """Write `histories.h5` and its index, without states and tasks.

    The last episode is unfinished in two of the four histories.

    Returns:
        The arrays of each history; actions are indices into `ACTIONS`.
    """
    rng = np.random.default_rng(0)
    plans = [("demo_wide", "a", 120), ("demo_wide", "a", 130), ("coord_simple", "b", 60), ("demo_wide", "c", 50)]
    written = []
    folder.mkdir()
    with h5py.File(folder / "histories.h5", "w") as file, (folder / "histories_index.jsonl").open("w") as index:
        for number, (name, task, steps) in enumerate(plans):
            layout = get_layout(name)
            arrays = random_history(layout, 7, KEPT, rng)
            kept = {"obs": observe(layout, arrays["state"], 0)[:steps]}
            kept |= {field: arrays[field][:steps] for field in ("actions", "rewards", "dones")}
            kept |= {"teammate_actions": arrays["teammate_actions"][:steps]} if task != "c" else {}
            kept |= {"expert_actions": arrays["expert_actions"][:steps]} if task != "b" else {}
            written.append(kept)
            for field, array in kept.items():
                stored = array.astype("f4" if field in ("obs", "rewards") else "?" if field == "dones" else "i4")
                if field.endswith("actions"):
                    stored = np.array([_IDS[ACTIONS[a]] for a in array], "i4")
                file.create_dataset(f"/{number}/{field}", data=stored, compression="gzip", chunks=True)
            line = {
                "history_id": number,
                "task_id": f"task_{task}",
                "env_idx": 10 + number,
                "T": steps,
                "obs_shape": list(layout.obs_shape),
                "action_dim": 6,
                "track": "teammate",
                "split": "train",
                "layout": layout.alias if task == "c" else name,
                "teammate_family": "H2" if task == "c" else "rl",
                "teammate_kind": "some_variant",
                "h5_group": f"/{number}",
                "has_teammate_actions": task != "c",
                "has_expert_actions": task != "b",
            }
            index.write(json.dumps(line) + "\n")
    return written
