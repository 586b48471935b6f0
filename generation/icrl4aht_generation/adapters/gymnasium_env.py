"""A task as a Gymnasium environment, in which the ego is the agent and the teammate belongs to the environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, SupportsIndex, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from icrl4aht_data.benchmark.tasks import Task, parse_task
from icrl4aht_data.errors import OptionError, TaskFormatError, check_choice
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import ACTIONS, EGO, TEAMMATE
from icrl4aht_data.overcooked.channels import Channels, observation_shape
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.overcooked.render import draw_frame
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.utils.options import check_int
from icrl4aht_generation.adapters.arguments import (
    RENDER_MODES,
    check_action,
    check_channels_and_render_mode,
    check_integers,
    check_record,
)
from icrl4aht_generation.env import Environment, EnvState
from icrl4aht_generation.learners.rollout import policy_player
from icrl4aht_generation.policy import Noise, Policy
from icrl4aht_generation.teammates.instances import published_task
from icrl4aht_generation.teammates.registry import build_teammate

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:
    reason = f"an environment for Gymnasium needs {error.name or error}: {install_command('gym')}"
    raise ImportError(reason, name=error.name) from error

RESET_OPTIONS = ("state", "key", "episode", "teammate_actions", "recipes")
"""Names of the options of `TaskEnv.reset`."""


class TaskEnv(gymnasium.Env[np.ndarray, np.int64]):
    """Environment of the ego in a task; the task's teammate acts inside the environment.

    Observation: uint8 (5, 5, C), what the ego sees; see `icrl4aht_data.overcooked.observe.observe`.
    Action: 0..5 (up, down, left, right, stay, interact).
    Reward: the team's reward, without shaping.
    End: the environment never ends an episode. `gymnasium.make` adds a limit of 100 steps, or `max_episode_steps`.
    Info: `state`, the state record uint8 (S,); after a step also `teammate_action`, an int, and `shaped_rewards`,
    float32 (2,), of ego and teammate. Egos in the benchmark do not see this info.

    Args:
        task: the fields of a task, as in a line of a manifest; see `icrl4aht_data.benchmark.tasks.Task`.
        suite: folder of learned teammates' checkpoints: a suite, or the folder `teammates` of a release.
        noise: source of a heuristic teammate's randomness, see `icrl4aht_generation.policy.Noise`.
        channels: "own" for the layout's observation channels, "canonical" for channels that all layouts share.
        render_mode: "rgb_array" for pictures, which need Pillow.

    Raises:
        TaskFormatError: if the task is malformed, or sets parameters that its teammate does not have.
        OptionError: if the checkpoint of a learned teammate is missing.
        UnknownNameError: if the noise, the channels or the render mode do not exist.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 5}  # noqa: RUF012 - type of the base class

    def __init__(
        self,
        task: Mapping[str, Any],
        *,
        suite: str | Path | None = None,
        noise: Noise = "seeded",
        channels: Channels = "own",
        render_mode: str | None = None,
    ) -> None:
        check_channels_and_render_mode(channels, render_mode)
        check_choice("noise", noise, get_args(Noise))
        if not isinstance(task, Mapping):
            raise TaskFormatError(
                f"task = {task!r:.200}: expected the fields of a task by name, such as dataclasses.asdict(task), found "
                f"{type(task).__name__}"
            )
        self.task: Task = parse_task(dict(task))
        self.layout: Layout = self.task.layout
        policy = build_teammate(
            self.layout, self.task.teammate, TEAMMATE, noise, None if suite is None else Path(suite)
        )
        self._start, self._step = _compiled_functions(self.layout, policy._replace(params=()), channels == "canonical")
        self._params = policy.params
        self.observation_space = spaces.Box(0, 255, observation_shape(self.layout, channels == "canonical"), np.uint8)
        self.action_space = spaces.Discrete(len(ACTIONS))
        self.render_mode = render_mode
        self._current: _RunningEpisode | None = None
        self._script, self._recipes = np.empty(0, np.int32), np.empty(0, np.uint8)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.layout.name}, task {self.task.task_id})"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seed of the random draws of this episode and all later episodes.
            options: all optional. `state`: uint8 (S,), the state record to start from; by default a random state.
                `key`: uint32 (2,), data of the JAX key for all random draws of the episode, and `episode`: number of
                the episode with this key, 0 by default; see `icrl4aht_generation.env.Environment`.
                `teammate_actions`: integers (n,), the teammate's actions in the first n steps, whatever the ego does.
                `recipes`: uint8 (n,), item of the recipe after each of the first n steps, if the recipe changes in this
                step. `Dataset.reset_options` returns the options of a recorded episode.

        Returns:
            The first observation, and `info`.

        Raises:
            UnknownNameError, OptionError: if an option does not exist, or has an impossible value.
        """
        super().reset(seed=seed)
        given = dict(options or {})
        for name in given:
            check_choice("option of reset", name, RESET_OPTIONS)
        # Always draw a key: an episode with options must not change the keys of later episodes.
        drawn = self.np_random.integers(0, 2**32, 2, dtype=np.uint32)
        key = check_integers("key", given.get("key", drawn), np.uint32, 2**32 - 1, (2,))
        record = None if (state := given.get("state")) is None else check_record(self.layout, state)
        episode = check_int("episode", given.get("episode", 0), 0)
        self._script = check_integers("teammate_actions", given.get("teammate_actions", ()), np.int32, len(ACTIONS) - 1)
        self._recipes = check_integers("recipes", given.get("recipes", ()), np.uint8, 255)
        if not np.isin(self._recipes, self.layout.recipe_items).all():
            raise OptionError(
                f"recipes: expected items of {self.layout.name}'s recipes, {self.layout.recipe_items.tolist()}, found "
                f"{np.unique(self._recipes).tolist()}"
            )
        self._current, observation = self._start(self._params, key, np.int32(episode), record)
        return np.asarray(observation)[0], {"state": self.state}

    def step(self, action: SupportsIndex) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Play one step with the ego's action 0..5; the teammate's policy chooses the teammate's action.

        Returns:
            Observation, reward, terminated (False), truncated (False) and `info`; see the class.

        Raises:
            OptionError: if `reset` was not called before, or the action does not exist.
        """
        moment, number = self._running, check_action("action", action)
        scripted = np.int32(self._script[0]) if len(self._script) else np.int32(-1)
        recipe = self._recipes[0] if len(self._recipes) else np.uint8(0)
        self._script, self._recipes = self._script[1:], self._recipes[1:]
        self._current, observation, reward, shaped, other = self._step(
            self._params, moment, np.int32(number), scripted, recipe
        )
        info = {"state": self.state, "teammate_action": int(other), "shaped_rewards": np.asarray(shaped)[0]}
        return np.asarray(observation)[0], float(reward[0]), False, False, info

    def render(self) -> np.ndarray | None:
        """Return a picture of the state, uint8 of shape (height, width, 3), or None without a render mode."""
        return None if self.render_mode is None else draw_frame(self.layout, self.state)

    @property
    def state(self) -> np.ndarray:
        """State record of the running episode, uint8 of shape (S,); see `icrl4aht_data.overcooked.state`."""
        return np.array(self._running.env.record[0])

    @property
    def _running(self) -> _RunningEpisode:
        if self._current is None:
            raise OptionError("the environment has not been started: call reset() first")
        return self._current


