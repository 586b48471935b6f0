"""Training of RL^2 (Duan et al. 2016): PPO on episodes that the model plays with a release's teammates.

A training step plays one or more episodes of every task, then updates the model on all of them. After these episodes, a
task continues with the model's recurrent state, or ends at random; then a new task with the same teammate begins.
Returns include the rewards of later episodes of the task, so exploration that helps later is rewarded. Gradients pass
through all episodes of a step, so with several episodes the model learns to remember what a later one needs.

At first the model also imitates a script: the loss contains the cross-entropy of the script's actions in the states
that the model visits, with a weight that falls to 0 (kickstarting, Schmitt et al. 2018; DAgger, Ross et al. 2011). The
script is the oracle, which knows what the model has to find out. In tasks with a hidden dish, the script is
`search`, which finds out the dish over the episodes of a task.

Shapes: `B` tasks, `E` episodes of a step, `T` steps of all these episodes, `S` size of the recurrent state.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from icrl4aht_generation.collection.curate import follow_script
from icrl4aht_generation.experts.oracle import oracle
from icrl4aht_generation.experts.search import searcher
from icrl4aht_generation.learners.config import PPOConfig
from icrl4aht_generation.learners.ppo import PPO, Sequences, ppo_optimizer
from icrl4aht_generation.learners.rollout import select_rows
from icrl4aht_generation.policy import Policy
from jaxtyping import Array, Bool, Float, Int, Key

from icrl4aht_baselines.evaluate.protocols import get_protocol
from icrl4aht_baselines.evaluate.rollout import EpisodeBatch, EvaluationRollout, RolloutState, no_outcome
from icrl4aht_baselines.methods.method import Method
from icrl4aht_baselines.methods.tokens import StepInput, input_step
from icrl4aht_baselines.methods.view_change import ViewChange, no_change
from icrl4aht_baselines.online.teammates import mixed_chances, with_behaviours
from icrl4aht_baselines.training.options import PlayOptions, TrainOptions
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.utils.groups import grouped

PLAY_REWARD_SCALE = 0.05
"""Factor of the rewards in returns and values: a delivery, which earns 20 points, becomes 1."""


class PlayerMemory(NamedTuple):
    """Memory of the model in a running task.

    Attributes:
        change: changes of the model's observations, see `ViewChange`.
        state: float32 (S,), recurrent state of the model.
        started: bool (), whether a step of the task was played; if not, the outcome of the previous step is zero.
        partner: int32 (), number of the teammate for an informed model; None for other models.
        searcher: memory of the script `search` if the model imitates this script; None otherwise.
    """

    change: ViewChange
    state: Float[Array, " S"]
    started: Bool[Array, ""]
    partner: Int[Array, ""] | None = None
    searcher: Any = None


class PlayState(NamedTuple):
    """State of a training run that plays its own episodes. A checkpoint contains exactly this state.

    Attributes:
        params: pytree of float32 arrays.
        optimizer: state of the optimizer.
        tasks: states of the running tasks, one entry for each `_Player`.
        step: int32 (), number of training steps so far.
    """

    params: Any
    optimizer: Any
    tasks: tuple[RolloutState, ...]
    step: Int[Array, ""]


class PlayTask(NamedTuple):
    """A training task. A training step plays episodes of every task.

    Attributes:
        layout: layout of the task.
        family: kind of the teammate, such as "assembly_line".
        teammate: the teammate; all teammates of a kind share their functions.
        hidden: whether recipe indicators are hidden from the model.
        label: name of the layout in the log.
        partner: number of the teammate, for an informed model; None for other models.
        id: id of the task that the teammate comes from; empty if it is not recorded.
        searched: whether the model imitates the script `search` instead of the oracle.
    """

    layout: Layout
    family: str
    teammate: Policy
    hidden: bool
    label: str
    partner: int | None = None
    id: str = ""
    searched: bool = False

    @property
    def name(self) -> str:
        """Name in the log, which all tasks with this label and kind of teammate share."""
        return f"{self.label} {self.family}"


def make_play_tasks(
    teammates: Mapping[tuple[Layout, str], Mapping[str, Policy]],
    tasks: int,
    shares: Mapping[str, float],
    hidden: Collection[str] = (),
) -> list[PlayTask]:
    """Return tasks, in groups of one layout and one kind of teammate.

    Layouts get tasks in proportion to their shares; all kinds of teammates on a layout get equally many tasks.

    Args:
        teammates: (layout, kind of teammate) -> task id -> teammate; see `make_group` for the choice among them.
        tasks: approximate total number of tasks; each group has at least one.
        shares: name of each layout -> relative number of its tasks.
        hidden: names of layouts whose recipe indicators the model does not see.
    """
    families = Counter(layout.name for layout, _ in teammates)
    total = sum(shares[name] for name in families)
    found = []
    for (layout, family), policies in teammates.items():
        count = max(1, round(tasks * shares[layout.name] / total / families[layout.name]))
        found += make_group([layout] * count, family, policies, layout.name in hidden, layout.name)
    return found


def make_group(
    layouts: Sequence[Layout], family: str, teammates: Mapping[str, Policy], hidden: bool, label: str
) -> list[PlayTask]:
    """Return a group of tasks on some layouts, with teammates that do not always follow their script.

    Teammates have equal numbers of tasks, up to a difference of one. With fewer tasks than teammates, some teammates
    have none.

    Args:
        layouts: layout of each task.
        family, hidden, label: see `PlayTask`.
        teammates: task id -> teammate to choose from.
    """
    names, tasks = list(teammates), len(layouts)
    numbers = np.arange(max(tasks, len(names))) % len(names)
    # The order is shuffled, because a teammate's behaviours depend on the index of its task.
    ids = [names[number] for number in np.random.default_rng(0).permutation(numbers)[:tasks]]
    mates = with_behaviours([teammates[task] for task in ids], mixed_chances(tasks))
    return [
        PlayTask(layout, family, mate, hidden, label, id=task)
        for layout, mate, task in zip(layouts, mates, ids, strict=True)
    ]


class _Network(NamedTuple):
    """Adapter that gives the model the interface of `ppo.RecurrentNetwork`."""

    model: Any

    def apply(self, variables: Any, /, *inputs: Any) -> Any:
        hidden, seen, *_ = inputs
        output, state = self.model.apply({"params": variables}, seen, hidden)
        return state, output.logits, output.value


class _Player:
    """Plays the tasks that share one compiled program; their teammates must have the same functions."""

    def __init__(
        self,
        tasks: Sequence[PlayTask],
        method: Method,
        play: PlayOptions,
        mirror: bool,
        compact: Callable[[Array], Any],
    ) -> None:
        self.tasks, self._method, self._play, self._mirror, self._compact = tasks, method, play, mirror, compact
        self._hidden = np.array([task.hidden for task in tasks])
        informed = tasks[0].partner is not None
        self._partners = jnp.array([task.partner for task in tasks], jnp.int32) if informed else None
        # Without changed views, the code for them is left out, which saves time in every step and in compilation.
        self._changes = mirror or bool(self._hidden.any())
        layouts = list(dict.fromkeys(task.layout for task in tasks))
        number = {layout: position for position, layout in enumerate(layouts)}
        several = len(layouts) > 1
        self.rollout = EvaluationRollout(
            layouts if several else layouts[0],
            _model_policy(method, self._changes, self._compact),
            [task.teammate for task in tasks],
            get_protocol("seeded"),
            np.array([number[task.layout] for task in tasks]) if several else None,
        )
        self.mates = self.rollout.teammate_params
        self._searched = tasks[0].searched
        own = self.rollout.layout
        self._script = searcher(own, advises=True) if self._searched else oracle(own)

    def start(self, key: Key[Array, ""]) -> RolloutState:
        """Return the state before the first episode of all tasks."""
        env_key, change_key = jax.random.split(key)
        state = self.rollout.start(jax.random.split(env_key, len(self.tasks)))
        change, searcher_memory = self._draw_change(change_key), self._search_memory(key)
        return state._replace(ego=state.ego._replace(change=change, partner=self._partners, searcher=searcher_memory))

    def _search_memory(self, key: Key[Array, ""]) -> Any:
        """Return the memory of `search` at the start of every task; None if the model imitates the oracle."""
        if not self._searched:
            return None
        keys = jax.random.split(jax.random.fold_in(key, 2), len(self.tasks))
        return jax.vmap(self._script.init, in_axes=(None, 0))(self._script.params, keys)

    def _draw_change(self, key: Key[Array, ""]) -> ViewChange:
        chance = 0.5 if self._mirror else 0.0
        upside_down, sideways = jax.random.bernoulli(key, chance, (2, len(self.tasks)))
        return ViewChange(jnp.asarray(self._hidden), upside_down, sideways)

    def episodes(
        self, params: Any, mates: Any, state: RolloutState, key: Key[Array, ""]
    ) -> tuple[RolloutState, Sequences, Float[Array, "B E"]]:
        """Play the next episodes of every task. Return the next state, the episodes for learning, and their returns."""
        change_key, end_key = jax.random.split(key)

        def episode(state: RolloutState, _: None) -> tuple[RolloutState, tuple[EpisodeBatch, Array]]:
            after, played = self.rollout.episode(params, mates, state)
            records, taken = (jnp.swapaxes(x, 0, 1) for x in (played.record, played.actions[..., EGO]))
            layout, memory = self.rollout.layout, state.ego.searcher
            expert, memory = follow_script(self._script, layout, records, taken, state.env.layout, memory)
            ego = after.ego._replace(searcher=memory if self._searched else None)
            return after._replace(ego=ego), (played, expert)

        after, (played, expert) = jax.lax.scan(episode, state, length=self._play.episodes)
        returns = jnp.swapaxes(played.reward.sum(axis=-1), 0, 1)
        # The episodes of a task follow one another: (E, B, 100, ...) becomes (B, E * 100, ...).
        played = jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:]), played)
        ended = jax.random.bernoulli(end_key, self._play.task_end, (len(self.tasks),))
        sequences = self._sequences(params, state, after, played, expert.reshape(-1, len(self.tasks)), ended)
        # A new task has the same teammate, but another view, a zero state and no previous step.
        memory = PlayerMemory(
            select_rows(ended, self._draw_change(change_key), after.ego.change),
            jnp.where(ended[:, None], 0.0, after.ego.state),
            ~ended,
            state.ego.partner,
            select_rows(ended, self._search_memory(key), after.ego.searcher),
        )
        before = select_rows(ended, no_outcome(len(self.tasks)), after.before)
        return RolloutState(after.env, memory, before), sequences, returns

    def _sequences(
        self,
        params: Any,
        state: RolloutState,
        after: RolloutState,
        played: EpisodeBatch,
        expert: Int[Array, "T B"],
        ended: Bool[Array, " B"],
    ) -> Sequences:
        env, change = self.rollout.env, state.ego.change
        record, actions, reward = (jnp.swapaxes(x, 0, 1) for x in (played.record, played.actions, played.reward))
        taken, theirs = actions[..., EGO], actions[..., TEAMMATE]
        # The inputs also include the step that follows the played steps; its value bootstraps the return.
        look = partial(observe, agent=EGO, canonical=True)
        seen_records = jnp.concatenate([played.record, after.env.record[:, None]], axis=1)
        steps = StepInput(
            obs=jnp.swapaxes(env.call_with_tables(look, state.env.layout, seen_records), 0, 1),
            prev_action=jnp.concatenate([state.before.prev_action[None], taken]),
            prev_reward=jnp.concatenate([state.before.prev_reward[None], reward]),
            prev_teammate_action=jnp.concatenate([state.before.prev_teammate_action[None], theirs]),
            partner=None if state.ego.partner is None else jnp.tile(state.ego.partner, (len(record) + 1, 1)),
        )
        if self._changes:
            # Only the first step of `steps` can be the first step of a task.
            started = jnp.ones((len(record) + 1, len(self.tasks)), bool).at[0].set(state.ego.started)
            steps = change.steps(steps, started)
        steps = steps._replace(obs=self._compact(steps.obs))
        # Log-probabilities and values are computed again with the operations of the loss, so that both agree exactly.
        _, logits, value = _Network(self._method.model).apply(params, state.ego.state, steps)
        action = change.actions(taken)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits[:-1]), action[..., None], axis=-1)[..., 0]
        return Sequences(
            seen=jax.tree.map(lambda leaf: leaf[:-1], steps),
            reset=jnp.zeros(reward.shape, bool),  # the recurrent state is never reset within a task
            action=action,
            log_prob=log_prob,
            value=value[:-1],
            reward=PLAY_REWARD_SCALE * reward,
            # Returns end with a task, not with an episode, so that exploration is rewarded in later episodes.
            done=jnp.zeros(reward.shape, bool).at[-1].set(ended),
            hidden=state.ego.state[None],
            partner=jnp.zeros((1, len(self.tasks)), jnp.int32),  # one value function for all teammates
            weight=jnp.ones((1, len(self.tasks))),
            last_value=value[-1][None],
            # The script's actions are converted from the environment's view to the model's view.
            expert=change.actions(expert),
        )


def make_players(tasks: Sequence[PlayTask], method: Method, play: PlayOptions, mirror: bool) -> list[_Player]:
    """Return one player for each group of tasks that can share a compiled program."""

    def program(task: PlayTask) -> tuple[Any, ...]:
        mate = task.teammate
        # Teammates that see a `Situation` receive the layout as an input, so that one program serves several layouts.
        # The functions of other teammates are made for one layout.
        shared = (mate.init, mate.act) if mate.sees == "situation" else (task.layout,)
        return (task.family, task.searched, *shared)

    # All players leave out the same entries of observations, because the learner concatenates their episodes.
    changes = mirror or any(task.hidden for task in tasks)
    compact = _observation_filter(method, {task.layout for task in tasks}, changes)
    return [_Player(own, method, play, mirror, compact) for own in grouped(tasks, program).values()]


def _observation_filter(method: Method, layouts: Collection[Layout], changes: bool) -> Callable[[Array], Any]:
    """Return a function that removes entries of observations that are always 0, which makes the encoder faster.

    The function returns observations unchanged if they may have entries that the encoder's view does not have, because
    `changes` alter the observations, or the view does not have the maps of all layouts.
    """
    view = method.model.tokens.encoder.view
    if changes or view is None or not view.canonical:
        return lambda obs: obs
    # The entries of a layout do not depend on its recipes.
    known, played = ({(one.rows, one.indicates_delivery) for one in some} for some in (view.layouts, layouts))
    return view.compact if played <= known else lambda obs: obs


def _model_policy(method: Method, changes: bool, compact: Callable[[Array], Any]) -> Policy:
    """Return the policy that samples the model's actions in training; `changes` alter the observations.

    `compact` converts observations to the encoder's input.
    """

    def init(params: Any, key: Array) -> PlayerMemory:
        return PlayerMemory(no_change(), method.start(0, True), jnp.bool_(False))

    def act(params: Any, memory: PlayerMemory, ego_input: Any, key: Array) -> tuple[Array, PlayerMemory]:
        step = input_step(ego_input)._replace(partner=memory.partner)
        step = memory.change.steps(step, memory.started) if changes else step
        step = step._replace(obs=compact(step.obs))
        logits, state = method.act(params, step, ego_input.prev_done, memory.state)
        action = jax.random.categorical(key, logits).astype(jnp.int32)
        return memory.change.actions(action), memory._replace(state=state, started=jnp.bool_(True))

    return Policy({}, init, act, "canonical_input")


class PlayTrainer:
    """Trainer of RL^2 by playing, with the interface of `icrl4aht_baselines.training.trainer.Trainer`.

    Args:
        method: the method RL^2.
        options: options of the training; `steps`, `learning_rate`, `warmup`, `clip` and `seed` are used here.
        play: hyper-parameters of playing and learning.
        tasks: tasks to play.
        mirror: whether tasks are mirrored at random.

    Raises:
        OptionError: if there are fewer tasks than minibatches.
    """

    def __init__(
        self,
        method: Method,
        options: TrainOptions,
        play: PlayOptions,
        tasks: Sequence[PlayTask],
        mirror: bool = False,
    ) -> None:
        self.method, self.options, self.play = method, options, play
        self.players = make_players(tasks, method, play, mirror)
        self.tasks = [task for player in self.players for task in player.tasks]
        names = np.array([task.name for task in self.tasks])
        self._rows = {name: np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())}
        if len(self.tasks) < play.minibatches:
            raise OptionError(
                f"minibatches = {play.minibatches}: expected at most the {len(self.tasks)} tasks that are played at "
                f"once; give fewer --minibatches or a larger --batch-size"
            )
        # Minibatches have equal sizes, so a pass leaves out up to minibatches - 1 tasks, different ones in each pass.
        learned = len(self.tasks) - len(self.tasks) % play.minibatches
        config = PPOConfig(
            total_steps=options.steps * learned * play.episodes * KEPT_STEPS,
            environments=learned,
            rollout=play.episodes * KEPT_STEPS,
            epochs=play.epochs,
            minibatches=play.minibatches,
            learning_rate=options.learning_rate,
            warmup=options.warmup,
            discount=play.discount,
            gae_lambda=play.gae_lambda,
            entropy=play.entropy,
            max_grad_norm=options.clip,
        )
        self.ppo = PPO(_Network(method.model), config)
        # The old parameters and the old optimizer state are donated, because nothing uses them after an update.
        self._learn = jax.jit(self._learn_from, donate_argnums=(0, 1))
        self._compiled: list[Callable[..., Any]] = []

    def init(self) -> PlayState:
        """Return the state before the first training step."""
        return jax.jit(self._initial_state)()

    def state_like(self) -> Any:
        """Return the shapes and dtypes of the state, for restoring a checkpoint."""
        return jax.eval_shape(self._initial_state)

    def _initial_state(self) -> PlayState:
        key = jax.random.key(self.options.seed)
        params = self.method.model.init(key, *self.method.example)["params"]
        keys = jax.random.split(jax.random.fold_in(key, 1), len(self.players))
        tasks = tuple(player.start(own) for player, own in zip(self.players, keys, strict=True))
        return PlayState(params, ppo_optimizer(self.ppo.config).init(params), tasks, jnp.int32(0))

    def batches(self, sampler: Any, start: int, stop: int, prefetch: int = 0) -> AbstractContextManager[range]:
        """Return the numbers of the training steps instead of batches, because `step` plays the episodes."""
        return nullcontext(range(start, stop))

    def step(self, state: PlayState, number: int) -> tuple[PlayState, dict[str, Array]]:
        """Play the next episodes of every task and update the model. Return the new state, and the numbers to log."""
        # Random keys depend on the seed and the step only, so that a resumed run plays the same episodes.
        play_key, learn_key = jax.random.split(jax.random.fold_in(jax.random.key(self.options.seed + 1), number))
        keys = jax.random.split(play_key, len(self.players))
        programs = self.programs(state.params, state.tasks)
        played = [
            program(state.params, player.mates, tasks, key)
            for program, player, tasks, key in zip(programs, self.players, state.tasks, keys, strict=True)
        ]
        tasks, sequences, returns = zip(*played, strict=True)
        falling = jnp.maximum(0.0, 1.0 - state.step / (self.play.imitation_end * self.options.steps))
        weight = self.play.imitation * falling
        # Minibatches are sampled from the tasks of all players together, so that a minibatch has many layouts.
        params, optimizer, log = self._learn(state.params, state.optimizer, sequences, learn_key, weight)
        earned = jnp.concatenate(returns)
        log |= {f"return {name}": earned[rows].mean() for name, rows in self._rows.items()}
        return PlayState(params, optimizer, tasks, state.step + 1), log

    def measure(self, params: Any, episodes: int, seed: int) -> np.ndarray:
        """Play new episodes of `self.tasks` with sampled actions. Return their returns, float64 (tasks, episodes).

        Args:
            params: parameters of the model.
            episodes: number of episodes of each task.
            seed: seed of the episodes.
        """
        found = []
        keys = [jax.random.fold_in(jax.random.key(seed), number) for number in range(len(self.players))]
        states = [jax.jit(player.start)(key) for player, key in zip(self.players, keys, strict=True)]
        for player, key, state, program in zip(self.players, keys, states, self.programs(params, states), strict=True):
            returns = []
            for step in range(-(-episodes // self.play.episodes)):
                state, _, own = program(params, player.mates, state, jax.random.fold_in(key, step + 1))
                returns.append(np.asarray(own, np.float64))
            found.append(np.concatenate(returns, axis=-1)[:, :episodes])
        return np.concatenate(found)

    def programs(self, params: Any, tasks: Sequence[RolloutState]) -> list[Callable[..., Any]]:
        """Return each player's `_Player.episodes`, compiled for the shapes of the player's rollout states `tasks`.

        The first call compiles for all players in parallel, since each compilation takes seconds and uses one core.
        """
        if not self._compiled:
            key = jax.random.key(0)
            lowered = [
                jax.jit(player.episodes).lower(params, player.mates, own, key)
                for player, own in zip(self.players, tasks, strict=True)
            ]
            with ThreadPoolExecutor() as pool:
                self._compiled = list(pool.map(lambda one: one.compile(), lowered))
        return self._compiled

    def _learn_from(
        self, params: Any, optimizer: Any, parts: tuple[Sequences, ...], key: Key[Array, ""], weight: Array
    ) -> tuple[Any, Any, dict[str, Array]]:
        played: Sequences = jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *parts)
        played = played._replace(imitation=jnp.full((1, len(self.tasks)), weight))
        params, optimizer, log = self.ppo.learn(params, optimizer, played, key)
        config = self.ppo.config
        total = log["policy_loss"] + config.value * log["value_loss"] - config.entropy * log["entropy"]
        total += weight * log["imitation_loss"]  # so that "loss" is the complete loss, as in the logs of other methods
        return params, optimizer, {"loss": total, **log, "imitation_weight": weight}
