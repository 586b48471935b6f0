"""Test meta/info.json and meta/provenance.json: round trips and malformed content."""

from __future__ import annotations

import json

import pytest

from icrl4aht_data.dataset import MINI
from icrl4aht_data.errors import IndexFormatError
from icrl4aht_data.format.info import ReleaseInfo, read_info
from icrl4aht_data.format.provenance import Provenance, ReferenceEgos, read_provenance
from icrl4aht_data.format.schema import INFO, PROVENANCE
from icrl4aht_data.utils.files import write_json


def test_info_and_provenance_of_the_bundled_release_round_trip(tmp_path):
    write_json(tmp_path / "info.json", read_info(MINI).to_json())
    assert (tmp_path / "info.json").read_bytes() == (MINI / INFO).read_bytes()
    found = read_provenance(MINI / PROVENANCE)
    content = {task_id: of_task.to_json() for task_id, of_task in found.items()}
    write_json(tmp_path / "provenance.json", content, indent=None)
    assert (tmp_path / "provenance.json").read_bytes() == (MINI / PROVENANCE).read_bytes()


def test_headroom_of_a_learned_teammate_uses_its_self_play_return():
    assert not ReferenceEgos(2.0, 4.75, 6.0, 20).returns_differ
    learned = ReferenceEgos(2.0, 4.75, 6.0, 20, self_play=10.0)
    assert learned.returns_differ
    assert learned.describe() == "stay 2.0, random 4.8, oracle 6.0, self-play 10.0"
    for references in (learned, ReferenceEgos(2.0, 4.75, 6.0, 20)):
        made = Provenance(references=references)
        assert Provenance.from_json(made.to_json()) == made
    assert "self_play" not in made.to_json()["references"]


def test_provenance_keeps_expert_fields_and_unknown_fields():
    labels = {"policy_sha256": "ab" * 32, "action": "greedy", "step": 7, "return_greedy": 0.0, "return_sampled": 16.9}
    note = {"xla_threads": 2, "expert": labels | {"episodes": 200, "last_return_greedy": -1.0}}
    note |= {"laboratory": {"city": "elsewhere"}, "other": [1]}
    found = Provenance.from_json(note)
    assert found.to_json() == note
    described = {"expert_return": 0.0, "expert_return_sampled": 16.9, "expert_step": 7}
    assert found.entry_fields(2, True) == described | {"label_view": None, "teammate_of_episode": None}
    old = {"expert": {"policy_sha256": "ab" * 32, "action": "greedy"}}
    assert Provenance.from_json(old).to_json() == old
    assert set(Provenance.from_json(old).entry_fields(2, True).values()) == {None}
    assert set(found.entry_fields(2, False).values()) == {None}


@pytest.mark.parametrize(
    ("note", "message"),
    [
        ({"seed": "3"}, r"Expected `int \| null`, got `str` - at `\$\.seed`"),
        ({"ego": {"total_steps": 1}}, "missing required field `environments`"),
        ({"streams_recorded": -1}, "Expected `int` >= 0"),
        ({"expert": {"policy_sha256": "0" * 64, "action": "", "return_greedy": 1e300}}, "Expected `float` <"),
        ({"filter": {"before": {}, "after": {}}}, "missing required field `streams`"),
        ([], "expected a JSON object"),
    ],
)
def test_malformed_provenance_raises_error_that_names_the_fault(tmp_path, note, message):
    (tmp_path / "provenance.json").write_text(json.dumps({"task": note}))
    with pytest.raises(IndexFormatError, match=rf"provenance\.json: malformed provenance of task 'task': .*{message}"):
        read_provenance(tmp_path / "provenance.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "heavy"}, "Invalid enum value 'heavy'"),
        ({"environment": {"max_steps": 400, "kept_steps": 0}}, "Expected `int` >= 1"),
        ({"environment": {"max_steps": 400, "kept_steps": 100, "speed": 2}}, "unknown field `speed`"),
        ({"data_version": "1.0.0-.."}, r"data version '1\.0\.0-\.\.': expected a SemVer version such as 1.0.0"),
    ],
)
def test_malformed_info_raises_error_that_names_the_fault(change, message):
    content = json.loads((MINI / INFO).read_text())
    with pytest.raises(IndexFormatError, match=message):
        ReleaseInfo.from_json(content | change)
