"""Test which packages and folders may import which others, and which libraries the reader imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from typing import NamedTuple

from tests.helpers.commands import run_python
from tests.helpers.paths import PACKAGES

ORDER = {
    "": "icrl4aht_data icrl4aht_generation icrl4aht_baselines benchmarks tests",
    "icrl4aht_data": "errors utils overcooked benchmark format plotting clients fetch reading sampling "
    "environments dataset interop writing checking publishing browsing commands",
    "icrl4aht_generation": "policy env paths learners jobs experts layouts teammates profiles collection "
    "adapters populations releases planning verbs commands",
    "icrl4aht_baselines": "plotting methods training agents evaluate play online control report headroom proof "
    "reference demo commands",
}
"""Package -> its folders and files from the lowest to the highest; "" -> the packages. Imports go down or stay."""

BASELINES_MAY_USE = {"env", "policy", "teammates", "learners", "experts", "layouts", "collection", "profiles", "jobs"}
"""Parts of `icrl4aht_generation` that trainers and evaluators need; the others serve only a rebuild."""

JAX = {"jax", "jaxlib", "flax", "optax"}
JAX_ON_DEMAND = {"icrl4aht_data.sampling.batches"}
"""Modules of the reader that put batches on a device if the caller has one."""

PICTURES = {"matplotlib", "PIL"}
HEAVY = {*JAX, *PICTURES, "torch", "datasets", "huggingface_hub", "grain", "pyarrow", "pandas", "scipy"}


class Import(NamedTuple):
    """One import in a module of the project.

    Attributes:
        importer: name of the importing module, such as "package.folder.file".
        imported: name of the imported module, of this project or of a library.
        place: where the statement is: "top", "function" or "types" (under TYPE_CHECKING).
    """

    importer: str
    imported: str
    place: str


def imports_of(importer: str, node: ast.AST, modules: set[str], place: str = "top") -> Iterator[Import]:
    """Yield the imports below a node of a module's syntax tree."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):
            continue  # expressions contain no imports
        if isinstance(child, ast.Import):
            yield from (Import(importer, alias.name, place) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            source = "." * child.level + (child.module or "")
            for alias in child.names:
                name = f"{source}.{alias.name}"
                yield Import(importer, name if name in modules else source, place)
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            yield from imports_of(importer, child, modules, "types")
        elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from imports_of(importer, child, modules, place if place == "types" else "function")
        else:
            yield from imports_of(importer, child, modules, place)


@cache
def project_imports() -> tuple[set[str], list[Import]]:
    """Return the names of all modules of the project, and all imports in these modules."""
    paths = {
        ".".join((name, *path.relative_to(folder).with_suffix("").parts)).removesuffix(".__init__"): path
        for name, folder in PACKAGES.items()
        for path in sorted(folder.rglob("*.py"))
    }
    modules = set(paths)
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in paths.items()}
    return modules, [found for name, tree in trees.items() for found in imports_of(name, tree, modules)]


def test_modules_import_only_lower_packages_and_folders():
    """No module may import a package or folder that comes later in `ORDER`."""
    modules, imports = project_imports()
    faults = []
    for found in imports:
        if found.imported not in modules:
            continue
        importer, imported = found.importer.split("."), found.imported.split(".")
        order, pair = ORDER[""].split(), (importer[0], imported[0])
        if pair[0] == pair[1]:
            if pair[0] not in ORDER or len(importer) < 2 or len(imported) < 2 or importer[1] == "__main__":
                continue  # a package may import public names from all of its folders
            order, pair = ORDER[pair[0]].split(), (importer[1], imported[1])
        if any(name not in order for name in pair) or order.index(pair[1]) > order.index(pair[0]):
            faults.append(f"{found.importer} imports {found.imported}: expected an import down the list {order}")
    assert faults == []


def test_imports_have_no_cycles():
    modules, imports = project_imports()
    graph: dict[str, set[str]] = {name: set() for name in modules}
    for found in imports:
        lazy = found.importer in ORDER  # packages import their public objects at first use
        if found.imported in modules and not lazy and found.place != "types":
            graph[found.importer].add(found.imported)
    TopologicalSorter(graph).prepare()  # raises CycleError with the cycle


def test_reader_does_not_import_jax():
    faults = [
        found
        for found in project_imports()[1]
        if found.importer.startswith("icrl4aht_data.") and found.imported.split(".")[0] in JAX
        if found.place == "top" or (found.place == "function" and found.importer not in JAX_ON_DEMAND)
    ]
    assert faults == []


def test_baselines_import_only_allowed_parts_of_generation():
    used = {
        found.imported.split(".")[1]
        for found in project_imports()[1]
        if found.importer.startswith("icrl4aht_baselines") and found.imported.startswith("icrl4aht_generation.")
    }
    assert used <= BASELINES_MAY_USE


def test_importing_the_reader_loads_no_heavy_libraries():
    code = "import sys, icrl4aht_data; print(sorted({name.split('.')[0] for name in sys.modules}))"
    loaded = ast.literal_eval(run_python("-c", code))
    assert "numpy" in loaded
    assert not HEAVY & set(loaded)
