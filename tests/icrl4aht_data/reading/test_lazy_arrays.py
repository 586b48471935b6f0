"""Lazy arrays give what NumPy arrays give, or refuse."""

from __future__ import annotations

import pickle
import re

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import torch

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import FIELDS


@pytest.fixture(scope="module")
def history(lite):
    return load_icrl4aht(lite[0])[4]


@pytest.fixture(scope="module")
def arrays(lite):
    return {name: array.astype(FIELDS[name].dtype) for name, array in lite[1][4].items()}


def test_comparison_of_two_lazy_arrays(history, arrays):
    """Was plain False: Python compared the two objects."""
    expected = arrays["actions"] == arrays["expert_actions"]
    assert 0 < expected.mean() < 1
    for equal in (
        history.actions == history.expert_actions,
        history.actions == arrays["expert_actions"],
        arrays["actions"] == history.expert_actions,
    ):
        np.testing.assert_array_equal(equal, expected, strict=True)
    np.testing.assert_array_equal(history.actions != history.expert_actions, ~expected, strict=True)


CALLS = {
    "== number": lambda x: x == 3,
    "number ==": lambda x: 3 == x,  # noqa: SIM300
    "== list": lambda x: x == x[:].tolist(),
    "list ==": lambda x: x[:].tolist() == x,
    "== None": lambda x: x == None,  # noqa: E711
    "> number": lambda x: x > 1,
    "number >=": lambda x: 3 >= x,  # noqa: SIM300
    "arithmetic": lambda x: (1 - x) * 2 + x / 4 - x // 2,
    "&": lambda x: (x & 1) | (x ^ 2),
    "-": lambda x: -x,
    "@": lambda x: x @ x,
    "divmod": lambda x: divmod(x, 2)[1],
    "mean": lambda x: x.mean(),
    "sum": lambda x: x.sum(axis=0),
    "std": lambda x: x.std(ddof=1),
    "min and max": lambda x: (x.min(), x.max(), x.argmin(), x.argmax()),
    "any and all": lambda x: ((x > 4).any(), (x > 4).all(), x.any(), x.all()),
    "cumsum": lambda x: x.cumsum(),
    "mean of some": lambda x: x.mean(where=x > 2),
    "astype": lambda x: x.astype("float32"),
    "reshape": lambda x: x.reshape(6, 20).T,
    "tolist": lambda x: x.tolist(),
    "nonzero": lambda x: x.nonzero()[0],
    "attributes": lambda x: (x.shape, x.dtype.str, x.ndim, x.size, x.nbytes, len(x)),
    "item": lambda x: x.item(3),
    "bytes": bytes,
    "iteration": list,
    "backwards": lambda x: list(reversed(x)),
    "builtins": lambda x: (sum(x), max(x), sorted(x)),
    "in": lambda x: (3 in x, 9 in x),
    "index by itself": lambda x: x[x],
    "index by a mask of itself": lambda x: x[x > 2],
    "index by a bool": lambda x: x[True],
    "index by nothing": lambda x: x[()],
    "index of another array": lambda x: np.eye(6)[x],
    "np.mean": np.mean,
    "np.log1p": np.log1p,
    "np.where": lambda x: np.where(x == 1, x, -1),
    "np.add.reduce": np.add.reduce,
    "np.subtract.outer": lambda x: np.subtract.outer(x, x),
    "where=": lambda x: np.add(x, 1, where=x > 2, out=np.zeros(120, np.int32)),
    "np.concatenate": lambda x: np.concatenate([x, x]),
    "np.unique": lambda x: np.unique(x, return_counts=True),
    "np.bincount": lambda x: np.bincount(x, minlength=6),
    "np.array_equal": lambda x: np.array_equal(x, x),
    "np.sort": np.sort,
    "np.median": np.median,
    "np.zeros_like": np.zeros_like,
    "np.isin": lambda x: np.isin(x, [1, 2]),
    "np.array": lambda x: np.array(x, dtype=float),
    "torch.as_tensor": lambda x: torch.as_tensor(x).numpy(),
    "jnp.asarray": lambda x: np.asarray(jnp.asarray(x)),
    "pandas": lambda x: pd.Series(x).to_numpy(),
    "series ==": lambda x: (pd.Series(np.full(120, 3)) == x).to_numpy(),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_same_as_the_array(history, arrays, call):
    expected = call(np.array(arrays["actions"]))
    found = call(history.actions)
    if isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(found, expected, strict=True)
    else:
        assert type(found) is type(expected)
        assert repr(found) == repr(expected)


@pytest.mark.parametrize("name", ["state", "obs", "rewards", "dones", "episode_end_state"])
def test_every_field(history, arrays, name):
    lazy = getattr(history, name)
    expected = lazy[:] if name == "obs" else arrays[name]
    np.testing.assert_array_equal(lazy > 0, expected > 0, strict=True)
    assert lazy.max() == expected.max()
    np.testing.assert_array_equal(lazy.sum(axis=0), expected.sum(axis=0), strict=True)


REFUSED = {
    "truth": bool,
    "assignment": lambda x: x.__setitem__(0, 1),
    "in place": lambda x: x.__iadd__(1),
    "as an output": lambda x: np.add(1, 1, out=x),
    "ufunc.at": lambda x: np.add.at(x, 0, 1),
    "no copy": lambda x: np.array(x, copy=False),
}


@pytest.mark.parametrize("call", REFUSED.values(), ids=REFUSED)
def test_refused(history, arrays, call):
    with pytest.raises(OptionError, match=re.escape("LazyArray(actions of history 4, shape=(120,), dtype=int32)")):
        call(history.actions)
    np.testing.assert_array_equal(history.actions, arrays["actions"])


@pytest.mark.parametrize(
    "call",
    [
        hash,
        lambda x: x == "up",  # NumPy says False of every action
        lambda x: np.copyto(x, 1),
        lambda x: np.cumsum(np.arange(120), out=x),
        lambda x: x.cumsum(out=x),
    ],
)
def test_refused_by_numpy(history, call):
    with pytest.raises(TypeError):
        call(history.actions)


def test_a_lazy_array_travels_by_pickle(history, arrays):
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(history.rewards)), arrays["rewards"])


def test_iteration_reads_rows_in_blocks(lite, monkeypatch):
    monkeypatch.setattr("icrl4aht_data.reading.lazy_array._BLOCK", 50)
    history = load_icrl4aht(lite[0])[4]
    np.testing.assert_array_equal(np.stack(list(history.state)), lite[1][4]["state"])
