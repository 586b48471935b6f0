"""Test that the page of `icrl4aht-data browse` embeds the stored data, stays small, and is written safely."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS
from icrl4aht_data.browsing.drawings import layout_drawings, shape_to_json
from icrl4aht_data.browsing.page import (
    NO_ACTION,
    PAGE_START,
    embed_history,
    evenly_spaced_episodes,
    make_browser_page,
    varied_history_ids,
)
from icrl4aht_data.errors import NotStoredError, OptionError, ReleaseError, UnknownNameError
from icrl4aht_data.format.layouts_file import layout_title
from icrl4aht_data.overcooked.drawing import Canvas, state_parts
from icrl4aht_data.overcooked.layouts import LAYOUTS
from icrl4aht_data.reading.history import History
from icrl4aht_data.writing.convert import to_release
from tests.helpers.browser_pages import embedded_data, embedded_episodes
from tests.helpers.commands import run_cli
from tests.helpers.random_releases import random_release
from tests.helpers.states import random_records


@pytest.fixture(scope="module")
def release(tmp_path_factory) -> Path:
    """Return a release on two layouts with two teammates each, and with expert and oracle actions."""
    root = tmp_path_factory.mktemp("browse") / "release"
    sources = ("ppo", "noise", "ppo", "noise")
    random_release(root, oracle=True, sources=sources, episodes=8)
    return root


def run_browse(*arguments: object, code: int = 0) -> str:
    return run_cli("browse", *arguments, code=code)


def assert_page_embeds(page: bytes, dataset, shown: int | None = None) -> None:
    """Assert that every frame embedded in a page equals the stored arrays."""
    index, contents = embedded_data(page)
    assert [facts["history_id"] for facts in index["histories"]] == dataset.ids.tolist()
    for facts, content, history in zip(index["histories"], contents, dataset, strict=True):
        returns, ends = history.returns(), np.flatnonzero(history.dones[:]) + 1
        assert facts["returns"] == returns.tolist()
        decoded = embedded_episodes(index, facts, content)
        assert len(decoded) == (len(ends) if shown is None else min(shown, len(ends)))
        assert {0, len(ends) - 1} <= set(decoded)
        names = {"state", "rewards", "actions", "teammate_actions", "expert_actions"}
        # The expert of a noise history is the oracle, so the page stores one copy of the labels.
        apart = history.entry.has_oracle_actions and history.entry.source != "noise"
        names |= {"oracle_actions"} if apart else set()
        arrays = {name: history.read(name) for name in names}
        end_states = history.read("episode_end_state")
        for number, frames in decoded.items():
            steps = slice(ends[number - 1] if number else 0, ends[number])
            assert frames.keys() == names
            for name in names:
                np.testing.assert_array_equal(frames[name][:-1], arrays[name][steps])
            np.testing.assert_array_equal(frames["state"][-1], end_states[number])
            assert {int(frames[name][-1]) for name in names if name.endswith("actions")} == {NO_ACTION}
            assert frames["rewards"].sum() == returns[number]


def test_embedded_episodes_equal_the_stored_episodes(release):
    dataset = load_icrl4aht(release)
    page = make_browser_page(dataset)
    assert_page_embeds(page.html, dataset)
    total = int(dataset.column("episodes").sum())
    assert (page.histories, page.episodes, page.shown_episodes) == (len(dataset), total, total)
    assert len(repr(page)) < 100


def test_page_omits_label_columns_of_histories_without_labels(tmp_path):
    random_release(tmp_path / "r", labels=False, teammates=1, streams=1)
    index, _ = embedded_data(make_browser_page(load_icrl4aht(tmp_path / "r")).html)
    assert [facts["columns"] for facts in index["histories"]] == [["rewards", "actions", "teammate_actions"]] * 2


@pytest.mark.slow
def test_page_of_thirty_bundled_histories_is_below_five_megabytes():
    bundled = load_icrl4aht()
    chosen = bundled.select(varied_history_ids(bundled, 30))
    assert len(chosen) == 30
    shown, known = ({layout_title(one.name) for one in part.layouts} for part in (chosen, bundled))
    assert shown == known
    assert set(chosen.counts("source")) == set(bundled.counts("source"))
    assert set(chosen.counts("teammate_kind")) > set(HEURISTIC_KINDS)  # some histories have learned teammates
    page = make_browser_page(chosen)
    assert len(page.html) < 5_000_000
    assert page.shown_episodes == page.episodes == chosen.column("episodes").sum()
    assert_page_embeds(page.html, chosen)


def test_page_above_the_size_limit_shows_fewer_episodes(release):
    dataset = load_icrl4aht(release)
    size = len(make_browser_page(dataset).html)
    page = make_browser_page(dataset, megabytes=0.9 * size / 1e6)
    assert len(page.html) < 0.9 * size
    assert page.shown_episodes < page.episodes
    assert_page_embeds(page.html, dataset, shown=len(embedded_data(page.html)[0]["histories"][0]["shown"]))
    with pytest.raises(OptionError, match=r"first and last episodes of 12 histories, expected less than 0\.05 MB"):
        make_browser_page(dataset, megabytes=0.05)


@settings(deadline=None)
@given(st.integers(1, 5000), st.integers(1, 400))
def test_spread_episodes_returns_evenly_spaced_episodes(number, most):
    chosen = evenly_spaced_episodes(number, most)
    assert {0, number - 1} <= set(chosen.tolist())
    assert len(chosen) == min(number, max(2, most))
    gaps = np.diff(chosen)
    assert number == 1 or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)
    assert evenly_spaced_episodes(number, None).tolist() == list(range(number))


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_stored_drawings_equal_the_shapes_drawn_for_each_part_of_a_state(layout):
    records = random_records(layout, 50, np.random.default_rng(0))
    drawings = layout_drawings(layout, records)
    json.dumps(drawings)
    for record in records[:5]:
        for part, (name, moves, anchor, columns) in zip(state_parts(layout), drawings["parts"], strict=True):
            values = record[columns].tolist()
            canvas = Canvas()
            part.draw(canvas, 0.0, 0.0, *values)
            assert drawings["drawings"][name][",".join(map(str, values))] == list(map(shape_to_json, canvas.shapes))
            assert (part.moves, part.anchor) == (moves, anchor)


def test_the_page_is_self_contained(release):
    html = make_browser_page(load_icrl4aht(release)).html
    assert html.startswith(PAGE_START)
    text = html.decode()
    outside = text[: text.index('<script id="data"')] + text[text.index("</script>") :]
    for address in ("http:", "https:", "src=", "@import", "url("):
        assert address not in outside
    assert "href=" not in outside.replace('href="data:,"', "")


def test_name_of_the_release_is_escaped_in_html(release, tmp_path):
    hostile = shutil.copytree(release, tmp_path / "<b>$data&amp;<script>")
    html = make_browser_page(load_icrl4aht(hostile)).html.decode()
    assert "<h1>Learning histories of &lt;b&gt;$data&amp;amp;&lt;script&gt;</h1>" in html
    assert str(tmp_path) not in html


class TestBrowseCommand:
    def test_browse_writes_a_page(self, release, tmp_path):
        out = tmp_path / "page.html"
        assert run_browse(release, "--out", out).startswith(f"{out}: 12 of 12 histories, all 96 episodes to watch, ")
        facts = json.loads(run_browse(release, "--out", out, "--histories", 4, "--json"))
        assert facts == {
            "page": str(out),
            "histories": 4,
            "episodes": 32,
            "shown_episodes": 32,
            "bytes": out.stat().st_size,
        }
        assert [facts["layout"] for facts in embedded_data(out.read_bytes())[0]["histories"]].count("demo_wide") == 2

    def test_history_option_selects_histories_in_the_given_order(self, release, tmp_path):
        out = tmp_path / "page.html"
        run_browse(release, "--out", out, "--history", 5, "--history", 2, "--history", 5, "-q")
        assert [facts["history_id"] for facts in embedded_data(out.read_bytes())[0]["histories"]] == [5, 2]
        with pytest.raises(UnknownNameError, match="99"):
            run_browse(release, "--out", tmp_path / "other.html", "--history", 99)

    def test_browse_refuses_releases_without_state_records(self, release, tmp_path):
        to_release(load_icrl4aht(release), tmp_path / "obs", "observations")
        with pytest.raises(NotStoredError, match="obs: a release of kind observations has no state records"):
            run_browse(tmp_path / "obs", "--out", tmp_path / "page.html")
        assert not (tmp_path / "page.html").exists()

    def test_browse_overwrites_its_own_pages_but_no_other_files(self, release, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        for _ in range(2):
            assert run_browse(release).startswith("browse.html: 12 of 12 histories")
        (tmp_path / "browse.html").write_text("<!doctype html>\n<html><title>mine</title>")
        with pytest.raises(
            OptionError, match=r"browse\.html: exists; give another name, or use --overwrite to replace it"
        ):
            run_browse(release)
        assert (tmp_path / "browse.html").read_text().endswith("<title>mine</title>")


def test_impossible_states_and_actions_raise_errors(release, monkeypatch):
    read, wrong = History.read, []

    def read_damaged_rows(self, name, start=0, stop=None):
        rows = read(self, name, start, stop)
        if name in wrong:
            rows = rows.copy()
            rows[3] = 200
        return rows

    monkeypatch.setattr(History, "read", read_damaged_rows)
    for name, found in (("state", "a position"), ("expert_actions", "expert_actions below 6"), ("dones", "ends")):
        wrong.append(name)
        with pytest.raises(ReleaseError, match=f"history 0: .*{found}"):
            embed_history(load_icrl4aht(release)[0])
        wrong.clear()
    assert len(embed_history(load_icrl4aht(release)[0]).records) == 8 * 21
