"""Learned teammates: frozen checkpoints of the actor-critic (paper, App. B.1)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict
from jaxtyping import Array, Key, UInt8

from icrl4aht_data.errors import OptionError, TaskFormatError
from icrl4aht_data.format.checkpoints import checkpoint_folder
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.files import file_hash
from icrl4aht_generation.learners.checkpoint import POLICY_WEIGHTS, load_policy
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.network import ActorCritic
from icrl4aht_generation.policy import Policy

Action = Literal["greedy", "sampled"]
"""How a checkpoint acts: "greedy" for the most probable action, as in the dataset, "sampled" for a random action."""

_CRITIC = ("critic", "critic_hidden")


def build_learned(layout: Layout, folder: Path, action: Action = "greedy") -> Policy:
    """Return a checkpoint as a policy for either agent, with a recurrent state that is reset at each episode.

    Args:
        layout: layout on which the policy plays.
        folder: folder of the checkpoint, see `learners.checkpoint`.
        action: "greedy" to take the most probable action, "sampled" to sample an action.

    Raises:
        OptionError: if the folder is not a checkpoint, or its shapes do not match the layout's observations.
    """
    network, params, _ = load_policy(folder)
    weights = {name: part for name, part in params["params"].items() if name not in _CRITIC}
    acting = ActorCritic(network.widths, critic=False)
    untrained = jax.eval_shape(lambda key: acting.untrained(key, layout.channels), jax.random.key(0))
    expected, found = (
        flatten_dict(jax.tree.map(lambda leaf: leaf.shape, tree), sep="/") for tree in (untrained["params"], weights)
    )
    if found != expected:
        wrong, right = found.items() - expected.items(), expected.items() - found.items()
        raise OptionError(
            f"{folder}: does not fit {layout.name} (observations 5 x 5 x {layout.channels}): its weights have shapes "
            f"{dict(sorted(wrong))}, expected {dict(sorted(right))}"
        )
    init, act = _acting_functions(network.widths, action)
    return Policy({"params": jax.tree.map(jnp.asarray, weights)}, init, act, "observation")


def build_learned_entry(layout: Layout, teammate: dict[str, Any], suite: Path | None) -> Policy:
    """Return the policy of a task's teammate entry of kind "rl".

    Args:
        layout: layout of the task.
        teammate: the task's teammate entry.
        suite: folder of a suite, or the folder TEAMMATES of a release.

    Raises:
        OptionError: without a suite, or if the checkpoint is missing or does not match the layout.
        TaskFormatError: if the SHA-256 of the weights differs from the entry.
    """
    if suite is None:
        raise OptionError(
            f"teammate {teammate['theta']['checkpoint']} is loaded from a checkpoint: give the folder of its suite as "
            "`suite`"
        )
    folder = checkpoint_folder(suite, teammate)
    policy = build_learned(layout, folder)
    digest = file_hash(folder / POLICY_WEIGHTS)
    if digest != teammate["theta"]["sha256"]:
        raise TaskFormatError(
            f"{folder / POLICY_WEIGHTS}: sha256 {digest}, expected {teammate['theta']['sha256']} as in the task; "
            f"restore the checkpoint, or write the manifest again"
        )
    return policy


@lru_cache(maxsize=16)
def _acting_functions(widths: Widths, action: Action):
    """Return the functions `init` and `act` of policies, cached, so checkpoints of equal widths share compilations."""
    network = ActorCritic(widths, critic=False)

    def init(params, key: Key[Array, ""]) -> Array:
        return network.initial_hidden(1)[0]

    def act(params, hidden, obs: UInt8[Array, "5 5 C"], key: Key[Array, ""]):
        result: Any = network.apply(params, hidden[None], obs[None, None], jnp.zeros((1, 1), bool))
        hidden, logits = result[0][0], result[1][0, 0]
        chosen = jnp.argmax(logits) if action == "greedy" else jax.random.categorical(key, logits)
        return chosen.astype(jnp.int32), hidden

    return init, act
