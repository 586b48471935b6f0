"""Two small environments in which adaptation in context is known to be possible, and algorithms that learn in them.

Bernoulli bandits have arms with unknown means, uniform in 0..1. Dark Room is a square grid with an unknown goal: the
ego observes its position but not the goal, and is rewarded while it is on the goal (Laskin et al. 2022).

Shapes: `N` tasks or histories, `T` steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.learners.encoder import orthogonal_dense
from icrl4aht_generation.policy import Policy
from jaxtyping import Array, Float, Int, Num

from icrl4aht_baselines.agents.host import EgoInput
from icrl4aht_baselines.methods.method import World
from icrl4aht_baselines.methods.tokens import plain_view
from icrl4aht_data.sampling.ad import ADBatch
from icrl4aht_data.sampling.dpt import DPTBatch
from icrl4aht_data.sampling.draws import random_uint32, scale_to_range


class FlatEncoder(nn.Module):
    """Encoder with one dense layer, for observations that are short vectors."""

    features: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, obs: Num[Array, "*B N"]) -> Float[Array, "*B F"]:
        """Return the features of integer or float observations."""
        return orthogonal_dense(self.features)(obs.astype(self.dtype))


class SmallWorld(NamedTuple):
    """Rules of a small environment, as pure functions. A task is an array, and a state is an integer.

    Attributes:
        world: description of the environment for models.
        episode: steps of an episode; 0 for a single episode without an end.
        start: int32 (), state at the start of an episode.
        observe: function from a state to the observation.
        step: function from (task, state, action, key) to (state, reward).
    """

    world: World
    episode: int
    start: Int[Array, ""]
    observe: Callable[[Array], Array]
    step: Callable[[Array, Array, Array, Array], tuple[Array, Array]]


ARMS = 5
"""Number of arms of a bandit."""


def bandit() -> SmallWorld:
    """Return the environment of Bernoulli bandits. A task is the means of the 5 arms; a reward is 1 or 0."""

    def step(means: Array, state: Array, action: Array, key: Array) -> tuple[Array, Array]:
        return state, 1.0 * (jax.random.uniform(key) < means[action])

    world = World(lambda dtype: FlatEncoder(8, dtype), (1,), plain_view, ARMS)
    return SmallWorld(world, 0, jnp.int32(0), lambda state: jnp.ones(1), step)


SIDE, MOVES = 5, np.array([[-1, 0], [1, 0], [0, -1], [0, 1], [0, 0]])
CELLS = SIDE * SIDE
MIDDLE = CELLS // 2
"""Number of the grid cell where episodes of Dark Room start."""

ROOM_STEPS = 10
"""Number of steps of an episode of Dark Room."""

_ROWS, _COLUMNS = np.divmod(np.arange(CELLS), SIDE)
CELL_OBS = np.concatenate([np.tri(SIDE, SIDE - 1, -1, dtype=np.uint8)[line] for line in (_ROWS, _COLUMNS)], axis=1)
"""Observation in each grid cell, uint8 (cells, 2 * (SIDE - 1)): r ones for row r, then c ones for column c."""


_TO = np.clip(np.stack([_ROWS, _COLUMNS], axis=-1)[:, None] + MOVES, 0, SIDE - 1)
NEXT_CELLS = (_TO[..., 0] * SIDE + _TO[..., 1]).astype(np.int32)
"""Number of the grid cell that each move leads to, int32 (cells, moves)."""


def dark_room() -> SmallWorld:
    """Return the environment Dark Room. A task is the number of the goal's cell; a step that ends on it earns 1."""
    next_cells = jnp.asarray(NEXT_CELLS)

    def step(goal: Array, cell: Array, action: Array, key: Array) -> tuple[Array, Array]:
        cell = next_cells[cell, action]
        return cell, 1.0 * (cell == goal)

    world = World(lambda dtype: FlatEncoder(32, dtype), (2 * (SIDE - 1),), plain_view, len(MOVES))
    return SmallWorld(world, ROOM_STEPS, jnp.int32(MIDDLE), lambda cell: jnp.asarray(CELL_OBS)[cell], step)


def best_return(goal: np.ndarray) -> np.ndarray:
    """Return the highest possible return in Dark Room for each goal: the return of a straight walk to the goal."""
    return ROOM_STEPS + 1.0 - np.maximum(_distance(goal, np.asarray(MIDDLE)), 1)


def play_small_tasks(
    small: SmallWorld, policy: Policy, tasks: Array, seed: int, steps: int
) -> tuple[Int[Array, "N T"], Float[Array, "N T"]]:
    """Play tasks of a small environment. The ego keeps its memory for a complete task. Return actions and rewards."""

    def play_task(task: Array, key: Array) -> tuple[Array, Array]:
        def step(carry: Any, t: Array) -> tuple[Any, Any]:
            state, memory, before = carry
            ego_key, world_key = jax.random.split(jax.random.fold_in(key, t))
            action, memory = policy.act(policy.params, memory, before._replace(obs=small.observe(state)), ego_key)
            state, reward = small.step(task, state, action, world_key)
            done = (t + 1) % small.episode == 0 if small.episode else jnp.bool_(False)
            state = jnp.where(done, small.start, state)
            after = EgoInput(before.obs, action, jnp.float32(reward), jnp.int32(0), done)
            return (state, memory, after), (action, reward)

        obs = jnp.zeros_like(small.observe(small.start))
        nothing = EgoInput(obs, jnp.int32(0), jnp.float32(0), jnp.int32(0), jnp.bool_(False))
        return jax.lax.scan(step, (small.start, policy.init(policy.params, key), nothing), jnp.arange(steps))[1]

    return jax.jit(jax.vmap(play_task))(tasks, jax.random.split(jax.random.key(seed), len(tasks)))


