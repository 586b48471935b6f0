"""Teammates that learned: checkpoints of the one network, frozen (paper, App. B.1)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Key, UInt8

from generation.learners.checkpoint import WEIGHTS, load_policy
from generation.learners.network import ActorCritic, Widths
from generation.policy import Policy
from icrl4aht_data.errors import OptionError, TaskFormatError
from icrl4aht_data.format.checkpoints import checkpoint_folder
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.hashes import file_hash

Action = Literal["greedy", "sampled"]
"""How a checkpoint acts: its likeliest action, as teammates of the dataset do, or a draw from its distribution."""

_CRITIC = ("critic", "critic_hidden")


def build(layout: Layout, folder: Path, action: Action = "greedy") -> Policy:
    """A checkpoint as a policy for either seat; its GRU is carried through the episode.

    Raises:
        OptionError: if it is no checkpoint, or its shapes do not fit the layout's observations.
    """
    network, params, _ = load_policy(folder)
    weights = {name: part for name, part in params["params"].items() if name not in _CRITIC}
    acting = ActorCritic(network.widths, critic=False)
    expected = _shapes(acting, layout)
    found = jax.tree.map(lambda leaf: leaf.shape, weights)
    if found != expected:
        raise OptionError(
            f"{folder}: does not fit {layout.name} (observations 5 x 5 x {layout.channels}): its weights have shapes "
            f"{_differing(found, expected)}, expected {_differing(expected, found)}"
        )
    init, act = _functions(network.widths, action)
    return Policy({"params": jax.tree.map(jnp.asarray, weights)}, init, act, "observation")


def untrained(layout: Layout, widths: Widths) -> Policy:
    """A checkpoint that has learned nothing, for measuring."""
    init, act = _functions(widths, "greedy")
    params = ActorCritic(widths, critic=False).untrained(jax.random.key(0), layout.channels)
    return Policy(params, init, act, "observation")


def build_entry(layout: Layout, teammate: dict[str, Any], suite: Path | None, action: Action = "greedy") -> Policy:
    """The policy of a task's teammate entry of kind "rl".

    Args:
        suite: a suite, or TEAMMATES of a release.

    Raises:
        OptionError: without a suite, or if the checkpoint is missing or does not fit.
        TaskFormatError: if its weights are not those that the entry names by their hash.
    """
    if suite is None:
        raise OptionError(
            f"teammate {teammate['theta']['checkpoint']} is a checkpoint: say in which folder the suite of teammates is"
        )
    folder = checkpoint_folder(suite, teammate)
    policy = build(layout, folder, action)
    digest = file_hash(folder / WEIGHTS)
    if digest != teammate["theta"]["sha256"]:
        raise TaskFormatError(
            f"{folder / WEIGHTS}: sha256 {digest}, expected {teammate['theta']['sha256']} as the task says; "
            f"restore the checkpoint, or make the manifest anew"
        )
    return policy


@lru_cache(maxsize=16)
def _functions(widths: Widths, action: Action):
    """The same functions for all checkpoints of one shape, so that they share compilations."""
    network = ActorCritic(widths, critic=False)

    def init(params, key: Key[Array, ""]) -> Array:
        return network.initial_hidden(1)[0]

    def act(params, hidden, obs: UInt8[Array, "5 5 C"], key: Key[Array, ""]):
        result: Any = network.apply(params, hidden[None], obs[None, None], jnp.zeros((1, 1), bool))
        hidden, logits = result[0][0], result[1][0, 0]
        chosen = jnp.argmax(logits) if action == "greedy" else jax.random.categorical(key, logits)
        return chosen.astype(jnp.int32), hidden

    return init, act


def _shapes(network: ActorCritic, layout: Layout) -> dict[str, Any]:
    tree = jax.eval_shape(lambda key: network.untrained(key, layout.channels), jax.random.key(0))
    return jax.tree.map(lambda leaf: leaf.shape, tree["params"])


def _differing(one: Any, other: Any) -> dict[str, Any]:
    """The shapes of one tree that the other has not."""
    there = flatten_dict(other, sep="/")
    return {name: shape for name, shape in flatten_dict(one, sep="/").items() if there.get(name) != shape}
