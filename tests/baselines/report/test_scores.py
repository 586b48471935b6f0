"""Scores of cells and groups, the summary and the paper's numbers, against hand-made values."""

from __future__ import annotations

import csv
from io import StringIO

import numpy as np
import pytest
from icrl4aht_baselines.report.page import csv_text, markdown
from icrl4aht_baselines.report.results import PUBLISHED_PROTOCOL, ResultCell, published_cells, read_published
from icrl4aht_baselines.report.scores import (
    AVERAGE,
    cell_headroom,
    find_headlines,
    normalised_returns,
    open_cells,
    published_score,
    returns_tables,
    table_score,
)

from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import HEURISTICS
from icrl4aht_data.benchmark.tasks import make_task
from tests.helpers.evaluated import TEST_TASKS, evaluated_run

DEMO_WIDE = [ResultCell("demo_wide", family) for family in HEURISTICS]


def score(value: float, cell: ResultCell) -> float:
    egos = cell_headroom("published")[cell]
    return (value - egos["stay"]) / (egos["oracle"] - egos["stay"])


def test_there_are_20_cells_with_headroom():
    found = open_cells("seeded")
    assert len(found) == 20 and ResultCell("coord_ring", "H2") in found
    assert ResultCell("demo_simple", "H2") not in found


def test_the_score_is_the_mean_over_complete_cells_with_headroom():
    run = evaluated_run("mine", ("coord_simple", "demo_wide"), protocol="published")
    assert [*normalised_returns(run)] == DEMO_WIDE, "coord_simple has no headroom"
    np.testing.assert_allclose(normalised_returns(run)[DEMO_WIDE[0]], np.full((5, 1), score(11.0, DEMO_WIDE[0])))
    (headline,) = find_headlines(run)
    expected = np.mean([score(11.0, cell) for cell in DEMO_WIDE])
    assert headline.score == pytest.approx((expected,) * 3), "equal instances"
    paper = np.mean(
        [score(published_cells("AD")["demo_wide"][family][0], ResultCell("demo_wide", family)) for family in HEURISTICS]
    )
    assert headline.paper["AD"] == pytest.approx(paper)
    assert headline.text == (
        "mine (published), 4 test cells with headroom, of 8 played: normalised score 0.26 (0.26 to 0.26); return 11.0 "
        "(11.0 to 11.0); gain +2.0 (+2.0 to +2.0): 10.0 in the first, 12.0 in the last 20 episodes. Parentheses: 95 % "
        f"intervals. The paper's normalised score in these cells: AD {paper:z.2f}, DPT {headline.paper['DPT']:z.2f}."
    )


def test_paper_numbers_appear_only_if_the_protocol_matches():
    assert list(find_headlines(evaluated_run("DPT", protocol="published"))[0].paper) == ["DPT"]
    assert find_headlines(evaluated_run("DPT"))[0].paper == {}
    assert find_headlines(evaluated_run("DPT", protocol="published", variant=("K", 500)))[0].paper == {}


def test_results_without_a_score_say_why():
    tasks = [task for task in TEST_TASKS if task.layout.name == "demo_wide"]
    own = make_task("teammate", "validation", "demo_wide", tasks[-1].teammate | {"theta_id": 70}, 3)
    test, validation = find_headlines(evaluated_run("mine", tasks=[tasks[0], own]))
    assert test.score is None and not test.mean.range()
    assert test.why_no_score == "No score: it needs all published tasks of a cell, in episodes of 100 steps."
    assert "these are validation tasks" in validation.why_no_score
    flat = find_headlines(evaluated_run("mine", ("coord_simple",)))[0]
    assert flat.why_no_score == "No score: no cell that was played completely has headroom."
    assert "return 11.0; gain" in test.text, "no interval of a single instance"


def test_other_episode_lengths_have_no_paper_numbers():
    run = evaluated_run("AD", protocol="published", steps=20)
    assert table_score(DEMO_WIDE[:1], run, "published", (1.0, 1.0)).notes == ["gain +2.0"]
    assert find_headlines(run)[0].score is None


