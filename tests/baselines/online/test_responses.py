"""Test best responses and adaptation headroom: groups of tasks, choice of training runs, tables and tiny jobs."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from icrl4aht_baselines.commands import experiment_commands
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, bundled_tasks, get_protocol
from icrl4aht_baselines.evaluate.protocols import test_tasks as tasks_of
from icrl4aht_baselines.online import adaptation, responses
from icrl4aht_baselines.online.adaptation import (
    AdaptationJob,
    adaptation_entry,
    adaptation_jobs,
    informed_responses,
    write_adaptation,
)
from icrl4aht_baselines.online.responses import ResponseJob, ResponseOptions
from icrl4aht_baselines.training import trainer
from icrl4aht_generation.teammates.distances import common_records

from icrl4aht_data.benchmark.adaptation import EGO_KINDS, SCRIPTS, adaptation_table, read_adaptation, task_set_name
from icrl4aht_data.benchmark.best_responses import read_best_responses
from icrl4aht_data.benchmark.facts import ALL_TRACKS, PREFERENCE, PREFERENCE_LAYOUTS
from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.layouts_file import read_tasks_and_layouts
from icrl4aht_data.format.schema import TASKS, TEAMMATES
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.utils.text import card_file
from tests.helpers.paths import ROOT

TINY = ResponseOptions(steps=400, tasks=4)
DEMO = tasks_of("teammate", "demo_wide")


def test_tasks_on_which_the_oracle_gains_little_are_dropped():
    """Headroom is stored by layout and family for test tasks, and by teammate for validation tasks."""
    flat = {task.layout.name for task in tasks_of("teammate")} - {
        task.layout.name for task in responses.tasks_with_headroom(tasks_of("teammate"))
    }
    assert flat == {"coord_simple", "test_simple"}
    validation = bundled_tasks("teammate", "validation")
    assert 0 < len(responses.tasks_with_headroom(validation)) < len(validation)


@pytest.mark.slow
def test_teammates_with_the_same_behaviour_share_a_best_response(monkeypatch):
    """On test_wide, the five H4 teammates behave alike; the five H3 teammates differ even in few episodes."""
    monkeypatch.setattr(responses, "common_states", cache(lambda layout: (common_records(layout, 1), None)))
    tasks = [task for family in ("H3", "H4") for task in tasks_of("teammate", "test_wide", family)]
    assert [len(alike) for alike in responses.find_behaviours(tasks)] == [1] * 5 + [5]


def write_finished_job(job, choice: float, earned: float, slope: float = 0.0) -> None:
    folder = job.out / job.name
    folder.mkdir(parents=True)
    modes = {"greedy": {"choice": choice, "return": earned}, "sampled": {"choice": choice - 1, "return": 99.0}}
    result = {"settings": job.settings, "modes": modes, "slope": slope}
    (folder / "result.json").write_text(json.dumps(result))


def test_best_response_is_chosen_on_separate_episodes(tmp_path):
    behaviour = (DEMO[0],)
    jobs = [ResponseJob(behaviour, seed, TINY, tmp_path) for seed in range(3)]
    assert not any(job.is_finished() for job in jobs)
    write_finished_job(jobs[0], choice=10.0, earned=9.0)
    write_finished_job(jobs[1], choice=8.0, earned=20.0)
    entry = responses.choose_best_response(behaviour, map(responses.trained_response, jobs[:2]))
    assert (entry.best, entry.agent) == (9.0, "best response, seed 0")
    assert [one.acting for one in entry.seeds] == ["greedy"] * 2
    path = responses.write_responses(jobs[:1], tmp_path)
    first = read_best_responses(path)
    assert first.behaviours == (responses.choose_best_response(behaviour, [responses.trained_response(jobs[0])]),)
    responses.write_responses(jobs[1:], tmp_path)  # the stored result of the first run is kept
    second = read_best_responses(path)
    assert second.behaviours == (entry,)
    assert second.version != first.version
    models = {name: {DEMO[0].task_id: np.array(of)} for name, of in
              {"better": (12.0, 9.0, 12.0), "lucky": (0.0, 0.0, 30.0), "worse": (8.0, 8.0, 8.0)}.items()}  # fmt: skip
    responses.write_responses(jobs, tmp_path, models | {"elsewhere": {"other": np.full(3, 50.0)}})
    (third,) = read_best_responses(path).behaviours
    # With the other two seeds, `lucky` earns 15 for seeds 0 and 1, and `better` 10.5 for seed 2; the trained ego
    # earns 9. Thus the chosen egos earn 0, 0 and 12 in the seeds that did not decide.
    assert (third.best, third.agent, third.seeds) == (4.0, "better", entry.seeds)
    row = "| demo_wide | test | H1 t0 | 4.0 | better | 9.0 to 20.0 | 2 | 400 | 128 | +0.0 |"
    assert row in responses.responses_table(tmp_path)
    responses.write_responses([], tmp_path, {"worse": models["worse"]})
    (fourth,) = read_best_responses(path).behaviours
    assert (fourth.best, fourth.agent) == (9.0, "best response, seed 0")
    second_job = ResponseJob((DEMO[2],), 0, TINY, tmp_path / "second")
    write_finished_job(second_job, choice=1.0, earned=1.0)
    for own in ([second_job], jobs):
        responses.write_responses(own, tmp_path)
    order = [one.tasks for one in read_best_responses(path).behaviours]
    assert order == [(DEMO[0].task_id,), (DEMO[2].task_id,)], "the new entry is where the earlier one was"
    pair = ResponseJob((DEMO[0], DEMO[1]), 0, TINY, tmp_path / "pair")
    write_finished_job(pair, choice=1.0, earned=1.0)
    responses.write_responses([pair], tmp_path)
    order = [one.tasks for one in read_best_responses(path).behaviours]
    assert order == [(DEMO[2].task_id,), (DEMO[0].task_id, DEMO[1].task_id)]
    longer = ResponseJob(behaviour, 0, replace(TINY, steps=800), tmp_path)
    assert longer.name != jobs[0].name, "runs of several lengths can share a folder"
    same = ResponseJob(behaviour, 0, replace(TINY, learning_rate=0.5), tmp_path)
    assert same.name == jobs[0].name and not same.is_finished(), "the stored result has other settings"


def test_headroom_table_shows_mean_difference_and_interval(tmp_path):
    """Two seeds differ by 4 and 6: the mean is 5, and Student's interval with one degree of freedom is 5 +- 12.7."""
    jobs = adaptation_jobs({"demo_wide": DEMO[:2]}, 2, TINY, tmp_path)
    returns = {("informed", 0): 10.0, ("informed", 1): 11.0, ("episodic", 0): 6.0, ("episodic", 1): 5.0}
    for job in jobs:
        (tmp_path / job.name).mkdir()
        of_task = {task.task_id: returns[job.kind, job.seed] for task in job.tasks}
        result = {"settings": job.settings, "returns": of_task}
        (tmp_path / job.name / "result.json").write_text(json.dumps(result))
        assert job.is_finished()
    write_adaptation(jobs, tmp_path)
    row = "| demo_wide | 2 | 10.5 | 5.5 | +5.0 (-7.7 to +17.7) | 2 | 400 | 128 |"
    (entry,) = read_adaptation(tmp_path)
    assert entry["interval"] == [-7.706, 17.706]
    assert adaptation_table([entry]).splitlines()[-1] == row
    write_adaptation([job for job in jobs if job.seed == 0], tmp_path)
    assert read_adaptation(tmp_path) == [entry], "the stored return of the other seed is kept"
    (tmp_path / "adaptation.json").unlink()
    for seed in (1, 0):
        write_adaptation([job for job in jobs if job.seed == seed], tmp_path)
    assert read_adaptation(tmp_path) == [entry], "seeds that are measured one after the other count together"
    write_adaptation([replace(job, options=replace(TINY, width=64)) for job in jobs[:2]], tmp_path)
    assert read_adaptation(tmp_path) == [entry], "no job of the other width is finished"
    narrow = entry | {"width": 64, "returns": {kind: {"7": 0.0} for kind in EGO_KINDS}}
    write_json(tmp_path / "adaptation.json", [narrow])
    write_adaptation(jobs, tmp_path)
    assert read_adaptation(tmp_path) == [entry], "seeds of another width are replaced by a larger number of seeds"
    write_json(tmp_path / "adaptation.json", [entry | {"steps": 800}])
    write_adaptation(jobs[:2], tmp_path)
    assert read_adaptation(tmp_path) == [entry | {"steps": 800}], "one seed with other steps does not replace two"
    write_json(tmp_path / "adaptation.json", [entry])
    write_adaptation(adaptation_jobs({"other": DEMO[2:3]}, 1, TINY, tmp_path), tmp_path)
    assert read_adaptation(tmp_path) == [entry], "no job of the other set is finished"


