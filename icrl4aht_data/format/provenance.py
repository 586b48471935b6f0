"""Content of meta/provenance.json: how the histories of each task were generated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from icrl4aht_data.benchmark.facts import LEAST_HEADROOM
from icrl4aht_data.benchmark.tasks import Task, check_teammate, teammate_id
from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError
from icrl4aht_data.format.schema import FiniteNumber, StoredCount, StreamCount, check_name
from icrl4aht_data.utils.files import parse_json, read_text
from icrl4aht_data.utils.options import Share
from icrl4aht_data.utils.text import counted_noun

_Positive = Annotated[int, Meta(ge=1, le=2**63 - 1)]
_Exponent = Annotated[float, Meta(gt=0, lt=1e15)]

LabelView = Literal["ego", "state"]
"""One of `facts.LABEL_VIEWS`."""


class StreamReturns(Struct, frozen=True, omit_defaults=True):
    """Mean returns of a set of environment streams.

    Args:
        streams: number of streams.
        return_start: mean over the first episodes, see `schema.curve_ends`.
        return_end: mean over the last episodes.
    """

    streams: StreamCount
    return_start: float
    return_end: float


class StreamFilter(Struct, frozen=True, omit_defaults=True):
    """Mean returns before and after filtering a task's streams.

    Args:
        before: all recorded streams.
        after: the streams that the release keeps.
        least_improvement: minimum improvement of a kept stream's return; None without such a filter.
    """

    before: StreamReturns
    after: StreamReturns
    least_improvement: FiniteNumber | None = None


class ExpertLabels(Struct, frozen=True, omit_defaults=True):
    """Policy that produced the expert actions of all histories of a task.

    Args:
        policy_sha256: SHA-256 of the policy's weights; None for a script.
        action: how the policy chose actions.
        step: environment steps that the policy was trained for; None for a script.
        return_greedy: mean return of the policy's greedy actions over `episodes` episodes with the task's teammate.
        return_sampled: mean return of its sampled actions.
        episodes: number of episodes of each measurement.
        last_return_greedy: greedy return of the learner's last checkpoint, the paper's source of labels.
        view: what the policy could see: a name in `facts.LABEL_VIEWS`; None if not recorded.
    """

    policy_sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")] | None
    action: str
    step: StoredCount | None = None
    return_greedy: FiniteNumber | None = None
    return_sampled: FiniteNumber | None = None
    episodes: StoredCount | None = None
    last_return_greedy: FiniteNumber | None = None
    view: LabelView | None = None


class TeammateSwaps(Struct, frozen=True, omit_defaults=True):
    """Changes of the teammate within each history of a task.

    Args:
        every: number of episodes after which the next teammate plays.
        teammates: entries of the teammates, as in `Task.teammate`, in order of play; after the last one the first one,
            the task's own, plays again.
    """

    every: _Positive
    teammates: Annotated[list[dict[str, Any]], Meta(min_length=2)]

    def teammate(self, episode: int) -> dict[str, Any]:
        """Return the entry of the teammate that plays an episode, counted from 0."""
        return self.teammates[episode // self.every % len(self.teammates)]

    def spans(self, episodes: int) -> tuple[tuple[int, str], ...]:
        """Return `Entry.teammate_of_episode` of a history with a number of episodes."""
        return tuple((first, teammate_id(self.teammate(first))) for first in range(0, episodes, self.every))


class TeammateSuite(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Settings of the populations that a learned teammate was selected from.

    Args:
        algorithms: layout -> algorithms.
        members: policies in each population.
        train: training teammates wanted per population.
        total_steps: environment steps of each member's training.
        threshold: minimum self-play return of a checkpoint.
        xla_threads: XLA's threads per operation on the CPU that trained them; None on other platforms or if unknown.
    """

    algorithms: dict[str, list[str]]
    members: int
    train: int
    total_steps: int
    threshold: float
    xla_threads: Annotated[int, Meta(ge=1)] | None = None


