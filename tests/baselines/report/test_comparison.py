"""Test the page docs/results.md: stored results, tables computed from invented returns, and the committed page."""

from __future__ import annotations

import dataclasses
import lzma

import numpy as np
import pandas as pd
import pytest
from icrl4aht_baselines.report import comparison, stored_results
from icrl4aht_baselines.report.comparison import SecondaryEffect
from icrl4aht_baselines.report.scores import add_scales, cell_scales
from icrl4aht_baselines.report.statistics import MeanInterval, holm_corrected
from icrl4aht_baselines.report.stored_results import StoredResults
from icrl4aht_baselines.report.submission import AgentFacts, make_submission
from msgspec import structs

from icrl4aht_data.benchmark import best_responses
from icrl4aht_data.benchmark.adaptation import published_adaptation_table
from icrl4aht_data.benchmark.facts import PREFERENCE
from icrl4aht_data.benchmark.reference_returns import read_reference_returns
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.text import card_file
from tests.helpers.evaluated import write_invented_responses, write_results
from tests.helpers.paths import ROOT

FACTS = AgentFacts("a rule", "noise", "oracle", steps="10 updates", core_hours=2.0)
LOW, HIGH = [0.0] * 5 + [10.0] * 95, [10.0] * 5 + [20.0] * 95


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> StoredResults:
    """Return results of two agents on the layout track: `high`, which needs its memory, and `low`."""
    folder = tmp_path_factory.mktemp("results")
    write_results(folder / "high", "high", HIGH, offset=1.0)
    write_results(folder / "high" / "cleared", "high (cleared)", [5.0] * 100, offset=0.5, forget=True)
    write_results(folder / "high" / "swapped", "high (swapped)", HIGH[:80] + [20.0] * 20, offset=1.0, swapped=True)
    write_results(folder / "low", "low", LOW)
    found = StoredResults()
    for name in ("high", "low"):
        found = stored_results.add_submission(found, make_submission([folder / name], FACTS))
    return found


def effects(stored: StoredResults) -> dict[tuple[str, ...], SecondaryEffect]:
    return comparison.secondary_effects(stored, stored.returns(), cell_scales("seeded"))


def agent_row(table: str, agent: str) -> list[str]:
    (line,) = [line for line in table.splitlines() if line.startswith(f"| `{agent}` ")]
    return [cell.strip() for cell in line.strip("|").split(" | ")]


def test_stored_results_have_episode_blocks_and_curves_and_can_be_read_again(stored, tmp_path):
    assert len(stored.table) == 4 * 40 * 3 * 6 and len(stored.curves) == 4 * 2 * 100
    curve = stored.curves[(stored.curves["agent"] == "high") & (stored.curves["control"] == "")]
    assert curve["return"].tolist() == [value + 2.0 for value in HIGH] * 2, "mean over the five teammates"
    stored_results.write_stored(tmp_path / "results.json", stored)
    again = stored_results.read_stored(tmp_path / "results.json")
    assert again.agents == stored.agents
    pd.testing.assert_frame_equal(again.table, stored.table, check_dtype=False)
    pd.testing.assert_frame_equal(again.curves, stored.curves, check_dtype=False)


def test_agents_table_has_scores_of_complete_tracks_only(stored, invented_responses):
    scales = cell_scales("seeded")
    table = comparison.agents_table(stored, stored.returns(), scales, effects(stored))
    high, low = agent_row(table, "high"), agent_row(table, "low")
    assert high[1:6] == ["noise", "oracle", "10 updates, 2 core-hours", "–", "–"], "no track teammate"
    # Score: (return - stay) / 20; the mean return of `stay` is 12.0 on asymm_right and 0.0 on cramped_down.
    stays = np.mean([np.mean([scale.stay for cell, scale in scales.items() if cell.layout == name])
                     for name in ("asymm_right", "cramped_down")])  # fmt: skip
    for found, mean in ((high, 21.5), (low, 9.5)):
        assert found[6].startswith(f"**{(mean - stays) / 20:z.2f} (")
    weak = comparison.SecondaryEffect(MeanInterval(0.5, 0.1, 0.9, p=0.02), p=0.06)
    assert weak.text(1) == "+0.5 (+0.1 to +0.9)", "bold only if the corrected p-value is below 0.05"
    (line,) = comparison.describe_differences(effects(stored)).splitlines()
    assert line.startswith("* Track `layout`: `high` - `low` **+0.60 (") and line.endswith(")**.")
    assert comparison.describe_differences({}) == "No two models have a score on the same track."


