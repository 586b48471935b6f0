"""Files of results that others add to the page of results: made from folders of `evaluate`, checked, and read.

A file has the return of every episode, so the page can recompute all numbers. `Submission` defines its content;
`icrl4aht-data submit --schema` prints the JSON schema.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from icrl4aht_baselines.agents.bundled import bundled_models
from icrl4aht_baselines.agents.egos import AGENTS, OTHER_WAYS
from icrl4aht_baselines.evaluate.protocols import CONTROLS, bundled_tasks, get_protocol
from icrl4aht_baselines.evaluate.results import RESULTS, Result
from icrl4aht_baselines.report.results import EvaluationRun, as_run, find_seen, read_results
from icrl4aht_baselines.training.seen import TRAINED_ON
from icrl4aht_data.benchmark.best_responses import read_best_responses
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import atomic_write
from icrl4aht_data.utils.text import counted_noun

SUBMITTED_PROTOCOL = "seeded"
"""Name of the protocol of the page's scores."""

SUBMITTED_SEEDS = (0, 1, 2)
"""Seeds with which every task has to be played."""

_Text = Annotated[str, Meta(min_length=1)]
_Name = Annotated[str, Meta(pattern=r"^[^\s`|]([^\n`|]*[^\s`|])?$")]  # nothing that would end a cell of a table


