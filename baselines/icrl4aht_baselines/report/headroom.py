"""Headroom of the benchmark: returns of the reference egos on every test task, and the cards that state them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from icrl4aht_baselines.agents.egos import AGENTS
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import PROTOCOLS, get_protocol
from icrl4aht_baselines.report.results import EvaluationRun, as_run
from icrl4aht_baselines.report.summary import headroom_markdown
from icrl4aht_data.benchmark.facts import TRACKS
from icrl4aht_data.benchmark.reference_returns import REFERENCES
from icrl4aht_data.benchmark.tasks import manifest_path, read_tasks
from icrl4aht_data.utils.progress import counted

HEADROOM_BEGINS: dict[str, bytes | tuple[bytes, ...]] = {
    "headroom.json": tuple(f'{{\n "{name}": {{\n  "'.encode() for name in PROTOCOLS),
    "headroom.md": b"# Headroom: what an ego can change\n",
}
"""Files with the headroom -> their first bytes, by which they are recognised before they are replaced."""


def measure_headroom(out: Path, protocols: Sequence[str], show: Callable[..., None]) -> list[EvaluationRun]:
    """Evaluate every reference ego under every protocol into out/<protocol>/<agent>; finished tasks are kept.

    Args:
        out: folder of the results.
        protocols: their names.
        show: called with (name, tasks done, tasks), for progress.
    """
    tasks = [task for track in TRACKS for task in read_tasks(manifest_path(track, "test"))]
    runs = []
    for protocol in protocols:
        for agent in REFERENCES:
            results = evaluate(
                agent,
                AGENTS[agent],
                tasks,
                get_protocol(protocol),
                out=out / protocol / agent,
                done=counted(show, f"{agent}, {protocol}", len(tasks)),
            )
            runs.append(as_run(results))
    return runs


def write_headroom_cards(runs: Sequence[EvaluationRun], folder: Path) -> list[Path]:
    """Write headroom.json and headroom.md into a folder. Returns their paths.

    headroom.json holds protocol -> layout -> family -> reference ego -> mean return.
    """
    content: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for run in runs:
        for layout, family in run.cells:
            cell = content.setdefault(run.protocol, {}).setdefault(layout, {}).setdefault(family, {})
            cell[run.agent] = round(float(run.means((layout, family)).mean()), 3)
    paths = [folder / "headroom.json", folder / "headroom.md"]
    paths[0].write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    paths[1].write_text(headroom_markdown(content), encoding="utf-8")
    return paths
