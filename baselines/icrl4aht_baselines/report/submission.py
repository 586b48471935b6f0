"""Make, check, write and read submissions, which are files of results for the page docs/results.md.

A submission has the return of every episode, so all numbers of the page can be computed from it. `Submission` defines
the content; `icrl4aht-data submit --schema` prints the JSON schema.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from icrl4aht_baselines.agents.bundled import bundled_models
from icrl4aht_baselines.agents.egos import AGENTS, OTHER_WAYS
from icrl4aht_baselines.evaluate.protocols import CONTROLS, SUBMITTED_SEEDS, get_protocol, plan_tasks
from icrl4aht_baselines.evaluate.results import RESULTS
from icrl4aht_baselines.report.results import bundled_tasks_by_id, find_training_record, read_results
from icrl4aht_baselines.training.seen import TRAINED_ON
from icrl4aht_data.benchmark.best_responses import read_best_responses
from icrl4aht_data.benchmark.facts import ALL_TRACKS, KEPT_STEPS, TRACKS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.rules import DELIVERY_REWARD
from icrl4aht_data.utils.files import json_hash, write_atomically
from icrl4aht_data.utils.text import counted_noun

SUBMITTED_PROTOCOL = "seeded"
"""Name of the protocol that submitted results must have."""

_LARGEST = 2.0 * DELIVERY_REWARD * KEPT_STEPS
"""Limit of an episode's absolute return: two agents deliver in every step."""

# Texts are shown in Markdown: no line breaks, and no | in tables. Without the lookahead, $ accepts a break at the end.
_NAME = r"^[^\s`|]([^\n`|]*[^\s`|])?$(?!\n)"
_Sentence = Annotated[str, Meta(min_length=1, pattern=r"^[^\n\r]*$(?!\n)")]
_CellText = Annotated[str, Meta(pattern=r"^[^\n\r|]*$(?!\n)")]
_FullCellText = Annotated[str, Meta(min_length=1, pattern=r"^[^\n\r|]*$(?!\n)")]
_Link = Annotated[str, Meta(pattern=r"^(https?://[^\s()<>|]+)?$(?!\n)")]
_Commit = Annotated[str, Meta(pattern=r"^[0-9a-f]*$(?!\n)")]
_Return = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]


