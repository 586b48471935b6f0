"""Test that the index, read as columns, equals the lines of meta/histories.jsonl."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from icrl4aht_data.errors import EmptySelectionError, IndexFormatError, UnknownNameError
from icrl4aht_data.format.index import Index, read_index
from icrl4aht_data.format.schema import Entry
from tests.helpers.random_releases import write_long_index


@pytest.fixture(scope="module")
def release_with_long_histories(tmp_path_factory) -> tuple[Path, list[Entry]]:
    root = tmp_path_factory.mktemp("long") / "release"
    return root, write_long_index(root)


def test_index_entries_equal_the_written_lines(release_with_long_histories):
    index = read_index(release_with_long_histories[0])
    assert list(index.entries) == release_with_long_histories[1]
    assert index.entries[-1] == release_with_long_histories[1][-1]


@pytest.fixture
def read_changed_index(release_with_long_histories, tmp_path) -> Callable[[Callable[[list[str]], str]], Index]:
    """Return a function that changes the lines of a long index and reads the changed index."""
    shutil.copytree(release_with_long_histories[0] / "meta", tmp_path / "meta")
    path = tmp_path / "meta" / "histories.jsonl"
    lines = path.read_text().splitlines()

    def write_and_read(change: Callable[[list[str]], str]) -> Index:
        path.write_text(change(lines), newline="")
        return read_index(tmp_path)

    return write_and_read


@pytest.mark.parametrize(
    "change",
    [
        lambda lines: "".join(
            json.dumps(json.loads(line), separators=(",", ":"), sort_keys=True) + "\n" for line in lines
        ),
        lambda lines: "\n".join(lines),
        lambda lines: "".join(f" {line} \r\n" for line in lines),
    ],
    ids=["compact", "no last newline", "spaces"],
)
def test_index_lines_may_differ_in_json_formatting(release_with_long_histories, read_changed_index, change):
    assert list(read_changed_index(change).entries) == release_with_long_histories[1]


@pytest.mark.parametrize(
    ("change", "number"),
    [
        (lambda lines: [*lines[:7], "", *lines[7:]], 8),
        (lambda lines: [*lines[:7], f"{lines[7]} {lines[8]}", *lines[9:]], 8),
        (lambda lines: [lines[0][:20], f"{lines[0][20:]} {lines[1]}", *lines[2:]], 1),
        (lambda lines: [*lines[:7], lines[7].replace('"T": ', '"T": 0'), *lines[8:]], 8),
        (lambda lines: [*lines[:7], lines[7].replace('"score": ', '"score": NaN, "x": '), *lines[8:]], 8),
    ],
    ids=["empty", "two on one line", "one on two lines", "leading zero", "not finite"],
)
def test_index_line_that_is_not_one_json_object_raises_error(read_changed_index, change, number):
    with pytest.raises(IndexFormatError, match=rf"histories\.jsonl, line {number}: "):
        read_changed_index(lambda lines: "".join(f"{line}\n" for line in change(lines)))


def test_index_queries_match_a_scan_of_all_entries(release_with_long_histories):
    root, entries = release_with_long_histories
    index = read_index(root)
    for wanted in (
        {},
        {"layout": ["demo_wide", "cramped_up"], "split": ["train"]},
        {name: [getattr(entries[5], name)] for name in ("teammate_family", "teammate_kind", "track")},
        {"task_id": [entries[777].task_id]},
        {"source": ["ppo", "source_0"], "split": ["train"]},
        {"task_id": [entries[777].task_id, entries[1].task_id], "layout": [entries[1].layout]},
    ):
        found = [entry for entry in entries if all(getattr(entry, name) in wanted[name] for name in wanted)]
        assert index.query(**wanted).tolist() == [entry.history_id for entry in found], wanted
    for value, one in (("demo_wide", "demo_cook_wide"), ("cramped_up", "cramped_room_up")):
        assert index.query(layout=[value]).tolist() == index.query(layout=one).tolist()
    with pytest.raises(EmptySelectionError, match="no history has split='test'"):
        index.query(split="test")
    with pytest.raises(UnknownNameError, match="unknown task_id"):
        index.query(task_id=entries[0].task_id[:-1] + "x" * 99)


@pytest.mark.parametrize("where", [0, 1500, 2999])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 99999}, "found 99999 episodes in"),
        ({"has_teammate_actions": False}, "has_teammate_actions true"),
        ({"seed": 2**63}, r"Expected `int` <= 9223372036854775807 - at `\$\.seed`"),
    ],
)
def test_error_names_the_number_of_an_invalid_index_line(read_changed_index, where, change, message):
    def damage_line(lines: list[str]) -> str:
        lines[where] = json.dumps(json.loads(lines[where]) | change)
        return "\n".join(lines)

    with pytest.raises(IndexFormatError, match=rf"histories\.jsonl, line {where + 1}: .*({message})"):
        read_changed_index(damage_line)
