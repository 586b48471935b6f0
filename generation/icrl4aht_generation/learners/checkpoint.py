"""Policies on disk: a folder with the weights as safetensors and a JSON card that describes them."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load_file
from safetensors.numpy import save as to_bytes

from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.format.checkpoints import CHECKPOINT_BYTES
from icrl4aht_data.utils.files import check_file_size, parse_json, read_text, sync
from icrl4aht_data.utils.options import replace_options
from icrl4aht_generation.learners.config import PPOConfig, Widths
from icrl4aht_generation.learners.network import ActorCritic

POLICY_WEIGHTS, POLICY_CARD = "policy.safetensors", "policy.json"

_ROWS = "@rows"
"""Suffix in the name of an array that lists the indices of a matrix's stored rows."""

POLICY_CHECKPOINTS = 5
"""Number of checkpoints of each policy, evenly spaced over its training (paper, App. B.1)."""


def checkpoint_updates(config: PPOConfig) -> tuple[int, ...]:
    """Return the numbers of updates after which a checkpoint is saved, ascending; the last is the end of training.

    A training run with fewer updates than `POLICY_CHECKPOINTS` has a checkpoint after each update.
    """
    moments = (-(-config.updates * (number + 1) // POLICY_CHECKPOINTS) for number in range(POLICY_CHECKPOINTS))
    return tuple(dict.fromkeys(moments))


def save_policy(folder: Path, network: ActorCritic, params: Any, card: dict[str, Any]) -> None:
    """Write policy.safetensors and policy.json into a folder, which is replaced atomically."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    weights = {name: np.asarray(w) for name, w in flatten_dict(params, sep="/").items()}
    shapes = {name: list(w.shape) for name, w in weights.items()}
    content = card | {"widths": asdict(network.widths), "partners": network.partners, "shapes": shapes}
    # Not `save_file`, which does not raise an OSError for a full disk.
    (partial / POLICY_WEIGHTS).write_bytes(to_bytes(_without_zero_rows(weights)))
    (partial / POLICY_CARD).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    for name in (POLICY_WEIGHTS, POLICY_CARD):
        sync(partial / name)
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def load_card(folder: Path) -> dict[str, Any]:
    """Return the card of a stored policy.

    Raises:
        OptionError: if the card is missing or not a JSON object.
    """
    try:
        card = parse_json(read_text(folder / POLICY_CARD))
    except IndexFormatError as error:
        raise _checkpoint_error(folder, repr(error)) from error
    if not isinstance(card, dict):
        raise _checkpoint_error(folder, f"{POLICY_CARD} is not a JSON object")
    return card


def load_policy(folder: Path) -> tuple[ActorCritic, Any, dict[str, Any]]:
    """Return a policy's network, its parameters, and its card.

    Raises:
        OptionError: if the files are missing or unreadable, or the shapes of the weights differ from the card.
    """
    card = load_card(folder)
    try:
        check_file_size(folder / POLICY_WEIGHTS, CHECKPOINT_BYTES)
        network = ActorCritic(replace_options(Widths(), card["widths"]), card["partners"])
        expected = card["shapes"]
        weights = _with_zero_rows(load_file(folder / POLICY_WEIGHTS), expected)
        tree = unflatten_dict(weights, sep="/")
    except Exception as error:  # the file may be damaged, and each of three libraries raises its own errors
        raise _checkpoint_error(folder, repr(error)) from error
    shapes = {name: list(w.shape) for name, w in weights.items()}
    if shapes != expected or "params" not in tree:
        raise OptionError(f"{folder}: the weights have shapes {shapes}, but the card states {expected}")
    return network, tree, card


def _without_zero_rows(weights: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the weights to store: a matrix of mostly zero rows is reduced to its nonzero rows and their indices.

    This shortens the kernel of encoder `mlp`, because most entries of flat observations are always 0 on a layout.
    """
    stored = {}
    for name, matrix in weights.items():
        rows = np.flatnonzero(matrix.any(axis=1)) if matrix.ndim == 2 else ()
        if matrix.ndim == 2 and 2 * len(rows) < len(matrix):
            stored[name] = np.ascontiguousarray(matrix[rows])
            stored[name + _ROWS] = np.asarray(rows, np.int32)
        else:
            stored[name] = matrix
    return stored


def _with_zero_rows(stored: dict[str, np.ndarray], shapes: dict[str, list[int]]) -> dict[str, np.ndarray]:
    """Return complete weights with the given shapes from stored weights, see `_without_zero_rows`.

    Raises:
        ValueError, IndexError, KeyError: if the stored rows do not match the shapes.
    """
    weights = {name: matrix for name, matrix in stored.items() if not name.endswith(_ROWS)}
    for name in stored.keys() - weights.keys():
        name = name.removesuffix(_ROWS)
        length, width = shapes[name]
        if length * width * weights[name].itemsize > CHECKPOINT_BYTES:
            raise ValueError(f"{name}: expected at most {CHECKPOINT_BYTES:,} bytes, found the shape {shapes[name]}")
        complete = np.zeros((length, width), weights[name].dtype)
        complete[stored[name + _ROWS]] = weights[name]
        weights[name] = complete
    return weights


def _checkpoint_error(folder: Path, problem: str) -> OptionError:
    return OptionError(f"{folder}: not a checkpoint ({problem}); expected {POLICY_WEIGHTS} and {POLICY_CARD}")
