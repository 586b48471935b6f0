"""Test submissions: files are made from results of `evaluate`, and refused if incomplete or not comparable."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from icrl4aht_baselines.evaluate.results import read_result
from icrl4aht_baselines.report import comparison, stored_results
from icrl4aht_baselines.report.submission import AgentFacts, make_submission, read_submission, write_submission

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import json_hash
from tests.helpers.commands import run_cli
from tests.helpers.evaluated import TEST_TASKS, write_results

CURVE = [0.0, *[10.0] * 4, *[20.5] * 95]
OTHER_CURVE = [1.0, *CURVE[1:]]
FACTS = AgentFacts("a rule", "none", "none")


@pytest.fixture(scope="module")
def submission_file(tmp_path_factory) -> Path:
    """Write a submission of two training runs of an agent, with results with memory cleared."""
    folder = tmp_path_factory.mktemp("submitted")
    write_results(folder / "one", "rule", CURVE)
    write_results(folder / "two", "rule", OTHER_CURVE, trained_on=[{"layout": "asymm_both", "family": "H1"}])
    for run, value in (("one", 1.0), ("two", 0.0)):
        write_results(folder / run / "cleared", "rule (cleared)", [value] * 100, forget=True)
    write_submission(folder / "rule.json", make_submission([folder / "one", folder / "two"], FACTS))
    return folder / "rule.json"


def test_submission_has_all_results_of_all_folders(submission_file):
    found = read_submission(submission_file)
    assert (found.agent, found.tracks, found.facts.about) == ("rule", ["layout"], "a rule")
    parts = [(one.control, one.training, len(one.returns)) for one in found.evaluations]
    assert parts == [("", 0, 40), ("cleared", 0, 40), ("", 1, 40), ("cleared", 1, 40)]
    assert next(iter(found.evaluations[0].returns.values())) == [CURVE] * 3


def changed_submission(path: Path, target: Path, change: Any) -> Path:
    content = json.loads(path.read_text())
    change(content, content["evaluations"][0], next(iter(content["evaluations"][0]["returns"])))
    target.write_text(json.dumps(content))
    return target


def rename_task(one: dict[str, Any], task: str, name: str) -> None:
    one["returns"][name] = one["returns"].pop(task)


def name_only_control(content: dict[str, Any], model: str) -> None:
    """Give a submission the name of a bundled model that only its results with a control come from."""
    content["agent"] = model
    for control in (one for one in content["evaluations"] if one["control"] == "cleared"):
        control["settings"]["details"]["model"] = model


OTHER = next(task.task_id for task in TEST_TASKS if task.track == "teammate")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, one, task: c.update(agent="Search"), "search names a reference ego or a bundled model; give"),
        (lambda c, one, task: c.update(agent="dpt-reference"), "dpt-reference names a reference ego or a bundled"),
        (lambda c, one, task: name_only_control(c, "dpt-reference"), "names a reference ego or a bundled"),
        (lambda c, one, task: c.update(agent="rule (greedy)"), "without a play mode at the end"),
        (lambda c, one, task: c.update(agent="a | b"), "not valid results: .*matching regex"),
        (lambda c, one, task: c.update(agent="rule\n"), "not valid results: .*matching regex"),
        (lambda c, one, task: c["facts"].update(data="x | **0.99**"), r"matching regex .* at `\$\.facts\.data`"),
        (lambda c, one, task: c["facts"].update(about="a\n# b"), r"matching regex .* at `\$\.facts\.about`"),
        (lambda c, one, task: c["facts"].update(link="javascript:x"), r"matching regex .* at `\$\.facts\.link`"),
        (lambda c, one, task: c["facts"].update(core_hours=-1), r"Expected `float` >= 0.* at `\$\.facts\.core_hours`"),
        (lambda c, one, task: c.update(tracks=[]), r"length >= 1 - at `\$\.tracks`"),
        (lambda c, one, task: one["returns"].clear(), r"length >= 1 - at `\$\.evaluations\[0\]\.returns`"),
        (lambda c, one, task: one["returns"].update({task: None}), "Expected `array`, got `null`"),
        (lambda c, one, task: one["returns"][task][0].append(None), "Expected `float`, got `null`"),
        (lambda c, one, task: one["returns"][task][0].append(1e9), "Expected `float` <= 4000"),
        (lambda c, one, task: one["settings"].pop("agent"), "settings: Object missing required field `agent`"),
        (lambda c, one, task: one["settings"].update(details=None), r"settings: .*got `null` - at `\$\.details`"),
        (lambda c, one, task: one["settings"]["details"].update(model=[]), r"got `array` - at `\$\.details\.model`"),
        (lambda c, one, task: c["evaluations"][2].update(returns=one["returns"]), "1: the same returns as training 0"),
        (lambda c, one, task: c["evaluations"][3].update(training=2), "2: no results without `cleared` of this"),
        (lambda c, one, task: c.update(best_responses="99"), r"best responses '99', but this package has '0'"),
        (lambda c, one, task: one["settings"]["details"].clear(), "no declaration of the training data"),
        (lambda c, one, task: one["settings"]["protocol"].update(four_recipes=True), "'four_recipes': True"),
        (lambda c, one, task: one.update(control="swap"), "control 'swap', expected cleared or swapped"),
        (lambda c, one, task: c["evaluations"].append(one), "of the 40 test tasks of layout and no others, found 2 of"),
        (lambda c, one, task: one["returns"].pop(task), "found 0 of layout_test_.*1 wrong task"),
        (lambda c, one, task: rename_task(one, task, OTHER), "found 0 of layout_test_.*2 wrong tasks"),
        (lambda c, one, task: c.update(tracks=["teammate"]), "the 120 test tasks of teammate and no others"),
        (lambda c, one, task: one["settings"].update(seeds=[0, 1]), r"seeds \[0, 1\], expected \[0, 1, 2\]"),
        (lambda c, one, task: one["returns"][task].pop(), r"has 2 lists of \[100\] returns, expected 3 of 100"),
        (lambda c, one, task: one["settings"]["protocol"].update(name="published"), "protocol {'name': 'published'"),
        (lambda c, one, task: c.update(evaluations=c["evaluations"][3:]), "found only results of controls"),
        (lambda c, one, task: one["settings"]["details"].update(forget=True), "found control cleared, expected none"),
        (lambda c, one, task: c["evaluations"][3]["settings"]["details"].clear(), "control none, expected cleared"),
        (lambda c, one, task: one["settings"]["details"].update(sampled=True), "greedy actions, but .* sampled"),
        (lambda c, one, task: [e["settings"]["details"].update(run="x") for e in c["evaluations"]], "same run x as"),
        (lambda c, one, task: [e["settings"]["details"].update(run=e["control"] + "x") for e in c["evaluations"][:2]],
         "cleared, training 0: run clearedx in task layout_test_.*, but x in other results of this training"),
        (lambda c, one, task: c["evaluations"][1]["settings"]["details"].update(sampled=True), "sampled actions, but"),
        (lambda c, one, task: c["facts"].update(data=""), "Expected `str` of length >= 1 - at `\\$.facts.data`"),
    ],
)  # fmt: skip
def test_incomplete_or_invalid_submission_raises_error(submission_file, tmp_path, change, message):
    with pytest.raises(OptionError, match=message) as caught:
        read_submission(changed_submission(submission_file, tmp_path / "bad.json", change))
    assert str(caught.value).startswith(str(tmp_path / "bad.json"))


def test_control_swapped_needs_the_teammates_of_the_complete_track(tmp_path):
    """Teammates that play first depend on the tasks that were evaluated together."""
    write_results(tmp_path / "mine", "rule", CURVE)
    write_results(tmp_path / "mine" / "swapped", "rule (swapped)", CURVE, swapped=True)
    found = make_submission([tmp_path / "mine"], FACTS)
    assert [len(one.partners) for one in found.evaluations] == [0, 40]
    path = sorted((tmp_path / "mine" / "swapped" / "tasks").iterdir())[0]
    result = read_result(path)
    path.write_text(json.dumps(replace(result, partners=[result.task_id] * 2).to_json()))
    with pytest.raises(
        OptionError, match=f"has the teammates of .*{result.task_id}.*; evaluate all tasks of the track"
    ):
        make_submission([tmp_path / "mine"], FACTS)


def test_training_data_can_be_declared_for_the_submitted_track_alone(tmp_path):
    folder = write_results(tmp_path / "mine", "mine", CURVE)
    for path in (folder / "tasks").iterdir():
        content = json.loads(path.read_text())
        content["settings"]["details"]["trained_on"] = {"layout": []}
        path.write_text(json.dumps(content | {"settings_hash": json_hash(content["settings"])}))
    assert make_submission([folder], FACTS).tracks == ["layout"]


def test_results_that_cannot_be_submitted_raise_errors(tmp_path):
    one, other = (write_results(tmp_path / name, name, CURVE) for name in ("one", "other"))
    with pytest.raises(OptionError, match="one: given more than once; give each folder once"):
        make_submission([one, tmp_path / "none" / ".." / "one"], FACTS)
    with pytest.raises(OptionError, match=r"one has results of one, .*other has results of other; give folders of one"):
        make_submission([one, other], FACTS)
    with pytest.raises(OptionError, match="training 1: the same returns as training 0"):
        make_submission([one, other], FACTS, "both")
    path = next((one / "tasks").iterdir())
    path.write_text(path.read_text().replace("20.5", "NaN"))
    with pytest.raises(OptionError, match="one: not valid results: Expected `float`, got `null`"):
        make_submission([one], FACTS)
    path.write_bytes(b"\xff")
    with pytest.raises(OptionError, match=f"{path.name}: not a result: UnicodeDecodeError"):
        make_submission([one], FACTS)
    with pytest.raises(OptionError, match=f"{tmp_path}/none: no results in"):
        make_submission([tmp_path / "none"], FACTS)
    folder = write_results(tmp_path / "undeclared", "rule", CURVE, trained_on=None)
    with pytest.raises(OptionError, match="undeclared: rule, training 0: no declaration of the training data"):
        make_submission([folder], FACTS)
    paths = sorted((folder / "tasks").iterdir())
    messages = "the results have different settings", r"made with icrl4aht-data 0\.0\.1, but"
    for changed, message in zip((paths[:1], paths), messages, strict=True):
        for path in changed:
            result = read_result(path)
            other = replace(result, settings=result.settings | {"code_version": "0.0.1"})
            path.write_text(json.dumps(other.to_json()))
        with pytest.raises(OptionError, match=message):
            make_submission([folder], FACTS)


def test_submit_and_results_commands_write_file_and_page(submission_file, tmp_path, monkeypatch):
    monkeypatch.setattr(stored_results, "results_file", lambda: tmp_path / "stored.json")
    stored_results.write_stored(tmp_path / "stored.json", stored_results.StoredResults())
    folder = str(write_results(tmp_path / "mine", "mine", CURVE))
    said = ["--about", "a rule", "--data", "none", "--labels", "none", "--core-hours", "1.5", "--name", "my rule"]
    printed = run_cli("submit", folder, *said, "--out", tmp_path / "mine.json")
    assert "mine.json: my rule, layout;" in printed
    assert run_cli("submit", folder, *said, "--out", tmp_path / "mine.json", "--overwrite") == printed
    assert read_submission(tmp_path / "mine.json").facts.core_hours == 1.5
    assert json.loads(run_cli("submit", "--schema"))["$defs"]["AgentFacts"]
    page = ["results", str(submission_file), str(tmp_path / "mine.json"), "--out", str(tmp_path / "page")]
    run_cli(*page)
    text = (tmp_path / "page" / "results.md").read_text(encoding="utf-8")
    assert "| `my rule` | none | none | 1.5 core-hours |" in text and "| `rule` † (2 runs) |" in text
    run_cli(*page, "--overwrite", "--store")
    assert list(stored_results.read_stored(tmp_path / "stored.json").agents) == ["rule", "my rule"]
    said = ["submit", folder, *said[:-1], "Rule", "--out", str(tmp_path / "again.json")]
    for words, message in (
        ([*page, "--overwrite"], "the page already has results of an agent rule;"),
        (said, "mine: the page already has results of an agent rule;"),
        ([*said, "--update"], "updates the agent Rule, which is not on the page"),
    ):
        with pytest.raises(OptionError, match=message):
            run_cli(*words)


def test_results_with_sampled_actions_are_added_to_an_agent(tmp_path):
    """Results with sampled actions are recognized by the agent's name, and can be added to stored results later."""
    own, drawn = (
        write_results(tmp_path / name, name, CURVE, sampled=name != "mine") for name in ("mine", "mine (sampled)")
    )
    write_results(drawn / "cleared", "mine (sampled) (cleared)", CURVE, sampled=True, forget=True)
    other = write_results(tmp_path / "default", "mine", OTHER_CURVE, sampled=True)
    runs = [(one.control, one.training) for one in make_submission([other, drawn], FACTS).evaluations]
    assert runs == [("", 0), ("", 1), ("cleared", 1)], "the agent samples by default"
    both = make_submission([drawn, own], FACTS)
    assert (both.agent, [one.control for one in both.evaluations]) == ("mine", ["sampled", ""])
    stored = stored_results.add_submission(stored_results.StoredResults(), make_submission([own], FACTS))
    with pytest.raises(OptionError, match="expected results of the agent's own play, found only results of "):
        make_submission([drawn], FACTS)
    later = stored_results.add_submission(stored, make_submission([drawn], AgentFacts("x", "x", "x"), update=True))
    assert len(later.table) == 2 * len(stored.table) and later.agents == {"mine": FACTS}
    shown = later.with_other_play_modes(later.returns())
    assert list(shown) == ["mine", "mine (sampled)"]
    table = comparison.agents_table(later, shown, {}, {})
    assert "| `mine` | none | none | – | – | – |" in table and "| `mine (sampled)` |  |  |  | – |" in table
    page = comparison.render_comparison(later)
    assert "Not measured for" not in page and "Not measured for: `mine`." in comparison.render_comparison(stored)
    two = [
        write_results(tmp_path / f"{run}", "mine", curve, track="teammate")
        for run, curve in enumerate((CURVE, OTHER_CURVE))
    ]
    with pytest.raises(
        OptionError, match=r"mine.json: .* would have training runs \[0, 1\] on coord_ring, but \[0\] in its"
    ):
        stored_results.add_submission(later, make_submission(two, FACTS, update=True), "mine.json")
    replaced = stored_results.add_submission(later, make_submission([own], FACTS, update=True))
    assert set(replaced.table["control"]) == {""}
    removed = ["`sampled`, protocol seeded, test tasks: training runs 0 on 2 layouts"]
    assert stored_results.describe_removed(later, replaced, "mine") == removed
    with_control = make_submission([other, drawn], FACTS)
    with pytest.raises(
        OptionError, match=r"runs \[1\] on asymm_right with control `cleared`, but \[0, 1\] in its other"
    ):
        stored_results.add_submission(stored_results.StoredResults(), with_control)
