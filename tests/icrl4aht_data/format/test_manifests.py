"""Test that task ids equal the published ids, and that bundled manifests equal newly generated tasks."""

from __future__ import annotations

from dataclasses import replace

import pytest
from icrl4aht_generation.teammates.instances import published_tasks

from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks, write_tasks
from icrl4aht_data.errors import TaskFormatError
from tests.helpers.commands import run_cli

PUBLISHED_HASHES = """
grounded_coord_simple recipe_aware_button 9bc579c9 57546c8f ebc58b53 5f64c6e3 f465bd31
grounded_coord_simple territory a8e8ab9a bc4f0b61 3b5422bb a9c7323c 11317a0e
grounded_coord_simple assembly_line e9d1d6a7 b35d9f4b b6505f24 ca1d7650 05b992f2
grounded_coord_simple utility_greedy 558d1d4c 5d85685e 198bca4c 8c38c488 da2e3ef2
grounded_coord_ring recipe_aware_button 92b41a23 c0d02aa2 d8795d8e 4e3ba7f0 e8df39d7
grounded_coord_ring territory f7dbf29c 93e1c658 844b0aa7 23e9b8e5 0eb45338
grounded_coord_ring assembly_line 62365163 5e2d2515 6d9fb707 fe643dd9 940d2d37
grounded_coord_ring utility_greedy 877c0a07 7aaa9d3b 6cec8dbc 5365241a 9f81afc5
test_time_simple recipe_aware_button 00a62c79 f3eecd86 26f64955 17f0fc46 7a79b050
test_time_simple territory 5107b270 37db5c8a 3490108d 7c6fe13d 482430bf
test_time_simple assembly_line e88e9cec 9e06549a 5504993b 4684b40d e0868858
test_time_simple utility_greedy 91dd3323 8abd5f10 0d045966 e9242736 c0f8d047
test_time_wide recipe_aware_button f26f18c5 89f1def5 ad9bb6ec e56fc7f3 34326fcb
test_time_wide territory fe35f884 9a856dd3 d3b1b3de cc1e6f27 eb8fd66a
test_time_wide assembly_line 2b9f97a2 4f1ac704 9b5f65cd d1be54e5 8efcca50
test_time_wide utility_greedy 3aad05e9 6262d916 b1138fa7 d09e1e4d 57274783
demo_cook_simple recipe_aware_button beac8b0a 0b53434c c51d67c0 1ad5e7e8 8f57ff3a
demo_cook_simple territory 5683ebf3 50ae4f13 1b70f193 1159cb43 f6c237c5
demo_cook_simple assembly_line 3872ee65 b4396d3f 9ebfb86c 2c606234 db7af66b
demo_cook_simple utility_greedy 31ad4268 5e6ff0f0 22ea65db a552a220 e467f707
demo_cook_wide recipe_aware_button ea8a2cf4 57d60de1 82eb2429 727c7e73 ae1469a7
demo_cook_wide territory e2e7bcb2 93d58f86 57047bb7 34aaad60 2d31b4a5
demo_cook_wide assembly_line 3668a1fa 4fe08ce9 5249fe9b 552c6cea 80d0f285
demo_cook_wide utility_greedy bb62174b 4e5d0c92 b4680bc4 532bd9a0 a5357b43
asymm_advantages_recipes_right recipe_aware_button a1ede2b0 79c8b352 fec5c389 e69da722 e2f9e3f4
asymm_advantages_recipes_right territory 428e2110 fb16a45d 56df07f9 d89af667 f9a02ae7
asymm_advantages_recipes_right assembly_line 796a4253 480ed924 eaad6d29 0d3b2344 136a45db
asymm_advantages_recipes_right utility_greedy bbb17eed 8e57d27a 8cd36136 a7c97cbe dd4311eb
cramped_room_down recipe_aware_button 086eff6f 77c8e5ce 0029aefe 689c0389 0ca41ed2
cramped_room_down territory 229854ed 73147ab2 46b6671c 9689935d ee72bb75
cramped_room_down assembly_line c3cea66f e9b6dbce 469082c1 eed5b8fd 78575c63
cramped_room_down utility_greedy 187d848e ed1fd3ea 4016d5da 610b126b c35fde55
"""
"""layout, family, and the last eight digits of the ids of t0..t4, as the published manifests have them."""


def test_task_ids_equal_the_160_published_ids():
    expected = []
    for line in PUBLISHED_HASHES.split("\n")[1:-1]:
        layout, family, *hashes = line.split()
        track = "layout" if layout in ("asymm_advantages_recipes_right", "cramped_room_down") else "teammate"
        expected += [f"{track}_test_{layout}_{family}_t{t}_s0_{digits}" for t, digits in enumerate(hashes)]
    assert len(expected) == 160
    assert [task.task_id for track in TRACKS for task in published_tasks(track)] == expected


@pytest.mark.parametrize("track", TRACKS)
def test_bundled_manifests_have_the_layouts_of_their_split(track):
    found = {task.layout.name for task in read_tasks(manifest_path(track, "validation"))}
    assert found <= {*TRACKS[track]["validation"]}
    for split in ("train", "validation"):
        found = {task.layout.name for task in read_tasks(manifest_path(track, split, "diverse"))}
        assert found == {*TRACKS[track]["train"]}


def test_manifests_check_command_fails_on_a_difference(monkeypatch, tmp_path):
    short = tmp_path / "short.jsonl"
    write_tasks(short, published_tasks("layout")[:-1])
    run_cli("research manifests --check")
    monkeypatch.setattr("icrl4aht_generation.commands.manifest_path", lambda track, split, teammates="": short)
    monkeypatch.setattr(
        "icrl4aht_generation.teammates.draws.diverse_tasks", lambda track, split: []
    )  # drawing these tasks takes a second
    with pytest.raises(TaskFormatError, match="the file's tasks differ from the tasks of this version"):
        run_cli("research manifests --check")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"family": "utility"}, r"line 1: unknown heuristic family 'utility'.*Did you mean 'utility_greedy'"),
        ({"slot": 0}, r"line 1: teammate: Invalid enum value 0 - at `\$\.slot`"),
        ({"colour": "red"}, r"line 1: teammate: .*unknown field `colour`; expected the fields "),
        ({"theta": [1]}, r"line 1: teammate: expected `object`, got `array` - at `\$\.theta`"),
    ],
)
def test_invalid_teammate_raises_error_with_line_and_fault(tmp_path, change, message):
    task = published_tasks("layout")[0]
    path = tmp_path / "tasks.jsonl"
    write_tasks(path, [replace(task, teammate=task.teammate | change)])
    with pytest.raises(TaskFormatError, match=message):
        read_tasks(path)
