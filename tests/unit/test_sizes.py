"""No function has more branches than a reader can follow."""

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
