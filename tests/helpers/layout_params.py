"""Parameters of tests that take a layout."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest

from icrl4aht_data.overcooked.layouts import LAYOUTS


def layout_params(quick: Collection[str], names: Iterable[str] = LAYOUTS) -> list[Any]:
    """Return test parameters for layouts by name; all but those in `quick` are marked slow."""
    return [pytest.param(name, marks=[] if name in quick else [pytest.mark.slow]) for name in names]
