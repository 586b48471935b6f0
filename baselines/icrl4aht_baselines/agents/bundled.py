"""Trained models in this package: `models/NAME/TRACK` is the run folder of model NAME for the tasks of TRACK.

TRACK is the name of a track, or "all" for a model that plays all tracks. A bundled run folder holds the run's settings,
its last parameters without the optimizer's state, and its training curves. The folder NAME also holds the model's
card, and `bundle.json`, which states how the model plays by default.
"""

from __future__ import annotations

import re
import shutil
from datetime import date
from pathlib import Path
from typing import NamedTuple

import jax
from icrl4aht_generation.learners.resume import Checkpoints

from icrl4aht_baselines.plotting import shrink_picture
from icrl4aht_baselines.training.histories import read_trained
from icrl4aht_baselines.training.run_folder import CHECKPOINTS, CONFIG, RUN_CURVES, read_config
from icrl4aht_data.benchmark.facts import TRACKS, layout_track
from icrl4aht_data.errors import OptionError
from icrl4aht_data.fetch import is_address
from icrl4aht_data.format.layouts_file import LAYOUTS_NAME
from icrl4aht_data.utils.files import read_json, write_json
from icrl4aht_data.utils.text import listed_names

MODELS = Path(__file__).parents[1] / "models"
"""Folder of the bundled models."""

MODEL_CARD = "README.md"
"""File name of a bundled model's card, in the folder `models/NAME`."""

BUNDLE = "bundle.json"
"""Name of the JSON file with the last two fields of a `BundledModel`, in the folder `models/NAME`."""

EVERY_TRACK = "all"
"""Name, in place of a track, of a run that plays the tasks of all tracks."""

_LARGEST = 2 * 10**6  # maximum size of a bundled model's parameters, in bytes


class BundledModel(NamedTuple):
    """A trained model that is part of this package. By default it samples its actions.

    Attributes:
        name: name of the model, such as "ad-reference".
        runs: name of a track -> run folder of the model for this track; a model for all tracks has the only key
            `EVERY_TRACK`.
        role: purpose of the model, such as "plays best".
        date: day on which the model was bundled, such as "2026-11-24".
    """

    name: str
    runs: dict[str, Path]
    role: str = ""
    date: str = ""

    def run_key(self, layout: str) -> str:
        """Return the key of a layout's run in `runs`; `layout` is the layout's short name."""
        return EVERY_TRACK if EVERY_TRACK in self.runs else layout_track(layout)


def bundled_models(folder: Path = MODELS) -> dict[str, BundledModel]:
    """Return the models in a folder of bundled models: name -> model."""
    found = {}
    for path in sorted(folder.glob("*/")):
        runs = {track: path / track for track in (*TRACKS, EVERY_TRACK) if (path / track / CONFIG).is_file()}
        if runs:
            found[path.name] = BundledModel(path.name, runs, **read_json(path / BUNDLE))
    return found


def format_track(track: str) -> str:
    """Return text with the name of a track, or "all tracks" for `EVERY_TRACK`."""
    return "all tracks" if track == EVERY_TRACK else f"track {track}"


def describe_model(model: BundledModel) -> list[str]:
    """Return one line of text for each training run of a bundled model: method, size, and training data."""
    lines = []
    for track, folder in model.runs.items():
        trained = read_trained(folder)
        count = sum(leaf.size for leaf in jax.tree.leaves(trained.params))
        sources = sorted({cell["source"] for cell in trained.trained_on})
        context = "" if trained.method.data == "tasks" else f", K = {trained.context}"
        lines.append(
            f"{format_track(track)}: {trained.label}, {count:,} parameters{context}, {trained.step:,} steps on "
            f"{listed_names(trained.layouts)} (source {' and '.join(sources)})"
        )
    return lines


def check_bundle_name(name: str) -> None:
    """Check that a bundled model's name is two or more words of lowercase letters and digits, joined by hyphens.

    Raises:
        OptionError: if the name has another form.
    """
    if not re.fullmatch("[a-z][a-z0-9]*(-[a-z0-9]+)+", name):
        raise OptionError(f"name = {name!r}: expected lowercase words joined by hyphens, such as ad-reference")


def bundle_run(run: Path, name: str, track: str, folder: Path = MODELS, *, role: str = "") -> Path:
    """Copy a finished run to the bundled models, where it replaces earlier runs of its track. Return the new folder.

    Args:
        run: folder of the run.
        name: name of the bundled model.
        track: track of the tasks that the model plays, or `EVERY_TRACK`.
        folder: folder of the bundled models.
        role: purpose of the model, such as "plays best".

    Raises:
        OptionError: if the name is invalid, the run is not finished, or its parameters are too large.
    """
    check_bundle_name(name)
    trained, config = read_trained(run), read_config(run)
    steps = config["train"]["steps"]
    if trained.step < steps:
        raise OptionError(f"{run}: training stopped at step {trained.step} of {steps}; resume it with the same command")
    size = sum(4 * leaf.size for leaf in jax.tree.leaves(trained.params))
    if size > _LARGEST:
        raise OptionError(f"{run}: parameters of {size:,} bytes, expected at most {_LARGEST:,}: bundle a smaller model")
    target = folder / name / track
    for replaced in (track, *(TRACKS if track == EVERY_TRACK else (EVERY_TRACK,))):
        shutil.rmtree(folder / name / replaced, ignore_errors=True)
    target.mkdir(parents=True)
    if not is_address(config["histories"]["root"]):  # a path on the training machine means nothing on other machines
        config["histories"]["root"] = Path(config["histories"]["root"]).name
    write_json(target / CONFIG, config, indent=1)
    Checkpoints(target / CHECKPOINTS).save({"params": trained.params}, trained.step)
    if (run / LAYOUTS_NAME).is_file():
        shutil.copyfile(run / LAYOUTS_NAME, target / LAYOUTS_NAME)
    if (run / RUN_CURVES).is_file():
        shrink_picture(run / RUN_CURVES, target / RUN_CURVES)
    write_json(folder / name / BUNDLE, {"role": role, "date": f"{date.today()}"}, indent=None)
    return target
