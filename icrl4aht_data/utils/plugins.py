"""Plugins: objects that other installed packages register as entry points, imported on first use.

A package registers an object in its pyproject.toml, for example a layout:

    [project.entry-points."icrl4aht.layouts"]
    open_kitchen = "my_package.layouts:OPEN_KITCHEN"
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from icrl4aht_data.errors import PluginError
from icrl4aht_data.utils.install_hints import PACKAGE

METHOD_GROUP = "icrl4aht.methods"
"""Entry-point group of training methods, which `doctor` lists."""


class Plugins:
    """Objects that installed packages register in one group of entry points.

    Package metadata is read on first use, once per process, which takes milliseconds.

    Args:
        group: name of the group, such as "icrl4aht.layouts".
        own: names that this package uses itself, which other packages may not register.
    """

    def __init__(self, group: str, own: Iterable[str]) -> None:
        self.group, self._own = group, frozenset(own)
        self._loaded: dict[str, Any] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the registered objects in sorted order; no object is imported.

        Raises:
            PluginError: if two packages, or this package and another one, use the same name, or a name has characters
                other than letters, digits, "_" and "-".
        """
        return tuple(self._entry_points)

    @property
    def packages(self) -> dict[str, str]:
        """Name and version of the package that registers each object, by the registered name.

        Raises:
            PluginError: if names collide or are invalid, see `names`.
        """
        return {name: _package_id(point) for name, point in self._entry_points.items()}

    def load(self, name: str, kind: Any) -> Any:
        """Return a registered object; the first call imports it.

        Args:
            name: one of `names`.
            kind: the expected class of the object, or `Callable`.

        Raises:
            PluginError: if the object cannot be imported or has another class; the message names the entry point.
        """
        if name not in self._loaded:
            try:
                loaded = self._entry_points[name].load()
            except Exception as error:  # importing another package may raise any exception
                reason = f"cannot be imported ({type(error).__name__}: {error}): correct the package, or uninstall it"
                raise self.error(name, reason) from error
            if not isinstance(loaded, kind):
                raise self.error(name, f"expected a {kind.__name__}, found {type(loaded).__name__}: {loaded!r:.100}")
            self._loaded[name] = loaded
        return self._loaded[name]

    def error(self, name: str, problem: str) -> PluginError:
        """Return a `PluginError` whose message names the package and the entry point of a registered object."""
        point = self._entry_points[name]
        return PluginError(f"package {_package_id(point)}, entry point {self.group}: {name} = {point.value}: {problem}")

    @cached_property
    def _entry_points(self) -> dict[str, EntryPoint]:
        found: dict[str, EntryPoint] = {}
        for point in sorted(entry_points(group=self.group), key=lambda one: one.name):
            where = f"package {_package_id(point)}, entry point {self.group}: {point.name}"
            if not re.fullmatch("[A-Za-z][A-Za-z0-9_-]*", point.name):
                raise PluginError(f"{where}: expected a name of letters, digits, _ and -: rename the entry point")
            if point.name in self._own:
                remedy = f"rename the entry point, or uninstall {_package_id(point)}"
                raise PluginError(f"{where}: {PACKAGE} itself uses this name: {remedy}")
            if point.name in found:
                other = _package_id(found[point.name])
                raise PluginError(f"{where}: package {other} also registers this name: uninstall one package")
            found[point.name] = point
        return found


def _package_id(point: EntryPoint) -> str:
    """Return name and version of the package that registers an entry point."""
    return f"{point.dist.name} {point.dist.version}" if point.dist else "of unknown name"
