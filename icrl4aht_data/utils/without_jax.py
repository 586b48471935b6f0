"""Imports of packages that need JAX, where JAX is not installed: their errors name the command that installs it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import find_spec
from types import ModuleType

from icrl4aht_data.utils.requirements import missing_library


def explain_missing_jax(package: str) -> None:
    """Make the modules of a package say how to install what they import, if JAX is not installed.

    Where JAX is installed this does nothing. Most modules of the packages need JAX, but their command lines start
    without it, so the packages themselves cannot refuse to be imported.

    Args:
        package: name of a package, and of the extra that it needs.
    """
    if find_spec("jax") is None:
        sys.meta_path.insert(0, _Finder(package))


class _Finder(MetaPathFinder):
    def __init__(self, package: str) -> None:
        self._package = package

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith(f"{self._package}."):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        try:
            super().exec_module(module)
        except ModuleNotFoundError as error:
            error.msg = (
                missing_library(error.name or "", module.__name__.partition(".")[0].removeprefix("icrl4aht_"))
                or error.msg
            )
            raise
