"""Reports say what a number is: its protocol, its instances and seeds, and how training data and tasks overlap."""

from __future__ import annotations

import csv
import re
from html import unescape
from html.parser import HTMLParser
from io import StringIO
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from icrl4aht_baselines.report import page
from icrl4aht_baselines.report.overlap import OVERLAPS
from icrl4aht_baselines.report.results import GROUP_TEXTS, EvaluationRun, merge
from icrl4aht_baselines.report.summary import csv_text, markdown, rows
from icrl4aht_baselines.report.tables import PAPER_TABLES, fill_table, score_cells, sweep_points

from icrl4aht_data.benchmark.reference_returns import read_headroom
from icrl4aht_data.benchmark.tasks import Task, make_task, teammate_id
from icrl4aht_data.errors import OptionError
from tests.helpers.evaluated import TEST_TASKS, evaluated_run

H4 = {task.layout.name: task.teammate for task in TEST_TASKS if task.teammate_family == "H4"}


def learned(number: int, algorithm: str = "fcp") -> dict[str, Any]:
    theta = {"checkpoint": f"{algorithm}/{number}", "sha256": f"{number:064x}"[::-1]}
    return {"kind": "rl", "family": algorithm, "theta_id": number, "base_seed": 0, "theta": theta}


def own_h4(number: int) -> dict[str, Any]:
    theta = H4["demo_wide"]["theta"] | {"inertia": number / 100}
    return H4["demo_wide"] | {"theta_id": 50 + number, "theta": theta}


def tasks_of(kind: str, count: int) -> list[Task]:
    """Tasks of one cell."""
    if kind in ("test", "layout test"):
        layout = "demo_wide" if kind == "test" else "asymm_right"
        return [task for task in TEST_TASKS if (task.layout.name, task.teammate_family) == (layout, "H4")][:count]
    makers = {
        "training": lambda k: make_task("layout", "train", "cramped_up", learned(k), k),
        "training H4": lambda k: make_task("teammate", "train", "demo_wide", own_h4(k), k),
        "validation": lambda k: make_task("teammate", "validation", "demo_wide", own_h4(k), k),
        "held out": lambda k: make_task("layout", "heldout", "cramped_up", learned(k), k),
        "own": lambda k: make_task("teammate", "test", "demo_wide", own_h4(k), k),
    }
    return [makers[kind](number) for number in range(1, count + 1)]


def trained_on(how: str, tasks: list[Task]) -> list[dict[str, Any]] | None:
    """Record of the training data of an agent whose training overlaps with some tasks in one way."""
    task = tasks[0]
    entry = {"layout": "cramped_up", "family": task.teammate_family, "algorithm": task.teammate_kind}
    records = {
        "unknown": None,
        "none": [{"layout": "demo_wide", "family": "rl", "algorithm": "comedi", "teammates": ["00"]}],
        "family": [entry | {"teammates": ["00"]}],
        "teammate": [entry | {"teammates": ["00", teammate_id(task.teammate)]}],
        "layout": [{"layout": task.layout.name, "family": "rl", "algorithm": "comedi", "teammates": ["00"]}],
    }
    return records[how]


class Cells(HTMLParser):
    """Parser that collects the cells of tables: (tooltip, text)."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, str]] = []
        self.inside = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == "td":
            self.inside = True
            self.found.append((dict(attrs).get("title") or "", ""))

    def handle_endtag(self, tag):
        self.inside = self.inside and tag != "td"

    def handle_data(self, data):
        if self.inside:
            tooltip, text = self.found[-1]
            self.found[-1] = tooltip, f"{text} {data}"


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    """Function that returns the text of the page of some runs."""
    folder = tmp_path_factory.mktemp("page")
    return lambda runs, **options: page.write_page(runs, folder / "report.html", **options).read_text()


class Kind(NamedTuple):
    """Kinds of results."""

    tasks: str
    instances: int
    protocol: str
    overlap: str


KINDS = st.builds(
    Kind,
    st.sampled_from(["test", "layout test", "validation", "training", "training H4", "held out", "own"]),
    st.integers(1, 5),
    st.sampled_from(["published", "seeded"]),
    st.sampled_from(["unknown", "none", "family", "teammate", "layout"]),
)


def expected_overlaps(kind: Kind) -> list[str]:
    """Kinds of overlap of a cell: layouts are reserved in the layout track's tests only."""
    if kind.overlap == "teammate":  # one teammate was in training, the others are of its kind
        return ["teammate", "family"] if kind.instances > 1 else ["teammate"]
    if kind.overlap == "none" or (kind.overlap == "layout" and kind.tasks != "layout test"):
        return []
    return [kind.overlap]