def test_differences_are_between_agents_with_neighbouring_scores(tmp_path, invented_responses):
    one, found = make_submission([write_results(tmp_path, "a", [0.0] * 100, "teammate")], FACTS), StoredResults()
    for name, value in {"a": 3.0, "b": 9.0, "c": 5.0}.items():
        returns = dict.fromkeys(one.evaluations[0].returns, [[value] * 100] * 3)
        of_agent = structs.replace(one, agent=name, evaluations=[structs.replace(one.evaluations[0], returns=returns)])
        found = stored_results.add_submission(found, of_agent)
    assert comparison.describe_differences(effects(found)) == (
        "* Track `teammate`: `b` - `c` **+0.20 (+0.20 to +0.20)**, `c` - `a` **+0.10 (+0.10 to +0.10)**."
    )


def test_p_values_are_corrected_over_all_effects(stored, invented_responses):
    """The five effects are N of both agents and their difference on track `layout`, and M and P of `high`."""
    found = effects(stored)
    assert {*found} == {
        ("N", "layout", "high"), ("N", "layout", "low"), ("difference", "layout", "high", "low"),
        ("cleared", "published", "high"), ("swapped", "published", "high"),
    }  # fmt: skip
    assert {key: of.p for key, of in found.items()} == holm_corrected({key: of.effect.p for key, of in found.items()})
    memory = found["cleared", "published", "high"]
    assert memory.p >= 4 * memory.effect.p


def test_controls_table_has_memory_and_partner_controls_and_episode_blocks(stored, invented_responses):
    table = comparison.controls_table(stored.returns(), cell_scales("seeded"), effects(stored))
    high, low = agent_row(table, "high"), agent_row(table, "low")
    assert high[1] == low[1] == "layout"
    assert high[2].startswith("**+15.5 (") and high[2].endswith(")**"), "19.5 + 2 - (5 + 1)"
    assert high[3] == "+0.0 (+0.0 to +0.0)" and high[4:] == ["12.0", "12.0", "22.0", "22.0"]
    assert low[2:] == ["–", "–", "0.0", "0.0", "10.0", "10.0"]


def test_results_on_track_preference_have_their_own_columns_and_rows(stored, tmp_path, monkeypatch):
    """They are added to the agent's results on other tracks, which stay as they were."""
    monkeypatch.setattr(best_responses, "best_responses_file", lambda: tmp_path / "both.json")
    write_invented_responses(tmp_path / "both.json", preference=True)
    write_results(tmp_path / "high", "high", [12.0] * 100, PREFERENCE)
    write_results(tmp_path / "high" / "cleared", "high (cleared)", [5.0] * 100, PREFERENCE, forget=True)
    more = stored_results.add_submission(stored, make_submission([tmp_path / "high"], FACTS, update=True))
    assert len(more.table) == len(stored.table) + 2 * 120 * 3 * 6, "results on the track layout are kept"
    assert len(more.curves) == len(stored.curves), "the figure shows published layouts only"
    scales, found = cell_scales("seeded"), effects(more)
    assert len([cell for cell in scales if cell.kind == PREFERENCE]) == len({(cell.layout, cell.family)
               for cell in more.returns()["high"] if cell.kind == PREFERENCE})  # fmt: skip
    table = comparison.agents_table(more, more.returns(), scales, found)
    assert "| N, layout | IQM, layout | N, preference | IQM, preference |" in table
    high, low = agent_row(table, "high"), agent_row(table, "low")
    assert high[8].startswith("**0.51 (") and low[8:] == ["–", "–"]
    assert high[:8] == agent_row(comparison.agents_table(stored, stored.returns(), scales, effects(stored)), "high")[:8]
    lines = comparison.controls_table(more.returns(), scales, found).splitlines()
    rows = [line for line in lines if PREFERENCE in line]
    assert len(rows) == 1 and rows[0].startswith("| `high` | preference | **+7.0 (+7.0 to +7.0)** | – | 12.0 |")


def test_layouts_table_has_reference_egos_and_returns_by_layout(stored, invented_responses):
    table = comparison.layouts_table(stored.returns(), cell_scales("seeded"))
    assert agent_row(table, "stay")[1:4] == ["12.8", "13.0", "12.7"] and "| best response | 12.8 | 18.0 |" in table
    low = agent_row(table, "low")
    assert low[1] == "–" and low[8] == "9.5 (0.47)" and low[10].endswith(" (layout only)")
    assert float(low[10].split()[0]) == pytest.approx(26.0 - 9.5, abs=0.1)
    assert low[9].endswith("asymm_right H4"), "stay earns 40 there"
    none = comparison.layouts_table(stored.returns(), {})
    assert agent_row(none, "low")[7:] == ["9.5", "9.5", "–", "–"] and "| best response | – |" in none


