"""Tasks: a task is a layout, a teammate and a seed, stored as one JSON line of a manifest or of meta/tasks.jsonl.

    {"task_id": ..., "track": "teammate", "split": "train", "layout_name": "demo_cook_wide", "seed": 0,
     "teammate": {"kind": "heuristic", "family": "utility_greedy", "theta_id": 0, "base_seed": 0, "theta": {...}}}

A task's id ends in a hash of its other fields, so a changed task has another id.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from icrl4aht_data.benchmark.facts import (
    ALGORITHMS,
    ALL_TRACKS,
    HEURISTIC_KINDS,
    SPLITS,
    TEAMMATE_PLUGINS,
    check_family,
    check_layout_in_split,
    kind_family,
)
from icrl4aht_data.errors import Icrl4ahtError, OptionError, TaskFormatError, check_choice, unknown_name
from icrl4aht_data.overcooked.layouts import Layout, get_layout, with_recipes
from icrl4aht_data.utils.files import is_safe_path, json_hash, parse_json, read_lines, write_atomically

Dish = tuple[int, int, int]
"""Ids of the three ingredients of a dish."""

_S = TypeVar("_S", bound=msgspec.Struct)

_HASHED = ("kind", "family", "theta_id", "base_seed", "theta")


@dataclass(frozen=True)
class Task:
    """One task of the benchmark: a layout, a teammate and a seed.

    Args:
        task_id: name of the task, made from the other fields by `task_id`.
        track: "teammate", "layout" or "preference".
        split: "train", "validation", "test" or "heldout".
        layout_name: the layout's environment name, as in the published manifests.
        seed: seed of the ego's training.
        teammate: kind, family, theta_id, base_seed and theta. For kind "heuristic", theta contains the parameters; for
            kind "rl", the checkpoint's folder within its suite and the sha256 of its weights.
        recipes: recipes that replace the layout's recipes, as triples of ingredient ids; None keeps the layout's. With
            a single recipe, all episodes of the task want the same dish.
    """

    task_id: str
    track: str
    split: str
    layout_name: str
    seed: int
    teammate: dict[str, Any]
    recipes: tuple[Dish, ...] | None = None

    @property
    def layout(self) -> Layout:
        """Layout of the task's environment, with the recipes of the task."""
        layout = get_layout(self.layout_name)
        return layout if self.recipes is None else with_recipes(layout, self.recipes)

    @property
    def teammate_key(self) -> tuple[str, str]:
        """Layout name and hash; tasks with the same teammate, layout and recipes have equal keys."""
        return self.layout.name, json_hash(self.teammate if self.recipes is None else [self.teammate, self.recipes])

    @property
    def teammate_kind(self) -> str:
        """Value of the index field `teammate_kind`: name of the heuristic, or of the training algorithm."""
        return self.teammate["family"]

    @property
    def teammate_family(self) -> str:
        """Value of the index field `teammate_family`: rl, H1..H4, or the name of a registered heuristic."""
        return "rl" if self.teammate["kind"] == "rl" else HEURISTIC_KINDS.get(self.teammate_kind, self.teammate_kind)


@dataclass(frozen=True)
class NamedTask(Task):
    """A task known only from the index of a release, with unknown parameters of the teammate and seed -1.

    Args:
        teammate: the fields teammate_kind and teammate_family of the index line.
    """

    @property
    def teammate_kind(self) -> str:
        return self.teammate["teammate_kind"]

    @property
    def teammate_family(self) -> str:
        return self.teammate["teammate_family"]


def named_task(line: Mapping[str, Any]) -> NamedTask:
    """Return the task named by an index line that has only the fields of the published format.

    Raises:
        UnknownNameError: for names that the benchmark does not know.
    """
    layout = get_layout(line["layout"])
    check_layout_in_split(line["track"], line["split"], layout.name)
    check_family(line["teammate_family"])
    teammate = {name: line[name] for name in ("teammate_kind", "teammate_family")}
    return NamedTask(line["task_id"], line["track"], line["split"], layout.alias, -1, teammate)


def teammate_id(teammate: Mapping[str, Any]) -> str:
    """Return an id of 16 hexadecimal digits, equal for teammates with the same kind and policy.

    Args:
        teammate: kind and theta, as in a task. A heuristic's numbers are rounded to single precision first, since
            some manifests round them.
    """
    theta = teammate["theta"]
    if teammate["kind"] == "rl":
        return theta["sha256"][:16]
    return json_hash({name: float(np.float32(value)) for name, value in theta.items()})


def make_task(
    track: str,
    split: str,
    layout: str,
    teammate: dict[str, Any],
    seed: int,
    recipes: Sequence[Dish] | None = None,
) -> Task:
    """Return the task with the given fields, and compute its id.

    Raises:
        UnknownNameError: if the layout does not belong to this split of the track.
        TaskFormatError: if a recipe occurs twice, or needs an ingredient that the layout does not have.
    """
    known = get_layout(layout)
    check_layout_in_split(track, split, known.name)
    task = Task("", track, split, known.alias, seed, teammate, None if recipes is None else tuple(recipes))
    task = replace(task, task_id=task_id(task))
    _check_recipes(task)
    return task


def task_id(task: Task) -> str:
    """Return a task's id: `{track}_{split}_{layout}_{family}_t{theta_id}_s{seed}_{hash8}`, as in published manifests.

    hash8 is the first 8 hexadecimal digits of the SHA-256 of `track:split:layout:<repr of the teammate>:seed`. If the
    task replaces the layout's recipes, the hashed text also has `:` and the recipes at its end, such as `:000,001`.
    """
    teammate, where = task.teammate, (task.track, task.split, task.layout_name)
    spec = {name: teammate[name] for name in _HASHED if name in teammate}
    text = f"{':'.join(where)}:{spec!r}:{task.seed}"
    if task.recipes is not None:
        text += ":" + ",".join("".join(map(str, recipe)) for recipe in task.recipes)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return f"{'_'.join(where)}_{teammate['family']}_t{teammate.get('theta_id', 0)}_s{task.seed}_{digest}"


