"""Evaluation of egos on the benchmark's tasks, under named protocols.

An evaluation writes these files into its folder OUT:

* `OUT/tasks/<task_id>.json`, one for each finished task: `settings`, their hash, `returns` of each seed's episodes,
  and, if teammates change, `partners`, the ids of their tasks.
* `OUT/tasks.jsonl`: the tasks that are not published test tasks.
* `OUT/run.json`: the training data of a model (`trained_on`), as in its run's `config.json`, with an entry for each
  layout, split, family, algorithm, source and kind of labels.
"""

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
