"""Test checkpoints of policies: parameters are restored exactly, and rows of zeros take no space."""

import json

import jax
import numpy as np
import pytest
from icrl4aht_generation.learners.checkpoint import POLICY_CARD, POLICY_WEIGHTS, load_policy, save_policy
from icrl4aht_generation.learners.config import Widths
from icrl4aht_generation.learners.encoder import CompactView
from icrl4aht_generation.learners.network import ActorCritic
from safetensors.numpy import load_file, save_file

from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import get_layout
from tests.helpers.trees import same_bytes


@pytest.fixture(scope="module")
def policy():
    layout = get_layout("demo_wide")
    network = ActorCritic(Widths(encoder="mlp", dense=16, gru=8, head=8), view=CompactView("mlp", (layout,)))
    return network, jax.jit(network.untrained, static_argnums=1)(jax.random.key(0), layout.channels)


def sparse_kernel_name(folder) -> str:
    """Return the name of the only weight matrix that is stored without its zero rows."""
    (name,) = (name for name in load_file(folder / POLICY_WEIGHTS) if name.endswith("@rows"))
    return name.removesuffix("@rows")


def test_policy_is_restored_exactly_from_a_small_file(policy, tmp_path):
    network, params = policy
    save_policy(tmp_path / "p", network, params, {"step": 3})
    found, read, card = load_policy(tmp_path / "p")
    assert same_bytes(read, params)
    assert (found.widths, card["step"]) == (network.widths, 3)
    full = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(params))
    assert (tmp_path / "p" / POLICY_WEIGHTS).stat().st_size < full / 3


@pytest.mark.parametrize(
    "change",
    [
        lambda rows, shape: (rows[:-1], shape),
        lambda rows, shape: (rows + shape[0], shape),
        lambda rows, shape: (rows, [2**40, shape[1]]),
        lambda rows, shape: (rows, [-5, shape[1]]),
    ],
)
def test_checkpoint_with_invalid_row_numbers_raises_error(policy, tmp_path, change):
    network, params = policy
    save_policy(tmp_path / "p", network, params, {})
    name, weights = sparse_kernel_name(tmp_path / "p"), load_file(tmp_path / "p" / POLICY_WEIGHTS)
    card = json.loads((tmp_path / "p" / POLICY_CARD).read_text())
    weights[f"{name}@rows"], card["shapes"][name] = change(weights[f"{name}@rows"], card["shapes"][name])
    save_file(weights, tmp_path / "p" / POLICY_WEIGHTS)
    (tmp_path / "p" / POLICY_CARD).write_text(json.dumps(card))
    with pytest.raises(OptionError, match="not a checkpoint"):
        load_policy(tmp_path / "p")