class RowSampler:
    """Sampler that draws training batches from fixed rows of data; batch i is a function of (seed, i)."""

    def __init__(self, rows: ADBatch | DPTBatch, batch_size: int, seed: int = 0) -> None:
        self.rows, self.batch_size, self.seed = rows, batch_size, seed

    def batch(self, i: int, out: Any = None) -> Any:
        """Return batch number i."""
        chosen = scale_to_range(random_uint32(self.seed, i, 1, self.batch_size)[0], len(self.rows[0]))
        return jax.tree.map(lambda array: array[chosen], self.rows)

    def empty(self) -> Any:
        """Return a batch that shows the shapes and dtypes of all batches."""
        return self.batch(0)


BanditAlgorithm = Callable[[np.ndarray, np.ndarray, int, np.random.Generator], np.ndarray]
"""(successes (N, arms), failures (N, arms), step, random generator) -> chosen arms (N,)."""


def thompson(wins: np.ndarray, losses: np.ndarray, t: int, rng: np.random.Generator) -> np.ndarray:
    """Choose arms by Thompson sampling, with the distribution of the tasks as the prior."""
    return rng.beta(1 + wins, 1 + losses).argmax(axis=1)


def ucb(wins: np.ndarray, losses: np.ndarray, t: int, rng: np.random.Generator) -> np.ndarray:
    """Choose arms by upper confidence bounds half as wide as those of UCB1; ties are broken at random."""
    pulls = wins + losses
    bound = wins / np.maximum(pulls, 1) + np.sqrt(0.5 * np.log(t + 1) / np.maximum(pulls, 1))
    return (np.where(pulls > 0, bound, 9.0) + 1e-6 * rng.random(bound.shape)).argmax(axis=1)


def play_bandits(
    choose: BanditAlgorithm, means: np.ndarray, steps: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Play N bandits, with means of shape (N, arms). Return int32 actions and float32 rewards, both of shape (N, T)."""
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


def dark_room_histories(
    goals: np.ndarray, episodes: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Dark Room histories of a learner that finds the goal: positions and actions (int32), rewards (float32).

    The arrays have shape (N, T). The learner walks between random grid cells until it is rewarded, and from then on
    straight to the cell of that reward. Half of its moves are random at first. The share of random moves falls linearly
    to 3 in 100 after 60 % of the history, so that histories show good behaviour after few rewards and after many.
    """
    target = rng.integers(0, CELLS, len(goals))
    cell, known = target, np.zeros(len(goals), bool)
    steps = episodes * ROOM_STEPS
    cells, actions, rewards = (np.zeros((len(goals), steps), kind) for kind in ("i4", "i4", "f4"))
    for t in range(steps):
        if t % ROOM_STEPS == 0:
            cell = np.full(len(goals), MIDDLE)
        arrived = (cell == target) & ~known
        target = np.where(arrived, rng.integers(0, CELLS, len(goals)), target)
        distance = _distance(NEXT_CELLS[cell], target[:, None]) + 0.5 * rng.random((len(goals), len(MOVES)))
        noise = rng.random(len(goals)) < max(0.03, 0.5 * (1 - t / (0.6 * steps)))
        action = np.where(noise, rng.integers(0, len(MOVES), len(goals)), distance.argmin(axis=1))
        cells[:, t], actions[:, t] = cell, action
        cell = NEXT_CELLS[cell, action]
        rewards[:, t] = cell == goals
        known |= cell == goals
        target = np.where(cell == goals, goals, target)
    return cells, actions, rewards


def _distance(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return the number of moves between two grid cells."""
    return np.abs(_ROWS[one] - _ROWS[two]) + np.abs(_COLUMNS[one] - _COLUMNS[two])


def ad_batch_of_histories(obs: np.ndarray, actions: np.ndarray, rewards: np.ndarray, episode: int) -> ADBatch:
    """Return an AD batch in which each window is a complete history. The arguments are arrays of shape (N, T, ..)."""
    t = np.arange(actions.shape[1])
    dones = np.broadcast_to((t + 1) % episode == 0 if episode else t < 0, actions.shape)
    before = [np.pad(array[:, :-1], ((0, 0), (1, 0))) for array in (actions, rewards)]
    return ADBatch(obs, before[0], before[1], actions, dones, np.ones(actions.shape, bool))


def dpt_bandit_batch(tasks: int, context: int, rng: np.random.Generator) -> DPTBatch:
    """Return DPT's training batch on bandits: contexts of diverse policies, and the best arms (Lee et al. 2023).

    A policy is a mixture of a random policy and one fixed arm; the arm's share is sampled from 0, 0.1, .., 1.
    """
    means = rng.random((tasks, ARMS))
    share = rng.integers(0, 11, (tasks, 1)) / 10
    chance = (1 - share) * rng.dirichlet(np.ones(ARMS), tasks) + share * np.eye(ARMS)[rng.integers(0, ARMS, tasks)]
    drawn = rng.random((tasks, context, 1)) > np.cumsum(chance, axis=1)[:, None]
    actions = np.minimum(drawn.sum(axis=-1), ARMS - 1).astype(np.int32)
    rewards = (rng.random(actions.shape) < np.take_along_axis(means, actions, axis=1)).astype(np.float32)
    same = np.ones((*actions.shape, 1), np.uint8)
    return DPTBatch(same[:, 0], means.argmax(axis=1).astype(np.int32), same, actions, same, rewards)
