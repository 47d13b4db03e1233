"""Sizes of arrays come from the shape of a leaf, and nothing from what is written about it."""

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest

import jaxtank
from jaxtank import presets
from jaxtank.core.errors import InputError

SCRIPT = """
import hashlib, json, sys, tomllib
from jaxtank.core import fields, toml_schema

if sys.argv[1] == "x":
    leaf, static, key = fields.leaf, fields.static, toml_schema.Key.__init__
    fields.leaf = lambda unit="-", doc="", **more: leaf(unit, "x", **more)
    fields.static = lambda unit="-", doc="", **more: static(unit, "x", **more)
    def undocumented(self, name, doc="", *values, **more):
        key(self, name, "x", *values, **{n: v for n, v in more.items() if n != "doc"})
    toml_schema.Key.__init__ = undocumented
    from jaxtank.core import tree
    tree.leaf, tree.static = fields.leaf, fields.static

import numpy as np
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import parameters, walk

docs, results = set(), {}
FILLED = '''case = "gouta2022/pi"
[controller]
kind = "pid"
Kc = 2.0
Ti = 40.0
[sensor]
kind = "level"
full_scale = 5.0
gain = 6.0
'''
for name in presets.names():
    case = presets.find(name)
    docs |= {meta["doc"] for _, _, meta in walk(case.loop)}
    try:
        text = rig.dump(case)
        again = rig.loads(text)
        values = {n: np.asarray(v).tolist() for n, v in parameters(again.loop).items()}
        results[name] = repr(tomllib.loads(text)) + repr(values)
    except InputError as error:
        results[name] = str(error)
values = parameters(rig.loads(FILLED).loop)
results["filled"] = repr({n: np.asarray(v).tolist() for n, v in values.items()})
for wrong in ("Kc = [1.0, 2.0, 3.0]", "Ti = []"):
    key = wrong.split()[0]
    text = "\\n".join(wrong if row.startswith(key) else row for row in FILLED.splitlines())
    try:
        case = rig.loads(text)
        results[wrong] = "accepted"
    except InputError as error:
        results[wrong] = str(error)
digests = {n: hashlib.sha256(v.encode()).hexdigest() for n, v in results.items()}
print(json.dumps({"docs": len(docs), "wrong": results[wrong], "digests": digests}))
"""


@pytest.mark.slow
def test_a_rig_file_is_read_and_written_without_a_word_of_documentation():
    """Every preset and an array filled by one number, with all descriptions replaced by "x"."""
    found = {}
    for docs in ("ours", "x"):
        run = subprocess.run(
            [sys.executable, "-c", SCRIPT, docs], capture_output=True, text=True, env=os.environ
        )
        assert run.returncode == 0, run.stderr[-2000:]
        found[docs] = json.loads(run.stdout)
    assert found["x"]["docs"] == 1 < found["ours"]["docs"]
    assert len(found["x"]["digests"]) > 70
    assert found["x"]["digests"] == found["ours"]["digests"]


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
