"""Evaluation of egos on the benchmark's tasks, under named protocols."""

from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, Protocol, get_protocol
from icrl4aht_baselines.evaluate.results import Result

__all__ = ["PROTOCOLS", "Protocol", "Result", "evaluate", "get_protocol"]
