"""Test the card of a release: computed values, README.md, and the long tables in card.json."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS
from icrl4aht_data.benchmark.tasks import Task, make_task, write_tasks
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.index import read_index
from icrl4aht_data.format.info import LeftOutTask, make_info
from icrl4aht_data.format.provenance import ExpertLabels, NearestTestTeammate, Provenance, ReferenceEgos
from icrl4aht_data.format.schema import ENTRY_HINTS, FIELDS, FORMAT_VERSION, HISTORIES, INFO, PROVENANCE, TASKS
from icrl4aht_data.reading.arrow_tables import EPISODE_COLUMNS
from icrl4aht_data.utils.files import write_json
from icrl4aht_data.writing import card
from icrl4aht_data.writing.card import card_facts, card_texts, episode_texts, rai_texts, render_card, write_card

KINDS_OF = {family: kind for kind, family in HEURISTIC_KINDS.items()}
LEFT_OUT = LeftOutTask("task", "demo_wide", "H1/t3", "ppo", 2, 128, 1.25, 2.5, "the learners did not learn")
Tasks = list[tuple[Task, Provenance, list[tuple[int, float, float]]]]
Change = Callable[[Provenance], Provenance]


def heuristic_task(layout: str, family: str, theta_id: int, split: str = "train", seed: int = 0) -> Task:
    teammate = {"kind": "heuristic", "family": KINDS_OF[family], "theta_id": theta_id}
    return make_task("teammate", split, layout, teammate | {"base_seed": int(split != "train"), "theta": {}}, seed)


def make_provenance(
    source: str, oracle: float = 40.0, distance: float = 0.25, behaviour: int | None = 0, nearest: str = "H3/t1"
) -> Provenance:
    expert = ExpertLabels(None if source == "noise" else "0" * 64, "greedy", None, oracle)
    return Provenance(
        source=source,
        learners=2 if source == "ppo" else None,
        references=ReferenceEgos(0.0, 1.5, oracle, 20),
        nearest_test=NearestTestTeammate(nearest, distance, behaviour),
        expert=expert,
    )


def four_tasks() -> Tasks:
    """Return a PPO task and a noise task with the same teammate, a validation task, and a task on coord_simple."""
    return [
        (heuristic_task("demo_wide", "H3", 12), make_provenance("ppo"), [(0, 0.0, 20.0), (1, 0.0, 4.0)]),
        (heuristic_task("demo_wide", "H3", 12, seed=1), make_provenance("noise"), [(0, 1.0, 41.0), (0, 0.0, 45.0)]),
        (heuristic_task("demo_wide", "H3", 7, "validation"), make_provenance("noise", 30, 0.02, 4), [(0, 2.0, 30.0)]),
        (heuristic_task("coord_simple", "H1", 0), make_provenance("ppo", 1.5, 0.5, None, "H1/t0"), [(0, 10.0, 10.0)]),
    ]


@pytest.fixture
def write_meta(lite, tmp_path, monkeypatch) -> Callable[..., dict[str, Any]]:
    """Return a function that writes the folder meta/ and returns the card's values; `change` edits the provenances."""
    like = read_index(lite[0]).entries[0]
    monkeypatch.setattr(card, "read_proof", lambda root: None)  # it reads chunk tables, which do not exist here

    def write_meta(tasks: Tasks | None = None, change: Change = lambda of: of, **fields: Any) -> dict[str, Any]:
        tasks, entries = four_tasks() if tasks is None else tasks, []
        for task, of_task, histories in tasks:
            for stream, (learner, start, end) in enumerate(histories):
                changes = {"history_id": len(entries), "task_id": task.task_id, "env_idx": stream, "learner": learner}
                changes |= {"layout": task.layout.name, "split": task.split, "obs_shape": task.layout.obs_shape}
                changes |= {"teammate_family": task.teammate_family, "teammate_kind": task.teammate_kind}
                changes |= {"shard": f"data/teammate/{task.layout.name}/{task.split}-00000-of-00001.h5"}
                changes |= {"source": of_task.source, "return_start": start, "return_end": end}
                changes |= {"has_oracle_actions": of_task.source == "noise"}
                changes |= of_task.entry_fields(like.episodes, fields.get("has_expert_actions", True)) | fields
                entries.append(msgspec.structs.replace(like, **changes))
        (tmp_path / "meta").mkdir(exist_ok=True)
        info = make_info("lite", "1.0.0", 20, entries, FORMAT_VERSION)
        write_json(tmp_path / INFO, replace(info, left_out=[LEFT_OUT], shards={"data/x.h5": 1}).to_json())
        (tmp_path / HISTORIES).write_text("".join(json.dumps(entry.to_json()) + "\n" for entry in entries))
        write_tasks(tmp_path / TASKS, [task for task, _, _ in tasks])
        write_json(tmp_path / PROVENANCE, {task.task_id: change(of_task).to_json() for task, of_task, _ in tasks})
        return card_facts(tmp_path)

    return write_meta