def published_environment(layout: str, teammate: str, **options: Any) -> TaskEnv:
    """Return the environment of a published test task; Gymnasium calls this function for registered ids.

    Args:
        layout: name of the layout.
        teammate: family and number of the teammate, such as "H4/t0".
        options: further arguments of `TaskEnv`.

    Raises:
        UnknownNameError: if the layout or the teammate does not exist.
    """
    return TaskEnv(asdict(published_task(layout, teammate)), **options)


class _RunningEpisode(NamedTuple):
    """State of a running episode: the state of one environment and the teammate's memory."""

    env: EnvState
    memory: Any


@lru_cache(maxsize=16)
def _compiled_functions(
    layout: Layout, policy: Policy, canonical: bool
) -> tuple[Callable[..., tuple[_RunningEpisode, Array]], Callable[..., tuple[Any, ...]]]:
    """Return two compiled functions for a layout and a teammate family: one starts an episode, one plays a step.

    A step returns the running episode, the observation (uint8 of shape (1, 5, 5, C)), the reward (float32 of shape
    (1,)), the shaped rewards (float32 of shape (1, 2)) and the teammate's action.
    """
    env = Environment(layout)
    teammate = lambda params: policy_player(env, policy, params, TEAMMATE, 1)  # noqa: E731

    def start(params, key, episode, record: np.ndarray | None):
        state = env.init(jnp.asarray(key)[None])
        state = state._replace(episode=state.episode + episode)
        drawn = env.first_record(state.key, state.episode)
        state = state._replace(record=drawn if record is None else jnp.asarray(record)[None])
        return _RunningEpisode(state, teammate(params).init(state)), observe(layout, state.record, EGO, canonical)

    def step(params, moment: _RunningEpisode, action, scripted, recipe) -> tuple[Any, ...]:
        state = moment.env
        # The key has no effect: heuristics use their own keys, and learned teammates act greedily.
        choice, memory = teammate(params).act(moment.memory, state, jax.random.key(0))
        other = jnp.where(scripted < 0, choice.action[0], scripted)
        following = jnp.where(recipe == 0, env.next_recipe(state), recipe)
        outcome = rules.step(layout, state.record, jnp.stack([action, other])[None], following)
        after = _RunningEpisode(state._replace(clock=state.clock + 1, record=outcome.state), memory)
        seen = observe(layout, outcome.state, EGO, canonical)
        return after, seen, outcome.reward, outcome.shaped, other

    return jax.jit(start), jax.jit(step)
