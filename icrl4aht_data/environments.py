"""Gymnasium ids of the benchmark's tasks.

`gymnasium.make("icrl4aht/demo_wide-H4-t0-v0")` makes the environment of a published test task;
`gymnasium.make("icrl4aht/task-v0", task=...)` makes the environment of any task. `import icrl4aht_data` registers the
ids, because Gymnasium 1.0 and later load no plugins. `gymnasium.make("icrl4aht_data:icrl4aht/demo_wide-H4-t0-v0")`
imports the package first. The environment class is `icrl4aht_generation.adapters.gymnasium_env.TaskEnv`; it needs JAX.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks
from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.install_hints import install_command

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec

TASK_ENVIRONMENT = "icrl4aht/task-v0"
"""Gymnasium id of an environment whose task is given as argument `task`."""

_MODULE = "icrl4aht_generation.adapters.gymnasium_env"
_TRACKS = ("teammate", "layout")


def register_environments() -> None:
    """Register the Gymnasium ids: `TASK_ENVIRONMENT`, and one for each of the 160 published test tasks.

    The id of a test task is `icrl4aht/<layout>-<family>-t<number>-v0`, such as icrl4aht/demo_wide-H4-t0-v0. Episodes
    have 100 steps, as in the evaluation, unless `gymnasium.make` gets another `max_episode_steps`. Ids that are
    already registered stay unchanged. The function does nothing if Gymnasium is not installed.
    """
    try:
        from gymnasium.envs.registration import register, registry
    except ImportError:
        return

    entries: dict[str, tuple[str, dict[str, Any]]] = {TASK_ENVIRONMENT: ("TaskEnv", {})}
    for task in (task for track in _TRACKS for task in read_tasks(manifest_path(track, "test"))):
        teammate = f"{task.teammate_family}/t{task.teammate['theta_id']}"
        name = f"icrl4aht/{task.layout.name}-{teammate.replace('/', '-')}-v0"
        entries[name] = ("published_environment", {"layout": task.layout.name, "teammate": teammate})
    for name, (entry_point, arguments) in entries.items():
        if name not in registry:
            register(name, f"{_MODULE}:{entry_point}", max_episode_steps=KEPT_STEPS, kwargs=arguments)


def environment_spec(max_steps: int, arguments: dict[str, Any]) -> EnvSpec:
    """Return the Gymnasium `EnvSpec` of a task, without making the environment.

    Args:
        max_steps: number of steps of an episode.
        arguments: arguments of `icrl4aht_generation.adapters.gymnasium_env.TaskEnv`.

    Raises:
        ImportError: if Gymnasium is not installed.
    """
    import gymnasium

    register_environments()
    return replace(gymnasium.spec(TASK_ENVIRONMENT), max_episode_steps=max_steps, kwargs=arguments)


def make_environment(**options: Any) -> gymnasium.Env:
    """Return the Gymnasium environment of a task.

    Args:
        options: options of `gymnasium.make` and of `icrl4aht_generation.adapters.gymnasium_env.TaskEnv`, including
            `task`.

    Raises:
        OptionError: if Gymnasium or JAX is not installed.
    """
    try:
        import gymnasium

        register_environments()
        return gymnasium.make(TASK_ENVIRONMENT, **options)
    except ImportError as error:
        raise OptionError(f"an environment needs {error.name or error}: {install_command('gym')}") from error
