"""Two small worlds in which adaptation in context is known to be possible, with the algorithms that learn in them.

Bernoulli bandits: arms with unknown means, uniform in 0..1. Dark Room: a square grid with an unknown goal; the ego sees
where it is, not where the goal is, and is rewarded while it stands on it (Laskin et al. 2022). `N` denotes tasks or
streams, `T` steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from baselines.agents.host import Percept
from baselines.methods.encoder import FlatEncoder
from baselines.methods.method import World
from baselines.methods.tokens import plain_view
from generation.policy import Policy
from icrl4aht_data.sampling.ad import ADBatch
from icrl4aht_data.sampling.dpt import DPTBatch
from icrl4aht_data.sampling.draws import random_uint32, scale_to_range


class SmallWorld(NamedTuple):
    """Rules for one task, as pure functions; `task` is an array, the state a whole number."""

    world: World
    episode: int  # steps; 0 for one episode without an end
    start: Int[Array, ""]
    observe: Callable[[Array], Array]  # state -> observation
    step: Callable[[Array, Array, Array, Array], tuple[Array, Array]]  # task, state, action, key -> state, reward


ARMS = 5


def bandit() -> SmallWorld:
    """A task is the arms' means, float32 (5,); a reward is 1 or 0."""

    def step(means: Array, state: Array, action: Array, key: Array) -> tuple[Array, Array]:
        return state, 1.0 * (jax.random.uniform(key) < means[action])

    world = World(lambda dtype: FlatEncoder(8, dtype), (1,), plain_view, ARMS)
    return SmallWorld(world, 0, jnp.int32(0), lambda state: jnp.ones(1), step)


SIDE, MOVES = 5, np.array([[-1, 0], [1, 0], [0, -1], [0, 1], [0, 0]])
CELLS = SIDE * SIDE
MIDDLE = CELLS // 2
ROOM_STEPS = 10
"""Of an episode, which starts in the middle."""


_ROWS, _COLUMNS = np.divmod(np.arange(CELLS), SIDE)
SEEN = np.concatenate([np.tri(SIDE, SIDE - 1, -1, dtype=np.uint8)[line] for line in (_ROWS, _COLUMNS)], axis=1)
"""uint8 (cells, 2 * (SIDE - 1)): the observation, row and column each as so many ones."""


def _next_cells() -> np.ndarray:
    """int32 (cells, moves)."""
    to = np.clip(np.stack([_ROWS, _COLUMNS], axis=-1)[:, None] + MOVES, 0, SIDE - 1)
    return (to[..., 0] * SIDE + to[..., 1]).astype(np.int32)


def dark_room() -> SmallWorld:
    """A task is the goal's cell, int32 (); the reward is 1 after a step that ends on it."""
    table = jnp.asarray(_next_cells())

    def step(goal: Array, cell: Array, action: Array, key: Array) -> tuple[Array, Array]:
        cell = table[cell, action]
        return cell, 1.0 * (cell == goal)

    world = World(lambda dtype: FlatEncoder(32, dtype), (2 * (SIDE - 1),), plain_view, len(MOVES))
    return SmallWorld(world, ROOM_STEPS, jnp.int32(MIDDLE), lambda cell: jnp.asarray(SEEN)[cell], step)


def best_return(goal: np.ndarray) -> np.ndarray:
    """Of an episode that goes straight to the goal, float (N,)."""
    return ROOM_STEPS + 1.0 - np.maximum(_distance(goal, np.asarray(MIDDLE)), 1)


def play(
    small: SmallWorld, policy: Policy, tasks: Array, seed: int, steps: int
) -> tuple[Int[Array, "N T"], Float[Array, "N T"]]:
    """What an ego does and gets in every task: actions, rewards. Its memory lives through the task."""

    def one(task: Array, key: Array) -> tuple[Array, Array]:
        def step(carry: Any, t: Array) -> tuple[Any, Any]:
            state, memory, before = carry
            mine, world = jax.random.split(jax.random.fold_in(key, t))
            action, memory = policy.act(policy.params, memory, before._replace(obs=small.observe(state)), mine)
            state, reward = small.step(task, state, action, world)
            done = (t + 1) % small.episode == 0 if small.episode else jnp.bool_(False)
            state = jnp.where(done, small.start, state)
            after = Percept(before.obs, action, jnp.float32(reward), jnp.int32(0), done)
            return (state, memory, after), (action, reward)

        obs = jnp.zeros_like(small.observe(small.start))
        nothing = Percept(obs, jnp.int32(0), jnp.float32(0), jnp.int32(0), jnp.bool_(False))
        return jax.lax.scan(step, (small.start, policy.init(policy.params, key), nothing), jnp.arange(steps))[1]

    return jax.jit(jax.vmap(one))(tasks, jax.random.split(jax.random.key(seed), len(tasks)))


class Pool:
    """Batches drawn from a fixed set of rows, each a function of (seed, i): a sampler for the trainer."""

    def __init__(self, rows: ADBatch | DPTBatch, batch_size: int, seed: int = 0) -> None:
        self.rows, self.batch_size, self.seed = rows, batch_size, seed

    def batch(self, i: int, out: Any = None) -> Any:
        """Batch i."""
        chosen = scale_to_range(random_uint32(self.seed, i, 1, self.batch_size)[0], len(self.rows[0]))
        return jax.tree.map(lambda array: array[chosen], self.rows)

    def empty(self) -> Any:
        """A batch of that size; nothing is written into it."""
        return self.batch(0)