def test_tables_have_our_and_the_papers_numbers():
    runs = [evaluated_run(agent, ("demo_wide", "cramped_down"), protocol="published") for agent in ("AD", "mine")]
    (table,) = returns_tables(runs, "published")
    assert list(table.columns) == ["demo_wide", "cramped_down", AVERAGE]
    assert list(dict.fromkeys(agent for _, agent in table.rows)) == ["AD", "mine", "DPT", "random"]
    one, mine = table.rows["H1", "AD"][0], table.rows["H1", "mine"][0]
    assert (one.text, one.notes) == ("11.0 ± 0.0", ["paper -3.2 ± 2.6", "normalised 0.28", "gain +2.0"])
    assert mine.notes == ["normalised 0.28", "gain +2.0"]
    dpt = table.rows["H1", "DPT"][0]
    assert (dpt.text, dpt.notes) == ("–", ["paper 1.0 ± 0.7"])
    assert table.rows[AVERAGE, "AD"][0].notes[0] == "paper {:.1f} ± {:.1f}".format(
        *published_cells("AD")["demo_wide"][AVERAGE]
    )
    seeded = returns_tables([evaluated_run("AD", families=("H1", "H4"))], "seeded")[0]
    assert list(seeded.rows) == [("H1", "AD"), ("H4", "AD"), (AVERAGE, "AD")]
    assert not any("paper" in note for scores in seeded.rows.values() for found in scores for note in found.notes)


def test_published_numbers_of_groups_of_cells():
    track = [ResultCell(layout, family) for layout in TRACKS["layout"]["test"] for family in HEURISTICS]
    assert published_score("AD", track) == (2.6, 4.1)
    assert published_score("DPT+TA", DEMO_WIDE) == (9.4, 5.5) and published_score("DPT", DEMO_WIDE[:2]) is None
    wide = [cell._replace(layout="test_wide") for cell in DEMO_WIDE]
    contexts = [evaluated_run("AD", ("test_wide",), variant=("K", k)) for k in (250, 500, 1000)]
    found = [published_score(run, wide) for run in contexts]
    assert (found[0], found[2]) == (None, (-7.6, None)) and found[1] == tuple(
        published_cells("AD")["test_wide"][AVERAGE]
    )


def test_the_papers_averages_equal_the_means_of_its_cells():
    """This check finds copying errors; the numbers are rounded to a tenth."""
    for layouts in read_published()["methods"].values():
        for families in layouts.values():
            if "H1" in families:
                mean = np.mean([families[family][0] for family in HEURISTICS])
                assert abs(mean - families[AVERAGE][0]) < 0.11


def test_incomplete_groups_are_marked():
    run = evaluated_run("AD", families=("H1", "H2"))
    found = table_score(DEMO_WIDE, run, "seeded")
    assert (found.text, found.notes[0]) == ("11.0 ± 0.0", "2 of 4 cells")
    few = evaluated_run("AD", tasks=[task for task in TEST_TASKS if task.layout.name == "demo_wide"][:2])
    assert table_score(DEMO_WIDE[:1], few, "seeded").notes == ["2 of 5 instances", "gain +2.0"]
    assert table_score(DEMO_WIDE, few, "seeded").notes[:2] == ["1 of 4 cells", "incomplete cells"]


def test_csv_and_markdown_have_the_numbers_of_each_cell():
    runs = [evaluated_run("AD", protocol="published", trained_on=None), evaluated_run("AD", variant=("K", 250))]
    found = list(csv.DictReader(StringIO(csv_text(runs))))
    assert len(found) == 8 and [row["variant"] for row in found] == [""] * 4 + ["K = 250"] * 4
    expected = {"mean": "11.0", "std": "0.0", "low": "11.0", "gain": "2.0", "published_mean": "-3.2", "seeds": "1"}
    expected |= {"headroom": "True", "overlap": "unknown", "tasks": "test", "instances": "5", "episodes": "40"}
    assert expected.items() <= found[0].items()
    assert found[4]["published_mean"] == "" and float(found[4]["normalised"]) == pytest.approx(0.28, abs=0.01)
    text = markdown(runs)
    assert "| H1 | AD | 11.0 ± 0.0 ?<br>paper -3.2 ± 2.6<br>normalised 0.28<br>gain +2.0 |" in text
    assert text.count("\n## Test tasks, ") == 2 and "| H1 | AD, K = 250 | 11.0 ± 0.0<br>" in text
    assert "* ? unknown training data: nothing says what the agent was trained on" in text
    assert "Evaluated under protocol published, 1 seed (0), 40 episodes of 100 steps; 5 instances in a cell." in text
    assert PUBLISHED_PROTOCOL == "published"
