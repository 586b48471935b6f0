"""Best responses for tests of scores."""

from __future__ import annotations

import pytest

from icrl4aht_data.benchmark import best_responses
from tests.helpers.evaluated import write_measured


@pytest.fixture
def measured(tmp_path_factory, monkeypatch) -> None:
    """Replace the package's best responses by those of `write_measured`."""
    path = write_measured(tmp_path_factory.getbasetemp() / "best_responses.json")
    monkeypatch.setattr(best_responses, "best_responses_file", lambda: path)
