"""A learner's state on disk."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from generation.learners import state_file as snapshot
from generation.learners.state_file import load_state, read_card, save_state
from icrl4aht_data.errors import OptionError


def state() -> dict:
    """A pytree with everything a learner's state may have."""
    return {
        "weights": {"kernel": jnp.arange(6.0).reshape(2, 3).T, "none": jnp.zeros((0, 4))},
        "count": jnp.int32(7),
        "record": jnp.arange(256, dtype=jnp.uint8),
        "ended": jnp.array([True, False]),
        "keys": jax.random.split(jax.random.key(3), 4),
        "key": jax.random.key(5),
        "nothing": (),
    }


def test_round_trip(tmp_path):
    saved = state()
    save_state(tmp_path / "s.safetensors", saved, {"updates": "7"})
    loaded = load_state(tmp_path / "s.safetensors", jax.eval_shape(lambda: saved))
    assert jax.tree.structure(loaded) == jax.tree.structure(saved)
    for before, after in zip(jax.tree.leaves(saved), jax.tree.leaves(loaded), strict=True):
        assert (before.dtype, before.shape) == (after.dtype, after.shape)
        if jnp.issubdtype(before.dtype, jax.dtypes.prng_key):
            before, after = jax.random.key_data(before), jax.random.key_data(after)
        assert np.array_equal(before, after)
    assert read_card(tmp_path / "s.safetensors") == {"updates": "7"}
    assert [path.name for path in tmp_path.iterdir()] == ["s.safetensors"]


def test_none_saved_yet(tmp_path):
    assert read_card(tmp_path / "s.safetensors") is None


def test_a_save_that_is_cut_short_leaves_the_one_before(tmp_path, monkeypatch):
    path = tmp_path / "s.safetensors"
    save_state(path, state(), {"updates": "1"})

    def cut(arrays, partial, metadata):
        partial.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(snapshot, "save_file", cut)
    with pytest.raises(KeyboardInterrupt):
        save_state(path, state(), {"updates": "2"})
    assert read_card(path) == {"updates": "1"}


@pytest.mark.parametrize(
    ("like", "message"),
    [
        ({"count": jnp.float32(0)}, r"count.*expected float32 \(\), found int32 \(\)"),
        ({"count": jnp.zeros(2, jnp.int32)}, r"count.*expected int32 \(2,\), found int32 \(\)"),
        ({"count": jnp.int32(0), "more": jnp.int32(0)}, r"more.*expected int32 \(\), found nothing"),
        ({}, r"count.*expected nothing, found int32 \(\)"),
    ],
)
def test_another_learners_state_is_named(tmp_path, like, message):
    save_state(tmp_path / "s.safetensors", {"count": jnp.int32(7)}, {})
    with pytest.raises(OptionError, match=rf"s\.safetensors: not a state of this learner: .*{message}; remove"):
        load_state(tmp_path / "s.safetensors", like)


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / "s.safetensors").write_bytes(b"not a state")
    for read in (read_card, lambda path: load_state(path, {})):
        with pytest.raises(OptionError, match=r"s\.safetensors: not a state of this learner: .*begin the task anew"):
            read(tmp_path / "s.safetensors")
