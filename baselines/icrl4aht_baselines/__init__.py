"""Reference agents, and the evaluator of the benchmark.

The names that an evaluation needs are imported from this package:

    from icrl4aht_baselines import evaluate, find_agent, from_host, report, test_tasks

`evaluate` and `report` are packages that can be called like their functions of the same name. Modules are imported
when they are first used, because importing JAX takes seconds.
"""

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icrl4aht_baselines.agents.egos import find_agent
    from icrl4aht_baselines.agents.host import from_host
    from icrl4aht_baselines.evaluate.evaluator import evaluate
    from icrl4aht_baselines.evaluate.protocols import test_tasks
    from icrl4aht_baselines.report import report

__all__ = ["evaluate", "find_agent", "from_host", "report", "test_tasks"]

_MODULES = {"find_agent": "agents.egos", "from_host": "agents.host", "test_tasks": "evaluate.protocols"}


class CallablePackage(ModuleType):
    """Package that can be called like its function of the same name: `evaluate(...)` runs `evaluate.evaluate(...)`."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **options)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
