"""Policies on disk: weights as safetensors, beside them a JSON card that says what they are."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load_file, save_file

from generation.learners.network import ActorCritic, Widths
from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.format.checkpoints import CHECKPOINT_BYTES
from icrl4aht_data.utils.files import parse_json, plain_size, read_text

WEIGHTS, CARD = "policy.safetensors", "policy.json"


def save_policy(folder: Path, network: ActorCritic, params: Any, card: dict[str, Any]) -> None:
    """Write policy.safetensors and policy.json into a folder, which appears whole or not at all."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write_policy(partial, network, params, card)
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def write_policy(folder: Path, network: ActorCritic, params: Any, card: dict[str, Any]) -> None:
    """Write policy.safetensors and policy.json into an existing folder."""
    weights = {name: np.asarray(w) for name, w in flatten_dict(params, sep="/").items()}
    save_file(weights, folder / WEIGHTS)
    shapes = {name: list(w.shape) for name, w in weights.items()}
    content = card | {"widths": asdict(network.widths), "partners": network.partners, "shapes": shapes}
    (folder / CARD).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def load_card(folder: Path) -> dict[str, Any]:
    """A checkpoint's card alone.

    Raises:
        OptionError: if it is missing or not JSON.
    """
    try:
        card = parse_json(read_text(folder / CARD))
    except IndexFormatError as error:
        raise OptionError(f"{folder}: not a checkpoint ({error!r}); expected {WEIGHTS} and {CARD}") from error
    if not isinstance(card, dict):
        raise OptionError(f"{folder}: not a checkpoint; expected an object in {CARD}")
    return card


def load_policy(folder: Path) -> tuple[ActorCritic, Any, dict[str, Any]]:
    """The network, its weights, and the card.

    Raises:
        OptionError: if the files are missing or not readable, or the weights have not the shapes that the card states.
    """
    card = load_card(folder)
    try:
        plain_size(folder / WEIGHTS, CHECKPOINT_BYTES)
        weights = load_file(folder / WEIGHTS)
        network = ActorCritic(Widths.from_table(card["widths"]), card["partners"])
        stated = card["shapes"]
        tree = unflatten_dict(weights, sep="/")
    except Exception as error:  # of three libraries, and whatever a name that is also a folder makes of them
        raise OptionError(f"{folder}: not a checkpoint ({error!r}); expected {WEIGHTS} and {CARD}") from error
    shapes = {name: list(w.shape) for name, w in weights.items()}
    if shapes != stated or "params" not in tree:
        raise OptionError(f"{folder}: weights have shapes {shapes}, the card states {stated}")
    return network, tree, card
