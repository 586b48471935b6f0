"""Best responses: the best return that an ego with the ego's own view is known to earn with a teammate.

`cards/best_responses.json` holds them. They were measured with recurrent egos that were trained against one teammate
each, or are the return of a model that earns more. Tasks whose teammates behave alike share a best response.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import msgspec

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_data.utils.install_hints import RESTORE
from icrl4aht_data.utils.templates import card_file


class TrainedResponse(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One training of an ego against one teammate.

    Attributes:
        seed: seed of the training.
        steps: environment steps of the training.
        width: width of its features and its recurrent state.
        mean_return: mean return of an episode after it, `return` in the file.
        choice: mean return on the episodes by which the best training is chosen.
        acting: whether it takes its most probable actions ("greedy") or draws them ("sampled"), by the same episodes.
        slope: rise of the return while it learned, from the third to the last quarter of the steps.
        init: bundled model that it started from; empty for random parameters.
    """

    seed: int
    steps: int
    mean_return: float = msgspec.field(name="return")
    width: int = 128
    choice: float | None = None
    acting: str = ""
    slope: float | None = None
    init: str = ""


class BestResponse(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The best response to one behaviour of a teammate.

    Attributes:
        layout: short name.
        family: family of the teammate.
        split: split of the tasks.
        tasks: ids of the tasks whose teammate behaves like this.
        seeds: the trainings against it.
        best: best mean return of any ego with the ego's view.
        agent: which ego earns it, such as "best response, seed 1".
    """

    layout: str
    family: str
    split: str
    tasks: tuple[str, ...]
    seeds: tuple[TrainedResponse, ...]
    best: float
    agent: str


class BestResponseCard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of `cards/best_responses.json`.

    Attributes:
        version: changes whenever a best response does.
        protocol: name of the protocol under which the returns were measured.
        about: how they were measured, as a sentence.
        behaviours: the best responses.
    """

    version: str
    protocol: str
    about: str
    behaviours: tuple[BestResponse, ...] = ()


def chosen_training(trainings: Iterable[TrainedResponse]) -> TrainedResponse:
    """Return the training that earns most on the episodes to choose by."""
    return max(trainings, key=lambda one: -math.inf if one.choice is None else one.choice)


def best_responses_file() -> Path:
    """Return the path of the package's best responses."""
    return card_file("best_responses.json")


def read_best_responses(path: Path | None = None) -> BestResponseCard:
    """Return the content of a file of best responses, by default the package's.

    Raises:
        OptionError: if the file does not exist or is damaged, or a task has two best responses.
    """
    path = path or best_responses_file()
    if not path.is_file():
        raise OptionError(f"{path}: no such file, expected best responses; restore it: `{RESTORE}`")
    try:
        card = msgspec.json.decode(path.read_bytes(), type=BestResponseCard)
    except msgspec.MsgspecError as error:
        raise OptionError(f"{path}: not a file of best responses: {error}; restore it: `{RESTORE}`") from error
    counts = Counter(task for behaviour in card.behaviours for task in behaviour.tasks)
    if twice := sorted(task for task, number in counts.items() if number > 1):
        raise OptionError(f"{path}: two best responses to task {twice[0]}, expected one; remove the other")
    return card


def best_responses(protocol: str | None = None) -> dict[str, BestResponse]:
    """Return task id -> best response, of the tasks with one.

    Args:
        protocol: name of a protocol; there are none if they were measured under another one.
    """
    card = read_best_responses()
    if protocol not in (None, card.protocol):
        return {}
    return {task: behaviour for behaviour in card.behaviours for task in behaviour.tasks}


def write_best_responses(path: Path, card: BestResponseCard) -> None:
    """Write a file of best responses, one line per behaviour, returns rounded to three digits."""
    content = msgspec.to_builtins(card)
    for behaviour in content["behaviours"]:
        behaviour["best"] = round(behaviour["best"], 3)
        for seed in behaviour["seeds"]:
            seed["return"] = round(seed["return"], 3)
    lines = ",\n  ".join(msgspec.json.encode(behaviour).decode() for behaviour in content.pop("behaviours"))
    head = msgspec.json.format(msgspec.json.encode(content), indent=1).decode().removesuffix("\n}")
    with atomic_write(path) as partial:
        partial.write_text(f'{head},\n "behaviours": [' + (f"\n  {lines}\n ]" if lines else "]") + "\n}\n", "utf-8")
