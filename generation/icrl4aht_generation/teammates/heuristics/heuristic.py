"""Heuristic families: the specification of their parameters, and the chain of random keys for their noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
from jaxtyping import Array, Bool, Float, Int, Key
from msgspec import Meta

from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.utils.options import Share
from icrl4aht_generation.paths import Scene
from icrl4aht_generation.policy import Noise, Policy, Situation, on_layout, randomize_action

RANDOM_ACTIONS = "random_actions"
"""Optional parameter of every family: chance of a uniformly random action in a step. This parameter is an addition to
the paper (see E3T, Yan et al. 2023)."""

SHARES = [0.0, 0.0, 0.25, 0.5, 0.75]
"""Values of chances of mistakes in `Heuristic.diverse`; two of five teammates never make the mistake."""


class Sampling(NamedTuple):
    """Distribution of the parameters of sampled teammates in a split.

    Attributes:
        presets: names of presets, from which one is drawn.
        ranges: for each parameter (low, high) of a uniform distribution, or a list of values to choose from.
    """

    presets: tuple[str, ...]
    ranges: Mapping[str, tuple[float, float] | list[float]]


@dataclass(frozen=True, eq=False)
class Heuristic:
    """A family of heuristic teammates: functions that play, and specification of the parameters.

    Attributes:
        kind: name of the family.
        begin: function of the episode's key that returns the memory at the start of an episode.
        act: function of (params, memory, scene) that returns the action, int32 scalar, and the next memory.
        defaults: default value of each parameter, in order of declaration; integers for integer parameters.
        presets: for each preset the parameters that differ from the defaults.
        train: distribution of sampled parameters for training tasks (paper, App. B.2).
        test: distribution of sampled parameters for test tasks.
        spans: full range of parameters that sampling moves from the preset by up to a fifth of the range.
        choices: number n of values for each parameter with values 0..n-1.
        unbounded: names of parameters without a limit below that of 32 bits; all others are in 0..1, or choices.
        diverse: distribution of all parameters that decide a teammate's behaviour; an addition to the paper, with most
            published ranges at their defaults. None for a family without diverse teammates.
    """

    kind: str
    begin: Callable[[Key[Array, ""]], Any]
    act: Callable[[Mapping[str, Array], Any, Scene], tuple[Int[Array, ""], Any]]
    defaults: dict[str, float]
    presets: dict[str, dict[str, float]]
    train: Sampling
    test: Sampling
    spans: dict[str, tuple[float, float]]
    choices: dict[str, int] = field(default_factory=dict)
    unbounded: frozenset[str] = frozenset()
    diverse: Sampling | None = None

    def build(
        self, layout: Layout | None, theta: Mapping[str, float], slot: int = TEAMMATE, noise: Noise = "seeded"
    ) -> Policy:
        """Return a teammate of this family as a policy.

        Policies with equal layout, slot and noise have equal functions, so they share compilations.

        Args:
            layout: layout of the state records that the teammate sees; None for a teammate that sees a `Situation`.
            theta: a value for every parameter, and the optional `RANDOM_ACTIONS`.
            slot: 0 or 1, the agent that the teammate plays.
            noise: source of the teammate's randomness.
        """
        # Only teammates with random actions have the second chain of keys, which costs a draw in every step.
        init, act = _policy_functions(self, slot, noise, RANDOM_ACTIONS in theta)
        params = {
            name: (jnp.int32 if isinstance(default, int) else jnp.float32)(theta[name])
            for name, default in (self.defaults | {RANDOM_ACTIONS: 0.0}).items()
            if name in theta
        }
        policy = Policy(params, init, act, "situation")
        return policy if layout is None else on_layout(policy, layout)

    @cached_property
    def theta_type(self) -> type[msgspec.Struct]:
        """Type of the parameters for validation by msgspec: all of `defaults`, and the optional `RANDOM_ACTIONS`."""
        most = {name: number - 1 for name, number in self.choices.items()} | dict.fromkeys(self.unbounded, 2**31 - 1)
        fields = [
            (name, Annotated[type(default), Meta(ge=0, le=most.get(name, 1))])
            for name, default in self.defaults.items()
        ]
        return msgspec.defstruct(self.kind, [*fields, (RANDOM_ACTIONS, Share, 0.0)], forbid_unknown_fields=True)


def parameters(presets: Sequence[str], rows: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Return the fields `defaults`, `presets` and `spans` of a family as keyword arguments of `Heuristic`.

    Args:
        presets: names of the presets; the first preset has the default values.
        rows: for each parameter its full range (None if sampling does not change the parameter), followed by its value
            in each preset.
    """
    spans, *values = (dict(zip(rows, column, strict=True)) for column in zip(*rows.values(), strict=True))
    return {
        "defaults": values[0],
        "presets": dict(zip(presets, values, strict=True)),
        "spans": {name: span for name, span in spans.items() if span},
    }


@lru_cache(maxsize=64)
def _policy_functions(heuristic: Heuristic, slot: int, noise: Noise, mixed: bool):
    """Return the functions `init` and `act` of a policy; with `mixed`, some actions are random."""

    # These functions are cached, because JAX compiles only once for policies with the same functions.
    def init(params, key: Key[Array, ""]) -> Any:
        return heuristic.begin(jax.random.key(slot) if noise == "fixed" else key)

    def act(params, memory: Any, view: Situation, key: Key[Array, ""]):
        # The rollout's key is not used, because published teammates have a chain of keys in their memory.
        action, memory = heuristic.act(params, memory, Scene(view.tables, view.record, slot))
        return action.astype(jnp.int32), memory

    # Random actions use a separate chain of keys, so they do not change the heuristic's random draws.
    def mixed_init(params, key: Key[Array, ""]) -> Any:
        start = jax.random.key(slot) if noise == "fixed" else key
        return init(params, key), jax.random.fold_in(start, 1)

    def mixed_act(params, memory: Any, view: Situation, key: Key[Array, ""]):
        action, own = act(params, memory[0], view, key)
        following, drawn = jax.random.split(memory[1])
        return randomize_action(drawn, params[RANDOM_ACTIONS], action), (own, following)

    return (mixed_init, mixed_act) if mixed else (init, act)


def next_key(key: Key[Array, ""]) -> Key[Array, ""]:
    """Return the next random key of a teammate."""
    return jax.random.split(key)[0]


def draw(key: Key[Array, ""]) -> tuple[Key[Array, ""], Float[Array, " 4"]]:
    """Return a teammate's next random key, and four uniform random numbers u1..u4, float32 in [0, 1)."""
    # As in the published code, the first of five keys becomes the next random key; the others give u1..u4.
    keys = jax.random.split(key, 5)
    return keys[0], jax.vmap(jax.random.uniform)(keys[1:])


def split_key_again(key: Key[Array, ""], where: Bool[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """Return a teammate's next random key, split once more if `where` is true, and a key for additional draws."""
    # The published code draws these numbers in some states only. Selecting a key gives the same keys; with a branch,
    # `jax.vmap` would compute both cases anyway.
    following, own = jax.random.split(key)
    return jnp.where(where, following, key), own