class AgentFacts(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """Facts about an agent, for the page of results.

    Attributes:
        about: one sentence on how the agent was made.
        data: training data in a few words, such as "noise histories"; "none" for an agent that was not trained.
        labels: training targets in a few words, such as "oracle"; "none" without targets.
        steps: length of the training, such as "41 million steps a track".
        core_hours: core-hours of the training and of making its data.
        link: http address of a paper or repository.
        commit: commit of this repository whose code made the agent, if later code cannot make it.
    """

    about: _Sentence
    data: _FullCellText
    labels: _FullCellText
    steps: _CellText = ""
    core_hours: Annotated[float, Meta(ge=0)] | None = None
    link: _Link = ""
    commit: _Commit = ""


class Evaluation(msgspec.Struct, forbid_unknown_fields=True):
    """Results from a folder that `evaluate` made, as a part of a submission.

    Attributes:
        control: name of a control, see `protocols.CONTROLS`, or of another play mode, see `egos.OTHER_WAYS`; empty for
            the agent's main results.
        training: number of the agent's training run, if there are several with different seeds.
        settings: settings of the results, see `evaluate.results.Result`; the details state `trained_on`.
        returns: task id -> return of each episode, as one list per seed.
        partners: task id -> the result's `partners`; for the control `swapped` only.
    """

    control: str
    training: Annotated[int, Meta(ge=0)]
    settings: dict[str, Any]
    returns: Annotated[dict[str, list[list[_Return]]], Meta(min_length=1)]
    partners: dict[str, list[str]] = {}


class Submission(msgspec.Struct, forbid_unknown_fields=True):
    """Content of a submitted file of results.

    Attributes:
        format: version of this format.
        agent: name of the agent in tables.
        facts: facts about the agent, for the page.
        best_responses: version of the best responses, see `benchmark.best_responses`.
        tracks: names of the evaluated tracks.
        evaluations: results of the agent.
        update: whether the agent is already on the page. Main results replace all stored results of the agent on the
            same layouts; without main results, controls and other play modes are added to the stored results.
    """

    format: Literal[1]
    agent: Annotated[str, Meta(pattern=_NAME)]
    facts: AgentFacts
    best_responses: str
    tracks: Annotated[list[Literal["teammate", "layout", "preference"]], Meta(min_length=1)]
    evaluations: Annotated[list[Evaluation], Meta(min_length=1)]
    update: bool = False


class _Details(msgspec.Struct):
    model: str | None = None


class _Settings(msgspec.Struct):
    agent: str
    protocol: dict[str, Any]
    seeds: list[int]
    code_version: str
    details: _Details = msgspec.field(default_factory=_Details)


def submission_schema() -> str:
    """Return the JSON schema of a submission."""
    return json.dumps(msgspec.json.schema(Submission), indent=1)


def make_submission(folders: Sequence[Path], facts: AgentFacts, agent: str = "", update: bool = False) -> Submission:
    """Make and check a submission, from folders that `evaluate` made and their subfolders with controls.

    Args:
        folders: folders with results of one agent. Folders with the same tasks and play mode count as
            training runs 0, 1 and so on. A play mode that is named in the results is the agent's own if the results
            that name none have it too. Controls of the agent's other play mode are left out.
        facts: facts about the agent, for the page.
        agent: name of the agent in tables; by default the name in the results.
        update: see `Submission`.

    Raises:
        OptionError: for the reasons of `check_submission`, if a folder is given twice, if its results are missing,
            invalid or differ in settings, or if the folders' agents have different names and `agent` is empty.
    """
    if twice := [folder for folder, number in Counter(map(Path.resolve, folders)).items() if number > 1]:
        raise OptionError(f"{twice[0]}: given more than once; give each folder once")
    counts: Counter[tuple[str, str]] = Counter()  # (play mode, task) -> number of training runs so far
    evaluations, tasks, names, training, way = [], set(), {}, 0, ""
    main = {folder: read_results(folder) for folder in folders}
    unnamed = [of[0].settings for of in main.values() if not _named_play_mode(of[0].settings)]
    own = {bool(settings.get("details", {}).get("sampled")) for settings in unnamed}
    for folder in folders:
        for control in ("", *CONTROLS):
            source = folder / control
            if control and (way or not (source / RESULTS).is_dir()):
                continue
            results = read_results(source) if control else main[folder]
            settings = results[0].settings
            if any(result.settings != settings for result in results):
                raise OptionError(f"{source}: the results have different settings; evaluate all tasks again")
            if not control:  # controls in the same folder belong to the same training run
                named = _named_play_mode(settings)
                names[settings["agent"].removesuffix(f" ({named})")] = source
                way = "" if own == {named == "sampled"} else named
                training = max(counts[way, result.task_id] for result in results)
                counts.update((way, result.task_id) for result in results)
            returns = {result.task_id: result.returns for result in results}
            tasks |= set() if control else returns.keys()
            partners = {result.task_id: result.partners for result in results if result.partners}
            evaluations.append(Evaluation(control or way, training, settings, returns, partners))
    tracks: Any = [track for track in ALL_TRACKS if tasks & bundled_tasks_by_id("test", (track,)).keys()] or [*TRACKS]
    if len(names) > 1 and not agent:
        texts = [f"{source} has results of {name}" for name, source in names.items()]
        raise OptionError(
            f"{', '.join(texts)}; give folders of one agent, or --name if these are training runs of one agent"
        )
    name = agent or next(iter(names))
    found = Submission(1, name, facts, read_best_responses().version, tracks, evaluations, update)
    return _parse_submission(msgspec.json.encode(found), ", ".join(map(str, folders)))


def _named_play_mode(settings: dict[str, Any]) -> str:
    """Return the play mode that the agent's name in results ends with, see `OTHER_WAYS`, or an empty string."""
    return next((way for way in OTHER_WAYS if settings["agent"].endswith(f" ({way})")), "")


def check_submission(found: Submission, where: str) -> None:
    """Check that a submission is complete and comparable, and states the training data.

    Raises:
        OptionError: if settings are missing, the agent's name is taken by another agent or cannot be shown in tables,
            the best responses have another version, the training data is not stated, protocol, seeds or episodes are
            not those of the page, the tasks are not exactly those of the tracks, two training runs have equal returns,
            are the same run or act in different ways, a control has a training run that the main results lack, or the
            control `swapped` has other teammates than for all tasks of a track.
    """
    for one in found.evaluations:
        try:
            msgspec.convert(one.settings, _Settings)
        except msgspec.ValidationError as error:
            raise OptionError(f"{where}: settings: {error}; expected those that `evaluate` writes") from error
    _check_name(found, where)
    known = read_best_responses().version
    if found.best_responses != known:
        raise OptionError(
            f"{where}: made with best responses {found.best_responses!r}, but this package has {known!r}; make the "
            f"file again with `icrl4aht-data submit`"
        )
    expected = bundled_tasks_by_id("test", tuple(found.tracks))
    swapped = plan_tasks([*expected.values()], get_protocol(SUBMITTED_PROTOCOL), "swapped")
    partners = {plan.task.task_id: [*plan.partners] for plan in swapped}
    played: dict[tuple[str, int], list[tuple[str, list[list[float]]]]] = defaultdict(list)
    for one in found.evaluations:
        part = f"{where}: {one.control or found.agent}, training {one.training}"
        if one.control not in ("", *CONTROLS, *OTHER_WAYS):
            raise OptionError(f"{part}: control {one.control!r}, expected {' or '.join((*CONTROLS, *OTHER_WAYS))}")
        _check_evaluation(one, part, found.tracks)
        for task in one.returns.keys() & partners if one.control == "swapped" else ():
            own = one.partners.get(task)
            if own != partners[task]:
                found_text = f"has the teammates of {own}" if own else "does not state its teammates"
                raise OptionError(
                    f"{part}: task {task} {found_text}, expected those of {partners[task]}; evaluate all tasks of the "
                    f"track with one command, and make the file again"
                )
        played[one.control, one.training] += one.returns.items()
    named = f"the {counted_noun(len(expected), 'test task')} of {' and '.join(found.tracks)}"
    runs, alike = {training for control, training in played if not control}, {}
    _check_same_play(found, where)
    for (control, training), results in played.items():
        part = f"{where}: {control or found.agent}, training {training}"
        counts = Counter(task for task, _ in results)
        if wrong := sorted(task for task in {*counts, *expected} if counts[task] != (task in expected)):
            raise OptionError(
                f"{part}: expected one result of each of {named} and no others, found {counts[wrong[0]]} of {wrong[0]} "
                f"({counted_noun(len(wrong), 'wrong task')}); evaluate exactly these tasks, and give each folder once; "
                f"submit tracks with different numbers of training runs separately"
            )
        same = alike.setdefault((control, json_hash(sorted(results))), training)
        if same != training:
            raise OptionError(f"{part}: the same returns as training {same}; give the results of a training run once")
        if runs and training not in runs:
            raise OptionError(f"{part}: no results without `{control}` of this training; give its folder, too")
    if not found.update and not runs:
        raise OptionError(
            f"{where}: expected results of the agent's own play, found only results of controls or of "
            f"greedy or sampled actions; also give the folder of the expected results, or --update if the page has them"
        )


def _check_same_play(found: Submission, where: str) -> None:
    """Check that all training runs and their controls act in the same way, and that no run is given twice."""
    ways: dict[str, str] = {}
    numbers: dict[tuple[str, str, str], int] = {}  # (control, task, run) -> number of the training run
    runs: dict[tuple[int, str], Any] = {}  # (number of the training run, task) -> run, if not in another play mode
    for one in found.evaluations:
        details, part = one.settings.get("details", {}), f"{where}: {one.control or found.agent}"
        part, mode = f"{part}, training {one.training}", one.control if one.control in OTHER_WAYS else ""
        way = f"acting {details.get('acting')}, {'sampled' if details.get('sampled') else 'greedy'} actions"
        first = ways.setdefault(mode, way)
        if first != way:
            raise OptionError(
                f"{part}: found {way}, but {first} in other results; evaluate all training runs and their controls in "
                f"the same way, see --greedy, --sampled and --acting"
            )
        run = details.get("run")
        for task in one.returns if run else ():
            same = numbers.setdefault((one.control, task, json_hash(run)), one.training)
            if same != one.training:
                raise OptionError(
                    f"{part}: the same run {run} as training {same}; give the results of a training run once"
                )
            if not mode and runs.setdefault((one.training, task), run) != run:
                raise OptionError(
                    f"{part}: run {run} in task {task}, but {runs[one.training, task]} in other results of this "
                    f"training; give the folders that `evaluate --controls` wrote"
                )


def _check_name(found: Submission, where: str) -> None:
    own = [one for one in found.evaluations if not one.control] or found.evaluations
    models = {one.settings.get("details", {}).get("model") for one in own} & bundled_models().keys()
    # Further training runs of a bundled model have its name only together with the model's own results.
    taken = {name.casefold(): name for name in (*AGENTS, *bundled_models())}.get(found.agent.casefold())
    if taken and not (found.agent == taken and models == {taken}):
        raise OptionError(f"{where}: {taken} names a reference ego or a bundled model; give another --name")
    if found.agent.endswith(tuple(f" ({way})" for way in OTHER_WAYS)):
        raise OptionError(
            f"{where}: agent {found.agent!r}: expected a name without a play mode at the end, which the settings "
            f"state; give another --name"
        )


def _check_evaluation(one: Evaluation, where: str, tracks: Sequence[str]) -> None:
    rules = get_protocol(SUBMITTED_PROTOCOL)
    protocol, seeds, code = (one.settings[name] for name in ("protocol", "seeds", "code_version"))
    if code != version("icrl4aht-data"):
        raise OptionError(
            f"{where}: made with icrl4aht-data {code}, but {version('icrl4aht-data')} is installed; evaluate again, or "
            f"install {code} to submit"
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
            f"{where}: found control {' and '.join(sorted(marks)) or 'none'}, expected "
            f"{''.join(expected) or 'none'}; give the folder that `evaluate --controls` wrote"
        )
    record = find_training_record(one.settings, where)
    if any(record[track] is None for track in record.keys() & {"", *tracks}):
        raise OptionError(
            f"{where}: no declaration of the training data; give `evaluate` details={{'{TRAINED_ON}': [...]}}, an "
            f"empty list for an agent that was not trained"
        )


def write_submission(path: Path, found: Submission) -> None:
    """Write a submission to a file."""
    write_atomically(path, msgspec.json.encode(found))


def read_submission(path: Path) -> Submission:
    """Read a submission from a file and check its content.

    Raises:
        OptionError: if the file is not a submission, or `check_submission` rejects it.
    """
    return _parse_submission(path.read_bytes(), str(path))


def _parse_submission(content: bytes, where: str) -> Submission:
    try:
        found = msgspec.json.decode(content, type=Submission)
    except msgspec.MsgspecError as error:
        raise OptionError(
            f"{where}: not valid results: {error}; `icrl4aht-data submit` makes a file from results of `evaluate`, and "
            f"texts need one line without |, names also without ` and spaces at the ends"
        ) from error
    check_submission(found, where)
    return found
