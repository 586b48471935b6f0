"""What this package asks of others, as the metadata of its installation says: pyproject.toml is the only source."""

from __future__ import annotations

from collections import Counter
from importlib.metadata import PackageMetadata, PackageNotFoundError, metadata, version
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from icrl4aht_data.errors import OptionError

PACKAGE = "icrl4aht-data"

_FOR_DEVELOPERS = ("dev", "peers", "all")
"""Extras that bring what work on this project needs, not what its use needs."""

_MODULES = {"PIL": "pillow"}
"""Modules that are not named after what is installed."""


class Need(NamedTuple):
    """Another package that this one asks for."""

    name: str
    versions: SpecifierSet
    extra: str | None  # the smallest that brings it; None if nothing works without it

    @property
    def found(self) -> str | None:
        """The version that is installed."""
        try:
            return version(self.name)
        except PackageNotFoundError:
            return None

    @property
    def fits(self) -> bool:
        """Whether it is installed in a version that is asked for."""
        return self.found is not None and self.versions.contains(self.found, prereleases=True)


def needs() -> list[Need]:
    """What the package needs, then what its extras bring, each package once.

    Raises:
        OptionError: if the package is not installed.
    """
    about = _metadata()
    asked = [Requirement(line) for line in about.get_all("Requires-Dist") or []]
    asked = [one for one in asked if canonicalize_name(one.name) != PACKAGE]  # one extra in another
    always = [Need(one.name, one.specifier, None) for one in asked if _wanted(one, "")]
    names = [name for name in about.get_all("Provides-Extra") or [] if name not in _FOR_DEVELOPERS]
    optional = [(name, one) for name in names for one in asked if _wanted(one, name) and not _wanted(one, "")]
    sizes = Counter(name for name, _ in optional)
    found: dict[str, Need] = {}
    for name, one in sorted(optional, key=lambda pair: (sizes[pair[0]], pair[0])):
        found.setdefault(one.name, Need(one.name, one.specifier, name))
    return [*always, *found.values()]


def _wanted(one: Requirement, extra: str) -> bool:
    return one.marker is None or one.marker.evaluate({"extra": extra})


def python_versions() -> SpecifierSet:
    """The versions of Python that the package runs on.

    Raises:
        OptionError: if the package is not installed.
    """
    return SpecifierSet(_metadata()["Requires-Python"] or "")


def _metadata() -> PackageMetadata:
    try:
        return metadata(PACKAGE)
    except PackageNotFoundError as error:
        raise OptionError(f"{PACKAGE}: not installed; `pip install -e .` in its checkout installs it") from error


def extra_with(module: str) -> str | None:
    """The extra that brings a module, if one does."""
    top = module.partition(".")[0]
    name = canonicalize_name(_MODULES.get(top, top))
    return next((need.extra for need in needs() if canonicalize_name(need.name) == name), None)
