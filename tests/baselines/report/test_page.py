"""Report: tables with the paper's numbers, and the page, which is complete and self-contained."""

from __future__ import annotations

import dataclasses
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from click.testing import CliRunner
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, get_protocol
from icrl4aht_baselines.report import episode_gifs as gifs
from icrl4aht_baselines.report import rendering
from icrl4aht_baselines.report.episode_gifs import EpisodePair, ShownEpisode, restore_ego
from icrl4aht_baselines.report.model_card import model_card, write_model_cards
from icrl4aht_baselines.report.page import write_page, write_page_with_episodes
from icrl4aht_baselines.report.results import TEST_LAYOUTS, EvaluationRun, merge, read_published, split_cells
from icrl4aht_baselines.report.summary import report_begins, write_report
from icrl4aht_baselines.report.tables import AVERAGE, PAPER_TABLES, fill_table, returns_table, score_cells, sweep_points
from matplotlib.figure import Figure

from icrl4aht_data.benchmark.reference_returns import HEURISTICS, read_headroom
from icrl4aht_data.benchmark.tasks import make_task, read_tasks, write_tasks
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import OptionError
from icrl4aht_data.plotting import legend_below
from icrl4aht_data.utils.install_hints import install_command
from tests.helpers.evaluated import TEST_TASKS, evaluated_run

GIF = b"GIF89a"  # the page does not look inside


