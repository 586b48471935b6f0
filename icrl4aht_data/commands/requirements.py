"""Packages that this one depends on, read from the metadata of its installation: pyproject.toml is the only source."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, metadata, version
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

PACKAGE = "icrl4aht-data"

_UNNAMED_EXTRAS = ("dev", "browser", "peers", "all", "baselines", "cuda12", "cuda13")
"""Extras that are never suggested: four for work on this project; the others install what `generation` does."""

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
    about = metadata(PACKAGE)
    listed = [Requirement(line) for line in about.get_all("Requires-Dist") or []]
    listed = [one for one in listed if canonicalize_name(one.name) != PACKAGE]  # an extra may include another
    extras = [name for name in about.get_all("Provides-Extra") or [] if name not in _UNNAMED_EXTRAS]
    needed = {
        extra: [one for one in listed if one.marker is None or one.marker.evaluate({"extra": extra})]
        for extra in ("", *extras)
    }
    found: dict[str, Dependency] = {}
    for extra, members in sorted(needed.items(), key=lambda item: (item[0] != "", len(item[1]), item[0])):
        for one in members:
            found.setdefault(one.name, Dependency(one.name, one.specifier, extra or None, installed_version(one.name)))
    return list(found.values())


def installed_version(name: str) -> str | None:
    """Return the installed version of a distribution; None if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def extra_with(module: str) -> str | None:
    """Return the extra that installs a module, if there is one."""
    top = module.partition(".")[0]
    name = canonicalize_name(_DISTRIBUTIONS.get(top, top))
    return next((one.extra for one in dependencies() if canonicalize_name(one.name) == name), None)
