"""Write and import test packages that register plugins by entry points, as installed packages do."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest import mock

from icrl4aht_baselines.methods.registry import METHOD_PLUGINS

from icrl4aht_data.benchmark.facts import TEAMMATE_PLUGINS
from icrl4aht_data.overcooked.layouts import LAYOUT_PLUGINS


def write_package(
    folder: Path, name: str, modules: Mapping[str, str], entry_points: Mapping[str, Mapping[str, str]]
) -> Path:
    """Write a package of version 0.1 with the metadata that an installer would write; return the folder.

    Args:
        folder: folder to write into, to be put on Python's path.
        name: name of the distribution; the package's name has underscores instead of hyphens.
        modules: source code of each module by name.
        entry_points: the registered objects as group -> name -> "module:object".
    """
    package, metadata = (folder / (name.replace("-", "_") + suffix) for suffix in ("", "-0.1.dist-info"))
    for path in (package, metadata):
        path.mkdir(parents=True)
    for module, source in {"__init__": "", **modules}.items():
        (package / f"{module}.py").write_text(source, encoding="utf-8")
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n", encoding="utf-8")
    sections = [
        "\n".join([f"[{group}]", *(f"{key} = {value}" for key, value in points.items())])
        for group, points in entry_points.items()
    ]
    (metadata / "entry_points.txt").write_text("\n\n".join(sections) + "\n", encoding="utf-8")
    return folder


@contextmanager
def installed_plugins(*folders: Path) -> Iterator[None]:
    """Put packages written by `write_package` on the Python path within a context, so that their plugins are found."""
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(sys, "path", [*map(str, folders), *sys.path]))
        for plugins in (LAYOUT_PLUGINS, TEAMMATE_PLUGINS, METHOD_PLUGINS):
            stack.enter_context(mock.patch.dict(vars(plugins), _loaded={}))
            vars(plugins).pop("_entry_points", None)
        yield
