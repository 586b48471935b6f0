"""docs/results.md: tables computed from hand-made numbers, and the committed page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from icrl4aht_baselines.report import comparison
from icrl4aht_baselines.report.comparison import (
    FORGETS,
    UNSEEN,
    StoredResults,
    add_unseen,
    read_stored,
    render_comparison,
    results_file,
    summary_table,
    unseen_table,
    write_stored,
)
from icrl4aht_baselines.report.results import BLOCKS, TABLE_COLUMNS, CellReturns, ResultCell, cell_rows
from icrl4aht_baselines.report.scores import cell_headroom, open_cells

from icrl4aht_data.commands.cli import cli
from tests.helpers.paths import ROOT


def blocks(mean: Any, gain: Any = 0.0) -> CellReturns:
    """Return results of five tasks and three seeds whose return rises by `gain`."""
    values, gain = np.broadcast_to(mean, (5, 3)), np.broadcast_to(gain, (5, 3))
    return CellReturns(values, values - gain / 2, values + gain / 2, values - gain)


def everywhere(share: float, gain: float = 0.0) -> dict[ResultCell, CellReturns]:
    """Return results of an agent with an equal normalised score in every cell."""
    egos = cell_headroom("seeded")
    return {
        cell: blocks(egos[cell]["stay"] + share * (egos[cell]["oracle"] - egos[cell]["stay"]), gain)
        for cell in open_cells("seeded")
    }


def stored_of(
    agents: Mapping[str, Mapping[ResultCell, CellReturns]], protocol: str = "seeded", overlaps=(), **texts
) -> StoredResults:
    rows = [
        row
        for agent, cells in agents.items()
        for cell, of in cells.items()
        for row in cell_rows((agent, protocol), cell, of[: len(BLOCKS)], overlaps)
    ]
    return StoredResults(pd.DataFrame(rows, columns=TABLE_COLUMNS), dict.fromkeys(agents, "a model"), **texts)


def summary(stored: StoredResults) -> list[str]:
    return summary_table(stored.protocol("seeded"), "seeded").splitlines()[2:]


def test_the_summary_has_scores_and_rising_cells():
    cells = everywhere(0.5, gain=2.0)
    cells[ResultCell("demo_wide", "H4")] = blocks(20.0, gain=-1.0)
    noisy = 20 * np.linspace(-1, 1.01, 15).reshape(5, 3)
    cells[ResultCell("demo_wide", "H3")] = blocks(20.0, gain=noisy)
    some = {"half": everywhere(0.5), "rising": cells, "flat": {ResultCell("coord_simple", "H1"): blocks(1.0)}}
    half, rising, flat = summary(stored_of(some, overlaps=["teammate"]))
    stays = np.mean([cell_headroom("seeded")[cell]["stay"] for cell in open_cells("seeded")])
    means = np.mean([of.mean.mean() for of in everywhere(0.5).values()])
    score = "0.50 (0.50 to 0.50)"
    assert half.startswith(f"| `half`‡ | {score} | {score} | {score} | 0 of 20 | {means:.1f} to {means:.1f}, +0.0 (")
    assert stays < means and half.endswith("| 3 |")
    assert "| 18 of 20 |" in rising and flat == "| `flat`‡ |  |  |  | 0 of 0 |  |  |"
    (opening,) = summary(stored_of({"a": everywhere(0.0, gain=2.0)}))
    assert f"| {stays - 2:.1f} to {stays + 1:.1f}, +3.0 (+3.0 to +3.0) |" in opening
    assert summary(StoredResults()) == [], "a protocol without results"


def test_the_page_has_a_column_for_each_current_model():
    """Older models and models without memory appear only in the summary."""
    agents = {"a": everywhere(0.5, gain=2.0), f"a{FORGETS}": everywhere(0.1), "old": everywhere(0.2)}
    ablations = {"ablate windows": {"plain": "the first", "long": "K = 500"}}
    stored = stored_of(agents, commits={"old": "71f723c"}, ablations=ablations)
    entries = {"plain": blocks(10.0, gain=1.0), "long": blocks(12.0)}
    found = stored_of(
        {name: {ResultCell("demo_wide", "H1", "diverse"): of} for name, of in entries.items()}, "ablate windows"
    )
    stored = comparison._replace_rows(stored, found.table)
    parts = {part.splitlines()[0]: part for part in render_comparison(stored).split("\n## ")}
    gains = "First and last episodes, protocol `seeded`"
    for agent, where in ((f"a{FORGETS}", {"Summary", gains}), ("old", {"Summary"})):
        assert {title for title, part in parts.items() if f"| `{agent}`" in part} == where
    assert "* `old`: a model (made by commit 71f723c)" in parts["# Results: reference models"]
    assert (
        f"| {(mean := agents['a'][ResultCell('demo_wide', 'H4')].mean.mean()):.1f} |"
        in parts["Track teammate, protocol `seeded`"]
    )
    assert f"**{mean - 1:.1f} to {mean + 1:.1f}, +2.0 (+2.0 to +2.0)**" in parts[gains]
    ablated = parts["Ablations of AD's windows and DPT's contexts"]
    assert "| `plain` | the first | 10.0 (10.0 to 10.0) |  | +1.0 (+1.0 to +1.0) |" in ablated
    assert "| `long` | K = 500 | 12.0 (12.0 to 12.0) | +2.0 (+2.0 to +2.0) | +0.0 (+0.0 to +0.0) |" in ablated


def test_unseen_layouts(tmp_path):
    """Check scores of hand-made returns on two versions of two layouts."""

    def returns(*of_versions: float) -> np.ndarray:
        return np.repeat(np.array(of_versions)[:, None], 40, axis=1)

    wide, both, other = ("demo_wide", "H1"), ("asymm_both", "H1"), ("asymm_both", "H3")
    found = {
        "stay": {wide: returns(0, 0), both: returns(10, 10), other: returns(0, 0)},
        "oracle": {wide: returns(40, 40), both: returns(30, 30), other: returns(20, 20)},
        "mine": {wide: returns(10, 30), both: returns(10, 10), other: returns(0, 20)},
    }
    stored = add_unseen(StoredResults(), found)
    stay, oracle, mine = unseen_table(stored).splitlines()[2:]
    assert stay == "| `stay` | 5.0 (5.0 to 5.0) | 0.0 (0.0 to 0.0) |  |"
    assert oracle == "| `oracle` | 25.0 (25.0 to 25.0) | 40.0 (40.0 to 40.0) |  |"
    # asymm_both: 5 and 15 of 5 to 25; demo_wide: 10 and 30 of 40: normalised 0 and 0.5, 0.25 and 0.75
    assert mine == "| `mine` | 10.0 (5.0 to 15.0) | 20.0 (10.0 to 30.0) | 0.38 (0.12 to 0.62) |"
    write_stored(tmp_path / "results.json", stored)
    assert unseen_table(read_stored(tmp_path / "results.json")) == unseen_table(stored)
    alone = add_unseen(StoredResults(), {"mine": {wide: found["mine"][wide]}})
    assert "| `mine` | 20.0 (10.0 to 30.0) |  |" in unseen_table(alone) and list(alone.protocol(UNSEEN)) == ["mine"]


@pytest.mark.slow
def test_the_committed_page_matches_the_stored_results():
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert page == render_comparison(read_stored(results_file()))


def test_the_command(tmp_path, monkeypatch):
    target = tmp_path / "stored.json"
    write_stored(target, stored_of({"a": everywhere(0.5)}))
    monkeypatch.setattr(comparison, "results_file", lambda: target)
    result = CliRunner().invoke(cli, ["results", "--out", str(tmp_path / "page")], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "| `a` | 0.50" in (tmp_path / "page" / "results.md").read_text(encoding="utf-8")
    assert (tmp_path / "page" / "results.png").stat().st_size > 10_000
