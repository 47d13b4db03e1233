"""Sizes of arrays come from the shape of a leaf, and nothing from what is written about it."""

import dataclasses
import json
import os

import numpy as np
import pytest
from helpers import python

import jaxtank
from jaxtank import presets
from jaxtank.core.errors import InputError

REWORD = """
import ast, sys
from importlib.machinery import SourceFileLoader

class Reword(ast.NodeTransformer):
    def visit(self, node):
        self.generic_visit(node)
        if getattr(node, "body", None) and isinstance(node.body, list):
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                if isinstance(first.value.value, str):
                    first.value.value = "x"
        if isinstance(node, ast.Dict):  # the metadata that `leaf` and `static` make
            for at, key in enumerate(node.keys):
                if getattr(key, "value", None) == "doc":
                    node.values[at] = ast.copy_location(ast.Constant("x"), node)
        return node

def source_to_code(self, data, path, *, _optimization=-1):
    tree = ast.parse(data)
    if "/jaxtank/" in path or "/tuning/" in path:
        tree = Reword().visit(tree)
    return compile(tree, path, "exec", dont_inherit=True, optimize=_optimization)

def without_bytecode(self, path):
    raise OSError

sys.dont_write_bytecode = True
SourceFileLoader.source_to_code, SourceFileLoader.path_stats = source_to_code, without_bytecode
from jaxtank.rig import schema
for section in schema.SECTIONS.values():
    object.__setattr__(section, "prose", "x")
    for key in section.keys:
        object.__setattr__(key, "doc", "x")
"""
RESULTS = """
import dataclasses, tomllib
import numpy as np
from jaxtank import evaluate, presets, rig
from jaxtank.core.tree import parameters, walk

NAMES = ["gouta2022/chadpc", "mirakhorli/hybrid"]
FILLED = 'case = "gouta2022/pi"\\n[controller]\\nkind = "pid"\\nKc = 2.0\\nTi = 40.0\\n'
FILLED += '[sensor]\\nkind = "level"\\nfull_scale = 5.0\\ngain = 6.0\\n'

def results():
    found = {}
    for name in NAMES:
        text = rig.complete(presets.find(name))
        case = rig.loads(text)
        values = {n: np.asarray(v).tolist() for n, v in parameters(case.loop).items()}
        measures = {}
        if name == "gouta2022/chadpc":
            clock = dataclasses.replace(case.clock, duration=50 * case.clock.dt)
            measures = evaluate(case.loop, clock, ["rms_error_total", "input_travel"])
        measures = {n: np.asarray(v).tolist() for n, v in measures.items()}
        found[name] = repr((tomllib.loads(text), values, measures))
    values = parameters(rig.loads(FILLED).loop)
    found["filled"] = repr({n: np.asarray(v).tolist() for n, v in values.items()})
    for wrong in ("[1.0, 2.0, 3.0]", "[]", "-1.0"):
        try:
            found[wrong] = repr(rig.loads(FILLED.replace("40.0", wrong)))
        except ValueError as error:
            found[wrong] = str(error)
    words = {meta["doc"] for name in NAMES for _, _, meta in walk(presets.find(name).loop)}
    return found, len(words)
"""


@pytest.mark.slow
def test_a_rig_is_read_written_and_simulated_whatever_its_docstrings_say():
    """All docstrings and descriptions of both packages are replaced by "x" in a new process."""
    script = f"{REWORD}\n{RESULTS}\nimport json\nprint(json.dumps(results()))"
    reworded, words = json.loads(python(script, env={**os.environ, "JAX_ENABLE_X64": "1"}))
    space: dict = {}
    exec(RESULTS, space)
    found, ours = space["results"]()
    assert words == 1 < ours and len(found) == 6
    assert reworded == found


def test_an_array_of_a_leaf_without_a_shape_is_refused_with_the_remedy():
    @jaxtank.component
    class Two(jaxtank.controllers.Controller):
        Kc: np.ndarray = jaxtank.leaf("V/cm", "(m,) gain")
        bias: np.ndarray = jaxtank.leaf("V", "gain", shape=("pump",))

        def step(self, state, tick, estimate):
            return tuple(b + 0.0 * self.Kc for b in self.bias), state

    case = presets.find("gouta2015/backstepping")

    def run(**gains):
        loop = dataclasses.replace(case.loop, controller=Two(**gains))
        jaxtank.check(loop, case.clock)

    run(Kc=1.0, bias=[1.0, 2.0])
    with pytest.raises(InputError, match=r"Kc has shape \(2,\): must be one number.*shape="):
        run(Kc=[1.0, 2.0], bias=[1.0, 2.0])
    with pytest.raises(
        InputError, match=r"bias has shape \(\): must be \(2,\), one entry per pump"
    ):
        run(Kc=1.0, bias=1.0)