def results_of(kind: Kind) -> EvaluationRun:
    tasks = tasks_of(kind.tasks, kind.instances)
    return evaluated_run("AD", protocol=kind.protocol, tasks=tasks, trained_on=trained_on(kind.overlap, tasks))


@settings(max_examples=15, deadline=None)
@given(kind=KINDS)
def test_the_page_says_what_each_number_is(write, kind):
    run = results_of(kind)
    text = write([run])
    ((layout, group),) = run.cells
    own = [cell for cell in Cells(text).found if cell[0].startswith("AD. ")]
    first = own[0]
    is_test = "test" in kind.tasks
    overlaps = expected_overlaps(kind)
    mark = "".join(OVERLAPS[name].mark for name in overlaps)
    total = " of 5" if is_test else ""
    noun = "instance" if kind.instances == 1 and not is_test else "instances"
    tooltip = f"AD. {layout}, {group}: {kind.instances}{total} {noun}, protocol {kind.protocol}, 1 seed (0), "
    assert first[0].startswith(f"{tooltip}40 episodes of 100 steps. ")
    score, *rest = first[1].split("paper")
    assert score.split()[0] == "11.0"
    assert ("±" in score) == (kind.instances > 1)
    assert (f"± 0.0 {mark}".strip() if kind.instances > 1 else f"11.0 {mark}".strip()) in score
    assert bool(rest) == (is_test and kind.protocol == "published"), "the paper's numbers are of one protocol"
    assert "gain +2.0" in first[1]
    for name, overlap in OVERLAPS.items():
        assert (f"<li>{overlap.mark} {overlap.meaning}</li>" in unescape(text)) == (name in overlaps)
    for name, explanation in GROUP_TEXTS.items():
        assert (explanation in unescape(text)) == kind.tasks.startswith(name)
    assert "Learned teammates are held out of training" not in text
    assert ("They belong to protocol" in text) == (kind.protocol == "seeded")
    before, _, after = text.partition('<section id="settings">')
    scores = [found for part in (before, after.partition('<section id="paper">')[2]) for found in Cells(part).found]
    numbers = [(tooltip, shown) for tooltip, shown in scores if " / " not in shown]  # other than the reference egos'
    assert all(tooltip for tooltip, shown in numbers if re.match(r"\s*(–\s*paper|[+-]?\d)", shown)), (
        "every number has a tooltip"
    )
    assert ("normalised" in first[1]) == (is_test and kind.instances == 5)
    not_run = {tooltip for tooltip, shown in scores if re.match(r"\s*–\s*paper", shown)}
    paper = "Not run. Paper: protocol published, 5 instances, 100 episodes of 100 steps."
    assert not_run == ({paper} if kind.protocol == "published" else set())
    assert ("Normalised score in each cell" in text) == (is_test and kind.instances == 5)


@settings(max_examples=40)
@given(kind=KINDS)
def test_markdown_and_csv_say_what_each_number_is(kind):
    run = results_of(kind)
    text = markdown([run])
    ((_, group),) = run.cells
    overlaps = expected_overlaps(kind)
    mark = "".join(OVERLAPS[name].mark for name in overlaps)
    is_test = "test" in kind.tasks
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {group} |")]
    spread = " ± 0.0" if kind.instances > 1 else ""
    assert f"11.0{spread} {mark}".rstrip() + "<br>" in line
    assert ("published" in line) == (is_test and kind.protocol == "published")
    few = f"{kind.instances} of 5 instances" if is_test else "instance"
    assert (few in line) == (not is_test or kind.instances < 5)
    assert f"* Protocol {kind.protocol}, 1 seed (0), 40 episodes of 100 steps, {kind.instances} instance" in text
    for name, overlap in OVERLAPS.items():
        assert (f"* {overlap.mark} {overlap.meaning}" in text) == (name in overlaps)
    (row,) = csv.DictReader(StringIO(csv_text([run])))
    assert (row["std"] == "") == (row["low"] == "") == (row["high"] == "") == (kind.instances == 1)
    assert row["overlap"].split() == overlaps
    assert row["tasks"] == {"layout test": "test", "training H4": "training"}.get(kind.tasks, kind.tasks)
    assert (row["published_mean"] != "") == (is_test and kind.protocol == "published")
    assert (row["seeds"], row["steps"], row["protocol"]) == ("1", "100", kind.protocol)