def test_mean_best_return_uses_stay_for_families_without_best_response(invented_responses):
    scales, stay = cell_scales("seeded"), read_reference_returns("seeded")
    ring = [cell for cell in scales if cell.layout == "coord_ring"]
    h2 = next(cell for cell in ring if cell.family == "H2")
    others = sum(stay[cell[:2]]["stay"] for cell in ring if cell != h2)
    assert comparison.mean_best_return("coord_ring", {h2: scales[h2]}) == pytest.approx((scales[h2].best + others) / 4)
    assert (
        comparison.mean_best_return("coord_ring", {cell: scales[cell] for cell in scales if cell not in ring}) is None
    )


def test_results_page_is_written_with_and_without_best_responses(stored, tmp_path, responses_folder, monkeypatch):
    old = stored.agents | {"low": AgentFacts("an old one", "noise", "oracle", commit="71f723c")}
    some = dataclasses.replace(stored, agents=old)
    paths = comparison.write_comparison(some, tmp_path / "page")
    assert [path.name for path in paths] == [*comparison.RESULTS_FILES]
    text = paths[0].read_text(encoding="utf-8")
    assert f"no ego can raise the return.\n\n{published_adaptation_table({})}\n" in text
    assert "| `high` | noise | oracle | 10 updates, 2 core-hours | – |" in text and "| `low`" not in text
    assert "`low`" not in text and "lists them (version 0)" in text
    assert paths[1].stat().st_size > 10_000
    assert len(pd.read_parquet(paths[2])) == len(stored.table)
    monkeypatch.setattr(best_responses, "best_responses_file", lambda: responses_folder / "measured.json")
    table = add_scales(stored.table)
    down = table[table["layout"] == "cramped_down"]
    assert len(table) == len(stored.table) and set((down["best"] - down["stay"]).dropna()) == {20}
    mixed = table[table["control"] == "swapped"]
    assert set(mixed.loc[mixed["best"].notna(), "block"]) == {"last 20"}, "others have another teammate"
    assert "20 of 32 cells" in comparison.render_comparison(some)
    panels, make = [], comparison.panel_grid
    monkeypatch.setattr(
        comparison, "panel_grid", lambda layouts, *options: panels.append(layouts) or make(layouts, *options)
    )
    comparison.plot_comparison(some, tmp_path / "again.png")
    assert panels == [["coord_ring", "test_wide", "demo_simple", "demo_wide", "asymm_right", "cramped_down"]]


@pytest.mark.parametrize("texts", ["{", "[]", '{"a": {}}', "{}"])
def test_damaged_stored_results_raise_error(texts, tmp_path):
    with pytest.raises(OptionError, match=r"none\.json: not stored results: FileNotFoundError.*restore this file"):
        stored_results.read_stored(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text(texts)
    (tmp_path / "bad.csv").write_text("agent,protocol\n")
    with pytest.raises(OptionError, match=r"bad\.json: not stored results: .*this file, bad\.csv\.xz and bad_curves"):
        stored_results.read_stored(tmp_path / "bad.json")


@pytest.mark.parametrize("part", [slice(40), slice(10, None)])
def test_damaged_tables_of_stored_results_raise_error(part, stored, tmp_path):
    """A table is cut at its end or its start."""
    stored_results.write_stored(tmp_path / "cut.json", stored)
    path = tmp_path / "cut.csv.xz"
    path.write_bytes(path.read_bytes()[part])
    with pytest.raises(OptionError, match=r"cut\.json: not stored results: .*restore this file, cut\.csv\.xz"):
        stored_results.read_stored(tmp_path / "cut.json")


def test_bundled_results_are_unchanged_if_written_again(tmp_path, monkeypatch):
    compress = stored_results.lzma.compress
    monkeypatch.setattr(stored_results.lzma, "compress", lambda text, preset: compress(text, preset=0))  # faster
    stored_results.write_stored(tmp_path / "results.json", stored_results.read_stored(stored_results.results_file()))
    for name in ("results.json", "results.csv.xz", "results_curves.csv.xz"):
        opened = lzma.open if name.endswith(".xz") else open
        with opened(tmp_path / name) as written, opened(stored_results.results_file().with_name(name)) as bundled:
            assert written.read() == bundled.read()


@pytest.mark.slow
def test_committed_results_page_matches_the_stored_results(monkeypatch):
    monkeypatch.setattr(best_responses, "best_responses_file", lambda: card_file("best_responses.json"))
    stored = stored_results.read_stored(stored_results.results_file())
    assert (ROOT / "docs" / "results.md").read_text(encoding="utf-8") == comparison.render_comparison(stored)
    assert len(pd.read_parquet(ROOT / "docs" / "results.parquet")) == len(stored.table)
