"""slow.txt names tests that exist: a test that is renamed falls out of it otherwise, and into every
run.
"""

import ast
from pathlib import Path

HERE = Path(__file__).parent


def test_the_list_of_slow_tests_is_of_tests():
    names = {
        f"{path.name}::{node.name}"
        for path in HERE.glob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    listed = [
        line.split("[")[0]
        for line in (HERE / "slow.txt").read_text().splitlines()
        if not line.startswith("#")
    ]
    assert len(listed) > 50 and set(listed) <= names
