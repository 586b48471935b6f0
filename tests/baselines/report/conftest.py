"""Fixtures that replace the package's best responses, which tests of scores must not depend on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from icrl4aht_data.benchmark import best_responses
from icrl4aht_data.benchmark.best_responses import BestResponseCard, write_best_responses
from tests.helpers.evaluated import write_invented_responses


@pytest.fixture(scope="session")
def responses_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cards")
    write_invented_responses(folder / "measured.json")
    write_best_responses(folder / "none.json", BestResponseCard("0", "seeded", "None measured."))
    return folder


@pytest.fixture(scope="module", autouse=True)
def empty_responses(responses_folder) -> Iterator[None]:
    """Replace the package's best responses with an empty set."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(best_responses, "best_responses_file", lambda: responses_folder / "none.json")
        yield


@pytest.fixture
def invented_responses(empty_responses, responses_folder, monkeypatch) -> None:
    """Replace the package's best responses with the invented ones that `write_invented_responses` writes."""
    monkeypatch.setattr(best_responses, "best_responses_file", lambda: responses_folder / "measured.json")
