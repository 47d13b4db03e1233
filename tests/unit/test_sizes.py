"""Sizes of modules, functions and folders of both packages."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXTS = {
    path.relative_to(ROOT).as_posix(): path.read_text()
    for package in ("jaxtank", "tuning")
    for path in sorted((ROOT / package).rglob("*.py"))
}


def long_functions(text, most):
    """[(name, lines without docstring)] of the functions and methods with more than `most`."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            first, last = node.body[0], node.end_lineno
            lines = last - node.lineno + 1
            if ast.get_docstring(node) is not None:
                lines -= first.end_lineno - first.lineno + 1
            found += [(node.name, lines)] if lines > most else []
    return found


@pytest.mark.parametrize("path", TEXTS)
def test_a_module_has_at_most_350_lines_and_its_functions_at_most_60(path):
    assert len(TEXTS[path].splitlines()) <= 350
    assert long_functions(TEXTS[path], 60) == []


def test_a_folder_holds_at_most_16_modules():
    counts = Counter(path.rpartition("/")[0] for path in TEXTS)
    assert {folder: n for folder, n in counts.items() if n > 16} == {}


def test_the_docstring_of_a_function_is_not_counted():
    text = 'def f():\n    """First.\n\n    Last.\n    """\n    return 1\n'
    assert long_functions(text, 1) == [("f", 2)]
    assert long_functions(text, 2) == []