Choose = Callable[[np.ndarray, np.ndarray, int, np.random.Generator], np.ndarray]
"""Successes and failures of every arm (N, arms), the step, randomness -> arms (N,)."""


def thompson(wins: np.ndarray, losses: np.ndarray, t: int, rng: np.random.Generator) -> np.ndarray:
    """Thompson sampling under the prior that the tasks come from."""
    return rng.beta(1 + wins, 1 + losses).argmax(axis=1)


def ucb(wins: np.ndarray, losses: np.ndarray, t: int, rng: np.random.Generator) -> np.ndarray:
    """Upper confidence bounds, half as wide as UCB1's; ties are broken at random."""
    pulls = wins + losses
    bound = wins / np.maximum(pulls, 1) + np.sqrt(0.5 * np.log(t + 1) / np.maximum(pulls, 1))
    return (np.where(pulls > 0, bound, 9.0) + 1e-6 * rng.random(bound.shape)).argmax(axis=1)


def play_bandits(
    choose: Choose, means: np.ndarray, steps: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Actions int32 and rewards float32 (N, T) of an algorithm on bandits (N, arms)."""
    wins, losses = np.zeros_like(means), np.zeros_like(means)
    row, actions, rewards = np.arange(len(means)), [], []
    for t in range(steps):
        action = choose(wins, losses, t, rng)
        reward = rng.random(len(means)) < means[row, action]
        wins[row, action] += reward
        losses[row, action] += ~reward
        actions.append(action)
        rewards.append(reward)
    return np.stack(actions, axis=1).astype(np.int32), np.stack(rewards, axis=1).astype(np.float32)


def search(goals: np.ndarray, episodes: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Learning histories of a model-based learner in Dark Rooms: cells, actions int32 and rewards float32 (N, T).

    It knows how it moves but not where the goal is: it walks from one random cell to the next until it is rewarded, and
    from then on straight to where that was. Half of its moves are random at first, linearly fewer until, from 0.6 of
    the history on, it is 3 in 100: so histories show what to do after few rewards as well as after many.
    """
    table = _next_cells()
    target = rng.integers(0, CELLS, len(goals))
    cell, known = target, np.zeros(len(goals), bool)
    steps = episodes * ROOM_STEPS
    cells, actions, rewards = (np.zeros((len(goals), steps), kind) for kind in ("i4", "i4", "f4"))
    for t in range(steps):
        if t % ROOM_STEPS == 0:
            cell = np.full(len(goals), MIDDLE)
        arrived = (cell == target) & ~known
        target = np.where(arrived, rng.integers(0, CELLS, len(goals)), target)
        distance = _distance(table[cell], target[:, None]) + 0.5 * rng.random((len(goals), len(MOVES)))
        noise = rng.random(len(goals)) < max(0.03, 0.5 * (1 - t / (0.6 * steps)))
        action = np.where(noise, rng.integers(0, len(MOVES), len(goals)), distance.argmin(axis=1))
        cells[:, t], actions[:, t] = cell, action
        cell = table[cell, action]
        rewards[:, t] = cell == goals
        known |= cell == goals
        target = np.where(cell == goals, goals, target)
    return cells, actions, rewards


def _distance(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Moves between cells."""
    return np.abs(_ROWS[one] - _ROWS[two]) + np.abs(_COLUMNS[one] - _COLUMNS[two])


def ad_rows(obs: np.ndarray, actions: np.ndarray, rewards: np.ndarray, episode: int) -> ADBatch:
    """Whole histories (N, T, ..) as windows."""
    t = np.arange(actions.shape[1])
    dones = np.broadcast_to((t + 1) % episode == 0 if episode else t < 0, actions.shape)
    before = [np.pad(array[:, :-1], ((0, 0), (1, 0))) for array in (actions, rewards)]
    return ADBatch(obs, before[0], before[1], actions, dones, np.ones(actions.shape, bool))


def dpt_rows(tasks: int, context: int, rng: np.random.Generator) -> DPTBatch:
    """Bandits with contexts by players of all kinds, as DPT is trained on (Lee et al. 2023), and the best arm.

    A player draws from a mixture of a random policy and one arm, in a share from none to all.
    """
    means = rng.random((tasks, ARMS))
    share = rng.integers(0, 11, (tasks, 1)) / 10
    chance = (1 - share) * rng.dirichlet(np.ones(ARMS), tasks) + share * np.eye(ARMS)[rng.integers(0, ARMS, tasks)]
    drawn = rng.random((tasks, context, 1)) > np.cumsum(chance, axis=1)[:, None]
    actions = np.minimum(drawn.sum(axis=-1), ARMS - 1).astype(np.int32)
    rewards = (rng.random(actions.shape) < np.take_along_axis(means, actions, axis=1)).astype(np.float32)
    same = np.ones((*actions.shape, 1), np.uint8)
    return DPTBatch(same[:, 0], means.argmax(axis=1).astype(np.int32), same, actions, same, rewards)
