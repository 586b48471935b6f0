"""Tables of the dataset card: learning by source, teammates, labels, and what is left out."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO

import msgspec
import pytest
from rich.console import Console

from icrl4aht_data.benchmark.facts import HEURISTIC_KINDS
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.format.info import LeftOutTask
from icrl4aht_data.format.provenance import ExpertLabels, NearestTest, Provenance, ReferenceEgos
from icrl4aht_data.format.schema import Entry
from icrl4aht_data.writing import card_tables
from icrl4aht_data.writing.card_content import CardContent, read_content
from icrl4aht_data.writing.dataset_card import render_card

KINDS_OF = {family: kind for kind, family in HEURISTIC_KINDS.items()}
LEFT_OUT = LeftOutTask("task", "demo_wide", "H1/t3", "ppo", 2, 128, 1.25, 2.5, "the learners did not learn")
UNHOSTED = LeftOutTask("", "demo_wide", "H4", "", 0, 0, None, None, "all 32 draws act like a test teammate")


def drawn(layout: str, family: str, theta_id: int, split: str = "train", seed: int = 0) -> Task:
    teammate = {"kind": "heuristic", "family": KINDS_OF[family], "theta_id": theta_id}
    return make_task("teammate", split, layout, teammate | {"base_seed": int(split != "train"), "theta": {}}, seed)


def made(
    source: str, oracle: float = 40.0, distance: float = 0.25, behaviour: int | None = 0, nearest: str = "H3/t1"
) -> Provenance:
    expert = ExpertLabels(None if source == "noise" else "0" * 64, "greedy", None, oracle)
    return Provenance(
        source=source,
        learners=2 if source == "ppo" else None,
        references=ReferenceEgos(0.0, 1.5, oracle, 20),
        nearest_test=NearestTest(nearest, distance, behaviour),
        expert=expert,
    )


@pytest.fixture
def content(lite) -> CardContent:
    """Four tasks: two learners with a teammate on demo_wide, noise with it, a validation teammate, and coord_simple."""
    base = read_content(lite[0])
    tasks = [
        (drawn("demo_wide", "H3", 12), made("ppo"), [(0, 0.0, 20.0), (1, 0.0, 4.0)]),
        (drawn("demo_wide", "H3", 12, seed=1), made("noise"), [(0, 1.0, 41.0), (0, 0.0, 45.0)]),
        (drawn("demo_wide", "H3", 7, "validation"), made("noise", 30, 0.02, 4), [(0, 2.0, 30.0)]),
        (drawn("coord_simple", "H1", 0), made("ppo", 1.5, 0.5, None, "H1/t0"), [(0, 10.0, 10.0)]),
    ]
    entries: list[Entry] = []
    for task, provenance, histories in tasks:
        for stream, (learner, start, end) in enumerate(histories):
            changes = {
                "history_id": len(entries),
                "task_id": task.task_id,
                "env_idx": stream,
                "layout": task.layout.name,
                "split": task.split,
                "teammate_family": task.teammate_family,
                "teammate_kind": task.teammate_kind,
                "learner": learner,
                "source": provenance.source,
                "return_start": start,
                "return_end": end,
                "has_oracle_actions": provenance.source == "noise",
                **provenance.entry_fields(),
            }
            entries.append(msgspec.structs.replace(base.entries[0], **changes))
    return replace(
        base,
        info=replace(base.info, left_out=[LEFT_OUT, UNHOSTED]),
        entries=entries,
        tasks=[task for task, _, _ in tasks],
        provenance={task.task_id: provenance for task, provenance, _ in tasks},
    )


def test_learning_by_layout_and_source(content):
    table = card_tables.curves_table(content)
    assert "| demo_wide | ppo | train | H3 | 1 | 2 | 2 | 240 | 0.0 | 12.0 | 50% |" in table
    assert "| demo_wide | noise | train | H3 | 1 |  | 2 | 240 | 0.5 | 43.0 | 100% |" in table
    assert "| demo_wide | noise | validation | H3 | 1 |  | 1 | 120 | 2.0 | 30.0 | 100% |" in table
    assert "| **with headroom** | noise | all | H3 | 2 |  | 3 | 360 | 1.0 | 38.7 | 100% |" in table
    assert "| **without headroom** | ppo | all | H1 | 1 | 1 | 1 | 120 | 10.0 | 10.0 | 0% |" in table


def test_totals_of_a_release_whose_headroom_is_unknown(content):
    unknown = replace(content, provenance={})
    assert "| **all** | ppo | all | H1 H3 | 2 | 3 | 3 | 360 | 3.3 | 11.3 | 33% |" in card_tables.curves_table(unknown)
    assert card_tables.teammates_table(unknown) == "How the teammates act was not measured."


def test_teammates_with_references_distance_and_behaviour(content):
    table = card_tables.teammates_table(content)
    assert "| demo_wide | train | H3/t12 | 0 | ppo, noise | 0.0 | 1.5 | 40.0 |  | yes | H3/t1 | 0.250 | 0 |" in table
    assert "| demo_wide | validation | H3/t7 | 1 | noise | 0.0 | 1.5 | 30.0 |  | yes | H3/t1 | 0.020 | 4 |" in table
    assert "| coord_simple | train | H1/t0 | 0 | ppo | 0.0 | 1.5 | 1.5 |  | no | H1/t0 | 0.500 |  |" in table
    assert "Split train: 1 teammate of known behaviour, 1 different behaviour." in table
    assert "Of the behaviours of validation (1), 0 also occur in training" in table


def test_drawn_teammates_that_act_like_another_family_of_the_test_are_named(content):
    """Only the own family of a drawn teammate excludes it, so the card says which act like another one."""
    first, own = content.tasks[0], "None acts like a test teammate of its own family"
    assert own in render_card(content)
    assert "another family (distance below" not in render_card(content)
    near = {first.task_id: made("ppo", distance=0.006, nearest="H1/t0")}
    card = render_card(replace(content, provenance=dict(content.provenance) | near))
    assert own in card
    assert "(distance below 0.02): H3 on demo_wide like H1/t0." in card


def test_long_tables_are_summarized(content, monkeypatch):
    monkeypatch.setattr(card_tables, "LONGEST_TABLE", 2)
    other = drawn("demo_wide", "H3", 13, seed=2)
    more = replace(
        content,
        tasks=[*content.tasks, other],
        provenance=dict(content.provenance) | {other.task_id: made("noise", 4.0, 0.5, 0, "H3/t2")},
    )
    table = card_tables.teammates_table(more)
    expected = (
        "| demo_wide | train | H3 | 2 | 1 | 1 of 2 | 0.0 | 1.5 | 4.0 to 40.0 |  | H3/t1, H3/t2 | 0.250 to 0.500 |"
    )
    assert expected in table
    assert "H3/t12" not in table
    labels = card_tables.labels_table(content)
    assert "| demo_wide | noise | train | 1 | 40.0 |  | 43.0 | 0 |" in labels


def test_labels_of_a_script_have_no_step(content):
    table = card_tables.labels_table(content)
    assert "| demo_wide | noise | train | H3/t12 | script | 40.0 |  | 43.0 |" in table
    assert "| demo_wide | ppo | train | H3/t12 | unknown | 40.0 | unknown | 12.0 |" in table


def test_the_card_says_what_is_left_out_and_what_sources_are_not(content):
    card = render_card(content)
    assert "| demo_wide | H1/t3 | ppo | 2 | 128 | 1.2 | 2.5 | the learners did not learn |" in card
    assert "| demo_wide | H4 |  |  |  |  |  | all 32 draws act like a test teammate |" in card
    assert "Sources: `ppo` (3 histories), `noise` (3 histories)." in card
    assert "the script knows the full state" in card
    assert "must infer what the script knew" in card
    assert "Labels: expert actions in every history, oracle actions in 3 histories." in card
    assert "It is the last checkpoint" not in card, "no greedy return of the last checkpoint is known"
    assert "No headroom: on coord_simple the ego hardly matters." in card
    assert 'labels="oracle"' in card


def test_teammates_that_act_like_the_test_are_named(content):
    near = [task.task_id for task in content.tasks if task.layout.name == "coord_simple"]
    content = replace(content, provenance=dict(content.provenance) | {near[0]: made("ppo", 1.5, 0.01, 0, "H1/t3")})
    card = render_card(content)
    assert "Training and validation teammates of H3 are heuristics whose parameters were drawn" in card
    assert "Its training teammates H1 are heuristics, in place of the learned teammates" in card


def test_tasks_that_hardly_rise_are_named(content):
    flat = [
        msgspec.structs.replace(entry, return_end=entry.return_start + 9.5) if entry.source == "ppo" else entry
        for entry in content.entries
    ]
    card = render_card(replace(content, entries=flat))
    assert "In 1 task on layouts with headroom the end exceeds the start by less than 10: demo_wide with H3/t12" in card
    assert "(ppo, 9.5)" in card
    assert "coord_simple with" not in card


def test_the_schedules_of_noise_are_stated(content):
    schedules = {"histories": 8, "episodes": 60, "start": [0.9, 1.0], "end": [0.0, 0.0]}
    noise = schedules | {"begin": [0.0, 0.3], "finish": [0.6, 1.0], "power": [0.5, 2.0]}
    made_so = {task_id: replace(of_task, noise=noise) for task_id, of_task in content.provenance.items()}
    card = render_card(replace(content, provenance=made_so))
    assert "8 histories of 60 episodes a task" in card
    assert "(0.90 to 1.00) and its last (0.00)" in card.replace("\n", " ")


def test_learning_is_printed(content):
    output = StringIO()
    card_tables.print_learning(content, Console(file=output, width=80))
    text = output.getvalue()
    assert "without headroom  ppo" in text
    assert "demo_wide         noise   train" in text
    assert "*" not in text
    assert "left out: demo_wide with H1/t3 (ppo): the learners did not learn" in text
    assert "left out: demo_wide with H4: all 32 draws act like a test teammate" in text


def test_oracle_labels_that_earn_little_are_named(content):
    assert "it earns less than half" not in render_card(content)  # noise histories, which end as the oracle does
    labelled = replace(
        content, entries=[msgspec.structs.replace(entry, has_oracle_actions=True) for entry in content.entries]
    )
    text = render_card(labelled)
    assert "in 1 task of ppo on coord_simple it earns less than half of what the histories earn at their end" in text
    assert "on demo_wide it earns less" not in text