def manifest_path(track: str, split: str, teammates: Literal["", "diverse"] = "") -> Path:
    """Return the path of the bundled manifest of a track's tasks.

    Args:
        track: name of the track, such as "teammate".
        split: "test" or "validation", or "train" for diverse teammates and the track "preference".
        teammates: "diverse" for training or validation tasks with teammates that vary in all parameters that decide a
            teammate's behaviour.

    Raises:
        UnknownNameError: for an unknown track or split.
    """
    check_choice("track", track, ALL_TRACKS)
    check_choice("split", split, SPLITS)
    return Path(__file__).parent.parent / "manifests" / f"{'_'.join(filter(None, (track, teammates, split)))}.jsonl"


def read_tasks(path: Path) -> list[Task]:
    """Return the tasks of a JSONL file.

    Raises:
        TaskFormatError: if a line is malformed or repeats a task id; the message names the file and the line.
    """
    tasks: dict[str, Task] = {}
    for number, line in enumerate(read_lines(path), start=1):
        try:
            task = parse_task(parse_json(line))
            if task.task_id in tasks:
                raise TaskFormatError(f"task_id {task.task_id!r} occurs twice; remove one of the lines")
        except Icrl4ahtError as error:
            raise TaskFormatError(f"{path}, line {number}: {error}") from error
        tasks[task.task_id] = task
    return list(tasks.values())


def write_tasks(path: Path, tasks: Iterable[Task]) -> None:
    """Write tasks to a JSONL file atomically, one line per task."""
    write_atomically(path, "".join(json.dumps(task_fields(task)) + "\n" for task in tasks))


def task_fields(task: Task) -> dict[str, Any]:
    """Return the fields of a task's manifest line, without `recipes` if the task uses the layout's recipes."""
    fields = asdict(task)
    return fields if task.recipes is not None else {name: fields[name] for name in fields if name != "recipes"}


class _RlTheta(msgspec.Struct, forbid_unknown_fields=True):
    """Fields of the entry `theta` of a learned teammate."""

    checkpoint: str
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class _Teammate(msgspec.Struct, forbid_unknown_fields=True):
    """Fields of a task's `teammate`; manifests of the published code may also have the teammate's slot."""

    kind: Literal["heuristic", "rl"]
    family: str
    theta_id: Any
    base_seed: Any
    theta: dict[str, Any]
    slot: Literal[1] = 1  # the teammate's agent number, `actions.TEAMMATE`


class _TaskFields(msgspec.Struct, forbid_unknown_fields=True):
    task_id: str
    track: str
    split: str
    layout_name: str
    seed: Annotated[int, Meta(gt=-(2**63), le=2**63 - 1)]
    teammate: dict[str, Any]
    recipes: tuple[Dish, ...] | None = None


def parse_task(fields: Any) -> Task:
    """Parse the fields of a manifest line as a task; this is the inverse of `task_fields`.

    Raises:
        TaskFormatError: for missing or unknown fields, or impossible values.
        UnknownNameError: for names that the benchmark does not know.
    """
    task = Task(**msgspec.structs.asdict(_convert(fields, _TaskFields, "")))
    _check_recipes(task)
    check_layout_in_split(task.track, task.split, task.layout.name)
    check_teammate(task.teammate)
    if task.task_id != (expected := task_id(task)):
        raise TaskFormatError(f"task_id {task.task_id!r} does not match the task's content, expected {expected!r}")
    return task


def _check_recipes(task: Task) -> None:
    """Check that the recipes of a task can be cooked on its layout.

    Raises:
        TaskFormatError: if the recipes are empty, if two have the same ingredients, or if an ingredient has no pile.
    """
    if task.recipes is None:
        return
    try:
        _ = task.layout
    except OptionError as error:
        raise TaskFormatError(f"recipes: {error}") from error


def check_teammate(teammate: dict[str, Any]) -> None:
    """Check the fields of a task's teammate entry, except the parameters of a heuristic.

    Raises:
        TaskFormatError: for missing or unknown fields, or impossible values.
        UnknownNameError: for a family that does not exist.
    """
    found = _convert(teammate, _Teammate, "teammate: ")
    family, is_heuristic = kind_family(found.family), found.kind == "heuristic"
    if family is None or (family == "rl") == is_heuristic:
        kinds = (*HEURISTIC_KINDS, *TEAMMATE_PLUGINS.names) if is_heuristic else ALGORITHMS
        raise unknown_name(f"{found.kind} family", found.family, kinds)
    if not is_heuristic:
        checkpoint = _convert(found.theta, _RlTheta, "teammate.theta: ").checkpoint
        if not is_safe_path(checkpoint):
            raise TaskFormatError(
                f"teammate.theta.checkpoint: expected a path in the teammate suite, found {checkpoint[:200]!r}"
            )


def _convert(fields: Any, kind: type[_S], where: str) -> _S:
    """Convert a JSON value to a struct.

    Raises:
        TaskFormatError: if a field is missing, unknown or has an impossible value; the message names the field.
    """
    try:
        return msgspec.convert(fields, kind)
    except msgspec.ValidationError as error:
        raise TaskFormatError(
            f"{where}{str(error).replace('Expected', 'expected')}; expected the fields "
            f"{', '.join(kind.__struct_fields__)}, found {fields!r:.300}"
        ) from error
