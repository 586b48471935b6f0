"""Checks of the labels that samplers use as targets: whether histories have them, and whether they are good."""

from __future__ import annotations

import warnings

import numpy as np

from icrl4aht_data.errors import LabelsMissingError, WeakLabelsWarning, check_choice
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import are_labels_weak
from icrl4aht_data.reading.history import LABELS, Labels
from icrl4aht_data.reading.selection import Selection


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
    # The error lists every way out: other labels that all have, or the histories that have these.
    total, missing = len(dataset), np.flatnonzero(~has[labels])
    choices = [f"take {name} as labels, which all have" for name in LABELS if has[name].all()] or [
        "choose histories or a release with labels"
    ]
    if has[labels].any():
        sources = " and ".join(sorted(set(dataset.column("source")[has[labels]].tolist())))
        choices.append(f"choose the {total - len(missing)} with {labels} actions (source {sources})")
    others = " and ".join(f"{int(has[name].sum())} have {name} actions" for name in LABELS if name != labels)
    raise LabelsMissingError(
        f"labels = {labels}: {len(missing)} of {total} histories have no {labels} actions (first: history "
        f"{dataset.ids[missing[0]]}), {others}: {', or '.join(choices)}"
    )


_NAMED = 5  # most tasks that a warning names


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
        earned, sampled = (dataset.column(name)[first] for name in ("expert_return", "expert_return_sampled"))
        texts = [f"labels {one:.1f}, sampled {other:.1f}" for one, other in zip(earned, sampled, strict=True)]
        advice = "leave these tasks out by min_expert_return, or select by ds.column('expert_return')"
    else:
        references = [(dataset.provenance.get(name) or Provenance()).references for name in names]
        earned = np.array([np.nan if one is None else one.oracle for one in references])
        texts = [f"labels {one:.1f}" for one in earned]
        advice = "leave these tasks out, or take expert as labels"
    weak = np.flatnonzero(are_labels_weak(earned, ends))
    if not len(weak):
        return
    named = ", ".join(f"{names[k]} ({texts[k]}, histories {ends[k]:.1f})" for k in weak[:_NAMED].tolist())
    more = f" and {len(weak) - _NAMED} more" if len(weak) > _NAMED else ""
    player = "a policy that earns, acting greedily," if labels == "expert" else "the oracle, which earns"
    warnings.warn(
        f"the {labels} actions of {len(weak)} of {len(codes)} tasks come from {player} less than half of what their "
        f"histories earn at the end: {named}{more}. A model would learn to play worse than its contexts: {advice}",
        WeakLabelsWarning,
        stacklevel=4,  # the line that called Dataset.ad or Dataset.dpt
    )
