"""Fixture of tests that compare teammates on many states."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import pytest
from icrl4aht_generation.teammates import distances


@pytest.fixture
def optimized_actions(monkeypatch) -> None:
    """Compile the teammates' actions on common states with optimizations, since they run longer than they compile."""
    compiled = distances._compiled_actions

    def act_optimized(family: Any, *arguments: Any) -> jax.Array:
        before = jax.config.read("jax_disable_most_optimizations")
        jax.config.update("jax_disable_most_optimizations", False)
        try:
            return compiled(family)(*arguments)
        finally:
            jax.config.update("jax_disable_most_optimizations", before)

    monkeypatch.setattr(distances, "_compiled_actions", lambda family: partial(act_optimized, family))
