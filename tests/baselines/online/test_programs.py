"""One compiled program for functions that differ only in constant arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from icrl4aht_baselines.online.programs import run_all, shared_programs


def walker(table: list[int], steps: int = 3) -> Callable[..., Any]:
    """Return a function that follows a lookup table for a number of steps."""
    leads_to = np.array(table, np.int32)

    def walk(scale: Any, cell: Any) -> dict[str, Any]:
        def step(cell: Any, _: None) -> tuple[Any, Any]:
            return jnp.asarray(leads_to)[cell], cell

        end, visited = jax.lax.scan(step, cell, length=steps)
        return {"end": end, "sum": scale * jax.lax.cond(end > 1, jnp.sum, jnp.max, visited)}

    return walk


TABLES = [[1, 2, 0], [2, 0, 1], [0, 0, 0]]


def test_each_function_has_its_own_constants():
    functions = [walker(table) for table in TABLES]
    (shared,) = shared_programs(functions, jnp.float32(2), jnp.int32(0))
    assert shared.members == [0, 1, 2]
    cells = jnp.array([1, 2, 1])
    found = jax.jit(lambda *arguments: run_all(shared, 1, *arguments))(jnp.float32(2), cells)
    for number, function in enumerate(functions):
        alone = function(jnp.float32(2), cells[number])
        assert {key: float(value[number]) for key, value in found.items()} == {k: float(v) for k, v in alone.items()}
    assert found["end"].tolist() == [1, 2, 0]  # the first table's constants would give 1 for the third function


def test_repeated_functions_share_a_program():
    (shared,) = shared_programs([walker(table) for table in TABLES], jnp.float32(1), jnp.int32(0))
    some = shared.repeated([2, 1, 1])
    assert some.members == [2, 1, 1]
    found = run_all(some, 1, jnp.float32(1), jnp.array([1, 1, 2]))
    assert found["end"].tolist() == [0, 1, 2]


def test_different_structures_get_separate_programs():
    """Step counts, table lengths and results differ; the order of the functions is kept."""
    functions = [walker([1, 0]), walker([1, 0], steps=2), walker([0, 1]), walker([1, 0, 2])]
    functions.append(lambda scale, cell: (walker([1, 0])(scale, cell)["end"],))
    found = shared_programs(functions, jnp.float32(2), jnp.int32(0))
    assert [shared.members for shared in found] == [[0, 2], [1], [3], [4]]


def test_constants_that_cannot_be_replaced_are_found():
    """A separately compiled function would keep the first layout's constants for all layouts."""
    with pytest.raises(AssertionError):
        shared_programs([jax.jit(walker([1, 0]))], jnp.float32(2), jnp.int32(0))