class ReferenceEgos(Struct, frozen=True, omit_defaults=True):
    """Mean returns of reference egos with the task's teammate, in episodes of `facts.KEPT_STEPS` steps.

    Args:
        stay: an ego that never moves.
        random: an ego with uniformly random actions.
        oracle: the scripted oracle, which sees the full state.
        episodes: number of episodes of each measurement.
        self_play: the training partner of a learned teammate (its last best response, or itself) with sampled actions;
            None for heuristics or if not measured.
    """

    stay: FiniteNumber
    random: FiniteNumber
    oracle: FiniteNumber
    episodes: _Positive
    self_play: FiniteNumber | None = None

    @property
    def returns(self) -> dict[str, float]:
        """Name of the ego -> mean return, for all measured egos."""
        found = {"stay": self.stay, "random": self.random, "oracle": self.oracle, "self-play": self.self_play}
        return {name: value for name, value in found.items() if value is not None}

    @property
    def matters(self) -> bool:
        """Whether the best ego earns at least `LEAST_HEADROOM` more than the worst."""
        return max(self.returns.values()) - min(self.returns.values()) >= LEAST_HEADROOM

    def describe(self) -> str:
        """Return the returns as text."""
        return ", ".join(f"{name} {value:.1f}" for name, value in self.returns.items())


class NearestTest(Struct, frozen=True, omit_defaults=True):
    """The test teammate on the same layout that acts most like the task's teammate.

    Args:
        teammate: family and number of the test teammate, such as "H3/t1".
        distance: share of states in which the two choose different actions.
        behaviour: id of the teammate's behaviour; teammates of the same layout and family with equal ids act alike.
            None if unknown.
    """

    teammate: str
    distance: Share
    behaviour: StoredCount | None = None


