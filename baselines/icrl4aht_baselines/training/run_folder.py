"""Run folders, which hold config.json, layouts.jsonl, metrics.jsonl, timing.jsonl, curves.png, checkpoints/ and logs.

Checkpoints, logs and resuming are in `icrl4aht_generation.learners.resume`; this module reads and writes settings.
"""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from icrl4aht_generation.learners.resume import METRICS, TIMING, Checkpoints, differing_settings

from icrl4aht_baselines.training.loggers import LOGGER_NAMES
from icrl4aht_data.errors import IndexFormatError, OptionError
from icrl4aht_data.format.layouts_file import LAYOUTS_NAME, write_layouts_file
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.files import check_folder_content, read_json, write_json

RUN_FORMAT = 4
"""Version of the format of run folders. Version 2 has checkpoints as safetensors files, version 3 adds `trained_on` to
config.json, and version 4 adds `channels`."""

CONFIG, RUN_CURVES, CHECKPOINTS = "config.json", "curves.png", "checkpoints"
_FILES = {CONFIG, RUN_CURVES, CHECKPOINTS, LAYOUTS_NAME, METRICS, TIMING, *LOGGER_NAMES}


def format_versions() -> dict[str, Any]:
    """Return the versions that config.json states: version of the run folder's format, and version of this package."""
    return {"run_format": RUN_FORMAT, "package_version": version("icrl4aht-data")}


def read_config(folder: Path) -> dict[str, Any]:
    """Return the settings in the config.json of a run folder.

    Raises:
        OptionError: if the folder is not a run, or its format has another version.
    """
    path = folder / CONFIG
    try:
        config = read_json(path)
        found = config["run_format"]
    except (IndexFormatError, KeyError, TypeError) as error:
        raise OptionError(f"{folder}: not a run: expected {CONFIG} with run_format ({error})") from error
    if found != RUN_FORMAT:
        reader = format_versions()["package_version"]
        raise OptionError(
            f"{path}: run_format {found!r}, but version {reader} of this package reads run_format {RUN_FORMAT} only: "
            f"train again into another folder (another --out){other_version(config)}"
        )
    return config


def other_version(config: dict[str, Any]) -> str:
    """Return the end of a message about a run: the version that wrote it, if this package has another version."""
    writer, reader = config.get("package_version"), format_versions()["package_version"]
    return f", or use this run with version {writer} of this package, which wrote it" if writer != reader else ""


def check_same_settings(found: dict[str, Any], expected: dict[str, Any], what: str) -> None:
    """Check that stored settings are the expected ones.

    Args:
        found: stored settings.
        expected: settings of the run that is to be resumed.
        what: start of the message, with the path of the stored settings.

    Raises:
        OptionError: if settings differ; the message states each of them.
    """
    if different := differing_settings(found, expected):
        listed = "; ".join(f"{name}: found {a!r:.80}, expected {b!r:.80}" for name, (a, b) in different.items())
        raise OptionError(f"{what} with other settings ({listed}); give another --out, or remove the old files")


def open_run(folder: Path, config: dict[str, Any]) -> dict[str, Any]:
    """Start a run in a folder, or check that the folder's run has the same settings. Return the settings in the folder.

    If the folder has settings but no checkpoint, there is nothing to resume, and the settings are replaced.

    Args:
        folder: run folder, which is created if it is missing.
        config: all settings of the run, as JSON.

    Raises:
        OptionError: if the folder has checkpoints of a run with other settings, or files that do not belong to a run.
    """
    if (folder / CONFIG).exists() and Checkpoints(folder / CHECKPOINTS).latest is not None:
        found = read_config(folder)
        check_same_settings(found, config, f"{folder}: holds a run")
        return found
    check_folder_content(folder, _FILES, "a run")
    folder.mkdir(parents=True, exist_ok=True)
    if jax.process_index() == 0:
        names = config.get("histories", {}).get("layouts", ())
        write_layouts_file(folder / LAYOUTS_NAME, map(get_layout, names))  # evaluation then needs no release
        write_json(folder / CONFIG, config)
    return config
