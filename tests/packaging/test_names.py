"""Names and docstrings: one public name has one meaning, and a docstring can be read without the one before it."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

PACKAGES = ("icrl4aht_data", "generation", "baselines", "benchmarks")
ENTRY_POINTS = {"main"}
"""Names that several command lines have."""
OPENING = re.compile(r"(Of|The same|By|Its)\b")
"""Openings of sentences that only the previous docstring explains."""


def parsed(*packages: str) -> Iterator[tuple[Path, ast.Module]]:
    """Paths relative to the repository, and syntax trees."""
    for path in sorted(path for package in packages for path in (ROOT / package).rglob("*.py")):
        yield path.relative_to(ROOT), ast.parse(path.read_text(encoding="utf-8"))


def public_names(tree: ast.Module) -> set[str]:
    """Names that a module defines at the top level, without commands, type variables and the names it imports."""
    found: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            decorators = " ".join(map(ast.unparse, node.decorator_list))
            found |= set() if ".command(" in decorators or ".group(" in decorators else {node.name}
        elif isinstance(node, ast.Assign | ast.AnnAssign) and "TypeVar(" not in ast.unparse(node):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return {name for name in found if not name.startswith("_")}


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of docstrings, also of those below a constant or field."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else []:
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                yield statement.lineno, str(statement.value.value)


def test_public_names_are_unique():
    modules: dict[str, list[str]] = defaultdict(list)
    for path, tree in parsed(*PACKAGES):
        for name in public_names(tree) - ENTRY_POINTS:
            modules[name].append(str(path))
    shared = [f"{name}: {', '.join(paths)}" for name, paths in sorted(modules.items()) if len(paths) > 1]
    assert not shared, "\n".join(shared)


@pytest.mark.parametrize("package", [*PACKAGES, "tests"])
def test_docstrings_make_sense_alone(package):
    found = [
        f"{path}:{line}: {text.splitlines()[0]}"
        for path, tree in parsed(package)
        for line, text in docstrings(tree)
        if OPENING.match(text)
    ]
    assert not found, "\n".join(found)
