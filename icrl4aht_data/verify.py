"""Is a release whole, and does its physics hold? Hashes, checksums, counts, ranges; `deep`: rendering and replay.

A release of observations cannot be replayed; `deep` then asks whether each observation shows the layout from some cell.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from icrl4aht_data.benchmark import ACTIONS, EGO
from icrl4aht_data.cache import free_memory
from icrl4aht_data.dataset import MINI, Names
from icrl4aht_data.download import ORIGIN, chosen_files
from icrl4aht_data.errors import EmptySelectionError, Icrl4ahtError, OptionError, UnknownNameError
from icrl4aht_data.history import History
from icrl4aht_data.index import Index, read_index
from icrl4aht_data.manifest import LARGEST, file_hash, files_below, inside, read_manifest
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.overcooked.observe import fixed_channels, observe
from icrl4aht_data.overcooked.rules import step
from icrl4aht_data.overcooked.state import columns, faults, record_size, start
from icrl4aht_data.release import checkpoint_files, describe, shard_sizes
from icrl4aht_data.remote import Remote, Root, open_root
from icrl4aht_data.schema import (
    ACTION_FIELDS,
    FIELDS,
    HISTORIES,
    INFO,
    KINDS,
    MANIFEST,
    PROVENANCE,
    TASKS,
    TEAMMATES,
    curve_ends,
    episode_ends,
    episode_returns,
    record_field,
    stream_score,
)
from icrl4aht_data.shard import Shard, chunk_table_name, read_table
from icrl4aht_data.statistics import layout_statistics
from icrl4aht_data.tasks import Task, read_provenance, read_tasks
from icrl4aht_data.transport import Traffic

_OF_THE_HUB = (".gitattributes", ".cache/huggingface/")
"""What its own tools put beside a repository's files."""