@pytest.mark.slow
def test_scripts_and_informed_egos_of_track_preference_are_stored(tmp_path, monkeypatch):
    """Scripts play all sets in one job; an informed ego is the best response in the test tasks among its tasks."""
    monkeypatch.setitem(PROTOCOLS, "seeded", get_protocol("seeded", 2))
    tasks = [task for task in bundled_tasks(PREFERENCE, "test") if task.layout.name == "rooms-0-46"][:2]
    crossed = adaptation.cross_dishes(tasks)
    assert len({(json.dumps(task.teammate), task.recipes) for task in crossed}) == len(crossed) == 4
    ids = {task.task_id for task in crossed}
    assert {task.task_id for task in tasks} < ids
    jobs = adaptation_jobs({"few": tasks}, 2, TINY, tmp_path)
    assert [job.kind for job in jobs] == [*EGO_KINDS, *EGO_KINDS, *SCRIPTS]
    for job in jobs[-len(SCRIPTS) :]:
        assert job.updates == 1
        job.run()
    earned = {job.kind: job.result()["returns"] for job in jobs if job.is_finished()}
    assert all(returns.keys() == ids for returns in earned.values())
    means = {kind: np.mean(list(returns.values())) for kind, returns in earned.items()}
    assert means["oracle"] > max(means["search"], means["stay"]), means
    assert not adaptation_entry("few", jobs), "no trained ego is finished"
    for job in jobs[:2]:
        (tmp_path / job.name).mkdir()
        content = {"settings": job.settings, "returns": {task.task_id: 7.0 for task in crossed}}
        (tmp_path / job.name / "result.json").write_text(json.dumps(content))
    entry = adaptation_entry("few", jobs)
    assert entry and entry["number"] == 4
    assert entry["scripts"] == pytest.approx(means, abs=1e-3)
    assert informed_responses(jobs, tmp_path) == [], "other test tasks of the layout are missing"
    every = [task for task in bundled_tasks(PREFERENCE, "test") if task.layout.name == "rooms-0-46"]
    for seed, steps, earned in ((0, 400, 7.0), (1, 400, 9.0), (0, 800, 8.0)):
        own = replace(TINY, steps=steps, tasks=32 if steps == 400 else 64)
        (job,) = [one for one in adaptation_jobs({"all": every}, 2, own, tmp_path / str(steps))
                  if (one.kind, one.seed) == ("informed", seed)]  # fmt: skip
        (tmp_path / str(steps) / job.name).mkdir(parents=True)
        content = {"settings": job.settings, "returns": {task.task_id: earned for task in job.tasks}}
        (tmp_path / str(steps) / job.name / "result.json").write_text(json.dumps(content))
        responses.add_responses(informed_responses([job], tmp_path), tmp_path, {})
    stored = read_best_responses(tmp_path / "best_responses.json").behaviours
    assert [one.tasks for one in stored] == [(task.task_id,) for task in every]
    assert {(one.best, one.agent, len(one.seeds), one.seeds[0].tasks) for one in stored} == {
        (8.0, "informed ego, 1 run", 3, 20)
    }, "the runs with the most steps count, and earlier runs are kept"


