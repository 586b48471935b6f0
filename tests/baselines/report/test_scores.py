"""Test scores relative to best responses, and the tables and summaries that show scores and published numbers."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pandas as pd
import pytest
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, bundled_tasks
from icrl4aht_baselines.evaluate.results import Result
from icrl4aht_baselines.report import page, report, scores
from icrl4aht_baselines.report.results import BLOCKS, CellReturns, ResultCell, task_label
from icrl4aht_baselines.report.scores import CellScale, TaskScale
from msgspec import structs

from icrl4aht_data.benchmark import best_responses
from icrl4aht_data.benchmark.best_responses import BestResponse, read_best_responses
from icrl4aht_data.benchmark.facts import PREFERENCE, TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS
from icrl4aht_data.errors import OptionError
from tests.helpers.evaluated import SPAN, TEST_TASKS, evaluated_run, write_invented_responses

DEMO_WIDE = [ResultCell("demo_wide", family) for family in HEURISTICS]
WIDE, RING, FLAT = ResultCell("demo_wide", "H1"), ResultCell("coord_ring", "H2"), ResultCell("demo_simple", "H1")


def cell_returns(*values: float, seeds: int = 3) -> CellReturns:
    """Return invented results of tasks t0, t1 and so on; all seeds of a task earn the same."""
    found = np.repeat(np.array(values)[None, :, None], seeds, axis=2)
    tasks = tuple(f"t{number}" for number in range(len(values)))
    return CellReturns(tasks, tuple(range(seeds)), {"all": found, "last 20": found + 1})


def cell_scale(*tasks: tuple[float, float, str]) -> CellScale:
    return CellScale({f"t{number}": TaskScale(*task) for number, task in enumerate(tasks)})


SCALES = {
    WIDE: cell_scale((0.0, 10.0, "a"), (5.0, 25.0, "b"), (0.0, 10.0, "c"), (0.0, 10.0, "c")),
    RING: cell_scale((0.0, 40.0, "d"), (0.0, 40.0, "e"), (0.0, 1.0, "f")),
    FLAT: cell_scale((10.0, 14.0, "g")),
}


def test_score_is_a_ratio_of_sums_on_each_layout():
    cells = {WIDE: cell_returns(5.0, 15.0, 0.0, 10.0), RING: cell_returns(10.0, 10.0, 7.0), FLAT: cell_returns(99.0)}
    assert scores.cells_with_headroom(SCALES) == [RING, WIDE], "FLAT has headroom of less than 5"
    score = scores.find_score(cells, [RING, WIDE], SCALES)
    assert score is not None
    wide, ring = (5 + 10 + 0 + 10) / (10 + 20 + 10 + 10), 27 / 81
    assert score.total.mean == pytest.approx((wide + ring) / 2)
    # Scores of behaviours: 0.25 for d and e, 0.5 for a and b, (0 + 10) / 20 for c; f has too little headroom.
    assert score.middle.mean == pytest.approx((0.25 + 0.5 + 0.5) / 3) and score.worst == ("coord_ring H2", 0.25)
    assert score.regret == pytest.approx(((50 - 25) + (81 - 27)) / 7)
    assert scores.find_score(cells, [RING, FLAT], SCALES) is None and scores.find_score(cells, [], SCALES) is None
    assert scores.find_score({WIDE: cell_returns(5.0, 5.0)}, [WIDE], SCALES) is None, "tasks are missing"


def test_score_differences_are_paired_by_task_and_seed():
    one, other = cell_returns(5.0, 15.0, 0.0, 10.0), cell_returns(10.0, 0.0, 10.0, 15.0, seeds=1)
    shuffled = other._replace(tasks=("t3", "t2", "t0", "t1"))  # task t3 earns 10.0
    difference = scores.score_difference({WIDE: one}, {WIDE: shuffled}, [WIDE], SCALES)
    assert difference.mean == pytest.approx(((5 - 10) + (15 - 15) + (0 - 0) + (10 - 10)) / 50)
    returns = scores.block_difference({WIDE: one}, {WIDE: shuffled}, [WIDE], "last 20")
    assert returns is not None and returns.mean == pytest.approx(-5 / 4)
    assert scores.block_difference({WIDE: one}, {}, [WIDE], "all") is None
    assert scores.block_difference({WIDE: one}, {WIDE: other}, [WIDE], "1") is None


def test_teammates_with_equal_behaviour_count_as_one_unit():
    """The interval over five teammates with equal behaviour is the interval over the seeds of one teammate."""
    alike = {WIDE: cell_scale(*[(0.0, 20.0, "same")] * 5)}
    values = np.broadcast_to([2.0, 4.0, 6.0, 8.0], (1, 5, 4))
    found = CellReturns(tuple(f"t{number}" for number in range(5)), (0, 1, 2, 3), {"all": values})
    one = found._replace(tasks=("t0",), blocks={"all": values[:, :1]})
    pair = [scores.find_score({WIDE: of}, [WIDE], alike) for of in (found, one)]
    assert pair[0] and pair[1] is None
    single = scores.find_score({WIDE: one}, [WIDE], {WIDE: cell_scale((0.0, 20.0, "same"))})
    assert single and single.total == pytest.approx(pair[0].total) and pair[0].total.interval_text()


def test_seeds_are_resampled_if_fewer_than_three_behaviours_have_headroom():
    """Many resamples of behaviours would have no scale or no variance: units are the seeds then."""
    values, names = np.arange(15.0).reshape(1, 5, 3), list("abcde")
    for scales in ([0.0, 0.0, 30.0, 0.1, 0.0], [0.0, 10.0, 20.0, 0.1, 0.0]):
        few = scores.stratum_of_behaviours(values, np.array(scales), names)
        assert few.gains.shape == (1, 3) and few.scales.tolist() == pytest.approx([30.1 / 3] * 3)
    three = scores.stratum_of_behaviours(values, np.array([0.0, 10.0, 30.0, 20.0, 0.0]), names)
    assert three.gains.shape == (1, 5) and three.scales.tolist() == [0.0, 10.0, 30.0, 20.0, 0.0]


def test_tasks_of_a_layout_of_track_preference_form_one_stratum():
    """On other tracks, each cell is a stratum."""
    parts = [
        (np.full((1, 1, 2), value), np.array([20.0]), [name]) for value, name in ((1.0, "a"), (9.0, "b"), (5.0, "c"))
    ]
    for kind, shapes in ((PREFERENCE, [(1, 3)]), ("test", [(1, 2)] * 3)):
        cells = [ResultCell("rooms-0-46", family, kind) for family in ("H1", "H2", "H3")]
        assert [stratum.gains.shape for stratum in scores._pooled_strata(cells, parts).values()] == shapes


def test_layout_with_a_missing_best_response_has_no_score(invented_responses, monkeypatch, tmp_path):
    """If one best response on demo_wide is missing, scores exist for all other layouts."""
    card = read_best_responses(best_responses.best_responses_file())
    lacks = next(one for one in card.behaviours if (one.layout, one.family) == ("demo_wide", "H1"))
    kept = tuple(one for one in card.behaviours if one != lacks)
    best_responses.write_best_responses(tmp_path / "less.json", structs.replace(card, behaviours=kept))
    monkeypatch.setattr(best_responses, "best_responses_file", lambda: tmp_path / "less.json")
    found = scores.cells_with_headroom(scores.cell_scales("seeded"))
    assert len(found) == 16 and "demo_wide" not in {cell.layout for cell in found}


def test_score_scales_cover_all_tasks_with_a_best_response(invented_responses):
    scales = scores.cell_scales("seeded")
    assert (
        len(scores.cells_with_headroom(scales)) == 20
        and RING in scores.cells_with_headroom(scales)
        and scores.cell_scales("published") == {}
    )
    assert all(len(scale.tasks) == 5 for cell, scale in scales.items() if cell.kind == "test")
    assert len({task.behaviour for task in scales[ResultCell("demo_wide", "H4")].tasks.values()}) == 1
    assert {*scales[WIDE].tasks} == {task_label(task) for task in scores.bundled_ids_by_cell()[WIDE]}


def test_damaged_file_of_best_responses_raises_error(tmp_path):
    with pytest.raises(OptionError, match=r"none\.json: no such file, expected best responses"):
        read_best_responses(tmp_path / "none.json")
    card = read_best_responses(write_invented_responses(tmp_path / "b.json"))
    assert card.version == "7" and isinstance(card.behaviours[0], BestResponse)
    text = (tmp_path / "b.json").read_text()
    (tmp_path / "twice.json").write_text(text.replace('"behaviours": [', f'"behaviours": [{text.splitlines()[5]}', 1))
    with pytest.raises(OptionError, match=r"twice\.json: expected one best response for task teammate_test_grounded_"):
        read_best_responses(tmp_path / "twice.json")
    (tmp_path / "bad.json").write_text(text.replace('"best":', '"beast":'))
    with pytest.raises(OptionError, match=r"bad\.json: invalid file of best responses: .*restore it"):
        read_best_responses(tmp_path / "bad.json")


def test_summary_of_a_run_has_score_and_return_by_episode(invented_responses):
    (found,) = scores.find_headlines(evaluated_run("mine", ("coord_simple", "demo_wide")))
    assert found.score and found.score.total[:3] == pytest.approx((11.0 / SPAN,) * 3), "equal instances"
    assert found.text == (
        "mine (seeded), 4 test cells with headroom, of 8 played: score 0.55 (0.55 to 0.55), interquartile mean 0.55, "
        "worst teammate 0.55 (demo_wide H1), regret 9.0; return 11.0 (11.0 to 11.0); in episodes 1: 10.0, 2-5: 10.0, "
        "6-20: 10.0, 21-100: 12.0. Ranges in parentheses: 95 % intervals."
    )


def test_validation_tasks_on_published_and_on_other_layouts_have_separate_summaries(invented_responses):
    """Validation tasks of the track `preference` have no best responses."""
    own = [task for task in bundled_tasks("teammate", "validation") if task.layout.name == "demo_wide"]
    scored, other = scores.find_headlines(
        evaluated_run("mine", tasks=[*own, *bundled_tasks(PREFERENCE, "validation")[:1]])
    )
    assert scored.score and scored.tasks == "2 validation cells with headroom, of 2 played"
    assert (other.score, other.tasks) == (None, "1 validation cell on other layouts")


def test_results_without_a_score_have_a_reason(invented_responses):
    (short,) = scores.find_headlines(evaluated_run("mine", steps=20))
    assert short.score is None and short.why_no_score.startswith("No score: it needs all tasks of a cell with a best")
    (flat,) = scores.find_headlines(evaluated_run("mine", ("coord_simple",)))
    assert flat.why_no_score == "No score: no best response earns 5 more than `stay` in these cells."
    (published,) = scores.find_headlines(evaluated_run("mine", protocol="published"))
    assert published.why_no_score == "No score: best responses were measured under protocol seeded."


def test_results_of_the_control_swapped_have_no_score(invented_responses):
    """Another teammate plays all but the last episodes, so only the last block has reference returns."""
    run = evaluated_run("mine (swapped)", details={"swapped": True})
    assert {*run.table["control"]} == {"swapped"}
    (found,) = scores.find_headlines(run)
    assert found.score is None and found.why_no_score.startswith("No score: in this control, another teammate plays")
    rows = scores.add_scales(run.table)
    assert {*rows[rows["best"].notna()]["block"]} == {"last 20"}
    (cleared,) = scores.find_headlines(evaluated_run("mine (cleared)", details={"forget": True}))
    assert cleared.score is not None


def test_behaviours_are_the_units_of_the_interval_of_a_mean_return():
    """The five H4 teammates have the same behaviour, and the run has one seed, so the mean return has no interval."""
    same, different = (evaluated_run("mine", families=(family,)).returns for family in ("H4", "H1"))
    assert np.isnan(scores.mean_return(same.values()).low)
    assert scores.mean_return(different.values())[:3] == pytest.approx((11.0, 11.0, 11.0))


def test_report_keeps_the_rows_of_three_results_of_one_agent():
    tasks = [task for task in TEST_TASKS if task.layout.name == "demo_wide" and task.teammate_family == "H1"]
    settings = {"agent": "mine", "seeds": [0], "protocol": PROTOCOLS["seeded"].settings, "code_version": "0"}
    found = [[Result(task.task_id, settings, [[value] * 100]) for task in tasks] for value in (1.0, 2.0, 3.0)]
    text = report(*found)
    for label, value in (("mine", 1.0), ("mine [results 2]", 2.0), ("mine [results 3]", 3.0)):
        assert f"| H1 | {label} | {value} " in text


def test_results_with_other_episode_lengths_show_no_paper_numbers():
    run = evaluated_run("AD", protocol="published", steps=20)
    found = page.table_score(DEMO_WIDE[:1], run, "published", (1.0, 1.0))
    assert found.notes == ["episodes 1: 10.0, 2-5: 10.0, 6-20: 10.0, 21-100: 12.0"]


def test_returns_tables_show_measured_and_published_numbers():
    runs = [evaluated_run(agent, ("demo_wide", "cramped_down"), protocol="published") for agent in ("AD", "mine")]
    (table,) = page.returns_tables(runs, "published")
    assert list(table.columns) == ["demo_wide", "cramped_down", page.AVERAGE]
    assert list(dict.fromkeys(agent for _, agent in table.rows)) == ["AD", "mine", "DPT", "random"]
    one, mine = table.rows["H1", "AD"][0], table.rows["H1", "mine"][0]
    assert (one.text, one.notes[0]) == ("11.0 ± 0.0", "paper -3.2 ± 2.6")
    assert not any("paper" in note for note in mine.notes)
    dpt = table.rows["H1", "DPT"][0]
    assert (dpt.text, dpt.notes) == ("–", ["paper 1.0 ± 0.7"])
    assert table.rows[page.AVERAGE, "AD"][0].notes[0] == "paper {:.1f} ± {:.1f}".format(
        *page.published_cells("AD")["demo_wide"][page.AVERAGE]
    )
    seeded = page.returns_tables([evaluated_run("AD", families=("H1", "H4"))], "seeded")[0]
    assert list(seeded.rows) == [("H1", "AD"), ("H4", "AD"), (page.AVERAGE, "AD")]
    assert not any("paper" in note for of_row in seeded.rows.values() for found in of_row for note in found.notes)


def test_published_numbers_are_found_for_complete_groups_only():
    track = [ResultCell(layout, family) for layout in TRACKS["layout"]["test"] for family in HEURISTICS]
    assert page.published_score("AD", track) == (2.6, 4.1)
    assert (
        page.published_score("DPT+TA", DEMO_WIDE) == (9.4, 5.5) and page.published_score("DPT", DEMO_WIDE[:2]) is None
    )
    wide = [cell._replace(layout="test_wide") for cell in DEMO_WIDE]
    contexts = [evaluated_run("AD", ("test_wide",), details={"context": k}) for k in (1000, 500, 250)]
    found = [page.published_score(run, wide) for run in contexts]
    assert found == [(-7.6, None), *2 * [tuple(page.published_cells("AD")["test_wide"][page.AVERAGE])]]


def test_incomplete_results_and_missing_headroom_are_marked(invented_responses):
    found = page.table_score(DEMO_WIDE, evaluated_run("AD", families=("H1", "H2")), "seeded")
    assert (found.text, found.notes[:2]) == ("11.0 ± 0.0", ["2 of 4 cells", "score 0.55"])
    few = evaluated_run("AD", tasks=[task for task in TEST_TASKS if task.layout.name == "demo_wide"][:2])
    assert page.table_score(DEMO_WIDE[:1], few, "seeded").notes[0] == "2 of 5 instances"
    assert page.table_score(DEMO_WIDE, few, "seeded").notes[:2] == ["1 of 4 cells", "incomplete cells"]
    flat_cell = ResultCell("coord_simple", "H1")
    flat = page.table_score([flat_cell], evaluated_run("AD", ("coord_simple",)), "seeded")
    assert flat.is_flat and flat.notes[-1] == "no headroom"
    assert page.table_score([flat_cell], None, "published").is_flat, "measured by the oracle"
    assert not page.table_score([flat_cell._replace(kind="validation")], None, "seeded").is_flat, "nothing was measured"


def test_csv_and_markdown_reports_have_all_numbers(invented_responses):
    runs = [evaluated_run("AD", protocol="published", trained_on=None), evaluated_run("AD", note="K250")]
    found = pd.read_csv(StringIO(page.csv_text(runs)), keep_default_na=False)
    assert set(found["agent"]) == {"AD", "AD [K250]"} and set(found["block"]) == {*BLOCKS}
    first, last = (found[found["agent"] == run.label].iloc[0] for run in runs)
    assert (first["return"], first["overlap"], first["best"]) == (11.0, "unknown", "")
    assert (float(last["stay"]), float(last["best"])) == (0.0, 20.0)
    text = page.markdown(runs)
    assert "| H1 | AD | 11.0 ± 0.0 ?<br>paper -3.2 ± 2.6<br>episodes 1: 10.0, " in text
    assert text.count("\n## Test tasks, ") == 2 and "| H1 | AD [K250] | 11.0 ± 0.0<br>score 0.55<br>" in text
    assert "* ? unknown training data: nothing says what the agent was trained on" in text
    assert "Evaluated under protocol published, 1 seed (0), 40 episodes of 100 steps; 5 instances in a cell." in text
