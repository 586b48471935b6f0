"""Test the HTML report, the Markdown report and cards: complete content, no external files, escaped names."""

from __future__ import annotations

import dataclasses
import json
import re
from html import unescape
from html.parser import HTMLParser
from unittest.mock import Mock

import pytest
from icrl4aht_baselines.agents.bundled import MODELS
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS
from icrl4aht_baselines.headroom import write_headroom_cards
from icrl4aht_baselines.reference import training_sentence
from icrl4aht_baselines.report import gifs, merge, page
from icrl4aht_baselines.report.figures import bar_charts, curve_charts
from icrl4aht_baselines.report.gifs import EpisodePair, ShownEpisode, restore_ego
from icrl4aht_baselines.report.page import markdown, write_page
from icrl4aht_baselines.report.results import TEST_LAYOUTS, EvaluationRun, ResultCell

from icrl4aht_data.benchmark.tasks import make_task, write_tasks
from icrl4aht_data.errors import OptionError, TaskFormatError
from tests.helpers.commands import run_cli
from tests.helpers.evaluated import TEST_TASKS, evaluated_run

GIF = b"GIF89a"  # an incomplete image, which the report does not decode
EVIL = '<img src=x onerror="alert(1)">&co'


class PageElements(HTMLParser):
    """An HTML parser that collects external addresses, scripts and images of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.outside, self.images, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        if tag not in ("meta", "img"):
            self.open.append(tag)
        if tag == "img":
            self.images.append(values["src"].split(";")[0])
            assert values["alt"]
        loaded = [values[name] for name in ("src", "href") if name in values]
        self.outside += [value for value in loaded if not value.startswith(("data:", "#"))]
        self.outside += [tag] if tag in ("script", "link", "iframe", "object") else []
        self.outside += [name for name in values if name.startswith("on")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_html_report_is_complete_and_loads_no_external_files(tmp_path, monkeypatch):
    runs = [evaluated_run(name, TEST_LAYOUTS, protocol="published") for name in ("AD", "random")]
    runs.append(evaluated_run("AD", protocol="published", note="K250"))
    (tmp_path / "a.gif").write_bytes(GIF)
    shown = tuple(ShownEpisode(number, 20.0 * number, tmp_path / "a.gif") for number in (1, 2))
    episodes = [
        EpisodePair(ResultCell("demo_wide", "H1"), "H1 & an ego", "task 1", shown),
        EpisodePair(ResultCell("demo_wide", "rl"), "an ego", "No picture: <its run> is gone"),
    ]
    monkeypatch.setattr(page, "family_gifs", lambda *options: episodes)
    runs.append(evaluated_run("stay", protocol="published", note="<left out>"))
    text = write_page(runs, tmp_path / "r" / "report.html", gifs=True).read_text()
    found = PageElements(text)
    assert (found.outside, found.open, found.images) == ([], [], ["data:image/gif"] * 2)
    for section in ("summary", "curves", "episodes", "tables", "settings", "paper"):
        assert f'<section id="{section}">' in text and f'href="#{section}"' in text
    parts = [
        "there is none of: stay [&lt;left out&gt;]",
        "H1 &amp; an ego",
        "Episode 2: return 40",
        "&lt;its run&gt; is gone",
    ]
    parts += ["paper 12.5 ± 11.3", "AD [K250]", 'name="viewport"', "prefers-color-scheme: dark"]
    assert [part for part in parts if part not in text] == []
    assert text.count("<table") == text.count("<caption>") and "url(" not in text and "@import" not in text


def test_html_in_names_is_escaped_in_all_reports(tmp_path):
    run = evaluated_run(EVIL, folder=EVIL)
    source = run.sources[0]._replace(trained={"config": {"method": EVIL, "model": {EVIL: 2}}, "run_hash": "ab12"})
    run = dataclasses.replace(run, sources=(source,))
    text = write_page([run], tmp_path / "report.html").read_text()
    assert PageElements(text).outside == [] and EVIL not in text and EVIL in unescape(text)
    text = markdown([run])
    assert "<img" not in text and '&lt;img src=x onerror="alert(1)"&gt;&amp;co' in text
    assert "<br>episodes 1: 10.0, " in text, "line breaks in table cells are not escaped"


def test_html_report_shows_conditions_once_and_flags_overlaps(tmp_path):
    record = [{"layout": "demo_wide", "family": "H4", "algorithm": "utility_greedy", "teammates": ["00"]}]
    runs = [evaluated_run("AD", trained_on=record), evaluated_run("mine", trained_on=None)]
    text = unescape(write_page(runs, tmp_path / "report.html").read_text())
    assert text.count("Evaluated under protocol seeded, 1 seed (0), 40 episodes of 100 steps; 5 instances") == 1
    assert text.count('<i class="key"></i>AD †</span>') == text.count('<i class="key"></i>mine ?</span>') == 2
    (chart,) = bar_charts(dict(enumerate(runs)), "seeded")  # bars show returns if no best response is measured
    marks = [[bar.text.lstrip("-0123456789.") for bar in row.bars] for row in chart.bars["demo_wide"]]
    assert marks == [["", "?"]] * 3 + [["†", "?"]]
    short = evaluated_run("DPT", steps=20)
    text = unescape(write_page([*runs, short], tmp_path / "report.html").read_text())
    assert "Evaluated AD and mine under protocol seeded, 1 seed (0), 40 episodes of 100 steps; DPT under" in text


def test_html_report_without_scores_has_no_score_columns(tmp_path):
    runs = [evaluated_run(name) for name in ("one", "two")]
    source = runs[0].sources[0]
    runs[0] = dataclasses.replace(runs[0], sources=(source._replace(settings=source.settings | {"seeds": [0, 1, 2]}),))
    text = write_page(runs, tmp_path / "report.html").read_text()
    assert 'data-label="return"' in text and 'data-label="score"' not in text and ">regret<" not in text
    assert "one under protocol seeded, 3 seeds (0 to 2), 40 episodes" in text


def test_score_bars_start_at_the_return_of_the_ego_stay(invented_responses, tmp_path):
    run = evaluated_run("mine", ("coord_simple", "demo_wide"), value=9.0)
    (chart,) = bar_charts({0: run}, "seeded")
    (rows,) = chart.bars.values()
    stay, best = (tick.position for tick in chart.x_ticks)
    for row in rows:
        (bar,) = row.bars
        assert (bar.start, bar.width) == (pytest.approx(stay), pytest.approx(0.5 * (best - stay), abs=0.02))
    assert rows[0].scale == "0.0 to 20.0" and rows[0].bars[0].text == "0.50"
    flat = ", ".join(f"coord_simple H{number}" for number in range(1, 5))
    assert chart.caption.endswith(f"Without a score, the tables say why: {flat}.")
    (low,) = bar_charts({0: evaluated_run("mine", ("asymm_right",), value=-90.0)}, "seeded")
    assert low.bars["asymm_right"][3].bars[0].text.endswith("*")
    (returns,) = bar_charts({0: evaluated_run("mine", ("coord_simple",))}, "seeded")
    assert returns.title == "Return in each cell, test tasks"
    assert [row.bars[0].text for row in returns.bars["coord_simple"]] == ["11.0"] * 4
    text = write_page([run], tmp_path / "one.html").read_text()
    assert "<b>0.50</b>" in text and "<span>Worst teammate</span>" in text
    text = write_page([run, evaluated_run("other", protocol="published")], tmp_path / "two.html").read_text()
    assert '<td data-label="regret">10.0</td>' in text and '<td data-label="regret">–</td>' in text


def test_curves_share_axes_and_can_have_one_episode():
    run = evaluated_run("mine", value=40.0)
    (chart,) = curve_charts({0: run})
    assert [tick.label for tick in chart.y_ticks] == ["0", "10", "20", "30", "40"] and len(chart.panels) == 4
    assert chart.panels["demo_wide, H1"][0].line.count("L") == 39
    one = dataclasses.replace(run, cells={cell: returns[:, :1] for cell, returns in run.cells.items()})
    assert curve_charts({0: one})[0].panels["demo_wide, H1"][0].line.count("L") == 1


def test_model_cards_describe_the_training_data():
    """The card of each bundled model contains the sentences that `training_sentence` writes for its training runs."""
    for name in ("ad-reference", "dpt-reference", "rl2-adapting", "rl2-reference"):
        configs = [json.loads(path.read_text()) for path in (MODELS / name).glob("*/config.json")]
        card = (MODELS / name / "README.md").read_text(encoding="utf-8")
        assert all(training_sentence(config) in card for config in configs)
        assert "datasets:" not in card
    assert "playing with teammates, not on learning histories. In the first 50% of its steps it also imitated" in card
    cells = [{"layout": "demo_wide", "family": "H4", "source": "student", "labels": "expert"}]
    assert training_sentence({"histories": {}, "trained_on": cells}) == (
        "It was trained on learning histories of source `student`, with `expert` labels."
    )


def test_headroom_card_lists_layouts_and_families_without_headroom(tmp_path):
    values = {"stay": (40.0, 0.0), "random": (35.0, 0.0), "oracle": (40.5, 39.9)}
    runs = []
    for agent, (simple, wide) in values.items():
        runs += merge([evaluated_run(agent, ("coord_simple",), simple - 1), evaluated_run(agent, value=wide - 1)])
    write_headroom_cards(runs, [["a", "b"]], tmp_path)
    content = json.loads((tmp_path / "headroom.json").read_text())
    assert json.loads((tmp_path / "behaviours.json").read_text()) == [["a", "b"]]
    assert content["seeded"]["demo_wide"]["H1"] == {"stay": 0.0, "random": 0.0, "oracle": 39.9}
    text = (tmp_path / "headroom.md").read_text()
    assert "**0.0 / 0.0 / 39.9**" in text and "No headroom: coord_simple/H1, coord_simple/H2" in text


def test_episodes_of_tasks_with_headroom_are_shown(invented_responses, tmp_path, monkeypatch):
    """Episodes are shown for layouts and families with headroom, and not for reference egos."""
    (tmp_path / "a.gif").write_bytes(GIF)
    monkeypatch.setattr(gifs, "save_episode_gifs", lambda *a, **k: (ShownEpisode(1, 7.0, tmp_path / "a.gif"),))
    monkeypatch.setattr(gifs, "restore_ego", lambda source: source)

    def fake_run(agent: str, **options) -> EvaluationRun:
        layouts, folder = ("coord_simple", "demo_wide"), f"runs/{agent}{options}"
        return evaluated_run(agent, layouts, families=("H1", "H4"), folder=folder, **options)

    runs = [fake_run("stay"), fake_run("oracle"), fake_run("AD"), fake_run("AD", note="K250"), fake_run("DPT")]
    drawn: list[tuple[int, int]] = []
    path = tmp_path / "report.html"
    text = write_page(runs, path, gifs=True, progress=lambda what, *counts: drawn.append(counts)).read_text()
    assert drawn == [(done, 6) for done in range(7)]
    found = re.findall(r"<h4>([^<]+? with \S+ on \S+)</h4>", text)
    agents = ("AD", "AD [K250]", "DPT")
    assert found == [f"{agent} with {mate} on demo_wide" for mate in ("H1/t0", "H4/t0") for agent in agents]
    assert "episodes are of 3 runs at most; there is none of: stay, oracle" in text
    assert 'id="episodes"' not in write_page(runs, path).read_text()


def test_restoring_an_unknown_or_missing_ego_raises_error(tmp_path):
    source = evaluated_run("AD").sources[0]
    with pytest.raises(
        OptionError, match="AD is neither a reference ego, nor a bundled model, nor a model with a run folder"
    ):
        restore_ego(source)
    with pytest.raises(OptionError, match=r"the run folder .*/gone of .* is missing"):
        restore_ego(source._replace(trained={"run": str(tmp_path / "gone")}))


def test_evaluate_and_report_commands_write_results_tables_and_page(tmp_path, monkeypatch):
    """The HTML report shows the first and last episode of each task with the stored returns."""
    tests = [task for task in TEST_TASKS if (task.layout.name, task.teammate_family) == ("coord_simple", "H4")]
    own = make_task("teammate", "train", "demo_wide", tests[0].teammate | {"theta_id": 77}, 5)
    write_tasks(tmp_path / "tasks.jsonl", [*tests[:2], own])
    monkeypatch.setitem(PROTOCOLS, "published", dataclasses.replace(PROTOCOLS["published"], steps=5))
    options = [
        "--protocol",
        "published",
        "--manifest",
        tmp_path / "tasks.jsonl",
        "--tasks",
        "1",
        "--episodes",
        "3",
        "--seed",
        "4",
    ]
    played = ["evaluate", "--agent", "stay", *options, "--out", tmp_path / "run"]
    printed = run_cli(*played)
    summary = (
        "stay (published), 1 training cell: return 0.0; in episodes 1: 0.0, 2-5: 0.0. No score: no best response "
        "measured."
    )
    assert summary in printed and f"2 results in {tmp_path / 'run'}, 1 program compiled" in printed
    report = ["report", tmp_path / "run", "--html", tmp_path / "report.html"]
    with monkeypatch.context() as stopped:
        stopped.setattr(page, "family_gifs", Mock(side_effect=KeyboardInterrupt))
        run_cli(*report, code=1)
    printed = run_cli(*report)  # not refused, since the stopped command left no files
    assert f"* {summary}" in printed
    assert "| H4 | stay | 0.0<br>1 of 5 instances<br>episodes 1: 0.0, 2-5: 0.0<br>no headroom |" in printed
    assert {path.name for path in (tmp_path / "run" / "report").iterdir()} == {"report.md", "report.csv"}
    text = (tmp_path / "report.html").read_text()
    assert PageElements(text).images.count("data:image/gif") == 4
    assert "<h4>stay with H4/t77 (training) on demo_wide</h4>" in text
    assert f"Task {own.task_id}, protocol published, seed 4." in text
    captions = re.findall(r"<figcaption>(Episode [^<]+)<", text)
    assert captions == ["Episode 1: return 0", "Episode 3: return 0"] * 2
    with pytest.raises(OptionError, match="report: exists"):
        run_cli("report", tmp_path / "run")
    run_cli(*report, "--no-gifs", "--overwrite")
    (tmp_path / "run" / "tasks.jsonl").unlink()
    with pytest.raises(OptionError, match=r"is neither a published test task, .* nor in the results' tasks\.jsonl"):
        run_cli("report", tmp_path / "run")
    (tmp_path / "tasks.jsonl").write_text("{}\n")
    with pytest.raises(TaskFormatError, match="line 1"):
        run_cli(*played)