class Provenance(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How the histories of one task were generated. None means not recorded.

    Args:
        profile: name of the generation profile.
        profile_hash: hash of that profile's content.
        ego: the ego's hyper-parameters, including the integers `total_steps` and `environments`.
        ego_hash: hash of these hyper-parameters.
        code_version: version of this package.
        jax_version: version of JAX.
        platform: JAX backend, such as "cpu".
        xla_threads: XLA's threads per operation on a CPU, which affect the results' bits; None on other platforms.
        seed: the learner's seed.
        source: how the histories were made, see `Entry.source`.
        learners: number of independent learners, each with `ego["environments"]` streams; None for a script.
        noise: settings of noise histories: numbers of `histories` and `episodes`, and ranges [least, most] that each
            history draws from: the chance of a random action at the `start` and the `end`, the shares of the history at
            which its fall begins and ends (`begin`, `finish`), the exponent of the fall (`power`).
        references: returns of reference egos.
        nearest_test: the test teammate that acts most like this one.
        teammate: the teammate's agent `slot` and the source of its `noise`.
        streams_recorded: number of environment streams of all learners.
        streams_kept: number of streams that became histories.
        filter: returns of the streams before and after filtering.
        expert: the policy that produced the expert actions.
        suite: the populations that a learned teammate was selected from.
        swaps: changes of the teammate within each history; None if the task's teammate plays all episodes.
        other: further fields, kept unchanged. Histories of people have `person`: `pseudonym`; `views`, what was shown
            in each episode ("ego", the cells that an ego sees, or "whole", the map with the recipe);
            `steps_per_second`.
    """

    profile: str | None = None
    profile_hash: str | None = None
    ego: dict[str, Any] | None = None
    ego_hash: str | None = None
    code_version: str | None = None
    jax_version: str | None = None
    platform: str | None = None
    xla_threads: Annotated[int, Meta(ge=1)] | None = None
    seed: int | None = None
    source: str | None = None
    learners: _Positive | None = None
    noise: dict[str, Any] | None = None
    references: ReferenceEgos | None = None
    nearest_test: NearestTest | None = None
    teammate: dict[str, Any] | None = None
    streams_recorded: StreamCount | None = None
    streams_kept: StreamCount | None = None
    filter: StreamFilter | None = None
    expert: ExpertLabels | None = None
    suite: TeammateSuite | None = None
    swaps: TeammateSwaps | None = None
    other: dict[str, Any] = {}

    def played(self, task: Task) -> list[Task]:
        """Return the task, and after it a copy with each further teammate that plays in its histories."""
        return [task, *(replace(task, teammate=one) for one in (self.swaps.teammates[1:] if self.swaps else ()))]

    def wants_oracle(self, return_end: float) -> bool:
        """Return whether the oracle's actions are worth learning: whether it earns what the histories' end earns.

        Args:
            return_end: mean return of the last episodes of the task's histories, see `schema.curve_ends`.

        Returns:
            True as well if the oracle's return is unknown, if teammates change, since it is with the task's own, and
            for source `noise`, whose expert is the oracle.
        """
        if self.references is None or self.swaps is not None or self.source == "noise":
            return True
        return self.references.oracle >= return_end

    def entry_fields(self, episodes: int) -> dict[str, Any]:
        """Return the fields of an index entry that describe its expert and its teammates.

        Args:
            episodes: number of the history's episodes.
        """
        expert = self.expert or ExpertLabels(None, "")
        return {
            "expert_return": expert.return_greedy,
            "expert_return_sampled": expert.return_sampled,
            "expert_step": expert.step,
            "label_view": expert.view,
            "teammate_of_episode": self.swaps.spans(episodes) if self.swaps else None,
        }

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object of a task, without fields that are None."""
        content = msgspec.to_builtins(self)
        other = content.pop("other", {})
        return content | other

    @classmethod
    def from_json(cls, content: Any) -> Provenance:
        """Parse the JSON object of a task.

        Raises:
            IndexFormatError: without the file, which the caller adds.
        """
        if not isinstance(content, dict):
            raise IndexFormatError("expected an object of objects, one for each task")
        known = set(cls.__struct_fields__) - {"other"}
        try:
            found = msgspec.convert({name: value for name, value in content.items() if name in known}, cls)
            msgspec.convert(found.ego, _EgoScale | None)
            msgspec.convert(found.teammate, _TeammateSetting | None)
            noise = msgspec.convert(found.noise or {}, _NoiseSetting)
            for name, value in msgspec.structs.asdict(noise).items():
                if isinstance(value, tuple) and value[0] > value[1]:
                    raise IndexFormatError(f"noise.{name}: expected a range [least, most], found {list(value)}")
            for teammate in found.swaps.teammates if found.swaps else ():
                check_teammate(teammate)
            for name in filter(None, (found.source, found.nearest_test and found.nearest_test.teammate)):
                check_name(name)
        except (msgspec.ValidationError, Icrl4ahtError) as error:
            raise IndexFormatError(str(error)) from error
        return msgspec.structs.replace(
            found, other={name: value for name, value in content.items() if name not in known}
        )


class _EgoScale(Struct):
    """Hyper-parameters of the ego that this package reads."""

    total_steps: int
    environments: int


class _NoiseSetting(Struct):
    """Known settings of noise schedules; unknown ones are kept unchanged."""

    histories: _Positive | None = None
    episodes: _Positive | None = None
    start: tuple[Share, Share] | None = None
    end: tuple[Share, Share] | None = None
    begin: tuple[Share, Share] | None = None
    finish: tuple[Share, Share] | None = None
    power: tuple[_Exponent, _Exponent] | None = None


class _TeammateSetting(Struct, forbid_unknown_fields=True):
    """Agent slot and noise source of a teammate. The task defines the teammate itself, so other fields are refused."""

    slot: Literal[1]
    noise: str | None = None


class ProvenanceByTask(dict[str, Provenance]):
    """Mapping of task ids to their `Provenance`, with a short repr."""

    def of(self, task_id: str) -> Provenance:
        """Return the provenance of a task; one without any fields if it is not recorded."""
        return self.get(task_id, Provenance())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({counted_noun(len(self), 'task')})"


def read_provenance(path: Path) -> ProvenanceByTask:
    """Read meta/provenance.json: task_id -> provenance.

    Raises:
        IndexFormatError: if the file or the object of a task is malformed.
    """
    text, found, where = read_text(path), ProvenanceByTask(), ""
    try:
        content = parse_json(text)
        for task_id, of_task in (content if isinstance(content, dict) else {"": content}).items():
            where = f"not as `generation` writes it: {task_id[:100]!r}: "
            found[task_id] = Provenance.from_json(of_task)
    except IndexFormatError as error:
        raise IndexFormatError(f"{path}: {where}{error}") from error
    return found
