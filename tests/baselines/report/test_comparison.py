"""The page of results: what is stored, intervals, tables against hand-made numbers, and the committed page."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest
from click.testing import CliRunner
from icrl4aht_baselines.evaluate.protocols import bundled_tasks, get_protocol
from icrl4aht_baselines.evaluate.results import Result, read_result, write_result
from icrl4aht_baselines.report import stored_results
from icrl4aht_baselines.report.comparison import (
    FORGETS,
    ablation_table,
    cells_with_headroom,
    drawn_agents,
    gains_table,
    layouts_above_paper,
    normalised_interval,
    render_page,
    rising_cells,
    shown_agents,
    summary_table,
    unseen_table,
)
from icrl4aht_baselines.report.overlap import OVERLAPS
from icrl4aht_baselines.report.results import OWN_TASKS, cell_of, published_cells, published_test_tasks
from icrl4aht_baselines.report.stored_results import (
    UNSEEN,
    CellReturns,
    StoredResults,
    add_ablation,
    add_results,
    add_unseen,
    read_stored,
    results_file,
    write_stored,
)
from icrl4aht_baselines.training.ablations import ABLATIONS
from icrl4aht_baselines.training.run_folder import RUN_FORMAT

from icrl4aht_data.benchmark.reference_returns import read_headroom
from icrl4aht_data.benchmark.tasks import write_tasks
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import OptionError, UnknownNameError
from tests.helpers.paths import ROOT


def cell(mean: float, gain: float = 0.0) -> CellReturns:
    values = np.full((5, 3), mean)
    return CellReturns(values, values - gain / 2, values + gain / 2, values - gain)


def same(values: np.ndarray) -> CellReturns:
    """Returns that are equal in all episodes."""
    return CellReturns(values, values, values, values)


def everywhere(share: float, gain: float = 0.0) -> dict:
    """Returns of an agent that has the same share of the headroom in every cell."""
    egos = read_headroom("seeded")
    return {
        one: cell(egos[one]["stay"] + share * (egos[one]["oracle"] - egos[one]["stay"]), gain)
        for one in cells_with_headroom("seeded")
    }


class TestNumbers:
    def test_there_are_20_cells_with_headroom(self):
        found = cells_with_headroom("seeded")
        assert len(found) == 20 and ("coord_ring", "H2") in found and ("demo_simple", "H2") not in found

    @pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
    def test_normalised_return(self, share):
        found = normalised_interval(everywhere(share), "seeded", cells_with_headroom("seeded"))
        assert found == (pytest.approx(share), pytest.approx(share), pytest.approx(share))

    def test_the_interval_shrinks_with_the_spread(self):
        wide = {
            one: CellReturns(*[found.mean + 5 * np.linspace(-1, 1, 15).reshape(5, 3)] * 4)
            for one, found in everywhere(0.5).items()
        }
        chosen = cells_with_headroom("seeded")
        mean, low, high = normalised_interval(wide, "seeded", chosen)
        assert low < mean - 0.01 and high > mean + 0.01 and mean == pytest.approx(0.5)
        mixed = {one: same(np.sort(found.mean, axis=None).reshape(3, 5).T) for one, found in wide.items()}
        narrow = normalised_interval(mixed, "seeded", chosen)
        assert narrow.low > low and narrow.high < high  # the same values, but teammates that differ by less

    def test_rising_cells(self):
        cells = everywhere(0.5, gain=2.0)
        cells["demo_wide", "H4"] = cell(20.0, gain=-1.0)
        noisy = cell(20.0)
        cells["demo_wide", "H3"] = noisy._replace(last=noisy.first + 20 * np.linspace(-1, 1.01, 15).reshape(5, 3))
        found = rising_cells(cells, "seeded")
        assert len(found) == 18 and ("demo_wide", "H4") not in found and ("demo_wide", "H3") not in found

    def test_layouts_above_the_paper(self):
        best = {name: max(published_cells(agent)[name]["Average"][0] for agent in ("AD", "DPT"))
                for name in ("demo_wide", "test_wide")}  # fmt: skip
        cells = {(name, family): cell(best[name] + 1) for name in best for family in ("H1", "H2", "H3", "H4")}
        assert layouts_above_paper(cells) == ["test_wide", "demo_wide"]
        cells["demo_wide", "H1"] = cell(best["demo_wide"] - 4)
        assert layouts_above_paper(cells) == ["test_wide"]
        del cells["test_wide", "H2"]
        assert layouts_above_paper(cells) == []


@pytest.fixture
def results(tmp_path):
    """Results of an agent in one cell: episode returns 0..99 plus the seed, in every task."""
    protocol = get_protocol("seeded")
    settings = {"agent": "ramp", "seeds": [0, 1], "protocol": asdict(protocol), "code_version": "0"}
    settings |= {"details": {"trained_on": [{"layout": "demo_wide", "family": "H4"}]}}
    for task in published_test_tasks().values():
        if cell_of(task) == ("demo_wide", "H4"):
            returns = [[float(seed + number) for number in range(100)] for seed in range(2)]
            write_result(tmp_path / "ramp", Result(task.task_id, settings, returns))
    return tmp_path / "ramp"


class TestStoring:
    def test_from_results_to_a_file_and_back(self, results, tmp_path):
        stored = add_results(StoredResults({}, {}), results, "a ramp")
        found = stored.cells["ramp", "seeded"]["demo_wide", "H4"]
        assert found.mean.tolist() == [[49.5, 50.5]] * 5
        assert found.opening.tolist() == [[0.0, 1.0]] * 5
        assert found.first.tolist() == [[9.5, 10.5]] * 5 and found.last.tolist() == [[89.5, 90.5]] * 5
        assert found.overlaps == ("family",)
        write_stored(tmp_path / "results.json", stored)
        again = read_stored(tmp_path / "results.json")
        assert again.about == {"ramp": "a ramp"} and shown_agents(again) == ["ramp"]
        for one, two in zip(found, again.cells["ramp", "seeded"]["demo_wide", "H4"], strict=True):
            np.testing.assert_array_equal(one, two)
        assert "9.5 to 89.5" not in gains_table(again, "seeded", ["ramp"])
        assert "10.0 to 90.0, +80.0 (+80.0, +80.0)" in gains_table(again, "seeded", ["ramp"])

    def test_no_file_and_damaged_files(self, tmp_path):
        assert read_stored(tmp_path / "none.json").cells == {}
        for content in ("{", "[]", '{"agents": {"a": {"seeded": {"demo_wide": {"H4": {}}}}}, "about": {}}'):
            (tmp_path / "bad.json").write_text(content)
            with pytest.raises(OptionError, match=r"bad\.json: not stored results: .*restore the file"):
                read_stored(tmp_path / "bad.json")

    def test_short_evaluations_have_no_ends(self, results):
        for path in (results / "tasks").iterdir():
            content = json.loads(path.read_text())
            content["returns"] = [row[:30] for row in content["returns"]]
            path.write_text(json.dumps(content))
        with pytest.raises(OptionError, match="30 episodes, expected at least 40; evaluate more"):
            add_results(StoredResults({}, {}), results, "short")

    def test_published_tasks_that_are_missing(self, results):
        next((results / "tasks").iterdir()).unlink()
        with pytest.raises(OptionError, match="4 of the 5 published tasks of demo_wide H4; evaluate all of them"):
            add_results(StoredResults({}, {}), results, "a part")

    def test_the_command(self, results, tmp_path, monkeypatch):
        target = tmp_path / "stored.json"
        monkeypatch.setattr(stored_results, "results_file", lambda: target)
        arguments = ["results", str(results), "--about", "a ramp", "--out", str(tmp_path / "page"), "--store"]
        result = CliRunner().invoke(cli, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        page = (tmp_path / "page" / "results.md").read_text(encoding="utf-8")
        assert "* `ramp`: a ramp" in page and "| `ramp`† |  |  |  | 1 of 1 |" in page
        assert (tmp_path / "page" / "results.png").stat().st_size > 10_000
        assert read_stored(target).about == {"ramp": "a ramp"}


def test_the_figure_has_the_best_models():
    """All cells of seven agents, each a little better than the one before."""
    cells, names = cells_with_headroom("seeded"), "gabcdef"
    found = {(name, "seeded"): {where: cell(float(rank)) for where in cells} for rank, name in enumerate(names)}
    missing = {("best", "seeded"): {cells[0]: cell(99.0)}}
    assert drawn_agents(StoredResults(about={}, cells=found | missing)) == list("bcdef")
    assert drawn_agents(StoredResults(about={}, cells=dict(reversed(found.items())))) == list("fedcb")


def test_the_committed_page_is_that_of_the_stored_results():
    stored = read_stored(results_file())
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert page == render_page(stored, shown_agents(stored))


def test_agents_that_forget_have_no_columns_of_their_own_beside_the_others():
    """They are in the summary and in the table of gains, since only the difference to their memory counts."""
    stored = StoredResults({("a", "seeded"): everywhere(0.5), (f"a{FORGETS}", "seeded"): everywhere(0.1)}, {})
    parts = render_page(stored, shown_agents(stored)).split("\n## ")
    named = {part.splitlines()[0] for part in parts if f"| `a{FORGETS}`" in part}
    assert named == {"Summary", "First and last episodes, protocol `seeded`"}
    halves = " | ".join(["0.50 (0.50 to 0.50)"] * 3)
    assert f"| `a` | {halves} | 0 of 20 |" in summary_table(stored, "seeded")


def test_the_summary_compares_the_very_first_episode_with_the_last():
    stored = StoredResults({("a", "seeded"): everywhere(0.0, gain=2.0)}, {})
    stays = np.mean([read_headroom("seeded")[one]["stay"] for one in cells_with_headroom("seeded")])
    text = f"| {stays - 2:.1f} to {stays + 1:.1f}, +3.0 (+3.0 to +3.0) |"
    assert text in summary_table(stored, "seeded")


def test_a_new_agent_needs_a_sentence(results):
    with pytest.raises(OptionError, match="results of ramp, a new agent: say how it was made by --about"):
        add_results(StoredResults({}, {}), results, "")
    known = add_results(StoredResults({}, {"ramp": "a ramp"}), results, "")
    assert known.about == {"ramp": "a ramp"}


class TestAblations:
    """Entries are compared with the first one, task by task."""

    WINDOWS = "ablate windows"

    @pytest.fixture
    def folder(self, tmp_path):
        """Two entries with 7 tasks of two seeds: returns of 10 and 12, the first of the two rising by 1 an episode."""
        self.write(tmp_path, [task for task in bundled_tasks("teammate", "diverse") if task.layout.name == "demo_wide"])
        return tmp_path

    def write(self, folder, tasks):
        protocol = get_protocol("seeded")
        entries = {entry.name: entry for entry in ABLATIONS[self.WINDOWS].entries}
        for name, offset in (("plain", 0.0), ("K500", 2.0)):
            settings = {"agent": "AD", "seeds": [0, 1], "protocol": asdict(protocol), "code_version": "0"}
            of_entry = folder / f"ad-{name}" / "demo_wide"
            for number, task in enumerate(tasks):
                rise = np.linspace(-5, 5, 100) if name == "plain" else np.zeros(100)
                returns = [(10 + offset + number + rise).tolist()] * 2
                write_result(of_entry / "results", Result(task.task_id, settings, returns))
            write_tasks(of_entry / "results" / OWN_TASKS, tasks)
            (of_entry / "run").mkdir()
            entry = entries[name]
            config = {
                "run_format": RUN_FORMAT,
                "model": entry.model,
                "train": entry.train,
                "histories": entry.histories,
            }
            (of_entry / "run" / "config.json").write_text(json.dumps(config))

    def test_from_an_experiment_to_the_table(self, folder, tmp_path):
        before = StoredResults({("gone", self.WINDOWS): {}}, {})
        stored = add_ablation(before, self.WINDOWS, folder)
        assert set(stored.cells) == {("plain", self.WINDOWS), ("K500", self.WINDOWS)}  # replaces what was stored
        write_stored(tmp_path / "results.json", stored)
        again = read_stored(tmp_path / "results.json")
        assert shown_agents(again) == []
        plain, longer = ablation_table(again, self.WINDOWS).splitlines()[2:]
        assert plain.startswith("| `plain` | size tiny") and "| 13.0 (" in plain
        assert "|  | +8.1 (+8.1 to +8.1) |" in plain
        assert longer.startswith("| `K500` |") and "| 15.0 (" in longer
        assert "| +2.0 (+2.0 to +2.0) | +0.0 (+0.0 to +0.0) |" in longer
        assert "`K500`" not in ablation_table(again, "ablate contexts")

    def test_entries_stay_while_the_first_is_the_same(self, folder):
        """So that entries may be added in several experiments with equal settings."""
        both = add_ablation(StoredResults({}, {}), self.WINDOWS, folder)
        shutil.rmtree(folder / "ad-K500")
        again = add_ablation(both, self.WINDOWS, folder)
        assert set(again.cells) == set(both.cells)
        path = next(folder.glob("ad-plain/*/results/tasks/*.json"))
        result = read_result(path)
        result.returns[0][0] += 1
        write_result(path.parents[1], result)
        assert set(add_ablation(both, self.WINDOWS, folder).cells) == {("plain", self.WINDOWS)}

    def test_settings_that_are_not_the_entrys(self, folder):
        path = folder / "ad-K500" / "demo_wide" / "run" / "config.json"
        config = json.loads(path.read_text())
        config["train"]["batch_size"] = 16
        path.write_text(json.dumps(config))
        with pytest.raises(OptionError, match="batch_size = 16, expected 6, as K500 has it; train it again"):
            add_ablation(StoredResults({}, {}), self.WINDOWS, folder)

    def test_test_tasks_are_refused(self, tmp_path):
        self.write(tmp_path, [task for task in published_test_tasks().values() if task.layout.name == "demo_wide"])
        with pytest.raises(OptionError, match="plain has results of test tasks, expected diverse ones"):
            add_ablation(StoredResults({}, {}), self.WINDOWS, tmp_path)

    def test_a_folder_without_an_ablation(self, tmp_path):
        with pytest.raises(OptionError, match="no results of plain; expected a folder that `icrl4aht-data"):
            add_ablation(StoredResults({}, {}), self.WINDOWS, tmp_path)
        with pytest.raises(UnknownNameError, match="unknown ablation 'ablate ta'; valid: ablate windows"):
            add_ablation(StoredResults({}, {}), "ablate ta", tmp_path)


def test_unseen_layouts(tmp_path):
    """Returns by hand: two versions of two layouts, one of them with two families, 40 episodes."""

    def returns(*of_versions: float) -> np.ndarray:
        return np.repeat(np.array(of_versions)[:, None], 40, axis=1)

    wide, both, other = ("demo_wide", "H1"), ("asymm_both", "H1"), ("asymm_both", "H3")
    found = {
        "stay": {wide: returns(0, 0), both: returns(10, 10), other: returns(0, 0)},
        "oracle": {wide: returns(40, 40), both: returns(30, 30), other: returns(20, 20)},
        "mine": {wide: returns(10, 30), both: returns(10, 10), other: returns(0, 20)},
    }
    stored = add_unseen(StoredResults({}, {}), found)
    assert stored.cells["mine", UNSEEN][wide].last.tolist() == [[10], [30]]
    stay, oracle, mine = unseen_table(stored).splitlines()[2:]
    assert stay == "| `stay` | 5.0 (5.0 to 5.0) | 0.0 (0.0 to 0.0) |  |"
    assert oracle == "| `oracle` | 25.0 (25.0 to 25.0) | 40.0 (40.0 to 40.0) |  |"
    # asymm_both: 5 and 15 of 5 to 25; demo_wide: 10 and 30 of 40: normalised 0 and 0.5, 0.25 and 0.75
    assert mine == "| `mine` | 10.0 (5.0 to 15.0) | 20.0 (10.0 to 30.0) | 0.38 (0.12 to 0.62) |"
    write_stored(tmp_path / "results.json", stored)
    again = read_stored(tmp_path / "results.json")
    assert unseen_table(again) == unseen_table(stored) and shown_agents(again) == []
    assert "| `mine` | 20.0 (10.0 to 30.0) |  |" in unseen_table(
        StoredResults({("mine", UNSEEN): {wide: again.cells["mine", UNSEEN][wide]}}, {})
    )


def test_agents_without_cells_with_headroom_have_a_row():
    stored = StoredResults({("a", "seeded"): {("coord_simple", "H1"): cell(1.0)}}, {})
    assert "| `a` |  |  |  | 0 of 0 |  | none |  |" in summary_table(stored, "seeded")


def test_the_summary_marks_agents_that_met_the_teammates():
    cells = {one: found._replace(overlaps=("teammate",)) for one, found in everywhere(0.5).items()}
    mark = OVERLAPS["teammate"].mark
    assert f"| `a`{mark} | 0.50" in summary_table(StoredResults({("a", "seeded"): cells}, {}), "seeded")
