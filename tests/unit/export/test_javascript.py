"""Exported JavaScript, run by node, against the loop it was made from."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from test_export import Compiled, needs_gcc, replayed

from jaxtank.core.errors import InputError
from jaxtank.export.source import export

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="no node on this machine")

REPLAY = """
const d = JSON.parse(require("fs").readFileSync(0)), s = law.init(d.start, d.u);
const out = d.t.map((t, k) => law.step(s, t, d.y[k], d.r[k], d.dr[k], d.ddr[k]));
console.log(JSON.stringify(out));
"""


def node(text, data=None):
    """What a script of JavaScript prints, as JSON."""
    done = subprocess.run(
        [NODE, "-e", text], input=json.dumps(data), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def inputs_of(case, run, signals):
    """Inputs (samples, pumps) that the exported controller gives."""
    data = {name: np.asarray(v).tolist() for name, v in zip(("r", "dr", "ddr"), signals)}
    data |= {"t": run.t.tolist(), "y": run.y.tolist(), "start": np.asarray(case.loop.x0).tolist()}
    data["u"] = np.asarray(case.loop.actuator.initial).tolist()
    return np.array(node(export(case, "js", name="law") + REPLAY, data))


@needs_node
@pytest.mark.parametrize(
    "name",
    [
        "cascaded/pi",
        *(
            pytest.param(n, marks=pytest.mark.slow)
            for n in ("gouta2022/chadpc", "gouta2022/fopi", "mirakhorli/hybrid", "mirakhorli/smc")
        ),
    ],
)
def test_javascript_gives_the_inputs_of_the_loop(name):
    """Within 1e-9 of the pumps' range, over 10,000 samples."""
    case, run, signals = replayed(name)
    reach = max(1.0, float(np.abs(run.applied).max()))
    found = inputs_of(case, run, signals)
    np.testing.assert_allclose(found, run.applied, atol=1e-9 * reach, rtol=0)


@pytest.mark.slow
@needs_node
@needs_gcc
def test_javascript_and_c_of_a_quadratic_programme_agree(tmp_path):
    case, run, signals = replayed("gouta2015/backstepping-boxqp")
    c = Compiled(case, tmp_path).run(case, run, signals)
    np.testing.assert_allclose(inputs_of(case, run, signals), c, atol=1e-10)


def test_a_function_is_not_called_what_javascript_has():
    case = replayed("cascaded/pi")[0]
    with pytest.raises(InputError, match="has this name already"):
        export(case, "js", name="function")