class Outside(HTMLParser):
    """Parser that collects everything a page would fetch or run."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found, self.images, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        if tag not in ("meta", "img"):
            self.open.append(tag)
        if tag in ("script", "link", "iframe", "object"):
            self.found.append(tag)
        if tag == "img":
            self.images.append(values["src"].split(";")[0])
            assert values["alt"]
        self.found += [
            value for name, value in values.items() if name in ("src", "href") and not value.startswith(("data:", "#"))
        ]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_complete_and_fetches_nothing(tmp_path):
    def published(*arguments, **options):
        return evaluated_run(*arguments, **options, protocol="published")

    sweeps = [published("AD", value=k / 100, variant=("K", k)) for k in (250, 500)]
    sweeps.append(published("DPT", variant=("size", "small")))
    (tmp_path / "a.gif").write_bytes(GIF)
    path = tmp_path / "r" / "report.html"
    runs = [published("AD", TEST_LAYOUTS), published("random", TEST_LAYOUTS, 1.0), *sweeps]
    runs.append(published("AD+TA", ("cramped_down",)))
    shown = [ShownEpisode(number, 20.0 * number, tmp_path / "a.gif") for number in (1, 2)]
    episodes = [
        EpisodePair("H1", "H1 & an ego", "task 1", tuple(shown)),
        EpisodePair("rl", "an ego", "No picture: <its run> is gone"),
    ]
    write_page(runs, path, episodes, ["left out: <nothing>"])
    text = path.read_text()
    page = Outside(text)
    assert page.found == []
    assert page.open == []
    assert page.images == ["data:image/gif"] * 2
    for section in ("summary", "curves", "sweeps", "episodes", "tables", "settings", "paper"):
        assert f'<section id="{section}">' in text
        assert f'href="#{section}"' in text
    for part in (
        "Table 5. Offline Meta-RL Comparison",
        "left out: &lt;nothing&gt;",
        "H1 &amp; an ego",
        "Episode 2: return 40",
        "No picture: &lt;its run&gt; is gone",
        "paper 12.5 ± 11.3",
        "Context length",
        "Model scale",
        "the paper&#39;s AD",
        "runs/AD+TA",
        '<meta name="viewport"',
        "prefers-color-scheme: dark",
    ):
        assert part in text
    assert text.count("<th ") == text.count('<th scope="')
    assert text.count("<table") == text.count("<caption>")
    assert "url(" not in text
    assert "@import" not in text
    with pytest.raises(OptionError, match=r"report\.txt: expected a name that ends in \.html"):
        write_page(runs, tmp_path / "report.txt")
    with pytest.raises(OptionError, match="no run to report"):
        write_page([], path)


def test_tables_hold_our_and_the_papers_numbers():
    runs = [
        evaluated_run("AD", TEST_LAYOUTS, protocol="published"),
        evaluated_run("oracle", value=50.0, protocol="published"),
    ]
    one, two, three, four, five = (fill_table(table, runs, "published") for table in PAPER_TABLES)
    assert [row.agent for row in one[:4]] == ["AD", "DPT", "random", "oracle"]
    assert [row.agent for row in two[:4]] == ["AD", "DPT", "random", "AD"], "oracle did not play there"
    column = PAPER_TABLES[0].columns.index("demo_wide")
    cell = one[0].scores[column]
    assert (cell.mean, cell.std, cell.published, cell.headroom) == (11.0, 0.0, (-3.2, 2.6), (1, 1))
    references = read_headroom("published")["demo_wide", "H1"]
    assert cell.normalised == pytest.approx((11 - references["stay"]) / (references["oracle"] - references["stay"]))
    assert one[1].scores[column].mean is None
    assert one[0].scores[0].headroom == (0, 1), "coord_simple with H1 is flat"
    assert one[0].scores[0].normalised is None
    assert next(row for row in three if (row.label, row.agent) == (AVERAGE, "DPT+TA")).scores[1].published == (9.4, 5.5)
    assert four[1].scores[0].published == (-6.5, 3.8)
    assert [(row.agent, row.scores[1].published) for row in five if row.agent != "random"] == [
        ("AD", (2.6, 4.1)),
        ("DPT", (6.9, 8.6)),
        ("AMAGO-Offline", (3.4, 4.8)),
    ]
    assert five[0].scores[0].played == (24, 24)


def test_scores_count_the_cells_played():
    partial = score_cells(
        [("demo_wide", family) for family in HEURISTICS], evaluated_run("AD", families=("H1", "H2")), {}
    )
    assert partial.played == (2, 4)
    assert (partial.mean, partial.normalised) == (11.0, None)


def test_short_runs_gain_from_half_to_half():
    assert evaluated_run("AD").gain(("demo_wide", "H1")) == 2
    short = dataclasses.replace(evaluated_run("AD"), cells={("demo_wide", "H1"): np.array([[1.0, 2, 3, 5, 8]])})
    assert short.gain(("demo_wide", "H1")) == 6.5 - 1.5


@pytest.mark.parametrize(
    "labels", [("a", "b"), ("quite a long label",) * 6, ("no room for more than one of these",) * 3]
)
def test_legends_fit_their_figures(labels):
    figure = Figure(figsize=(3.5, 3), layout="constrained")
    axes = figure.add_subplot()
    for number, label in enumerate(labels):
        axes.plot([0, 1], label=f"{label} {number}")
    legend_below(figure)
    figure.canvas.draw()
    (legend,) = figure.legends
    assert len(legend.get_texts()) == len(labels)
    box = legend.get_window_extent()
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1


def test_sweeps_have_the_papers_points_where_it_states_them():
    runs = [evaluated_run("AD", ("test_wide",), variant=("K", k), protocol="published") for k in (250, 500, 1000)]
    assert [(p.value, p.mean, p.published) for p in sweep_points(runs, "K")["test_wide"]["AD"]] == [
        (250, 11.0, None),
        (500, 11.0, -7.9),
        (1000, 11.0, -7.6),
    ]
    assert sweep_points(runs, "size") == {}


def test_the_papers_averages_are_those_of_its_cells():
    """Finds errors in the copied numbers, which are rounded to a tenth."""
    for layouts in read_published()["methods"].values():
        for families in layouts.values():
            if "H1" in families:
                mean = np.mean([families[family][0] for family in HEURISTICS])
                assert abs(mean - families[AVERAGE][0]) < 0.11


def test_models_of_different_layouts_are_one_agent():
    one, two = evaluated_run("AD", ("demo_wide",)), evaluated_run("AD", ("coord_simple",))
    (both,) = merge([one, two])
    assert next(iter(both.cells)) == ("coord_simple", "H1")
    assert len(both.cells) == 8
    assert [source.layouts for source in both.sources] == [("demo_wide",), ("coord_simple",)]
    assert [found.label for found in merge([one, evaluated_run("AD", value=3.0)])] == ["AD", "AD [runs/AD]"]
    assert len(merge([one, evaluated_run("AD", ("coord_simple",), variant=("K", 250))])) == 2


def test_ways_of_playing_are_stated_and_not_merged():
    one = evaluated_run("AD", ("demo_wide",), acting="cached")
    drawn, forgets = (
        _played_with(evaluated_run("AD", ("coord_simple",), acting="cached"), w) for w in ("sampled", "forget")
    )
    assert one.sources[0].conditions.endswith(", cached acting")
    assert drawn.sources[0].conditions.endswith(", cached acting, sampled actions")
    assert forgets.sources[0].conditions.endswith(", cached acting, memory cleared before each episode")
    assert [len(merge([one, other])) for other in (drawn, forgets)] == [2, 2]


def _played_with(run: EvaluationRun, way: str) -> EvaluationRun:
    settings = run.sources[0].settings
    changed = settings | {"details": settings["details"] | {way: True}}
    return dataclasses.replace(run, sources=(run.sources[0]._replace(settings=changed),))


def test_trained_models_have_cards(tmp_path):
    def trained(layout, tested_on, size, layers=4, channels=None, data=None, **options):
        histories = {"root": "hf://datasets/you/icrl4aht@v1", "layouts": [layout], "data_version": "1.0.0"}
        histories["sizes"] = {"train": size}
        histories |= {"channels": channels} if channels else {}
        histories |= {"labels": "oracle"} if data else {}
        config = {"model": {"layers": layers}, "train": {"seed": 3}, "package_version": "0", "histories": histories}
        config |= {"trained_on": data} if data else {}
        found = evaluated_run("AD", (tested_on,), **options)
        source = found.sources[0]._replace(trained={"config": config, "manifest_sha256": "ab12", "run_hash": layout})
        return dataclasses.replace(found, sources=(source,))

    greedy = {"layout": "demo_wide", "family": "H4", "algorithm": "utility_greedy", "teammates": ["00"]}
    first = trained("demo_wide", "demo_wide", 14, trained_on=[greedy])
    (path,) = write_model_cards([evaluated_run("stay"), first], tmp_path)
    card = path.read_text()
    assert path.name == "AD-seeded.md"
    assert "| data | you/icrl4aht, data version 1.0.0 |" in card
    assert (
        "| demo_wide | 14 of demo_wide; the release's manifest has SHA-256 `ab12` | demo_wide; with utility_greedy (1) "
        "| 3 | protocol seeded, 1 seed (0), 40 episodes of 100 steps, 5 instances in a cell |" in card
    )
    assert "* layers: 4\n* seed: 3\n* channels: own" in card, "as all models before channels could be chosen"
    assert "* seed: 3\n* channels: canonical" in model_card(trained("all", "demo_wide", 1, channels="canonical"))
    data = [{"source": "ppo"}, {"source": "noise"}, {"source": "ppo"}]
    settings = "* channels: own\n* sources of histories: noise, ppo\n* labels: oracle"
    assert settings in model_card(trained("demo_wide", "demo_wide", 1, data=data))
    assert "| H4 | 11.0 ± 0.0 †<br>" in card
    assert "| H3 | 11.0 ± 0.0<br>" in card
    assert "It is one run, of seed 3" in card
    assert card.count("* † the agent was trained with other teammates of this family") == 2, (
        "at the table, among the limits"
    )
    assert "40 episodes of 100 steps, cached acting, 5" in model_card(
        trained("demo_wide", "demo_wide", 1, acting="cached")
    )
    own = [make_task("teammate", "train", "demo_wide", TEST_TASKS[0].teammate, number) for number in (1, 2)]
    (twice,) = merge([first, trained("demo_wide", "demo_wide", 14, trained_on=[greedy], tasks=own)])
    card = model_card(twice)
    assert card.count("| demo_wide | 14 of demo_wide;") == 1, "one model, evaluated on two sets of tasks"
    assert "40 episodes of 100 steps, 2 to 5 instances in a cell |" in card
    assert "It is one run, of seed 3" in card
    both = merge([first, trained("asymm_both", "asymm_right", 8, layers=2, trained_on=None)])
    (path,) = write_model_cards(both, tmp_path)
    card = path.read_text()
    assert "| asymm_right | 8 of asymm_both; the release's manifest has SHA-256 `ab12` | unknown | 3 |" in card
    assert "Each model is one run" in card
    assert "Tested on demo_wide:\n\n* layers: 4" in card
    assert "Tested on asymm_right:\n\n* layers: 2" in card
    assert "* ? unknown training data" in card


def test_cards_of_bundled_models():
    model = {"layers": 2, "recurrent_layers": 2, "discounts": [0.9]}
    histories = {"root": "x", "layouts": ["demo_wide"], "data_version": "1.0.0", "sizes": {"train": 3}}
    histories |= {"mirror": True, "queries": 201, "every": 1, "weights": "uniform", "labels": None}
    config = {"method": "dpt", "model": model, "train": {"seed": 3}, "package_version": "0", "histories": histories}
    run = evaluated_run("dpt-student", trained_on=())
    trained = {"config": config, "manifest_sha256": "ab12", "run_hash": "1"}
    run = dataclasses.replace(run, sources=(run.sources[0]._replace(trained=trained),))
    own = [make_task("teammate", "validation", "demo_wide", TEST_TASKS[0].teammate, number) for number in (1, 2)]
    card = model_card(run, "dpt-reference", "python -m x", [evaluated_run("dpt-student", tasks=own)])
    assert "\n# dpt-reference, trained on" in card and "dpt-student" not in card
    assert "| method | dpt |" in card and "| made by | `python -m x` |" in card
    assert "\n* layers: 2\n* seed: 3\n* channels: own\n* queries: 201\n* mirror: True\n" in card
    assert "### Track teammate\n" in card and "### Track teammate, validation tasks\n" in card


def test_episodes_are_of_what_is_worth_seeing(tmp_path, monkeypatch):
    """Tasks with headroom, every agent once before any twice, reference egos last."""
    (tmp_path / "a.gif").write_bytes(GIF)
    shown = (ShownEpisode(1, 7.0, tmp_path / "a.gif"),)
    monkeypatch.setattr(gifs, "save_episodes", lambda *a, **k: shown)
    monkeypatch.setattr(gifs, "restore_ego", lambda source: source)

    def with_tasks(agent: str, **options) -> EvaluationRun:
        return evaluated_run(
            agent, ("coord_simple", "demo_wide"), families=("H1", "H4"), folder=f"runs/{agent}{options}", **options
        )

    runs = [with_tasks(agent) for agent in ("stay", "oracle", "AD", "DPT")]
    runs.insert(3, with_tasks("AD", variant=("K", 250)))
    drawn: list[tuple[int, int]] = []

    def progress(what: str, done: int, total: int) -> None:
        drawn.append((done, total))

    text = write_page_with_episodes(runs, tmp_path / "report.html", progress=progress).read_text()
    assert drawn == [(done, 6) for done in range(7)]
    found = re.findall(r"<h4>([^<]+? with \S+ on \S+)</h4>", text)
    assert text.count("Episode 1: return 7<") == 6
    assert found == [
        f"{agent} with {mate} on demo_wide" for mate in ("H1/t0", "H4/t0") for agent in ("AD", "DPT", "AD, K = 250")
    ]
    assert "episodes are of 3 runs at most; there is none of: stay, oracle" in text
    without = write_page_with_episodes(runs, tmp_path / "r.html", episodes=False).read_text()
    assert 'id="episodes"' not in without


def test_egos_that_cannot_be_made_again_say_why(tmp_path):
    source = evaluated_run("AD").sources[0]
    with pytest.raises(OptionError, match="AD is neither a reference ego, nor a bundled model, nor of a run folder"):
        restore_ego(source)
    with pytest.raises(OptionError, match=r"its run folder .*/gone is missing"):
        restore_ego(source._replace(trained={"run": str(tmp_path / "gone")}))


def test_commands_with_tasks_of_ones_own(tmp_path, monkeypatch):
    """Evaluates, prints the summary, and draws the first and the last episode, which earn what the results say."""
    theta = next(task for task in TEST_TASKS if task.teammate_family == "H4").teammate
    write_tasks(tmp_path / "own.jsonl", [make_task("teammate", "train", "demo_wide", theta | {"theta_id": 77}, 5)])
    monkeypatch.setitem(PROTOCOLS, "seeded", get_protocol("seeded").__class__("seeded", "seeded", False, 3, 5))
    played = ["evaluate", "--agent", "stay", "--manifest", str(tmp_path / "own.jsonl"), "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(cli, played, catch_exceptions=False)
    summary = (
        "stay (seeded), 1 training cell: return 0.0; gain +0.0: 0.0 in the first, 0.0 in the last episode. No score:"
    )
    assert summary in result.output
    arguments = ["report", str(tmp_path / "run"), "--html", str(tmp_path / "report.html")]
    result = CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert f"* {summary}" in result.stdout
    text = (tmp_path / "report.html").read_text()
    assert Outside(text).images.count("data:image/gif") == 2
    (task,) = read_tasks(tmp_path / "own.jsonl")
    assert "<h4>stay with H4/t77 (training) on demo_wide</h4>" in text
    assert f"Task {task.task_id}, protocol seeded, seed 0." in text
    assert re.findall(r"<figcaption>(Episode [^<]+)<", text) == ["Episode 1: return 0", "Episode 3: return 0"]
    (tmp_path / "run" / "tasks.jsonl").unlink()
    with pytest.raises(OptionError, match=r"is neither a published test task, .* nor in the results' tasks\.jsonl"):
        CliRunner().invoke(cli, ["report", str(tmp_path / "run")], catch_exceptions=False)


def test_what_a_page_lacks_is_named(tmp_path, monkeypatch):
    picture = EpisodePair("H1", "an ego", "", (ShownEpisode(1, 0.0, tmp_path / "gone.gif"),))
    with pytest.raises(OptionError, match=r"gone\.gif: missing, expected a picture .* draw it again, or .*--no-gifs"):
        write_page([evaluated_run("AD")], tmp_path / "report.html", [picture])
    with pytest.raises(
        OptionError, match=r"page\.html, line \d+: 'title' is undefined, expected .*; restore the templ"
    ):
        rendering.render("page.html", {})
    with pytest.raises(OptionError, match=r"templates/none\.html: missing; restore it: `.*baselines"):
        rendering.render("none.html", {})
    rendering.check_can_render()
    monkeypatch.setitem(sys.modules, "jinja2", None)
    rendering._environment.cache_clear()
    with pytest.raises(
        OptionError, match=rf"a page of results needs jinja2: {re.escape(install_command('baselines'))}"
    ):
        rendering.check_can_render()
    assert not list(tmp_path.iterdir())


def test_tables_have_only_what_was_run():
    run = evaluated_run("AD", ("demo_wide", "cramped_down"), families=("H1", "H4"))
    columns, rows = returns_table([run], list(run.cells), "seeded")
    assert columns == ["demo_wide", "cramped_down", AVERAGE]
    assert [row.label for row in rows] == ["H1", "H4", AVERAGE]
    assert [score.played for score in rows[-1].scores] == [(2, 2), (2, 2), (4, 4)]
    assert {score.gain for row in rows for score in row.scores} == {2.0}


def test_pictures_have_at_most_twelve_panels(tmp_path):
    run = evaluated_run("AD", ("coord_ring", "test_wide", "demo_simple", "demo_wide"))
    names = [path.name for path in write_report([run], tmp_path / "report")]
    assert names == ["report.md", "report.csv", "curves.png", "curves-2.png"]
    assert names == list(report_begins([run]))
    parts = split_cells(run.cells, 12)
    assert [len(part) for part in parts] == [12, 4]
    assert [cell for part in parts for cell in part] == list(run.cells)
