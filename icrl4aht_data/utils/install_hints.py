"""Address of the project, and commands that install missing optional packages.

The commands add an extra to the installed package, whether it comes from an index, a repository or a folder.
"""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, metadata
from typing import Any

from icrl4aht_data.errors import OptionError

PACKAGE = "icrl4aht-data"
"""Name of the distribution that contains icrl4aht_data, icrl4aht_generation and icrl4aht_baselines."""

AUTHORS = "The icrl4aht-data authors"
"""The authors of the package and of the bundled release, as in pyproject.toml and CITATION.cff."""

EXTRAS = {
    **dict.fromkeys(("jax", "flax", "optax", "jaxtyping", "safetensors"), "baselines"),
    **dict.fromkeys(("matplotlib", "pillow"), "plot"),
    **dict.fromkeys(("datasets", "pyarrow", "mlcroissant"), "hf"),
    **dict.fromkeys(("starlette", "uvicorn", "websockets"), "play"),
    **{name: name for name in ("pandas", "grain", "torch", "pettingzoo", "jaxmarl", "minari", "wandb", "trackio")},
    "tensorboardx": "tensorboard",
    "s3fs": "s3",
    "ray": "cluster",
    "gymnasium": "gym",
}
"""Optional package -> the extra that installs it."""

RESTORE = f"pip install --force-reinstall --no-deps {PACKAGE}, or in a checkout git checkout ."
"""Command that restores missing files of this package."""


def project_url() -> str | None:
    """Return the address of the repository, `Repository` in pyproject.toml; None if the address is unknown."""
    with suppress(PackageNotFoundError):  # raised if the sources are not installed as a package
        urls = dict(line.split(", ", 1) for line in metadata(PACKAGE).get_all("Project-URL") or [])
        return urls.get("Repository")
    return None


def install_command(*extras: str) -> str:
    """Return the shell command that installs extras, such as "plot"."""
    return f"pip install '{PACKAGE}[{','.join(extras)}]'"


def import_optional(module: str, purpose: str) -> Any:
    """Return an optional module, imported on first use.

    Args:
        module: name of the module, such as "pyarrow.parquet".
        purpose: what needs the module, in words, such as "a data frame", for the message.

    Raises:
        OptionError: if the module is not installed; the message has the command that installs the module.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise OptionError(f"{purpose} needs {module.partition('.')[0]}: {install_command(_extra(module))}") from error


def missing_library_message(module: str) -> str | None:
    """Return a message that says how to install a missing module; None if no extra installs it."""
    extra = _extra(module)
    top = module.partition(".")[0]
    return f"this needs {top}, which is not installed: {install_command(extra)}" if extra else None


def _extra(module: str) -> str:
    """Return the name of the extra that installs a module; an empty string if no extra does."""
    top = module.partition(".")[0].lower()
    return EXTRAS.get("pillow" if top == "pil" else top, "")
