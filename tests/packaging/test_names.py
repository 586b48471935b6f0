"""Test that public names are unique and that source files are short."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator

from tests.helpers.paths import PACKAGES, ROOT

LONGEST = 500
"""Most lines of a source file, as CONTRIBUTING.md says."""


def source_files(*names: str) -> Iterator[tuple[str, str]]:
    """Yield the repository path and the text of each source file of some packages."""
    for path in sorted(path for name in names for path in PACKAGES[name].rglob("*.py")):
        yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def public_names(tree: ast.Module) -> Iterator[str]:
    """Yield the classes, functions and constants that a module defines, except click commands and type variables."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            decorators = " ".join(map(ast.unparse, node.decorator_list))
            names = [] if ".command(" in decorators or ".group(" in decorators else [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign) and "TypeVar(" not in ast.unparse(node):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found = [name for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
            # The target `table[key]` reads the names `table` and `key`, and defines neither.
            names = [name.id for name in found if isinstance(name.ctx, ast.Store)]
        else:
            names = []
        yield from (name for name in names if not name.startswith("_"))


def test_public_names_are_unique():
    modules: dict[str, set[str]] = defaultdict(set)
    for path, text in source_files(*(name for name in PACKAGES if name != "tests")):
        for name in public_names(ast.parse(text)):
            modules[name].add(path)
    assert {name: paths for name, paths in modules.items() if len(paths) > 1 and name not in ("main", "VERBS")} == {}


def test_source_files_are_short():
    lines = {path: text.count("\n") for path, text in source_files(*(name for name in PACKAGES if name != "tests"))}
    assert {path: count for path, count in lines.items() if count > LONGEST} == {}
