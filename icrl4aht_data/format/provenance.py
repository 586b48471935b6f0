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
"""Input of the policy that chose the expert actions, see `facts.LABEL_VIEWS`."""


class MeanStreamReturns(Struct, frozen=True, omit_defaults=True):
    """Mean returns of streams; a stream is all recorded episodes of one parallel environment of a learner.

    Args:
        streams: number of streams.
        return_start: mean return of the first episodes, see `schema.curve_ends`.
        return_end: mean return of the last episodes, see `schema.curve_ends`.
    """

    streams: StreamCount
    return_start: float
    return_end: float


class StreamFilter(Struct, frozen=True, omit_defaults=True):
    """Mean returns of all recorded streams of a task, and of the streams that became histories of the release.

    Args:
        before: returns of all recorded streams.
        after: returns of the streams that are in the release.
        least_improvement: minimum improvement of the return of a stream in the release; None if there was no minimum.
    """

    before: MeanStreamReturns
    after: MeanStreamReturns
    least_improvement: FiniteNumber | None = None


class ExpertLabels(Struct, frozen=True, omit_defaults=True):
    """Policy that produced the expert actions of all histories of a task.

    Args:
        policy_sha256: SHA-256 of the policy's weights; None for a script.
        action: how the policy chose actions, such as "greedy".
        step: number of environment steps that the policy was trained for; None for a script.
        return_greedy: mean return of the policy's greedy actions over `episodes` episodes with the task's teammate.
        return_sampled: mean return of the policy's sampled actions with the task's teammate.
        episodes: number of episodes of each measurement.
        last_return_greedy: greedy return of the learner's last checkpoint, which is the expert in the paper.
        view: input of the policy, a name in `facts.LABEL_VIEWS`; None if not recorded.
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
        teammates: entries of the teammates, as in `Task.teammate`, in order of play. The first entry is the task's
            teammate, which plays again after the last entry's teammate.
    """

    every: _Positive
    teammates: Annotated[list[dict[str, Any]], Meta(min_length=2)]

    def teammate(self, episode: int) -> dict[str, Any]:
        """Return the entry of the teammate that plays the episode with the given number, counted from 0."""
        return self.teammates[episode // self.every % len(self.teammates)]

    def spans(self, episodes: int) -> tuple[tuple[int, str], ...]:
        """Return pairs (first episode, teammate id) of a history, see `Entry.teammate_of_episode`."""
        return tuple((first, teammate_id(self.teammate(first))) for first in range(0, episodes, self.every))


class TeammateSuite(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Settings of the populations that a learned teammate was selected from.

    Args:
        algorithms: names of the training algorithms, by layout.
        members: number of policies in each population.
        train: wanted number of training teammates per population.
        total_steps: number of environment steps of each policy's training.
        threshold: minimum self-play return of a checkpoint.
        xla_threads: number of XLA's threads per operation on the CPU that trained the populations; None on other
            platforms or if unknown.
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
        stay: return of an ego that never moves.
        random: return of an ego with uniformly random actions.
        oracle: return of the scripted oracle, which sees the full state.
        episodes: number of episodes of each measurement.
        self_play: return of the training partner of a learned teammate (the last best response to the teammate, or the
            teammate itself) with sampled actions; None for heuristics or if not measured.
    """

    stay: FiniteNumber
    random: FiniteNumber
    oracle: FiniteNumber
    episodes: _Positive
    self_play: FiniteNumber | None = None

    @property
    def returns(self) -> dict[str, float]:
        """Mean returns of all measured egos, by name of the ego."""
        found = {"stay": self.stay, "random": self.random, "oracle": self.oracle, "self-play": self.self_play}
        return {name: value for name, value in found.items() if value is not None}

    @property
    def returns_differ(self) -> bool:
        """Whether the returns of the best and the worst measured ego differ by at least `LEAST_HEADROOM`."""
        return max(self.returns.values()) - min(self.returns.values()) >= LEAST_HEADROOM

    def describe(self) -> str:
        """Return text with the name and the mean return of each measured ego."""
        return ", ".join(f"{name} {value:.1f}" for name, value in self.returns.items())


class NearestTestTeammate(Struct, frozen=True, omit_defaults=True):
    """The test teammate on the same layout whose behaviour is most similar to that of the task's teammate.

    Args:
        teammate: family and number of the test teammate, such as "H3/t1".
        distance: fraction of states in which the two teammates choose different actions.
        behaviour: id of the behaviour of the task's teammate; drawn teammates of one layout and family with equal ids
            behave the same. Spread teammates have ids of their own. None if unknown.
    """

    teammate: str
    distance: Share
    behaviour: StoredCount | None = None


class Provenance(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Description of how the histories of one task were generated; None stands for a value that was not recorded.

    Args:
        profile: name of the generation profile.
        profile_hash: hash of the profile's content.
        ego: the ego's hyper-parameters, including the integers `total_steps` and `environments`.
        ego_hash: hash of the ego's hyper-parameters.
        code_version: version of this package.
        jax_version: version of JAX.
        platform: JAX backend, such as "cpu".
        xla_threads: number of XLA's threads per operation on a CPU, which affects the bits of results; None on other
            platforms.
        seed: the learner's seed.
        source: how the histories were made, see `Entry.source`.
        learners: number of independent learners, each with `ego["environments"]` streams; None for a script.
        noise: settings of noise histories: numbers of `histories` and `episodes`, and ranges [least, most] from which
            each history draws the probability of a random action at the `start` and the `end`, the fractions of the
            history at which the probability begins and stops to fall (`begin`, `finish`), and the exponent of the fall
            (`power`).
        references: returns of reference egos.
        nearest_test: the test teammate with the most similar behaviour to the task's teammate.
        teammate: the teammate's agent number (`slot`) and the source of its randomness (`noise`).
        streams_recorded: number of environment streams of all learners.
        streams_kept: number of streams that became histories.
        filter: returns of the streams before and after filtering.
        expert: the policy that produced the expert actions.
        suite: settings of the populations that a learned teammate was selected from.
        swaps: changes of the teammate within each history; None if the task's teammate plays all episodes.
        other: unknown fields, which stay unchanged. Histories of people have `person` with `pseudonym`,
            `steps_per_second`, and `views`: the view shown in each episode, "ego" (only the cells that an ego sees) or
            "whole" (the map with the recipe).
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
    nearest_test: NearestTestTeammate | None = None
    teammate: dict[str, Any] | None = None
    streams_recorded: StreamCount | None = None
    streams_kept: StreamCount | None = None
    filter: StreamFilter | None = None
    expert: ExpertLabels | None = None
    suite: TeammateSuite | None = None
    swaps: TeammateSwaps | None = None
    other: dict[str, Any] = {}

    def played_tasks(self, task: Task) -> list[Task]:
        """Return the task, followed by one copy for each other teammate that plays in the task's histories."""
        return [task, *(replace(task, teammate=one) for one in (self.swaps.teammates[1:] if self.swaps else ()))]

    def is_oracle_useful(self, return_end: float) -> bool:
        """Return whether the oracle is a useful expert, that is, earns at least `return_end`.

        Args:
            return_end: mean return of the last episodes of the task's histories, see `schema.curve_ends`.

        Returns:
            Whether the oracle earns at least `return_end`. Also True if the oracle's return is unknown, if teammates
            change (the known return is with the task's teammate), or for source `noise` (the expert is the oracle).
        """
        if self.references is None or self.swaps is not None or self.source == "noise":
            return True
        return self.references.oracle >= return_end

    def entry_fields(self, episodes: int, has_expert_actions: bool) -> dict[str, Any]:
        """Return the fields of an index entry that describe the history's expert and teammates.

        Args:
            episodes: number of episodes of the history.
            has_expert_actions: whether the history has the expert's actions; otherwise the expert's fields are None.
        """
        expert = (self.expert if has_expert_actions else None) or ExpertLabels(None, "")
        return {
            "expert_return": expert.return_greedy,
            "expert_return_sampled": expert.return_sampled,
            "expert_step": expert.step,
            "label_view": expert.view,
            "teammate_of_episode": self.swaps.spans(episodes) if self.swaps else None,
        }

    def to_json(self) -> dict[str, Any]:
        """Return the task's provenance as a JSON object, without fields that are None."""
        content = msgspec.to_builtins(self)
        other = content.pop("other", {})
        return content | other

    @classmethod
    def from_json(cls, content: Any) -> Provenance:
        """Parse the JSON object with the provenance of a task.

        Raises:
            IndexFormatError: if a value is wrong; the caller adds the file's path to the message.
        """
        if not isinstance(content, dict):
            raise IndexFormatError("expected a JSON object with one object for each task")
        known = set(cls.__struct_fields__) - {"other"}
        try:
            found = msgspec.convert({name: value for name, value in content.items() if name in known}, cls)
            msgspec.convert(found.ego, _EgoSetting | None)
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


class _EgoSetting(Struct):
    """The ego's hyper-parameters that this package reads; other hyper-parameters are not checked."""

    total_steps: int
    environments: int


class _NoiseSetting(Struct):
    """Validated settings of noise schedules; other settings are accepted unchecked."""

    histories: _Positive | None = None
    episodes: _Positive | None = None
    start: tuple[Share, Share] | None = None
    end: tuple[Share, Share] | None = None
    begin: tuple[Share, Share] | None = None
    finish: tuple[Share, Share] | None = None
    power: tuple[_Exponent, _Exponent] | None = None


class _TeammateSetting(Struct, forbid_unknown_fields=True):
    """Agent number and source of randomness of a teammate; other fields are invalid, since they belong to the task."""

    slot: Literal[1]
    noise: str | None = None


class ProvenanceByTask(dict[str, Provenance]):
    """Mapping of task ids to their `Provenance`, with a short repr."""

    def of(self, task_id: str) -> Provenance:
        """Return the provenance of a task; an empty `Provenance` if none is recorded."""
        return self.get(task_id, Provenance())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({counted_noun(len(self), 'task')})"


def read_provenance(path: Path) -> ProvenanceByTask:
    """Read meta/provenance.json, and return the provenance of each task by task id.

    Raises:
        IndexFormatError: if the file or the object of a task is malformed.
    """
    text, found, where = read_text(path), ProvenanceByTask(), ""
    try:
        content = parse_json(text)
        for task_id, of_task in (content if isinstance(content, dict) else {"": content}).items():
            where = f"malformed provenance of task {task_id[:100]!r}: "
            found[task_id] = Provenance.from_json(of_task)
    except IndexFormatError as error:
        raise IndexFormatError(f"{path}: {where}{error}") from error
    return found
