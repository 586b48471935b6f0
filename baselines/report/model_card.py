"""Cards of trained models: `cards/baseline.md` filled with settings and results."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from baselines.report.results import EvaluationRun
from baselines.report.summary import track_tables
from icrl4aht_data.utils.templates import fill_template

CARD_BEGINS = b"---\nlicense: mit\nlibrary_name: icrl4aht-data\n"
"""First bytes of a model's card, by which it is recognised before it is replaced."""

_HUB = re.compile(r"hf://datasets/([^/@]+/[^/@]+)")


def model_card(run: EvaluationRun, trained: Mapping[str, Any]) -> str:
    """Returns README.md of a model, to publish with its run folder.

    Args:
        run: its results.
        trained: settings of its training, see `ResultSource.trained`.
    """
    config, histories = trained["config"], trained["config"]["histories"]
    on_hub = _HUB.match(histories["root"])
    limits = [
        f"It is one run, of seed {config['train']['seed']}: the variation between seeds is not known.",
        "Its input at each step must be what the evaluator passes, see `docs/protocol.md` in the repository.",
    ]
    return fill_template(
        "baseline.md",
        method=run.agent,
        dataset=on_hub[1] if on_hub else "icrl4aht",
        data_version=histories["data_version"],
        selection=f"{histories['sizes']['train']} of {', '.join(histories['layouts'])}; the release's manifest has "
        f"SHA-256 `{trained['manifest_sha256']}`",
        code_version=config["package_version"],
        settings=_bullets({**config["model"], **config["train"]}),
        protocol=run.protocol,
        results="\n\n".join(table for _, table in track_tables(run)),
        limits="\n".join(f"* {limit}" for limit in limits),
    )


def write_model_cards(runs: Iterable[EvaluationRun], folder: Path) -> list[Path]:
    """Write the card of every trained model into a folder; a merged run has the settings of its first source.

    Returns their paths, NAME.md by the run's name.
    """
    paths = []
    for run in runs:
        trained = next((source.trained for source in run.sources if source.trained), None)
        if trained:
            paths.append(folder / card_name(run))
            paths[-1].write_text(model_card(run, trained), encoding="utf-8")
    return paths


def card_name(run: EvaluationRun) -> str:
    """Returns the file name of a model's card."""
    return f"{re.sub(r'[^A-Za-z0-9+]+', '-', run.name).strip('-')}.md"


def _bullets(settings: Mapping[str, Any]) -> str:
    return "\n".join(f"* {name.replace('_', ' ')}: {value}" for name, value in settings.items())