class AgentFacts(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """What tables say about an agent.

    Attributes:
        about: one sentence on how it was made.
        data: training data in a few words, such as "noise histories"; "none" for an agent that was not trained.
        labels: targets of the training in a few words, such as "oracle"; "none" without any.
        steps: length of the training, such as "4,000 updates".
        core_hours: core-hours of the training, with everything it needs.
        link: address of a paper or repository.
        commit: commit of this repository whose code made it, if later code cannot.
    """

    about: _Text
    data: _Text
    labels: _Text
    steps: str = ""
    core_hours: float | None = None
    link: str = ""
    commit: str = ""


class Evaluation(msgspec.Struct, forbid_unknown_fields=True):
    """Results of a folder that `evaluate` made.

    Attributes:
        control: empty; or the control, see `protocols.CONTROLS`, or the way of playing, see `egos.OTHER_WAYS`, of
            results that are shown next to the agent's own.
        training: number of the agent's training, for several with different seeds.
        settings: settings of the results, see `evaluate.results.Result`, with `trained_on` among the details.
        returns: task id -> return of each episode, one list per seed.
    """

    control: str
    training: Annotated[int, Meta(ge=0)]
    settings: dict[str, Any]
    returns: dict[str, list[list[float]]]


class Submission(msgspec.Struct, forbid_unknown_fields=True):
    """Content of a file of results.

    Attributes:
        format: version of this format.
        agent: name of the agent in tables.
        facts: what tables say about it.
        best_responses: version of the best responses, see `benchmark.best_responses`.
        tracks: the tracks that were played.
        evaluations: the results.
        update: whether these are new results of an agent on the page. Without results of its own way of playing they
            are added to the stored ones, otherwise they replace all of them.
    """

    format: Literal[1]
    agent: _Name
    facts: AgentFacts
    best_responses: str
    tracks: list[Literal["teammate", "layout"]]
    evaluations: Annotated[list[Evaluation], Meta(min_length=1)]
    update: bool = False


def submission_schema() -> str:
    """Return the JSON schema of a file of results."""
    return json.dumps(msgspec.json.schema(Submission), indent=1)


def make_submission(folders: Sequence[Path], facts: AgentFacts, agent: str = "", update: bool = False) -> Submission:
    """Return the results in folders that `evaluate` made, and in their folders of controls, checked.

    Args:
        folders: results of one agent. Those of the same tasks and way of playing are of different trainings, in this
            order. Controls of the other way of playing are left out.
        facts: what tables say about it.
        agent: name of the agent in tables, by default that in the results.
        update: see `Submission`.

    Raises:
        OptionError: see `check_submission`; also if a folder has no results, or results of another version.
    """
    counts: Counter[tuple[str, str]] = Counter()  # way of playing, task -> trainings so far
    evaluations, tasks, training, way = [], set(), 0, ""
    for folder in folders:
        for control in ("", *CONTROLS):
            source = folder / control
            if control and (way or not (source / RESULTS).is_dir()):
                continue
            results, trained = read_results(source)
            settings = results[0].settings
            if any(result.settings != settings for result in results):
                raise OptionError(f"{source}: results of different settings in one folder; evaluate again")
            details = dict(settings.get("details", {}))
            declared = (trained or {}).get("config", {})
            if TRAINED_ON not in details and TRAINED_ON in declared:
                details[TRAINED_ON] = declared[TRAINED_ON]
            if not control:  # controls are of the training of their folder
                way = next((one for one in OTHER_WAYS if settings["agent"].endswith(f" ({one})")), "")
                training = max(counts[way, result.task_id] for result in results)
                counts.update((way, result.task_id) for result in results)
            returns = {result.task_id: result.returns for result in results}
            tasks |= set() if control else returns.keys()
            evaluations.append(Evaluation(control or way, training, settings | {"details": details}, returns))
    tracks: Any = [track for track in TRACKS if tasks & _track_tasks([track])] or [*TRACKS]
    name = agent or evaluations[0].settings["agent"].removesuffix(f" ({evaluations[0].control})")
    found = Submission(1, name, facts, read_best_responses().version, tracks, evaluations, update)
    check_submission(found, ", ".join(map(str, folders)))
    return found


def _track_tasks(tracks: Iterable[str]) -> set[str]:
    return {task.task_id for track in tracks for task in bundled_tasks(track, "test")}


def check_submission(found: Submission, where: str) -> None:
    """Check that results are complete, comparable, and declare the training data.

    Raises:
        OptionError: if the agent has the name of a reference ego or of a bundled model that it is not, or one that
            tables cannot show, the version of the best responses is unknown, the training data is not declared,
            protocol, seeds or episodes are others than those of the page, or the tasks are not exactly those of the
            tracks; names them.
    """
    _check_name(found, where)
    known = read_best_responses().version
    if found.best_responses != known:
        raise OptionError(
            f"{where}: best responses of version {found.best_responses!r}, expected {known!r}, that of this package: "
            f"run `icrl4aht-data submit` of this version again"
        )
    played: dict[tuple[str, int], list[str]] = defaultdict(list)
    for one in found.evaluations:
        part = f"{where}: {one.control or found.agent}, training {one.training}"
        if one.control not in ("", *CONTROLS, *OTHER_WAYS):
            raise OptionError(f"{part}: control {one.control!r}, expected {' or '.join((*CONTROLS, *OTHER_WAYS))}")
        _check_evaluation(one, part)
        played[one.control, one.training] += one.returns
    expected = _track_tasks(found.tracks)
    named = f"the {counted_noun(len(expected), 'test task')} of {' and '.join(found.tracks)}"
    for (control, training), tasks in played.items():
        part = f"{where}: {control or found.agent}, training {training}"
        if others := sorted({*tasks} - expected):
            raise OptionError(f"{part}: task {others[0]} is not one of {named}, expected only these; evaluate them")
        if missing := sorted(expected - {*tasks}):
            raise OptionError(
                f"{part}: {len(missing)} of {named} are missing, such as {missing[0]}; evaluate all of them"
            )
        if len(tasks) > len(expected):
            raise OptionError(f"{part}: results of a task twice, expected once; give each folder once")
    if not found.update and not any(one.control == "" for one in found.evaluations):
        raise OptionError(
            f"{where}: only controls or another way of playing, expected results of the agent itself; give their "
            f"folder, too, or --update if the page has these"
        )


def _check_name(found: Submission, where: str) -> None:
    models = {one.settings.get("details", {}).get("model") for one in found.evaluations}
    known = "a reference ego" if found.agent in AGENTS else ""
    if found.agent in bundled_models() and models != {found.agent}:
        known = "a bundled model"
    if known:
        raise OptionError(f"{where}: the agent {found.agent} has the name of {known}; give another --name")
    try:
        msgspec.convert(found.agent, _Name)
    except msgspec.ValidationError as error:
        raise OptionError(
            f"{where}: agent {found.agent!r}: expected a name on one line without |, ` and outer spaces; give --name"
        ) from error
    if found.agent.endswith(tuple(f" ({way})" for way in OTHER_WAYS)):
        raise OptionError(
            f"{where}: the agent {found.agent} has the name of another way of playing, which its folder shows; give a "
            f"--name without it"
        )


def _check_evaluation(one: Evaluation, where: str) -> None:
    rules = get_protocol(SUBMITTED_PROTOCOL)
    try:
        protocol, seeds, code = (one.settings[name] for name in ("protocol", "seeds", "code_version"))
    except (KeyError, TypeError) as error:
        raise OptionError(f"{where}: settings without {error}, expected those of `evaluate`") from error
    if code != version("icrl4aht-data"):
        raise OptionError(
            f"{where}: results of version {code}, expected {version('icrl4aht-data')}, the installed one: evaluate "
            f"again, or submit with that version"
        )
    if protocol != rules.settings:
        raise OptionError(f"{where}: protocol {protocol}, expected {rules.settings}; evaluate with these rules")
    if seeds != [*SUBMITTED_SEEDS]:
        raise OptionError(
            f"{where}: seeds {seeds}, expected {[*SUBMITTED_SEEDS]}; evaluate with `--seeds {len(SUBMITTED_SEEDS)}`"
        )
    for task, returns in one.returns.items():
        shape = len(returns), {len(row) for row in returns}
        if shape != (len(seeds), {rules.episodes}):
            raise OptionError(
                f"{where}: task {task} has {shape[0]} lists of {sorted(shape[1])} returns, expected "
                f"{len(seeds)} of {rules.episodes}, one for each seed and episode; evaluate it again"
            )
    details = one.settings.get("details", {})
    marks = {control for control, mark in CONTROLS.items() if details.get(mark)}
    expected = {one.control} & {*CONTROLS}
    if marks != expected:
        raise OptionError(
            f"{where}: results of {' and '.join(sorted(marks)) or 'no control'}, expected "
            f"{''.join(expected) or 'no control'}; give the folder that `evaluate --controls` wrote"
        )
    if None in find_seen(one.settings, None, where).values():
        raise OptionError(
            f"{where}: no declaration of the training data; give `evaluate` details={{'{TRAINED_ON}': [...]}}, an "
            f"empty list for an agent that was not trained"
        )


def write_submission(path: Path, found: Submission) -> None:
    """Write a file of results."""
    with atomic_write(path) as partial:
        partial.write_bytes(msgspec.json.encode(found))


def read_submission(path: Path) -> Submission:
    """Return the content of a file of results, checked.

    Raises:
        OptionError: if it is no such file, or see `check_submission`.
    """
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Submission)
    except msgspec.MsgspecError as error:
        raise OptionError(
            f"{path}: not a file of results: {error}; `icrl4aht-data submit` makes them from folders of `evaluate`"
        ) from error
    check_submission(found, str(path))
    return found


def submitted_runs(found: Submission) -> list[tuple[Evaluation, EvaluationRun]]:
    """Return each evaluation with its results as a run."""
    return [
        (one, as_run([Result(task, one.settings, returns) for task, returns in one.returns.items()], found.agent))
        for one in found.evaluations
    ]
