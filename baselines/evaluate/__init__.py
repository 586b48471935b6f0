"""Evaluation of egos on the benchmark's tasks, under named protocols."""

from baselines.evaluate.evaluator import evaluate
from baselines.evaluate.protocols import PROTOCOLS, Protocol, get_protocol
from baselines.evaluate.results import Result

__all__ = ["PROTOCOLS", "Protocol", "Result", "evaluate", "get_protocol"]
