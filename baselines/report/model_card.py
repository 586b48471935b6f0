"""The card of a trained model, `cards/baseline.md` filled with its settings and results."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from baselines.report.markdown import tables
from baselines.report.results import Run
from icrl4aht_data.utils.templates import fill_template

_HUB = re.compile(r"hf://datasets/([^/@]+/[^/@]+)")


def model_card(run: Run, trained: Mapping[str, Any]) -> str:
    """README.md of a model, for who publishes its run folder.

    Args:
        run: its results.
        trained: what was trained, see `report.Source`.
    """
    config, histories = trained["config"], trained["config"]["histories"]
    at_hub = _HUB.match(histories["root"])
    limits = [
        f"It is one run, of seed {config['train']['seed']}: how far another would differ is not known.",
        "What it is given at each step must be what the evaluator gives, see `docs/protocol.md` in the repository.",
    ]
    return fill_template(
        "baseline.md",
        method=run.agent,
        dataset=at_hub[1] if at_hub else "icrl4aht",
        data_version=histories["data_version"],
        selection=f"{histories['sizes']['train']} of {', '.join(histories['layouts'])}; the release's manifest has "
        f"SHA-256 `{trained['manifest_sha256']}`",
        code_version=config["package_version"],
        settings=_bullets({**config["model"], **config["train"]}),
        protocol=run.protocol,
        results="\n\n".join(table for _, table in tables(run)),
        limits="\n".join(f"* {limit}" for limit in limits),
    )


def write_model_cards(runs: Iterable[Run], folder: Path) -> list[Path]:
    """The cards of those that were trained, by their names, into a folder; of several sources the first's settings."""
    paths = []
    for run in runs:
        trained = next((source.trained for source in run.sources if source.trained), None)
        if trained:
            paths.append(folder / f"{re.sub(r'[^A-Za-z0-9+]+', '-', run.name).strip('-')}.md")
            paths[-1].write_text(model_card(run, trained), encoding="utf-8")
    return paths


def _bullets(settings: Mapping[str, Any]) -> str:
    return "\n".join(f"* {name.replace('_', ' ')}: {value}" for name, value in settings.items())