def test_h4_in_training_marks_all_five_test_teammates_of_h4():
    """The default H4 acts like the published ones, so every layout's H4 is marked, and no other family."""
    record = [{"layout": "demo_wide", "family": "H4", "algorithm": "utility_greedy", "teammates": ["00"]}]
    run = evaluated_run("AD", ("demo_wide", "cramped_down"), trained_on=record)
    marked = {(row["layout"], row["family"]) for row in rows(run) if row["overlap"]}
    assert marked == {("demo_wide", "H4"), ("cramped_down", "H4")}
    one = fill_table(PAPER_TABLES[0], [run], "seeded")
    column = PAPER_TABLES[0].columns.index("demo_wide")
    found = {row.label: row.scores[column].overlaps for row in one}
    assert found == {"H1": (), "H2": (), "H3": (), "H4": ("family",), "Average": ("family",)}


def test_learned_teammates_of_an_algorithm_that_was_left_out_are_not_marked():
    record = [{"layout": "cramped_up", "family": "rl", "algorithm": "brdiv", "teammates": None}]
    tasks = tasks_of("held out", 2)
    ours = evaluated_run("AD", tasks=tasks, trained_on=record)
    assert rows(ours)[0]["overlap"] == ""
    same = evaluated_run("AD", tasks=tasks, trained_on=[record[0] | {"algorithm": "fcp"}])
    assert rows(same)[0]["overlap"] == "family"
    details = score_cells(list(same.cells), same, {}).details
    assert "Trained with teammates of kind fcp: which ones is not recorded." in details


def test_tasks_of_different_splits_never_share_a_cell(write):
    """The paper's numbers and the headroom are those of the published test tasks alone."""
    kinds = ("test", "training H4", "own", "validation")
    tasks = [task for kind in kinds for task in tasks_of(kind, 5)]
    run = evaluated_run("AD", protocol="published", tasks=tasks)
    assert [(cell, len(returns)) for cell, returns in run.cells.items()] == [
        (("demo_wide", group), 5) for group in ("H4", "H4 (own)", "H4 (training)", "H4 (validation)")
    ]
    assert [row["tasks"] for row in rows(run)] == ["test", "own", "training", "validation"]
    assert [row["published_mean"] is None for row in rows(run)] == [False, True, True, True]
    assert [row["normalised"] is None for row in rows(run)] == [False, True, True, True]
    headings = re.findall("^## (.*)$", markdown([run]), flags=re.MULTILINE)
    assert headings == [
        f"AD (published), track teammate{kind}"
        for kind in ("", ", validation tasks", ", training tasks", ", own tasks")
    ]
    text = write([run])
    for kind in ("Test", "Own", "Training", "Validation"):
        assert text.count(f"<b>{kind} tasks: AD</b>") == 1


def test_seeded_results_have_no_published_numbers_and_no_rows_of_agents_that_were_not_run():
    runs = [evaluated_run("DPT", ("demo_wide", "cramped_down"))]
    for table in PAPER_TABLES:
        for row in fill_table(table, runs, "seeded"):
            assert row.agent == "DPT"
            assert all(score.published is None for score in row.scores)
    assert fill_table(PAPER_TABLES[3], runs, "seeded") == [], "the table has no DPT"
    sweep = [evaluated_run("AD", ("test_wide",), variant=("K", 500))]
    assert sweep_points(sweep, "K")["test_wide"]["AD"][0].published is None


def test_sweeps_compare_with_the_paper_where_all_families_were_played():
    options = {"variant": ("K", 500), "protocol": "published"}
    complete = evaluated_run("AD", ("test_wide",), **options)
    one = evaluated_run("AD", ("test_wide",), families=("H4",), **options)
    assert sweep_points([complete], "K")["test_wide"]["AD"][0].published == -7.9
    (point,) = sweep_points([one], "K")["test_wide"]["AD"]
    assert (point.published, point.std) == (None, None)


