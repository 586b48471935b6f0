"""PettingZoo's parallel interface to the environment of a layout, for policies of both agents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.channels import Channels, observation_shape
from icrl4aht_data.overcooked.layouts import Layout, get_layout
from icrl4aht_data.overcooked.observe import observe_both
from icrl4aht_data.overcooked.render import draw_frame
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.text import counted_noun
from icrl4aht_generation.adapters.arguments import (
    RENDER_MODES,
    check_action,
    check_channels_and_render_mode,
    check_record,
)
from icrl4aht_generation.env import Environment, EnvState

try:
    from gymnasium import spaces
    from gymnasium.utils import seeding
    from pettingzoo import ParallelEnv
except ImportError as error:
    reason = f"an environment for PettingZoo needs {error.name or error}: {install_command('pettingzoo')}"
    raise ImportError(reason, name=error.name) from error

AGENT_NAMES = ("ego", "teammate")
"""Names of the two agents, by slot."""


class BothAgentsEnv(ParallelEnv[str, np.ndarray, np.int64]):
    """Environment of a layout in which callers choose the actions of both agents, for self-play and cross-play.

    Agents: "ego" and "teammate", with equal spaces. If walls divide the layout, each agent starts on its own side.
    Observation: uint8 (5, 5, C) of each agent; see `icrl4aht_data.overcooked.observe.observe_both`.
    Action: 0..5 of each agent (up, down, left, right, stay, interact).
    Reward: the team's reward without shaping, equal for both agents.
    End: both agents are truncated after `max_steps` steps.
    Info: `shaped_reward` of each agent after a step; see `icrl4aht_data.overcooked.rules.shaped_rewards`.

    Args:
        layout: name of the layout.
        max_steps: steps of an episode: 100 in evaluation, 400 in training.
        channels: "own" for the layout's observation channels, "canonical" for channels that all layouts share.
        render_mode: "rgb_array" for pictures, which need Pillow.

    Raises:
        UnknownNameError: if the layout, the channels or the render mode do not exist.
        OptionError: if the number of steps is below 1.
    """

    metadata: dict[str, Any] = {"name": "icrl4aht_v0", "render_modes": RENDER_MODES, "render_fps": 5}  # noqa: RUF012 - type of the base class

    def __init__(
        self,
        layout: str,
        *,
        max_steps: int = KEPT_STEPS,
        channels: Channels = "own",
        render_mode: str | None = None,
    ) -> None:
        check_channels_and_render_mode(channels, render_mode)
        self.layout = get_layout(layout)
        self.max_steps = check_int("max_steps", max_steps, 1)
        self.render_mode = render_mode
        self.possible_agents = list(AGENT_NAMES)
        self.agents: list[str] = []
        shape = observation_shape(self.layout, channels == "canonical")
        # PettingZoo seeds these spaces, and requires the same objects in every call.
        self._observed = {agent: spaces.Box(0, 255, shape, np.uint8) for agent in AGENT_NAMES}
        self._played = {agent: spaces.Discrete(len(ACTIONS)) for agent in AGENT_NAMES}
        self._start, self._step = _compiled_functions(self.layout, channels == "canonical")
        self._random, _ = seeding.np_random()
        self._running: EnvState | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.layout.name}, episodes of {counted_noun(self.max_steps, 'step')})"

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the observation space of an agent."""
        return self._observed[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Return the action space of an agent."""
        return self._played[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Start an episode.

        Args:
            seed: seed of the random draws of this episode and all later episodes.
            options: `state`, uint8 (S,): the state record to start from; by default a random state. Other options are
                ignored, as PettingZoo's test of environments expects.

        Returns:
            The first observation of each agent, and empty infos.

        Raises:
            OptionError: if the state is impossible.
        """
        if seed is not None:
            self._random, _ = seeding.np_random(seed)
        key = self._random.integers(0, 2**32, 2, dtype=np.uint32)
        given = (options or {}).get("state")
        record = None if given is None else check_record(self.layout, given)
        self._running, observations = self._start(key, record)
        self.agents = list(AGENT_NAMES)
        return self._observations_by_agent(observations), {agent: {} for agent in AGENT_NAMES}

    def step(
        self, actions: Mapping[str, SupportsIndex]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Play one step with an action 0..5 of each agent.

        Returns:
            Observations, rewards, terminations, truncations and infos of both agents; see the class.

        Raises:
            OptionError: if no episode is running, or an action is missing or does not exist.
        """
        if self._running is None or not self.agents:
            raise OptionError("no episode is running: call reset() first")
        if set(actions) != set(AGENT_NAMES):
            raise OptionError(f"actions: expected actions of {' and '.join(AGENT_NAMES)}, found {sorted(actions)}")
        both = np.array([check_action(f"action of {agent}", actions[agent]) for agent in AGENT_NAMES], np.int32)
        after, observations, reward, shaped = self._step(self._running, both)
        self._running, ended = after, int(after.clock[0]) >= self.max_steps
        if ended:
            self.agents = []
        infos = {agent: {"shaped_reward": float(one)} for agent, one in zip(AGENT_NAMES, shaped[0], strict=True)}
        return (
            self._observations_by_agent(observations),
            dict.fromkeys(AGENT_NAMES, float(reward[0])),
            dict.fromkeys(AGENT_NAMES, False),
            dict.fromkeys(AGENT_NAMES, ended),
            infos,
        )

    def render(self) -> np.ndarray | None:
        """Return a picture of the state, uint8 of shape (height, width, 3), or None without a render mode."""
        return None if self.render_mode is None else draw_frame(self.layout, self.state())

    def state(self) -> np.ndarray:
        """Return the state record, uint8 of shape (S,); see `icrl4aht_data.overcooked.state`.

        Raises:
            OptionError: if `reset` was not called before.
        """
        if self._running is None:
            raise OptionError("no episode has been started: call reset() first")
        return np.array(self._running.record[0])

    @staticmethod
    def _observations_by_agent(observations: Any) -> dict[str, np.ndarray]:
        return dict(zip(AGENT_NAMES, np.asarray(observations)[0], strict=True))


@lru_cache(maxsize=16)
def _compiled_functions(layout: Layout, canonical: bool) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return two compiled functions for a layout: one starts an episode, the other plays a step."""
    env = Environment(layout)

    def start(key, record):
        state = env.init(jnp.asarray(key)[None])
        if record is not None:
            state = state._replace(record=jnp.asarray(record)[None])
        return state, observe_both(layout, state.record, canonical)

    def step(state: EnvState, actions):
        outcome = rules.step(layout, state.record, actions[None], env.next_recipe(state))
        after = state._replace(clock=state.clock + 1, record=outcome.state)
        return after, observe_both(layout, outcome.state, canonical), outcome.reward, outcome.shaped

    return jax.jit(start), jax.jit(step)
