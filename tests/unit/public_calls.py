"""Every public call of jaxtank in one process, which ends with an error if one loads `tuning`.

Run by test_layers.py. Runs are of a few samples; what they give is tested elsewhere.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import jaxtank
from jaxtank import presets, rig

case = presets.find("cascaded/pi")
loop, clock = case.loop, jaxtank.Clock(dt=4.0, duration=16.0)
short = case.replace(clock=clock)
folder = Path(tempfile.mkdtemp())
run = jaxtank.simulate(loop, clock)


@jaxtank.component
class Gain:
    """A component with a leaf and a static field."""

    k: float = jaxtank.leaf("-", "gain")
    name: str = jaxtank.static(doc="name", default="")


def saved(thing, *names):
    files = {path.name for path in thing.save(folder)}
    assert files >= set(names), files


def interop():
    from jaxtank.interop import python_control

    assert python_control.columns(run, loop.units)
    try:
        from jaxtank.interop.gymnasium import TankEnv
    except ImportError:
        return
    TankEnv(short).reset(seed=0)


CALLS = {
    "Case": lambda: (str(case), case.to_json(), case.safety_design(), case._repr_html_()),
    "Case.plot": case.plot,
    "Case.explore": lambda: case.explore(plants=3).save(folder / "page.html"),
    "Case.save": lambda: saved(case, "case.json", "rig.toml", "rig.png"),
    "ClosedLoop": lambda: loop.units,
    "Clock": lambda: clock.samples,
    "Trajectory": lambda: (str(run), run.to_json(), run._repr_html_()),
    "Trajectory.plot": run.plot,
    "Trajectory.save": lambda: saved(run, "trajectory.csv", "run.png"),
    "EquilibriumError": lambda: jaxtank.EquilibriumError("x"),
    "InputError": lambda: jaxtank.InputError("x"),
    "NonFiniteError": lambda: jaxtank.NonFiniteError,
    "cache": jaxtank.cache,
    "check": lambda: jaxtank.check(loop, clock),
    "component": lambda: Gain(k=1.0),
    "evaluate": lambda: jaxtank.evaluate(loop, clock, ["rms_error", "max_level"]),
    "evaluate_many": lambda: jaxtank.evaluate_many(
        loop, clock, ["max_level"], {"controller.Kc": np.ones((2, 1))}
    ),
    "leaf": lambda: None,
    "static": lambda: None,
    "notebook": jaxtank.notebook,
    "parameters": lambda: jaxtank.parameters(loop),
    "sensitivities": lambda: jaxtank.sensitivities(
        loop, clock, ["max_level"], {"controller.Kc[0]": 1.0}
    ),
    "simulate": lambda: jaxtank.simulate(loop, clock, save_every=2),
    "stability_margins": lambda: jaxtank.stability_margins(loop, clock),
    "with_values": lambda: jaxtank.with_values(loop, {"x0[0]": 1.0}),
    "presets": lambda: [presets.load(paper) for paper in presets.PAPERS],
    "rig": lambda: rig.loads(rig.complete(case)),
    "Rig": lambda: jaxtank.Rig(case="cascaded/pi"),
    **{name: getattr(jaxtank, name) for name in ("Tank", "Orifice", "Pipe", "Spill")},
    **{name: getattr(jaxtank, name) for name in ("Pump", "Valve")},
    "export": lambda: jaxtank.export.export(case, "c"),
    "interop": interop,
}
"""{name, with a method, or of a folder: call}."""


if __name__ == "__main__":
    functions = {n for n in jaxtank.__all__ if callable(getattr(jaxtank, n))}
    assert functions <= CALLS.keys(), functions - CALLS.keys()
    for name, call in CALLS.items():
        call()
        above = [m for m in sys.modules if m.split(".")[0] == "tuning"]
        assert not above, f"{name} loads {above[0]} and {len(above) - 1} more"