def test_headroom_tables_in_cards_and_docs_match_stored_results():
    """The page has means over the layouts of the track `preference`, and the least and the greatest difference."""
    page = (ROOT / "docs" / "preference.md").read_text(encoding="utf-8")
    entries = read_adaptation(card_file("adaptation.json").parent)
    assert adaptation_table(entries) in card_file("adaptation.md").read_text(encoding="utf-8")
    responses_card = card_file("best_responses.md")
    assert responses.responses_table(responses_card.parent) in responses_card.read_text(encoding="utf-8")
    assert read_best_responses().about == responses.ABOUT
    own = [entry for entry in entries if entry["tasks"].startswith(f"{PREFERENCE}-test-")]
    assert {entry["tasks"] for entry in own} == {
        task_set_name(PREFERENCE, "test", layout) for of in PREFERENCE_LAYOUTS.values() for layout in of
    }
    assert {tuple(entry["returns"][kind]) for entry in own for kind in EGO_KINDS} == {("0", "1")}
    assert min(entry["interval"][0] for entry in own) > 10
    trained = [{kind: np.mean([*entry["returns"][kind].values()]) for kind in EGO_KINDS} for entry in own]
    returns = [entry["scripts"] | of for entry, of in zip(own, trained, strict=True)]
    means = [np.mean([of[name] for of in returns]) for name in (*SCRIPTS, "episodic", "informed")]
    differences = [of["informed"] - of["episodic"] for of in returns]
    numbers = [f"{mean:.1f}" for mean in means] + [f"+{min(differences):.1f} to +{max(differences):.1f}"]
    assert f"| {' | '.join(numbers)} |" in page


