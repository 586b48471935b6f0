"""JaxMARL's interface to the environment of a layout."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Key, UInt8, UInt32

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked import rules
from icrl4aht_data.overcooked.actions import ACTIONS
from icrl4aht_data.overcooked.channels import Channels, observation_shape
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe_both
from icrl4aht_data.overcooked.state import unpack
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.utils.options import check_int
from icrl4aht_data.utils.text import counted_noun
from icrl4aht_generation.adapters.arguments import check_channels_and_render_mode
from icrl4aht_generation.env import Environment, EnvState

try:
    from jaxmarl.environments import spaces
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv
    from jaxmarl.environments.overcooked_v2.common import DynamicObject
except ImportError as error:
    reason = f"an environment for JaxMARL needs {error.name or error}: {install_command('jaxmarl')}"
    raise ImportError(reason, name=error.name) from error


@struct.dataclass
class JaxMARLState:
    """State of one environment, without a batch axis.

    Attributes:
        key: uint32 (2,), data of the JAX key for all random draws of the episode.
        step: int32 (), steps taken in the episode.
        done: bool (), whether the episode has ended.
        record: uint8 (S,), the state record; see `icrl4aht_data.overcooked.state`.
        recipe: int32 (), the current recipe in the encoding of JaxMARL's OvercookedV2, for its logging wrapper.
    """

    key: UInt32[Array, " 2"]
    step: Int[Array, ""]
    done: Bool[Array, ""]
    record: UInt8[Array, " S"]
    recipe: Int[Array, ""]


class JaxMARLEnv(MultiAgentEnv):
    """Environment of a layout for JaxMARL's learners and wrappers, which choose the actions of both agents.

    Agents: "agent_0", the ego, and "agent_1", the teammate.
    Observation: uint8 (5, 5, C) of each agent; see `icrl4aht_data.overcooked.observe.observe_both`.
    Action: 0..5 of each agent (up, down, left, right, stay, interact), which is not JaxMARL's order.
    Reward: float32, the team's reward, equal for both agents.
    End: both agents are `done` after `max_steps` steps; `step` then starts the next episode, as usual in JaxMARL.
    Info: `shaped_reward` of each agent, as in JaxMARL's OvercookedV2; not part of the reward.

    Args:
        layout: name of the layout.
        max_steps: steps of an episode: 400 in training, 100 in evaluation.
        channels: "own" for the layout's observation channels, "canonical" for channels that all layouts share.

    Attributes:
        possible_recipes: int32 (R, 3), the ingredient ids of each recipe, which JaxMARL's logging wrapper reads.

    Raises:
        UnknownNameError: if the layout or the channels do not exist.
        OptionError: if the number of steps is below 1.
    """

    def __init__(self, layout: str, *, max_steps: int = EPISODE_STEPS, channels: Channels = "own") -> None:
        check_channels_and_render_mode(channels)
        super().__init__(num_agents=2)
        self.layout = get_layout(layout)
        self.max_steps = check_int("max_steps", max_steps, 1)
        self._canonical = channels == "canonical"
        self._environment = Environment(self.layout)
        self.possible_recipes = jnp.array(self.layout.recipes, jnp.int32)
        self._recipe_items = jnp.array(self.layout.recipe_items)
        self._recipe_codes = jax.vmap(DynamicObject.get_recipe_encoding)(self.possible_recipes)
        observed = spaces.Box(0, 255, observation_shape(self.layout, self._canonical), jnp.uint8)
        self.observation_spaces = dict.fromkeys(self.agents, observed)
        self.action_spaces = dict.fromkeys(self.agents, spaces.Discrete(len(ACTIONS)))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.layout.name}, episodes of {counted_noun(self.max_steps, 'step')})"

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Key[Array, ""] | UInt32[Array, " 2"]) -> tuple[dict[str, UInt8[Array, "5 5 C"]], JaxMARLState]:
        """Return the first observations and the first state of an episode, which depend only on the key."""
        data = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
        record = self._environment.init(data[None]).record[0]
        state = JaxMARLState(data, jnp.int32(0), jnp.bool_(False), record, self._recipe_code(record))
        return self.get_obs(state), state

    def step_env(  # type: ignore[override]
        self, key: Key[Array, ""] | UInt32[Array, " 2"], state: JaxMARLState, actions: dict[str, Int[Array, ""]]
    ) -> tuple[
        dict[str, UInt8[Array, "5 5 C"]],
        JaxMARLState,
        dict[str, Float[Array, ""]],
        dict[str, Bool[Array, ""]],
        dict[str, Any],
    ]:
        """Return observations, state, rewards, dones and infos after a step, without a reset.

        Args:
            key: not used; all random draws use the episode's key in `state`.
            state: the state before the step.
            actions: action of each agent by its name.
        """
        both = jnp.stack([jnp.asarray(actions[agent], jnp.int32) for agent in self.agents])
        running = EnvState(
            jax.random.wrap_key_data(state.key)[None], jnp.zeros(1, jnp.int32), state.step[None], state.record[None]
        )
        recipe = self._environment.next_recipe(running)
        outcome = rules.step(self.layout, running.record, both[None], recipe)
        ended = state.step + 1 >= self.max_steps
        record = outcome.state[0]
        after = JaxMARLState(state.key, state.step + 1, ended, record, self._recipe_code(record))
        shaped = dict(zip(self.agents, outcome.shaped[0], strict=True))
        dones = dict.fromkeys((*self.agents, "__all__"), ended)
        rewards: dict[str, Any] = dict.fromkeys(self.agents, outcome.reward[0])
        return self.get_obs(after), after, rewards, dones, {"shaped_reward": shaped}

    def _recipe_code(self, record: UInt8[Array, " S"]) -> Int[Array, ""]:
        """Return JaxMARL's encoding of a record's recipe."""
        return self._recipe_codes[jnp.argmax(self._recipe_items == unpack(self.layout, record).recipe)]

    def get_obs(  # type: ignore[override]
        self, state: JaxMARLState
    ) -> dict[str, UInt8[Array, "5 5 C"]]:
        """Return the observation of each agent."""
        return dict(zip(self.agents, observe_both(self.layout, state.record, self._canonical), strict=True))

    def get_avail_actions(  # type: ignore[override]
        self, state: JaxMARLState
    ) -> dict[str, Bool[Array, " 6"]]:
        """Return a mask of available actions for each agent: all actions are always available."""
        return dict.fromkeys(self.agents, jnp.ones(len(ACTIONS), bool))

    def observation_space(self, agent: str = "") -> spaces.Box:
        """Return the observation space, equal for both agents; JaxMARL's learners omit the argument `agent`."""
        return self.observation_spaces[self.agents[0]]

    def action_space(self, agent: str = "") -> spaces.Discrete:
        """Return the action space, equal for both agents."""
        return self.action_spaces[self.agents[0]]

    @property
    def name(self) -> str:
        """Name of the environment, which includes the layout's name."""
        return f"icrl4aht_{self.layout.name}"

    @property
    def num_actions(self) -> int:
        """Number of actions."""
        return len(ACTIONS)

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Names of the agents by class; both agents have the class `chef`."""
        return {"chef": list(self.agents)}
