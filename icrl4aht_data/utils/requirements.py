"""Packages that this one depends on, read from the metadata of its installation: pyproject.toml is the only source."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, metadata, version
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from icrl4aht_data.utils.installation import PACKAGE, install_command

_UNNAMED_EXTRAS = ("dev", "docs", "browser", "peers", "all", "cuda12", "cuda13")
"""Extras that are never suggested: five for work on this project; the others install JAX for GPUs."""

_DISTRIBUTIONS = {"PIL": "pillow"}
"""Module -> distribution, where the names differ."""


class Dependency(NamedTuple):
    """A package that this one depends on.

    Args:
        name: the distribution's name.
        versions: the accepted versions.
        extra: the smallest extra that installs it; None if it is always required.
        found: the installed version; None if it is not installed.
    """

    name: str
    versions: SpecifierSet
    extra: str | None
    found: str | None


def dependencies() -> list[Dependency]:
    """Return the required packages, then those of the extras for users, each package once.

    Raises:
        PackageNotFoundError: if this package itself is not installed.
    """
    found: dict[str, Dependency] = {}
    for extra, members in _requirements_by_extra().items():
        for one in members:
            found.setdefault(one.name, Dependency(one.name, one.specifier, extra or None, installed_version(one.name)))
    return list(found.values())


def installed_version(name: str) -> str | None:
    """Return the installed version of a distribution; None if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def missing_library(module: str, extra: str | None) -> str | None:
    """Return a message that says how to install a missing module of another library; None if no extra has it.

    Args:
        module: name of the module.
        extra: the extra to suggest if it has the module.
    """
    try:
        extras = extras_with(module)
    except PackageNotFoundError:
        return None
    if not extras:
        return None
    chosen = extra if extra in extras else extras[0]
    return f"this needs {module}, which is not installed: {install_command(chosen)}"


def extras_with(module: str) -> list[str]:
    """Return the extras that install a module, the smallest first; none for a required one.

    Raises:
        PackageNotFoundError: if this package itself is not installed.
    """
    top = module.partition(".")[0]
    name = canonicalize_name(_DISTRIBUTIONS.get(top, top))
    needed = _requirements_by_extra()
    found = [extra for extra, members in needed.items() if name in {canonicalize_name(one.name) for one in members}]
    return [] if "" in found else found


def _requirements_by_extra() -> dict[str, list[Requirement]]:
    """Extra -> its requirements, the smallest extra first; before them "" -> those that are always required."""
    about = metadata(PACKAGE)
    listed = [Requirement(line) for line in about.get_all("Requires-Dist") or []]
    listed = [one for one in listed if canonicalize_name(one.name) != PACKAGE]  # an extra may include another
    extras = [name for name in about.get_all("Provides-Extra") or [] if name not in _UNNAMED_EXTRAS]
    required = [one for one in listed if one.marker is None or one.marker.evaluate({"extra": ""})]
    needed = {
        extra: [one for one in listed if one not in required and one.marker and one.marker.evaluate({"extra": extra})]
        for extra in extras
    }
    return {"": required} | dict(sorted(needed.items(), key=lambda item: (len(item[1]), item[0])))
