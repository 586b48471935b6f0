"""Evaluation of egos on the benchmark's tasks, under named protocols."""

import sys

from icrl4aht_baselines import CallablePackage
from icrl4aht_baselines.evaluate.evaluator import ControlledResults, evaluate, evaluate_controls
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, Protocol, get_protocol, test_tasks
from icrl4aht_baselines.evaluate.results import Result

__all__ = [
    "PROTOCOLS",
    "ControlledResults",
    "Protocol",
    "Result",
    "evaluate",
    "evaluate_controls",
    "get_protocol",
    "test_tasks",
]

sys.modules[__name__].__class__ = CallablePackage
