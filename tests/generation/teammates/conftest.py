"""Fixture of tests that compare teammates on many states."""

from __future__ import annotations

import pytest
from icrl4aht_generation.teammates import distances

from tests.helpers.xla_flags import optimized


@pytest.fixture
def optimized_actions(monkeypatch) -> None:
    """Compile the teammates' actions on common states with optimizations."""
    compiled = distances._compiled_actions
    monkeypatch.setattr(distances, "_compiled_actions", lambda family: optimized(compiled(family)))
