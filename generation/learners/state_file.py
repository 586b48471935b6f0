"""A learner's state on disk, whole or not at all: a safetensors file, written beside its place and moved there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write


def save_state(path: Path, state: Any, card: dict[str, str]) -> None:
    """Write a pytree of arrays and typed keys (of JAX's default kind); a reader sees the old file or the new one."""
    arrays = {name: np.require(_plain(leaf), requirements="C") for name, leaf in _leaves(state).items()}
    with atomic_write(path) as partial:
        save_file(arrays, partial, metadata=card)


def read_card(path: Path) -> dict[str, str] | None:
    """The card of a saved state; None where there is no file.

    Raises:
        OptionError: if the file is damaged.
    """
    if not path.is_file():
        return None
    try:
        with safe_open(path, "numpy") as file:
            return dict(file.metadata())
    except SafetensorError as error:
        raise _damaged(path, str(error)) from error


def load_state(path: Path, like: Any) -> Any:
    """A saved state in the shape of `like`: a pytree of arrays, typed keys, or what `jax.eval_shape` makes of them.

    Raises:
        OptionError: if the file is damaged, or holds other arrays.
    """
    wanted = _leaves(like)
    try:
        with safe_open(path, "numpy") as file:
            saved = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (a file, not a dict)
    except SafetensorError as error:
        raise _damaged(path, str(error)) from error
    expected = {name: _described(_plain_shape(leaf)) for name, leaf in wanted.items()}
    found = {name: _described(array) for name, array in saved.items()}
    if found != expected:
        name = min(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
        raise _damaged(path, f"{name}: expected {expected.get(name, 'nothing')}, found {found.get(name, 'nothing')}")
    leaves = [
        jax.random.wrap_key_data(saved[name]) if _is_key(leaf) else jnp.asarray(saved[name])
        for name, leaf in wanted.items()
    ]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def keep_lines(path: Path, lines: int) -> None:
    """Leave a text file's first lines alone; make an empty one where there is none."""
    kept = path.read_bytes().splitlines(keepends=True)[:lines] if path.exists() else []
    path.write_bytes(b"".join(kept))


def _leaves(tree: Any) -> dict[str, Any]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _plain_shape(leaf: Any) -> Any:
    return jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf


def _described(array: Any) -> str:
    return f"{np.dtype(array.dtype)} {tuple(array.shape)}"


def _damaged(path: Path, problem: str) -> OptionError:
    return OptionError(f"{path}: not a state of this learner: {problem}; remove {path.parent} to begin the task anew")