def test_card_lists_returns_by_layout_source_and_split(write_meta):
    content = write_meta()
    rows = [tuple(row.values()) for row in content["learning"]]
    assert rows == [
        ("demo_wide", "ppo", "train", 2, 0.0, 12.0, None, 0.5),
        ("demo_wide", "noise", "train", 2, 0.5, 43.0, None, 1.0),
        ("demo_wide", "noise", "validation", 1, 2.0, 30.0, None, 1.0),
        ("coord_simple", "ppo", "train", 1, 10.0, 10.0, None, 0.0),
    ]
    assert "| demo_wide | train | 0.0→12.0 (2) | 0.5→43.0 (2) |" in render_card(content)


def test_long_tables_are_written_to_card_json(write_meta, tmp_path):
    write_meta()
    write_card(tmp_path)
    tables = json.loads((tmp_path / "card.json").read_text())
    mates = {(row["layout"], row["teammate"]): row for row in tables["teammates"]}
    assert list(mates) == [("demo_wide", "H3/t12"), ("demo_wide", "H3/t7"), ("coord_simple", "H1/t0")]
    mate = mates["demo_wide", "H3/t12"]
    assert (mate["seed"], mate["sources"], mate["matters"]) == (0, ["noise", "ppo"], True)
    assert mate["references"] == {"stay": 0.0, "random": 1.5, "oracle": 40.0}
    assert mate["nearest_test"] == {"teammate": "H3/t1", "distance": 0.25, "behaviour": 0}
    assert tables["left_out"][0]["reason"] == "the learners did not learn"
    assert len(tables["learning"]) == 4


def test_card_names_teammates_that_behave_like_test_teammates(write_meta):
    content = write_meta()
    assert (content["drawn"], content["tested"], content["alike"]) == (["H1", "H3"], [], [])
    assert content["drawn_distance"] == 0.02, "the validation teammate's"
    assert "Hamming distance to every test teammate of the layout is 0.02 or more." in render_card(content)
    tasks = four_tasks()
    tasks[0] = (tasks[0][0], make_provenance("ppo", distance=0.006, nearest="H1/t0"), tasks[0][2])
    tasks[3] = (tasks[3][0], make_provenance("ppo", 1.5, 0.01, 0, "H1/t3"), tasks[3][2])
    content = write_meta(tasks)
    assert (content["drawn"], content["tested"]) == (["H3"], ["H1"])
    assert content["alike"] == ["H3 on demo_wide like H1/t0"]
    card = render_card(content)
    assert "(distance below 0.02): H3 on demo_wide like H1/t0." in card and "0.02 or more, with the exceptions" in card


def test_bundled_card_is_short_and_up_to_date():
    content = card_facts(MINI)
    assert (MINI / "README.md").read_text() == render_card(content)
    # The separator lines of tables do not count as words.
    words = [word for word in (MINI / "README.md").read_text().split() if word.strip("|:-")]
    assert len(words) <= 2500


def test_card_of_human_histories_says_only_what_is_true_of_them(write_meta):
    played = (heuristic_task("demo_wide", "H1", 0, "test"), make_provenance("human"), [(0, 0.0, 20.0)])
    content = write_meta([played], has_expert_actions=False)
    rai, card = rai_texts(content), render_card(content)
    assert rai["data_collection"].startswith("People play a simulated game with programs")
    assert rai["data_preprocessing_protocol"] == "Histories of human have all finished episodes."
    assert rai["data_annotation_protocol"] == "There are no labels. Nobody annotated anything by hand."
    assert "The people are volunteers" in rai["data_biases"] and "unequal" not in rai["data_biases"]
    assert "Teammates are scripts, not people." in rai["data_biases"]
    assert "Pseudonyms" in rai["personal_sensitive_information"]
    assert "delete their games" in rai["data_release_maintenance_plan"]
    assert [line.split(":")[0] for line in rai["data_limitations"][-1:]] == ["1 history of split `test`"]
    assert "No history has labels." in card and "expert_actions" not in card and "400 steps" not in card
    assert "Every episode has 20 steps." in card and "* 1 history of 1 task, " in card
    assert "`human` (1 history)" in card and "ten episodes" not in card and "## Teammates" not in card
    assert all(f"* {line}\n" in card for line in rai["data_limitations"])
    assert f"* Personal data: {rai['personal_sensitive_information']}\n" in card

    both = rai_texts(write_meta([*four_tasks(), played]))
    assert both["data_collection"].startswith("Programs and, in the source human, people play")
    assert both["data_preprocessing_protocol"].endswith("Histories of noise are complete and not selected.")
    assert "unequal" in both["data_biases"] and "Labels are actions" in both["data_annotation_protocol"]

    without = rai_texts(write_meta())
    assert without["personal_sensitive_information"] == "None."
    assert without["data_limitations"][-1] == "Nothing here shows how an agent plays with people."
    assert without.keys() == both.keys() == rai.keys()


def test_card_texts_describe_every_field():
    assert list(card_texts("arrays")) == list(FIELDS)
    assert list(card_texts("index")) == list(ENTRY_HINTS)
    assert list(episode_texts()) == list(EPISODE_COLUMNS)
    assert card_texts("episodes").keys() <= EPISODE_COLUMNS.keys()
