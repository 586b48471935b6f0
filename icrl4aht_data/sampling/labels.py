"""Checks of the labels that samplers use as targets: whether histories have them, and whether they are good."""

from __future__ import annotations

import warnings

import numpy as np

from icrl4aht_data.errors import LabelsMissingError, WeakLabelsWarning, check_choice
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import are_labels_weak
from icrl4aht_data.reading.history import LABELS, Labels
from icrl4aht_data.reading.selection import Selection
from icrl4aht_data.utils.text import counted_noun, listed_names


def check_labels(dataset: Selection, labels: Labels) -> Labels:
    """Check that all histories of a selection have these labels.

    Returns:
        The labels.

    Raises:
        UnknownNameError: for labels that do not exist.
        LabelsMissingError: if a history does not have them; names the labels that the selection has.
    """
    check_choice("labels", labels, LABELS)
    has = {name: dataset.has_labels(name) for name in LABELS}
    if has[labels].all():
        return labels
    missing = np.flatnonzero(~has[labels])
    counts = ", ".join(f"{int(has[name].sum())} have {name} actions" for name in LABELS)
    tasks = dataset.column("task_id")[missing]
    raise LabelsMissingError(
        f"labels = {labels}: {len(missing)} of {len(dataset)} histories have no {labels} actions, those of "
        f"{counted_noun(len(np.unique(tasks)), 'task')} (first: history {dataset.ids[missing[0]]} of task {tasks[0]}); "
        f"{counts}: take labels that all have, or ds.select(ds.has_labels({labels!r}))"
    )


def warn_of_weak_labels(dataset: Selection, labels: Labels) -> None:
    """Warn of tasks whose labels come from a policy that earns less than half of what their histories earn at the end.

    The end is the mean of `return_end` over a task's selected histories, see `schema.are_labels_weak`.
    """
    # Labels and their returns belong to a task, so one history of each task is enough to look them up.
    codes, first, task = np.unique(dataset.column_codes("task_id"), return_index=True, return_inverse=True)
    ends = np.bincount(task, dataset.column("return_end")) / np.bincount(task)
    values = dataset.index.values("task_id")
    names = [values[code] for code in codes.tolist()]
    if labels == "expert":
        earned = dataset.column("expert_return")[first]
        advice = "leave these tasks out by min_expert_return, or select by ds.column('expert_return')"
    else:
        references = [(dataset.provenance.get(name) or Provenance()).references for name in names]
        earned = np.array([np.nan if one is None else one.oracle for one in references])
        advice = "leave these tasks out, or take expert as labels"
    weak = np.flatnonzero(are_labels_weak(earned, ends))
    if not len(weak):
        return
    named = listed_names([f"{names[k]} (labels {earned[k]:.1f}, histories {ends[k]:.1f})" for k in weak.tolist()])
    player = "a policy that earns, acting greedily," if labels == "expert" else "the oracle, which earns"
    warnings.warn(
        f"the {labels} actions of {len(weak)} of {len(codes)} tasks come from {player} less than half of what their "
        f"histories earn at the end: {named}. A model would learn to play worse than its contexts: {advice}",
        WeakLabelsWarning,
        stacklevel=4,  # the line that called Dataset.ad or Dataset.dpt
    )