_FINDINGS = 100_000
_LOST = 100  # shards of one set that are named
_COPIES = 4  # of a history that checking it takes
_LONG = 2000  # characters of a finding


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong."""

    file: str  # path below the root
    problem: str


@dataclass
class Report:
    """What `verify_release` looked at and found."""

    root: str
    deep: bool
    quick: bool = False
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # what was asked for but could not be checked, which is no fault
    repaired: list[str] = field(default_factory=list)
    replayed: bool = False
    files: int = 0
    chunks: int = 0
    histories: int = 0
    transitions: int = 0
    fetched_bytes: int = 0
    requests: int = 0

    @property
    def ok(self) -> bool:
        return not self.findings

    @property
    def files_at_fault(self) -> set[str]:
        """Of the release, in which something is wrong."""
        return {finding.file for finding in self.findings}

    def to_json(self) -> dict[str, Any]:
        return {"ok": self.ok, **asdict(self)}

    def add(self, file: str, problem: str) -> None:
        if len(self.findings) < _FINDINGS:
            self.findings.append(Finding(_plain(file), _plain(problem)))
        elif len(self.findings) == _FINDINGS:
            self.findings.append(Finding(".", "and more: mend these first, then verify again"))


def _plain(text: str) -> str:
    """Without what a terminal would obey, or cannot show."""
    text = text if len(text) <= _LONG else f"{text[:_LONG]}..."
    return text if text.isprintable() else text.encode("unicode_escape").decode()


NamedProgress = Callable[[str, int, int], None]
"""Called with what is being checked, how many are done, and how many there are."""


def verify_release(
    root: str | Path | None = None,
    *,
    deep: bool = False,
    quick: bool = False,
    advance: NamedProgress = lambda what, done, total: None,
    **wanted: Names,
) -> Report:
    """Check a release; never raises for what is wrong in it.

    Args:
        root: a release folder, or an address as in `load_icrl4aht`; the bundled mini release by default. Of a remote
            release all that is checked comes here first, unless `quick`.
        deep: also check that observations are what the states show, that every recorded step follows from the one
            before under the rules, with the recorded reward, and that every episode starts as the environment starts.
            Without state records only that every observation shows the layout; a note says so.
        quick: check names, sizes and the index alone, no contents.
        advance: progress.
        wanted: check the shards of these histories alone; see `load_icrl4aht`. A folder that `download` filled with a
            part of a release has to have that part.

    Raises:
        UnknownNameError, EmptySelectionError: if there is nothing of what is `wanted`.
    """
    if deep and quick:
        raise OptionError("deep and quick: give one of them")
    report = Report(str(MINI if root is None else root), deep, quick)
    try:
        origin = open_root(MINI if root is None else root)
    except Icrl4ahtError as error:
        report.add(".", str(error))
        return report
    if not origin.folder.is_dir():
        report.add(".", f"{origin.folder}: no such folder; give the folder or the address of a release")
        return report
    before = origin.remote.store.traffic if origin.remote else Traffic()
    report.root = str(origin)
    try:
        _verify(origin, report, advance, wanted)
    except (Icrl4ahtError, OSError) as error:
        if isinstance(error, (EmptySelectionError, UnknownNameError)) and any(wanted.values()):
            raise  # nothing is wrong with the release
        report.add("meta", str(error))
    if origin.remote is not None:
        traffic = origin.remote.store.traffic - before
        report.fetched_bytes, report.requests = traffic.bytes, traffic.requests
    return report


def _verify(origin: Root, report: Report, advance: NamedProgress, wanted: dict[str, Names]) -> None:
    listed = _manifest(origin, report)
    chosen, unreadable = set(listed), None
    try:
        chosen = chosen_files(origin, **wanted)
    except (EmptySelectionError, UnknownNameError):
        raise
    except Icrl4ahtError as error:
        unreadable = error
    if origin.remote is not None and not report.quick:
        _fetch(origin.remote, sorted(chosen), report, advance)
    _check_files(
        origin, {name: digest for name, digest in listed.items() if name in chosen}, listed.keys(), report, advance
    )
    if unreadable is not None:
        report.add("meta", str(unreadable))
        return
    index = read_index(origin)
    tasks = read_tasks(inside(origin.folder, TASKS))
    report.replayed = report.deep and index.info["kind"] in KINDS
    if report.deep and not report.replayed:
        report.notes.append(
            "nothing was replayed: without state records it cannot be said whether steps obey the rules"
        )
    _check_index(index, tasks, chosen, report)
    shards = [name for name in index.values("shard") if name in chosen]
    left = len(index.values("shard")) - len(shards)
    if left:
        report.notes.append(f"{left} of {left + len(shards)} shards were not asked for")
    if report.quick:
        _check_sizes(index, shards, report)
    else:
        _check_teammates(origin.folder, tasks, report)
        _check_shards(index, shards, report, advance)


def _fetch(remote: Remote, names: list[str], report: Report, advance: NamedProgress) -> None:
    for number, name in enumerate(names, start=1):  # one by one, so that each that cannot be had is named
        try:
            remote.fetch([name])
        except Icrl4ahtError as error:
            report.add(name, str(error))
        advance("fetched", number, len(names))


def _check_index(index: Index, tasks: list[Task], chosen: set[str], report: Report) -> None:
    """Index, tasks, totals and shard names against each other."""
    by_id = {task.task_id: task for task in tasks}
    given = bool(tasks) or index.info["kind"] in KINDS
    streams: set[tuple[str, int]] = set()
    for entry in index.entries:
        task = by_id.get(entry.task_id)
        said = (entry.layout, entry.track, entry.split, entry.teammate_kind, entry.teammate_family, entry.seed)
        if task is None and given:
            report.add(TASKS, f"history {entry.history_id}: its task {entry.task_id!r} is missing")
        elif task is not None and said != (
            task.layout.name,
            task.track,
            task.split,
            task.teammate_kind,
            task.teammate_family,
            task.seed,
        ):
            report.add(TASKS, f"history {entry.history_id}: index and task {entry.task_id!r} disagree")
        if (entry.task_id, entry.env_idx) in streams:
            report.add(HISTORIES, f"history {entry.history_id}: stream {entry.env_idx} of its task stands twice")
        streams.add((entry.task_id, entry.env_idx))
    for task_id in by_id.keys() - {entry.task_id for entry in index.entries}:
        report.add(TASKS, f"task {task_id!r} has no history")
    _check_apart(tasks, report)
    if not index.entries:
        report.add(HISTORIES, "no histories")
    info = index.info
    kept_steps = info["environment"]["kept_steps"]
    expected = describe(info["kind"], info["data_version"], kept_steps, list(index.entries))
    here = all(name in chosen and (index.root / name).is_file() for name in index.values("shard"))
    if report.ok and here and not report.quick:
        expected["shards"] = shard_sizes(index.root, index.entries)  # else what they are made of is at fault, or away
        expected["statistics"] = _statistics(index, tasks)
    elif info["shards"].keys() != set(index.values("shard")):
        report.add(INFO, f"shards: expected {sorted(index.values('shard'))}, found {sorted(info['shards'])}")
    for name in expected:
        if info.get(name) != expected[name]:
            report.add(INFO, f"{name}: expected {expected[name]!r}, found {info.get(name)!r}")
    shards = {entry.shard for entry in index.entries}
    for shard in shards:
        stem, count = shard.removesuffix(".h5").split("-")[0], int(shard.removesuffix(".h5").split("-")[-1])
        names = (f"{stem}-{number:05}-of-{count:05}.h5" for number in range(count))
        for name in islice((name for name in names if name not in shards), _LOST):
            report.add(name, f"the name of {shard} promises this shard, the index has no history in it")


def _check_apart(tasks: list[Task], report: Report) -> None:
    """Whether no teammate of a training task is one of a test task on the same track."""
    seen: dict[tuple[str, str, str], str] = {}
    for task in sorted(tasks, key=lambda task: task.split, reverse=True):  # train before test
        who = (task.track, task.layout.name, json.dumps(task.teammate, sort_keys=True))
        if task.split == "train":
            seen[who] = task.task_id
        elif who in seen:
            report.add(TASKS, f"task {task.task_id!r} ({task.split}) has the teammate of {seen[who]!r} (train)")


def _check_sizes(index: Index, shards: list[str], report: Report) -> None:
    """Whether every shard is as long as the release says, where it is."""
    for name in shards:
        expected, found = index.info["shards"].get(name), None
        remote, path = index.origin.remote, inside(index.root, name)
        if path.exists():
            found = path.stat().st_size
        elif remote is not None:
            try:
                found = remote.store.size(name)
            except Icrl4ahtError as error:
                report.add(name, str(error))
                continue
        if found is not None and found != expected:
            report.add(name, f"expected {expected} bytes, found {found}")


def _check_teammates(root: Path, tasks: list[Task], report: Report) -> None:
    """Whether the weights of learned teammates are those that the tasks name. A release need not have them."""
    without = 0
    for task in tasks:
        try:
            files = checkpoint_files(root / TEAMMATES, task, root)
        except Icrl4ahtError as error:
            report.add(f"{TEAMMATES}/{task.teammate['theta']['sha256']}", str(error))
            continue
        without += task.teammate_family == "rl" and not files
        for name, path in files.items():
            found = file_hash(path)
            expected = task.teammate["theta"]["sha256"]
            if path.suffix == ".safetensors" and found != expected:
                report.add(name, f"sha256 {found}, expected {expected} as task {task.task_id!r} says")
    if without:
        report.notes.append(f"{without} tasks have learned teammates whose checkpoints this release does not have")


def _statistics(index: Index, tasks: list[Task]) -> Any:
    try:
        provenance = read_provenance(inside(index.root, PROVENANCE))
        kept_steps = index.info["environment"]["kept_steps"]
        return layout_statistics(index.root, index.entries, tasks, provenance, kept_steps)
    except (Icrl4ahtError, OSError) as error:
        return f"what {PROVENANCE} and the shards give: {error}"


def _manifest(origin: Root, report: Report) -> dict[str, str]:
    try:
        return read_manifest(origin.folder)
    except Icrl4ahtError as error:
        report.add(MANIFEST, str(error))
        return {}


def _check_files(
    origin: Root, expected: dict[str, str], listed: Collection[str], report: Report, advance: NamedProgress
) -> None:
    """Whether the files that are expected are here as the manifest has them, and no others.

    Args:
        expected: file -> SHA-256.
        listed: all files of the manifest.
    """
    root = origin.folder
    present = set(files_below(root))
    if not report.quick or origin.remote is None:
        for name in sorted(expected.keys() - present):
            report.add(name, "listed in the manifest, but missing")
    for name in sorted(present - set(listed) - {MANIFEST, ORIGIN}):
        if not name.startswith(_OF_THE_HUB):
            report.add(name, "not listed in the manifest")
    both = sorted(expected.keys() & present)
    for number, name in enumerate(both, start=1):
        try:
            path = inside(root, name)
            if path.stat().st_size > LARGEST and not _is_covered(root, name):
                report.add(name, f"expected at most {LARGEST:,} bytes, found {path.stat().st_size:,}")
                continue
            found = expected[name] if report.quick else file_hash(path)
        except (Icrl4ahtError, OSError) as error:
            report.add(name, str(error))
            continue
        if found != expected[name]:
            report.add(name, f"sha256: expected {expected[name]}, found {found}")
        report.files += 1
        advance("files", number, len(both))


def _is_covered(root: Path, name: str) -> bool:
    """Whether a file is a shard of which the chunk table accounts for every byte: a hole is not worth hashing."""
    if not name.startswith("data/"):
        return False
    table = read_table(inside(root, chunk_table_name(name)))
    return int(table["size"].sum(dtype=np.int64)) == (root / name).stat().st_size


def _check_shards(index: Index, shards: list[str], report: Report, advance: NamedProgress) -> None:
    local = Root(index.root)  # what could not be fetched has been reported
    members = {name: [index.entries[row] for row in index.entries.shard_rows(name).tolist()] for name in shards}
    total = sum(map(len, members.values()))
    for name, entries in members.items():
        try:
            shard = Shard(local, name, index.info["kind"], entries)
        except Icrl4ahtError as error:
            report.add(name, str(error))
            continue
        for fault in shard.check_between() + shard.check_structure(values=report.deep):
            report.add(name, fault)
        damaged = _check_chunks(shard, report)
        seen: dict[tuple[str, bytes], int] = {}
        for entry in entries:
            if entry.history_id not in damaged:
                try:
                    _check_history(History(entry, shard, "uint8"), index, seen, report)
                except (Icrl4ahtError, MemoryError) as error:
                    report.add(name, f"history {entry.history_id}: could not be checked: {error!r}")
            report.histories += 1
            advance("histories", report.histories, total)


def _check_history(history: History, index: Index, seen: dict[tuple[str, bytes], int], report: Report) -> None:
    entry, kind = history.entry, index.info["kind"]
    layout = get_layout(entry.layout)
    bytes_a_step = sum(part.element(layout, kind).itemsize for part in entry.stored_fields(kind))
    if (size := _COPIES * entry.T * bytes_a_step) > free_memory():
        raise OptionError(f"takes {size / 1e9:.3g} GB of memory, more than is free")
    for problem in _history_problems(history, index.info["environment"]["kept_steps"], report.deep):
        report.add(entry.shard, f"history {entry.history_id}: {problem}")
    seen_and_done = (record_field(kind).name, "actions")
    content = hashlib.sha256(b"".join(history.read(part).tobytes() for part in seen_and_done)).digest()
    twin = seen.setdefault((entry.task_id, content), entry.history_id)
    if twin != entry.history_id:
        report.add(entry.shard, f"history {entry.history_id}: the same as history {twin}")
    report.transitions += entry.T


def _check_chunks(shard: Shard, report: Report) -> set[int]:
    """Decode every chunk; the histories that have a damaged one."""
    damaged = set()
    for row, history_id, field_ in shard.chunk_rows():
        try:
            shard.decode(row, history_id, field_)
        except Icrl4ahtError as error:
            report.add(shard.name, str(error))
            damaged.add(history_id)
        report.chunks += 1
    return damaged


def _history_problems(history: History, kept_steps: int, deep: bool) -> Iterator[str]:
    entry = history.entry
    layout = get_layout(entry.layout)
    dones, rewards, replayable = history.read("dones"), history.read("rewards"), history.kind in KINDS
    counted = entry.episodes == entry.T // kept_steps and not (replayable and entry.T % kept_steps)
    if not counted or not np.array_equal(dones, episode_ends(entry.T, kept_steps)):
        yield f"dones: expected {entry.episodes} episodes of {kept_steps} steps, found {dones.sum()} in {entry.T} steps"
        return
    for name in (name for name in ACTION_FIELDS if entry.has(FIELDS[name])):
        values = history.read(name)
        if values.min() < 0 or values.max() >= len(ACTIONS):
            yield f"{name}: expected 0..{len(ACTIONS) - 1}, found {values.min()}..{values.max()}"
    if (rewards != np.rint(rewards)).any() or np.abs(rewards).max() > np.iinfo(FIELDS["rewards"].compact).max:
        yield f"rewards: expected whole numbers that a byte holds, found {rewards.min()}..{rewards.max()}"
    impossible = False
    for name in ("state", "episode_end_state") if replayable else ():
        for fault in faults(layout, history.read(name)):
            impossible = True
            yield f"{name} has {fault}"
    returns = episode_returns(rewards, dones)[None]
    first, last = curve_ends(returns)
    found = {"return_start": first[0], "return_end": last[0], "return_mean": returns.mean()}
    found["score"] = stream_score(returns)[0]
    for name, value in found.items():
        if not np.isclose(value, getattr(entry, name), rtol=0, atol=1e-9):
            yield f"{name}: the index says {getattr(entry, name)}, the rewards give {value}"
    if deep and not replayable:
        yield from _place_problems(layout, history)
    elif deep and not impossible:
        yield from _physics_problems(layout, history, dones, rewards)


def _place_problems(layout: Layout, history: History) -> Iterator[str]:
    fixed = fixed_channels(layout)
    records = np.zeros((len(layout.rooms[EGO]), record_size(layout)), np.uint8)
    records[:, columns(layout).positions] = layout.rooms[EGO][:, None]
    views = {view.tobytes() for view in observe(layout, records, EGO)[..., fixed]}
    wrong = [t for t, seen in enumerate(history.read("obs")[..., fixed]) if seen.tobytes() not in views]
    if wrong:
        yield f"obs: {len(wrong)} steps do not show {layout.name} from any cell of the ego's, first step {wrong[0]}"


def _physics_problems(layout: Layout, history: History, dones: np.ndarray, rewards: np.ndarray) -> Iterator[str]:
    states, ends = history.read("state"), history.read("episode_end_state")
    if history.kind == "full":
        wrong = np.flatnonzero((history.read("obs") != observe(layout, states, EGO)).any(axis=(1, 2, 3)))
        if len(wrong):
            yield f"obs: {len(wrong)} steps differ from what their state shows, first step {wrong[0]}"
    following = np.concatenate([states[1:], states[:1]])
    following[dones] = ends
    recipe = columns(layout).recipe
    actions = np.stack([history.read("actions"), history.read("teammate_actions")], axis=-1)
    played = step(layout, states, np.clip(actions, 0, len(ACTIONS) - 1), following[:, recipe])
    wrong = np.flatnonzero((played.state != following).any(axis=-1))
    if len(wrong):
        yield f"replay: {len(wrong)} steps do not lead to the recorded next state, first step {wrong[0]}"
    wrong = np.flatnonzero(played.reward != rewards)
    if len(wrong):
        t = int(wrong[0])
        yield f"replay: {len(wrong)} rewards differ, first at step {t}: rules {played.reward[t]}, found {rewards[t]}"
    if not np.isin([*states[:, recipe], *ends[:, recipe]], layout.recipe_items).all():
        yield "a recipe is not one of the layout's"
    yield from _start_problems(layout, states[np.concatenate([[0], np.flatnonzero(dones)[:-1] + 1])])


def _start_problems(layout: Layout, starts: np.ndarray) -> Iterator[str]:
    where = columns(layout)
    positions = starts[:, where.positions]
    fresh = start(layout, positions, starts[:, where.facings], starts[:, where.recipe])
    wrong = (fresh != starts).any(axis=-1)
    for agent in (0, 1):
        wrong |= ~np.isin(positions[:, agent], layout.rooms[agent])
    if wrong.any():
        yield f"{wrong.sum()} episodes do not start as the environment starts, first episode {wrong.argmax()}"
