"""No function has more branches than a reader can follow, no name of a module two meanings."""

import ast
from pathlib import Path

import pytest

import jaxtank
import tuning

MOST = 15
"""Largest cyclomatic complexity, as radon counts it."""


def functions(blocks):
    """Every function and method, those inside others too."""
    for block in blocks:
        yield from functions(getattr(block, "methods", []))
        yield from functions(getattr(block, "inner_classes", []))
        if not hasattr(block, "methods"):
            yield block
            yield from functions(block.closures)


def test_no_function_has_more_than_15_paths():
    visitors = pytest.importorskip("radon.visitors", reason="radon counts the paths")
    too_many = {}
    for root in (Path(package.__file__).parent for package in (jaxtank, tuning)):
        for path in sorted(root.rglob("*.py")):
            visitor = visitors.ComplexityVisitor.from_code(path.read_text())
            for f in functions([*visitor.functions, *visitor.classes]):
                if f.complexity > MOST:
                    too_many[f"{path}:{f.lineno} {f.name}"] = f.complexity
    assert not too_many


def assigned(statement):
    """Names that a statement of a module gives a value."""
    targets = getattr(statement, "targets", [getattr(statement, "target", None)])
    parts = [part for t in targets for part in getattr(t, "elts", [t])]
    return {part.id for part in parts if isinstance(part, ast.Name)}


def test_no_constant_of_a_module_is_given_a_second_meaning():
    """A value made of the first one is none."""
    twice = []
    for root in (Path(package.__file__).parent for package in (jaxtank, tuning)):
        for path in sorted(root.rglob("*.py")):
            seen = set()
            for statement in ast.parse(path.read_text()).body:
                if isinstance(statement, ast.Assign | ast.AnnAssign):
                    read = {n.id for n in ast.walk(statement.value) if isinstance(n, ast.Name)}
                    twice += [f"{path}: {n}" for n in (assigned(statement) & seen) - read]
                    seen |= assigned(statement)
    assert not twice
