"""Policies on disk: weights as safetensors, beside them a JSON card that says what they are."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load_file, save_file

from generation.learners.network import ActorCritic, Widths
from icrl4aht_data.errors import OptionError


def save_policy(folder: Path, network: ActorCritic, params: Any, card: dict[str, Any]) -> None:
    """Write policy.safetensors and policy.json into an existing folder."""
    weights = {name: np.asarray(w) for name, w in flatten_dict(params, sep="/").items()}
    save_file(weights, folder / "policy.safetensors")
    shapes = {name: list(w.shape) for name, w in weights.items()}
    content = card | {"widths": asdict(network.widths), "shapes": shapes}
    (folder / "policy.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def load_policy(folder: Path) -> tuple[ActorCritic, Any, dict[str, Any]]:
    """The network, its weights, and the card.

    Raises:
        OptionError: if the weights have not the shapes that the card states.
    """
    card = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
    weights = load_file(folder / "policy.safetensors")
    shapes = {name: list(w.shape) for name, w in weights.items()}
    if shapes != card["shapes"]:
        raise OptionError(f"{folder}: weights have shapes {shapes}, the card states {card['shapes']}")
    return ActorCritic(Widths.from_table(card["widths"])), unflatten_dict(weights, sep="/"), card