def test_sweeps_show_validation_tasks_apart_from_test_tasks():
    tasks = [task for kind in ("test", "validation") for task in tasks_of(kind, 2)]
    run = evaluated_run("AD", tasks=tasks, variant=("K", 500))
    panels = sweep_points([run], "K")
    assert list(panels) == ["demo_wide", "demo_wide (validation)"]
    alone = sweep_points([evaluated_run("AD", tasks=tasks[:2], variant=("K", 500))], "K")
    assert panels["demo_wide"] == alone["demo_wide"]


def test_validation_tasks_with_teammates_of_the_training_are_marked():
    tasks = tasks_of("validation", 2)
    record = trained_on("teammate", tasks)
    found = rows(evaluated_run("AD", tasks=tasks, trained_on=record))
    assert [row["overlap"] for row in found] == ["teammate family"]


def test_other_episode_lengths_compare_with_nothing():
    run = evaluated_run("AD", protocol="published")
    for source in run.sources:
        source.settings["protocol"]["steps"] = 20
    assert all(row["published_mean"] is None and row["normalised"] is None for row in rows(run))
    score = score_cells([("demo_wide", "H1")], run, read_headroom("published"), (1.0, 1.0))
    assert (score.published, score.normalised) == (None, None)


def test_runs_under_different_rules_are_not_merged():
    short = evaluated_run("AD", ("coord_simple",))
    short.sources[0].settings["seeds"].append(1)
    assert [run.label for run in merge([evaluated_run("AD"), short])] == ["AD", "AD [runs/AD]"]


def test_ways_of_acting_are_named_and_not_merged():
    exact, cached = (
        evaluated_run("AD", (layout,), acting=acting)
        for layout, acting in (("demo_wide", "exact"), ("coord_simple", "cached"))
    )
    runs = merge([exact, cached, evaluated_run("random")])
    assert [run.label for run in runs] == ["AD", "AD [runs/AD]", "random"]
    assert "40 episodes of 100 steps, exact acting. " in score_cells(list(exact.cells), exact, {}).details
    assert "40 episodes of 100 steps, exact acting, 5 instances in a cell." in markdown(runs)
    assert [rows(run)[0]["acting"] for run in runs] == ["exact", "cached", ""]
    assert len(merge([exact, evaluated_run("AD", ("coord_simple",), acting="exact")])) == 1


def test_captions_say_which_agents_different_conditions_are_of(write):
    short = evaluated_run("DPT")
    short.sources[0].settings["protocol"]["episodes"] = 3
    text = unescape(write([evaluated_run("AD"), evaluated_run("random"), short]))
    assert (
        "Evaluated AD and random under protocol seeded, 1 seed (0), 40 episodes of 100 steps; DPT under protocol "
        "seeded, 1 seed (0), 3 episodes of 100 steps; 5 instances in a cell." in text
    )


def test_reference_egos_are_not_trained_and_other_agents_must_say_it():
    def marks(agent, record):
        return {row["overlap"] for row in rows(evaluated_run(agent, trained_on=record))}

    assert marks("stay", None) == {""}
    assert marks("mine", None) == {"unknown"}
    assert marks("mine", []) == {""}
    with pytest.raises(OptionError, match=r"runs/mine: trained_on: expected a layout, a family"):
        evaluated_run("mine", trained_on=[{"layout": "demo_wide"}])


def test_figures_name_the_cells_that_tables_mark(write):
    record = [{"layout": "demo_wide", "family": "H4", "algorithm": "utility_greedy", "teammates": ["00"]}]
    text = unescape(write([evaluated_run("AD", trained_on=record), evaluated_run("mine", trained_on=None)]))
    captions = re.findall("<figcaption>([^<]*)</figcaption>", text)
    assert len(captions) == 2
    for caption in captions:
        assert caption.startswith("Evaluated under protocol seeded, 1 seed (0), 40 episodes of 100 steps; 5 instances")
        assert caption.endswith("Overlap with the training data: AD: demo_wide H4 †; mine: all cells ?.")