def test_all_episodes_of_a_best_response_are_split_into_choice_and_report(tmp_path, monkeypatch):
    """The fake returns are the episodes' seeds: the seed of the choice is 1000, the mean of the others is 1."""

    def return_seeds(*arguments, seeds, **options) -> list[SimpleNamespace]:
        return [SimpleNamespace(returns=[[seed] * 3 for seed in seeds]) for _ in range(2)]

    monkeypatch.setattr(responses, "evaluate", return_seeds)
    job = ResponseJob((DEMO[0], DEMO[1]), 0, TINY, tmp_path)
    policy: Any = None  # not used by the replaced function
    assert job._mean_returns(policy) == {"choice": 1000.0, "return": 1.0}


def test_stored_models_have_returns_with_each_seed_on_all_tracks():
    found = experiment_commands._model_returns()["rl2-adapting"]
    ids = {task.task_id for track in ALL_TRACKS for task in bundled_tasks(track, "test")}
    assert found.keys() == ids
    assert {values.shape for values in found.values()} == {(3,)}


def test_sets_without_tasks_of_track_preference_have_no_returns_of_scripts(tmp_path):
    """Jobs on two tracks: scripts play the tasks of one of them only."""
    sets = {"demo_wide": DEMO[:2], "rooms": bundled_tasks(PREFERENCE, "test")[:2]}
    jobs = adaptation_jobs(sets, 1, TINY, tmp_path)
    for job in jobs:
        (tmp_path / job.name).mkdir()
        content = {"settings": job.settings, "returns": {task.task_id: 1.0 for task in job.tasks}}
        (tmp_path / job.name / "result.json").write_text(json.dumps(content))
    assert ["scripts" in (adaptation_entry(name, jobs) or {}) for name in sets] == [False, True]


def test_headroom_job_with_fewer_tasks_than_needed_raises_error(tmp_path):
    with pytest.raises(OptionError, match=r"tasks = 4: demo_wide has 20 tasks, .* give --tasks 20 or more"):
        AdaptationJob(tuple(DEMO), 0, TINY, tmp_path, title="demo_wide", kind="informed")


def test_headroom_is_measured_with_learned_teammates_of_a_suite(tmp_path):
    tasks = [
        task
        for task in read_tasks_and_layouts(MINI / TASKS)
        if (task.layout.name, task.teammate_family) == ("coord_ring", "rl")
    ]
    job, episodic = adaptation_jobs({"learned": tasks}, 1, TINY, tmp_path, suite=MINI / TEAMMATES)
    played = job._parallel_tasks()
    assert {task.family for task in played} == {"fcp", "brdiv"}
    assert [task.partner for task in played] == [*range(len(tasks))] == [0, 1, 2, 3]
    assert [task.id for task in episodic._parallel_tasks()] == [task.task_id for task in tasks]
    with pytest.raises(OptionError, match="give the folder of its suite as `suite`"):
        replace(job, suite=None)._parallel_tasks()


@pytest.mark.slow
def test_tiny_best_response_and_headroom_jobs_finish(tmp_path, monkeypatch):
    """Train a best response for one task, then an informed and an episodic ego for two tasks.

    A finished job does nothing.
    """
    monkeypatch.setitem(PROTOCOLS, "seeded", get_protocol("seeded", 2))
    monkeypatch.setattr(adaptation, "MEASURED_EPISODES", 2)
    monkeypatch.setattr(trainer, "can_draw", lambda: False)
    job = ResponseJob((DEMO[0],), 0, TINY, tmp_path)
    calls = []
    job.run(lambda updates, speed: calls.append(updates))
    assert calls == [1]
    assert job.is_finished()
    modes = job.result()["modes"]
    assert all(np.isfinite(list(found.values())).all() for found in modes.values())
    before = (tmp_path / job.name / "result.json").read_bytes()
    job.run(lambda updates, speed: pytest.fail("a finished job was trained again"))
    assert (tmp_path / job.name / "result.json").read_bytes() == before
    tasks = {"two": [DEMO[5], *tasks_of("teammate", "test_wide", "H1")[:1]]}
    for other in adaptation_jobs(tasks, 1, TINY, tmp_path):
        other.run()
        assert set(other.result()["returns"]) == {task.task_id for task in tasks["two"]}
    write_adaptation(adaptation_jobs(tasks, 1, TINY, tmp_path), tmp_path)
    table = adaptation_table(read_adaptation(tmp_path))
    assert table.splitlines()[2].startswith("| two | 2 | ")
