"""Heuristic families: the specification of their parameters, and the chain of keys that their noise is drawn from."""

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
from icrl4aht_generation.policy import Noise, Policy, Situation, on_layout, sometimes_random

RANDOM_ACTIONS = "random_actions"
"""Optional parameter of every family: chance that a step's action is drawn uniformly from the six instead. It is not
the paper's (see E3T, Yan et al. 2023)."""

SHARES = [0.0, 0.0, 0.25, 0.5, 0.75]
"""Values of a chance of not doing one's part, for `Heuristic.diverse`: none for two teammates in five."""


class Sampling(NamedTuple):
    """Distribution of a split's parameters, for teammates that are not published.

    Attributes:
        presets: names of presets, of which one is drawn.
        ranges: parameter -> (low, high) of a uniform draw, or a list of values of which one is drawn.
    """

    presets: tuple[str, ...]
    ranges: Mapping[str, tuple[float, float] | list[float]]


@dataclass(frozen=True, eq=False)
class Heuristic:
    """A family of heuristic teammates: how it plays, and which parameters it has.

    Attributes:
        kind: name of the family.
        begin: episode key -> memory at the start of an episode.
        act: (params, memory, scene) -> action, int32 scalar, and the memory after the step.
        defaults: parameter -> default, in order of declaration; integer parameters have integer defaults.
        presets: preset -> parameters that differ from the defaults.
        train: distribution of sampled parameters for training tasks (paper, App. B.2).
        test: the one for test tasks.
        spans: parameter -> full range; sampling moves these by up to a fifth of their range from the preset.
        choices: parameter -> n, for parameters that are one of 0..n-1.
        unbounded: parameters with no other limit than that of 32 bits; all others are in 0..1, or choices.
        diverse: distribution of all parameters that decide how a teammate acts, most of which the published ranges
            leave at their defaults. It is not the paper's; None for a family without diverse
            teammates.
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
        """Return a teammate of this family.

        Policies of one layout, slot and noise share their functions, and so their compilations.

        Args:
            layout: the layout whose state records it sees; None for a teammate that sees a `Situation` of any layout.
            theta: a value for every parameter, and perhaps for `RANDOM_ACTIONS`.
            slot: 0 or 1, the agent it plays.
            noise: source of its randomness.
        """
        init, act = _functions(self, slot, noise, RANDOM_ACTIONS in theta)
        params = {
            name: (jnp.int32 if isinstance(default, int) else jnp.float32)(theta[name])
            for name, default in (self.defaults | {RANDOM_ACTIONS: 0.0}).items()
            if name in theta
        }
        policy = Policy(params, init, act, "situation")
        return policy if layout is None else on_layout(policy, layout)

    @cached_property
    def theta_type(self) -> type[msgspec.Struct]:
        """Type of the parameters, which `msgspec.convert` checks: all of `defaults`, and perhaps `RANDOM_ACTIONS`."""
        most = {name: number - 1 for name, number in self.choices.items()} | dict.fromkeys(self.unbounded, 2**31 - 1)
        fields = [
            (name, Annotated[type(default), Meta(ge=0, le=most.get(name, 1))])
            for name, default in self.defaults.items()
        ]
        return msgspec.defstruct(self.kind, [*fields, (RANDOM_ACTIONS, Share, 0.0)], forbid_unknown_fields=True)


def parameters(presets: Sequence[str], rows: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Return the fields `defaults`, `presets` and `spans` of a family as keyword arguments of `Heuristic`.

    Args:
        presets: names of the presets; the values of the first one are the defaults.
        rows: parameter -> its full range, or None for a parameter that sampling leaves alone, then its value in each
            preset.
    """
    spans, *values = (dict(zip(rows, column, strict=True)) for column in zip(*rows.values(), strict=True))
    return {
        "defaults": values[0],
        "presets": dict(zip(presets, values, strict=True)),
        "spans": {name: span for name, span in spans.items() if span},
    }


@lru_cache(maxsize=64)
def _functions(heuristic: Heuristic, slot: int, noise: Noise, mixed: bool):
    """Return `init` and `act` of a policy, which `mixed` mixes with random actions."""

    # Cached, so that policies of one family are the same functions, and JAX compiles them once.
    def init(params, key: Key[Array, ""]) -> Any:
        return heuristic.begin(jax.random.key(slot) if noise == "fixed" else key)

    def act(params, memory: Any, view: Situation, key: Key[Array, ""]):
        # The rollout's key is not used: the published teammates carry a chain of keys in their memory.
        action, memory = heuristic.act(params, memory, Scene(view.tables, view.record, slot))
        return action.astype(jnp.int32), memory

    # The chain of keys of the random actions is apart from the published one, so that the heuristic draws as without.
    def mixed_init(params, key: Key[Array, ""]) -> Any:
        start = jax.random.key(slot) if noise == "fixed" else key
        return init(params, key), jax.random.fold_in(start, 1)

    def mixed_act(params, memory: Any, view: Situation, key: Key[Array, ""]):
        action, own = act(params, memory[0], view, key)
        following, drawn = jax.random.split(memory[1])
        return sometimes_random(drawn, params[RANDOM_ACTIONS], action), (own, following)

    return (mixed_init, mixed_act) if mixed else (init, act)


def next_key(key: Key[Array, ""]) -> Key[Array, ""]:
    """Return the next key of the chain."""
    return jax.random.split(key)[0]


def draw(key: Key[Array, ""]) -> tuple[Key[Array, ""], Float[Array, " 4"]]:
    """Return the next key of the chain and the step's uniform draws u1..u4, float32 in [0, 1)."""
    # The published chain: a split into five keys, of which the first continues it. Golden actions depend on it.
    keys = jax.random.split(key, 5)
    return keys[0], jax.vmap(jax.random.uniform)(keys[1:])


def extra_split(key: Key[Array, ""], where: Bool[Array, ""]) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """Split the chain once more where a branch draws more: the chain's key after it, and the key to draw from."""
    following, own = jax.random.split(key)
    return jnp.where(where, following, key), own
