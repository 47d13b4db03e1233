"""The notebooks read as a user would write them; a quick run replaces parameters of their tagged
cell alone.
"""

import ast
import json
import re

import pytest
from helpers import ROOT

FOLDER = ROOT / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="the notebooks are not beside the tests")


def quick_parameters():
    """FAST of notebooks/run.py, read without its imports."""
    tree = ast.parse((FOLDER / "run.py").read_text())
    (node,) = (n for n in tree.body if isinstance(n, ast.Assign) and n.targets[0].id == "FAST")
    return ast.literal_eval(node.value)


def code(path):
    return [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]


def test_every_notebook_has_parameters_of_a_quick_run():
    assert [p.name[:2] for p in NOTEBOOKS] == sorted(quick_parameters())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_each_quick_parameter_is_assigned_once_in_the_tagged_cell(path):
    (cell,) = (c for c in code(path) if "parameters" in c["metadata"].get("tags", ()))
    source = "".join(cell["source"])
    for names, value in quick_parameters()[path.name[:2]].items():
        (assigned,) = re.findall(f"^{re.escape(names)} = (.*)$", source, re.M)
        assert len(ast.parse(names).body) == 1 and ast.parse(value) and assigned != value


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_no_later_cell_assigns_a_parameter(path):
    _, *later = code(path)
    trees = [ast.parse(re.sub("^[%!].*$", "", "".join(c["source"]), flags=re.M)) for c in later]
    stored = {
        n.id
        for tree in trees
        for n in ast.walk(tree)
        if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }
    names = {n.strip() for key in quick_parameters()[path.name[:2]] for n in key.split(",")}
    assert names & stored == set()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_no_notebook_asks_how_it_is_run(path):
    source = "".join("".join(c["source"]) for c in code(path))
    assert "FAST" not in source and "environ" not in source
