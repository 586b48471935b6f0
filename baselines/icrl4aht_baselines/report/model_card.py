"""Cards of trained models: `cards/baseline.md` filled with settings and results."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

from icrl4aht_baselines.methods.options import UNUSED_OPTIONS
from icrl4aht_baselines.report.overlap import describe_training, overlap_legend
from icrl4aht_baselines.report.results import EvaluationRun, ResultSource, instances_range
from icrl4aht_baselines.report.summary import track_tables
from icrl4aht_baselines.training.options import FILTERS, HistoryOptions
from icrl4aht_baselines.training.seen import TASKS_SOURCE, TRAINED_ON
from icrl4aht_data.utils.templates import fill_template

CARD_BEGINS = b"---\nlicense: mit\nlibrary_name: icrl4aht-data\n"
"""First bytes of a model's card, by which it is recognised before it is replaced."""

_HUB = re.compile(r"hf://datasets/([^/@]+/[^/@]+)")


_NOT_LISTED = ("layouts", "root", "split", "labels", "held_out", "obs", "channels", "hide_recipe", *FILTERS)


def model_card(
    run: EvaluationRun,
    title: str = "",
    command: str = "",
    validation: Sequence[EvaluationRun] = (),
    pictures: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Returns README.md of a model, to publish with its run folder.

    Args:
        run: results of a model that was trained here. A run that was merged from models of several layouts has one
            card, with a row of the table of models for each, and settings for each that differ. Several results of
            one model are one row.
        title: name of the model; by default the agent's.
        command: command that makes the model.
        validation: further results of the model, on validation tasks under the same protocol, which get tables, too.
        pictures: path of a picture with curves, relative to the card -> what it shows.
    """
    sources_of: dict[str, list[ResultSource]] = {}
    for source in run.sources:
        if source.trained:
            sources_of.setdefault(source.trained["run_hash"], []).append(source)
    models = list(sources_of.values())
    trained = _trained(models[0])
    config, histories = trained["config"], trained["config"]["histories"]
    on_hub = _HUB.match(histories["root"])
    seeds = list(dict.fromkeys(str(_trained(sources)["config"]["train"]["seed"]) for sources in models))
    single = len(models) == 1
    limits = [
        f"{'It is one run' if single else 'Each model is one run'}, of seed {', '.join(seeds)}: the variation between "
        f"seeds is not known.",
        "Its input at each step must be what the evaluator passes, see `docs/protocol.md` in the repository.",
        *overlap_legend(dict.fromkeys(name for one in (run, *validation) for name in one.overlaps(one.cells))),
    ]
    method, dataset = config["method"] if title else run.agent, on_hub[1] if on_hub else "icrl4aht"
    properties = {
        "method": method,
        "data": f"{dataset}, data version {histories['data_version']}",
        "created with": f"icrl4aht-data {config['package_version']}",
        "made by": command and f"`{command}`",
    }
    tables = [table for one in (run, *validation) for table in track_tables(one)]
    return fill_template(
        "baseline.md",
        title=title or run.agent,
        method=method,
        dataset=dataset,
        properties="\n".join(f"| {name} | {value} |" for name, value in properties.items() if value),
        models="\n".join(_model_row(run, sources) for sources in models),
        settings=_settings(models),
        protocol=run.protocol,
        results="\n\n".join(f"### {heading[0].upper()}{heading[1:]}\n\n{table}" for heading, table in tables),
        curves=_curves(pictures),
        limits="\n".join(f"* {limit}" for limit in limits),
    )


def _curves(pictures: Mapping[str, str]) -> str:
    """Returns the section with pictures, see `model_card`; empty if there are none."""
    if not pictures:
        return ""
    shown = [f"{text}:\n\n![{Path(at).stem}]({at})" for at, text in pictures.items()]
    return "\n\n".join(["## Curves", *shown]) + "\n\n"


def _trained(sources: Sequence[ResultSource]) -> dict[str, Any]:
    """Returns the content of run.json of one model's results."""
    return sources[0].trained or {}


def _layouts(sources: Sequence[ResultSource]) -> str:
    return ", ".join(dict.fromkeys(layout for source in sources for layout in source.layouts))


def _model_row(run: EvaluationRun, sources: Sequence[ResultSource]) -> str:
    """Returns a row of the table of models: training data and seed of one model, and its evaluation."""
    trained = _trained(sources)
    histories = trained["config"]["histories"]
    instances = instances_range(len(run.cells[cell]) for source in sources for cell in source.tasks)
    layouts = ", ".join(histories["layouts"])
    if "groups" in histories:  # trained by playing
        selection = _played_text(trained["config"], layouts)
    else:
        selection = f"{histories['sizes']['train']} of {layouts}"
    selection += f"; the release's manifest has SHA-256 `{trained['manifest_sha256']}`"
    values = [
        _layouts(sources),
        selection,
        describe_training(sources[0].seen),
        str(trained["config"]["train"]["seed"]),
        f"{sources[0].conditions}, {instances} in a cell",
    ]
    return f"| {' | '.join(values)} |"


def _played_text(config: dict[str, Any], layouts: str) -> str:
    """Returns what a model that learned by playing has played."""
    played = sum(config["histories"]["groups"].values())
    others = sum(cell["tasks"] for cell in config.get(TRAINED_ON, ()) if cell.get("source") == TASKS_SOURCE)
    text = f"none: {played} tasks at a time, played with the teammates of the release's histories of {layouts}"
    text += f", and with those of {others} other tasks" if others else ""
    if rearranged := config["play"].get("rearranged"):
        text += f"; also on {rearranged} rearranged versions of each layout"
    text += "; also with the oracle as the teammate" if config["play"].get("oracle_teammate") else ""
    return text + ("; also with four recipes" if config["play"].get("four_recipes") else "")


def write_model_cards(runs: Iterable[EvaluationRun], folder: Path) -> list[Path]:
    """Write the card of every model that was trained here into a folder. Returns their paths, NAME.md by run's name."""
    paths = []
    for run in runs:
        if any(source.trained for source in run.sources):
            paths.append(folder / card_name(run))
            paths[-1].write_text(model_card(run), encoding="utf-8")
    return paths


def card_name(run: EvaluationRun) -> str:
    """Returns the file name of a model's card."""
    return f"{re.sub(r'[^A-Za-z0-9+]+', '-', run.name).strip('-')}.md"


def _settings(models: Iterable[Sequence[ResultSource]]) -> str:
    """Returns the settings of models as lists, one for each set of equal settings."""
    tested_on: dict[str, list[ResultSource]] = {}
    for sources in models:
        config = _trained(sources)["config"]
        channels = config["histories"].get("channels", "own")  # models of earlier versions have a layout's own
        made_by = sorted({cell["source"] for cell in config.get(TRAINED_ON, ()) if "source" in cell})
        data = {"sources of histories": ", ".join(made_by), "labels": config["histories"].get("labels")}
        histories = config["histories"]
        changes = _changed(histories)
        changes["hidden recipe indicators"] = ", ".join(histories.get("hide_recipe", ()))
        changes["started from run"] = (
            config.get("init", {}).get("run") if isinstance(config.get("init"), dict) else None
        )
        unused = UNUSED_OPTIONS.get(config.get("method", ""), ())
        settings = {name: value for name, value in (config["model"] | config["train"]).items() if name not in unused}
        settings |= {**config.get("play", {}), "channels": channels}
        settings |= {name: value for name, value in (data | changes).items() if value}
        tested_on.setdefault(_bullets(settings), []).extend(sources)
    if len(tested_on) == 1:
        return next(iter(tested_on))
    return "\n\n".join(f"Tested on {_layouts(sources)}:\n\n{listed}" for listed, sources in tested_on.items())


def _changed(histories: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the options of a choice of histories that are not the defaults, without those that the card has."""
    default = asdict(HistoryOptions(()))
    return {
        name: histories[name]
        for name, value in default.items()
        if name not in _NOT_LISTED and histories.get(name, value) != value
    }


def _bullets(settings: Mapping[str, Any]) -> str:
    return "\n".join(f"* {name.replace('_', ' ')}: {value}" for name, value in settings.items())
