"""The order of packages and folders that imports follow, and the libraries that importing the reader loads."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

import icrl4aht_data
from tests.helpers.paths import ROOT

ORDER = {
    "": "icrl4aht_data generation baselines benchmarks tests",
    "icrl4aht_data": "errors utils overcooked benchmark format plotting remote reading sampling environments dataset "
    "interop writing checking publishing browsing commands",
    "generation": "plotting env policy paths learners experts teammates profiles collection adapters "
    "populations releases planning commands verbs",
    "baselines": "plotting methods training agents evaluate online control report experiments reference demo commands",
}
"""Package -> its folders and files from the lowest to the highest; "" -> the packages. Imports go down or stay."""

BASELINES_MAY_USE = (
    "icrl4aht_generation.env",
    "icrl4aht_generation.policy",
    "icrl4aht_generation.teammates",
    "icrl4aht_generation.learners",
    "icrl4aht_generation.experts",
    "icrl4aht_generation.collection",
    "icrl4aht_generation.profiles",
)
JAX = {"jax", "jaxlib", "flax", "optax"}
JAX_ON_DEMAND = {"icrl4aht_data.sampling.batches"}
"""The modules of the reader with functions that import JAX: they put batches on a device if the caller has one."""

PICTURES = {"matplotlib", "PIL"}
HEAVY = {*JAX, *PICTURES, "torch", "datasets", "huggingface_hub", "grain", "pyarrow"}


class Import(NamedTuple):
    """One import statement's target.

    Attributes:
        importer: the importing module, "package.folder.file".
        imported: the imported module, own or of a library.
        how: "" at the top level, else "in a function" or "under TYPE_CHECKING".
    """

    importer: str
    imported: str
    how: str = ""

    def __str__(self) -> str:
        return f"{self.importer} imports {self.imported}" + f" {self.how}" * bool(self.how)


class Tree:
    """The imports of all modules of some packages.

    Args:
        root: the folder with the packages.
        core: libraries that are always installed; importing any other is a reason to defer an import.
    """

    def __init__(self, root: Path, core: set[str]) -> None:
        paths = {_module(path.relative_to(root)): path for name in _order("") for path in (root / name).rglob("*.py")}
        self.modules, self._installed = set(paths), core | sys.stdlib_module_names | {""}  # "" of relative imports
        self.imports = [
            i for name, path in sorted(paths.items()) for i in self._read(name, ast.parse(path.read_text()))
        ]
        self._top: dict[str, set[str]] = {name: set() for name in self.modules}
        for found in self.imports:
            if not found.how:
                self._top[found.importer].add(found.imported)

    @property
    def own(self) -> list[Import]:
        """The imports of modules of the packages themselves."""
        return [found for found in self.imports if found.imported in self.modules]

    def optional(self, module: str) -> set[str]:
        """Libraries outside the core dependencies that are loaded by importing `module`."""
        seen, todo = set(), [module]
        while todo:
            name = todo.pop()
            if name not in seen:
                seen.add(name)
                todo += self._top.get(name, ())
                todo += {name.rpartition(".")[0]} & self.modules  # a package is imported before its modules
        return {name.split(".")[0] for name in seen - self.modules} - self._installed

    def _read(self, importer: str, node: ast.AST, how: str = "") -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from (Import(importer, alias.name, how) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                source = "." * child.level + (child.module or "")
                names = (f"{source}.{alias.name}" for alias in child.names)
                yield from (Import(importer, name if name in self.modules else source, how) for name in names)
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                yield from self._read(importer, child, how or "under TYPE_CHECKING")
            elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                yield from self._read(importer, child, "in a function")
            else:
                yield from self._read(importer, child, how)


def _module(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def _order(package: str) -> list[str]:
    return ORDER.get(package, "").split()


def absolute(tree: Tree) -> Iterator[str]:
    """Relative imports, which are forbidden."""
    for found in tree.imports:
        if found.imported.startswith("."):
            yield f"{found}: write the full name"


def downwards(tree: Tree) -> Iterator[str]:
    """Imports of a package or folder that comes later in `ORDER`."""
    for found in tree.own:
        (package, *inner), (other, *inner_other) = found.importer.split("."), found.imported.split(".")
        folder, order = "", _order("")
        if package == other:
            if package not in ORDER or not inner or not inner_other:
                continue  # `__init__.py` collects names from all folders
            folder, order, package, other = package, _order(package), inner[0], inner_other[0]
            unknown = [name for name in (package, other) if name not in (*order, "__main__")]
            if unknown or package == "__main__":
                yield from (f"{found}: {name} is not in the order of {folder}" for name in unknown)
                continue
        if order.index(other) > order.index(package):
            yield f"{found}: {package} comes before {other}" + f" in {folder}" * bool(folder)


def acyclic(tree: Tree) -> Iterator[str]:
    """Cycles between files, also those hidden in functions and under TYPE_CHECKING."""
    graph: dict[str, dict[str, None]] = {name: {} for name in sorted(tree.modules)}  # ordered, unlike sets
    for found in tree.own:
        graph[found.importer][found.imported] = None
    while True:
        try:
            return TopologicalSorter(graph).prepare()
        except CycleError as error:
            cycle = error.args[1]
            yield " is imported by ".join(cycle) + ": a cycle"
            graph[cycle[1]].pop(cycle[0])


def at_the_top(tree: Tree) -> Iterator[str]:
    """Deferred imports of own modules that do not keep JAX or an optional library from loading."""
    for found in tree.own:
        if found.importer == "icrl4aht_data":
            continue  # it names its public objects for type checkers, and imports them at their first use
        if found.how and not tree.optional(found.imported) - tree.optional(found.importer):
            yield f"{found}: it loads no optional library, import it at the top"


def reader_without_jax(tree: Tree) -> Iterator[str]:
    """Imports of JAX by the reader that are neither for types nor in a function of the modules that may import it."""
    for found in tree.imports:
        of_reader = found.importer.split(".")[0] == "icrl4aht_data" and found.imported.split(".")[0] in JAX
        on_demand = found.how == "in a function" and found.importer in JAX_ON_DEMAND
        if of_reader and found.how != "under TYPE_CHECKING" and not on_demand:
            yield f"{found}: the reader works without JAX"


def narrow_use_of_generation(tree: Tree) -> Iterator[str]:
    """Imports by `baselines` of what only a rebuild needs."""
    for found in tree.own:
        of_baselines = found.importer.startswith("baselines") and found.imported.startswith("generation.")
        if of_baselines and not found.imported.startswith(BASELINES_MAY_USE):
            yield f"{found}: baselines may use {', '.join(BASELINES_MAY_USE)}"


def pictures_on_demand(tree: Tree) -> Iterator[str]:
    """Imports of libraries for pictures at the top level: without the extra `plot`, only drawing fails."""
    for found in tree.imports:
        package, library = found.importer.split(".")[0], found.imported.split(".")[0]
        if library in PICTURES and not found.how and package not in ("benchmarks", "tests"):
            yield f"{found}: import it where it draws"


Rule = Callable[[Tree], Iterator[str]]
RULES: tuple[Rule, ...] = (
    absolute,
    downwards,
    acyclic,
    at_the_top,
    reader_without_jax,
    narrow_use_of_generation,
    pictures_on_demand,
)


@cache
def project() -> Tree:
    """The imports of this repository."""
    requirements = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    return Tree(ROOT, {re.split(r"[^\w-]", text)[0].replace("-", "_") for text in requirements})


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_imports_follow(rule):
    found = dict.fromkeys(rule(project()))
    assert not found, "\n".join(found)


def test_wrong_imports_are_found(tmp_path):
    files = {
        "icrl4aht_data/dataset.py": "import numpy",
        "icrl4aht_data/interop.py": "def f():\n    from flax import nnx",
        "icrl4aht_data/reading/shard.py": "from icrl4aht_data import dataset",
        "icrl4aht_data/sampling/batches.py": "import jax.numpy as jnp",
        "generation/cli.py": "import jax\ndef f():\n    from icrl4aht_generation.env import step",
        "generation/env.py": "import icrl4aht_baselines.demo, jax.numpy",
        "generation/new.py": "from . import env",
        "generation/learners/a.py": "from icrl4aht_generation.learners import b",
        "generation/learners/b.py": "import PIL.Image\ndef f():\n    from icrl4aht_generation.learners.a import x",
        "generation/releases.py": "import icrl4aht_generation.new, os",
        "baselines/demo.py": "import numpy\nif TYPE_CHECKING:\n    import icrl4aht_generation.releases",
        "benchmarks/bench.py": "import tests.conftest",
        "tests/conftest.py": "",
    }
    tree = _tree(tmp_path, files)
    no_reason = "it loads no optional library, import it at the top"
    allowed = f"baselines may use {', '.join(BASELINES_MAY_USE)}"
    cycle = "icrl4aht_generation.learners.a is imported by icrl4aht_generation.learners.b is imported by icrl4aht_generation.learners.a: a cycle"
    assert {rule: sorted(rule(tree)) for rule in RULES} == {
        absolute: ["icrl4aht_generation.new imports .: write the full name"],
        downwards: [
            "benchmarks.bench imports tests.conftest: benchmarks comes before tests",
            "icrl4aht_generation.env imports icrl4aht_baselines.demo: generation comes before baselines",
            "icrl4aht_generation.releases imports icrl4aht_generation.new: new is not in the order of generation",
            "icrl4aht_data.reading.shard imports icrl4aht_data.dataset: reading comes before dataset in icrl4aht_data",
        ],
        acyclic: [cycle],
        at_the_top: [
            f"icrl4aht_baselines.demo imports icrl4aht_generation.releases under TYPE_CHECKING: {no_reason}",
            f"icrl4aht_generation.cli imports icrl4aht_generation.env in a function: {no_reason}",
            f"icrl4aht_generation.learners.b imports icrl4aht_generation.learners.a in a function: {no_reason}",
        ],
        reader_without_jax: [
            "icrl4aht_data.interop imports flax in a function: the reader works without JAX",
            "icrl4aht_data.sampling.batches imports jax.numpy: the reader works without JAX",
        ],
        narrow_use_of_generation: [
            f"icrl4aht_baselines.demo imports icrl4aht_generation.releases under TYPE_CHECKING: {allowed}"
        ],
        pictures_on_demand: ["icrl4aht_generation.learners.b imports PIL.Image: import it where it draws"],
    }


def test_right_imports_are_not_found(tmp_path):
    files = {
        "icrl4aht_data/sampling/batches.py": "def f():\n    import jax",
        "generation/env.py": "import icrl4aht_data.sampling.batches\nimport jax.numpy",
        "generation/plotting.py": "def f():\n    from matplotlib.figure import Figure",
        "benchmarks/bench.py": "import matplotlib",
        "generation/policy.py": "import icrl4aht_generation.env",
        "generation/cli.py": "import numpy\ndef f():\n    from icrl4aht_generation.env import step",
        "baselines/demo.py": "from generation import env",
    }
    tree = _tree(tmp_path, files)
    assert len(tree.own) == 4
    assert [found for rule in RULES for found in rule(tree)] == []


def _tree(root: Path, files: dict[str, str]) -> Tree:
    """The imports of hand-made files."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return Tree(root, {"numpy"})


def test_importing_the_reader_loads_nothing_heavy():
    code = "import sys, icrl4aht_data; print(sorted({name.split('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = ast.literal_eval(done.stdout)
    assert "numpy" in loaded
    assert not HEAVY & set(loaded)


def test_public_names_exist():
    for name in icrl4aht_data.__all__:
        assert getattr(icrl4aht_data, name).__doc__ or name.isupper(), name
