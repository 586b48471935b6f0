"""Best responses: for each teammate, the return of the best known ego with the benchmark's view.

The file `cards/best_responses.json` stores the best responses. A best response is a recurrent ego that was trained with
one teammate, or a stored model of the page of results that earned more. On the track `preference` it is an informed
ego, which also observes the task's number, see `icrl4aht_data.benchmark.adaptation`. Tasks share a best response if
their teammates behave the same.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import msgspec

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import write_atomically
from icrl4aht_data.utils.install_hints import RESTORE
from icrl4aht_data.utils.text import card_file


class TrainingRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One training run of an ego with one teammate, or of an informed ego.

    Attributes:
        seed: seed of the training run.
        steps: environment steps of the training run.
        width: number of features and of recurrent units of the ego's network.
        mean_return: mean return per episode of the trained ego; stored as `return` in the file.
        choice: mean return in the episodes that decide which training run is the best.
        acting: "greedy" or "sampled" actions, whichever earned more in the episodes of `choice`; "sampled" for
            informed egos.
        slope: rise of the mean return from the third to the last quarter of the steps of the training run.
        init: name of the bundled model that the training run started from; empty for random parameters.
        tasks: number of tasks of the training run. If there are several, the ego is an informed ego, see
            `icrl4aht_data.benchmark.adaptation`.
    """

    seed: int
    steps: int
    mean_return: float = msgspec.field(name="return")
    width: int = 128
    choice: float | None = None
    acting: str = ""
    slope: float | None = None
    init: str = ""
    tasks: int = 1


class BestResponse(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The best response to one behaviour of a teammate.

    Attributes:
        layout: short name of the layout.
        family: family of the teammate.
        split: split of the tasks.
        tasks: ids of the tasks whose teammates show this behaviour.
        seeds: training runs of egos with a teammate of this behaviour.
        best: mean return of the best ego; training runs and models are chosen by other episodes.
        agent: name of the ego with the highest mean return over all seeds, such as "best response, seed 1".
    """

    layout: str
    family: str
    split: str
    tasks: tuple[str, ...]
    seeds: tuple[TrainingRun, ...]
    best: float
    agent: str


class BestResponseCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of `cards/best_responses.json`.

    Attributes:
        version: hash that changes whenever a best response changes.
        protocol: name of the protocol under which the returns were measured.
        about: sentences that say how the returns were measured.
        behaviours: the best responses, one for each behaviour of a teammate.
    """

    version: str
    protocol: str
    about: str
    behaviours: tuple[BestResponse, ...] = ()


def best_training_run(trainings: Iterable[TrainingRun]) -> TrainingRun:
    """Return the training run with the highest `choice`, the mean return in the episodes that decide between runs.

    Of runs without `choice`, the first of those with the most steps is returned.
    """
    return max(trainings, key=lambda one: (-math.inf, one.steps) if one.choice is None else (one.choice, 0))


def best_responses_file() -> Path:
    """Return the path of the bundled file of best responses."""
    return card_file("best_responses.json")


def read_best_responses(path: Path | None = None) -> BestResponseCard:
    """Return the content of a file of best responses, by default of the bundled file.

    Raises:
        OptionError: if the file does not exist or is damaged, or a task has two best responses.
    """
    path = path or best_responses_file()
    if not path.is_file():
        raise OptionError(f"{path}: no such file, expected best responses; restore it: `{RESTORE}`")
    try:
        card = msgspec.json.decode(path.read_bytes(), type=BestResponseCard)
    except msgspec.MsgspecError as error:
        raise OptionError(f"{path}: invalid file of best responses: {error}; restore it: `{RESTORE}`") from error
    counts = Counter(task for behaviour in card.behaviours for task in behaviour.tasks)
    if twice := sorted(task for task, number in counts.items() if number > 1):
        raise OptionError(f"{path}: expected one best response for task {twice[0]}, found two; remove one of them")
    return card


def best_responses(protocol: str | None = None) -> dict[str, BestResponse]:
    """Return the best responses by task id; tasks without a best response are missing.

    Args:
        protocol: name of a protocol. The result is empty if the returns were measured under another protocol.
    """
    card = read_best_responses()
    if protocol not in (None, card.protocol):
        return {}
    return {task: behaviour for behaviour in card.behaviours for task in behaviour.tasks}


def write_best_responses(path: Path, card: BestResponseCard) -> None:
    """Write a file of best responses: one line per behaviour, with returns rounded to three digits."""
    content = msgspec.to_builtins(card)
    for behaviour in content["behaviours"]:
        behaviour["best"] = round(behaviour["best"], 3)
        for seed in behaviour["seeds"]:
            seed["return"] = round(seed["return"], 3)
    lines = ",\n  ".join(msgspec.json.encode(behaviour).decode() for behaviour in content.pop("behaviours"))
    head = msgspec.json.format(msgspec.json.encode(content), indent=1).decode().removesuffix("\n}")
    write_atomically(path, f'{head},\n "behaviours": [' + (f"\n  {lines}\n ]" if lines else "]") + "\n}\n")
