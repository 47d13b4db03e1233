"""A rig by keywords of Python is the rig of the file with the same keys."""

import ast
import inspect
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers import DATA, RIGS, ROOT, assert_same_tree

import jaxtank
from jaxtank import rig
from jaxtank.bounds import bounds
from jaxtank.core.errors import InputError
from jaxtank.rig import keywords
from tuning.identification.coordinates import free_bounds

FILES = sorted([*RIGS.glob("*.toml"), *DATA.glob("cases/*.toml")])
TABLES = ("Tank", "Orifice", "Pipe", "Spill", "Pump", "Valve")


def arrays(value):
    """Lists of numbers as arrays, and other lists as tuples."""
    if isinstance(value, dict):
        return {k: arrays(v) for k, v in value.items()}
    if not isinstance(value, list):
        return value
    numbers = value and np.array(value, dtype=object).dtype == object
    flat = np.array(value, dtype=object).ravel() if numbers else ()
    same = len({np.shape(v) for v in value}) == 1
    if len(flat) and same and all(type(v) in (int, float) for v in flat):
        return np.array(value)
    return tuple(map(arrays, value))


def in_python(table):
    """The keywords of `Rig` for a table of a rig file."""
    calls = {}
    for key, value in rig.read.renamed(table).items():
        make = getattr(jaxtank, key.capitalize(), None) if key.capitalize() in TABLES else None
        name = f"{key}s" if isinstance(value, list) and isinstance(value[0], dict) else key
        if make:
            value = [
                make(**{"from_" if k == "from" else k: arrays(v) for k, v in row.items()})
                for row in value
            ]
        calls[name] = value if make else arrays(value)
    return calls


def assert_same(case, other):
    assert_same_tree(case.loop, other.loop)
    for field in ("name", "clock", "limits", "free", "objective", "uncertain", "scenarios"):
        assert getattr(case, field) == getattr(other, field)


@pytest.mark.extended_for("case31_safety_filter_outflow_pump", "case38_transfer_pump_manual_valve")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_keywords_with_arrays_give_the_case_of_the_file(path, monkeypatch):
    monkeypatch.chdir(path.parent)  # names of tables in files
    calls = in_python(tomllib.loads(path.read_text()))
    try:
        case = rig.load(path)
    except InputError as error:  # one of the cases is refused
        with pytest.raises(InputError) as info:
            jaxtank.Rig(**calls)
        assert str(error).endswith(str(info.value))
    else:
        assert_same(jaxtank.Rig(**calls), case)


PARTS = dict(
    tanks=[jaxtank.Tank("LT101", area=0.5, rim=1.2, drain="4 cm^2", level=0.4)],
    pumps=[jaxtank.Pump("P101", to="LT101", gain=3e-5, high=100.0)],
    units=("m", "%"),
)
PI = {"kind": "pi", "Kc": 200.0, "Ti": "5 min"}


def test_a_table_of_setpoints_is_its_changes():
    two = dict(PARTS, tanks=PARTS["tanks"] * 2, plant={"outputs": (1, 2)})
    two["tanks"] = [{**two["tanks"][0], "name": name} for name in ("LT101", "LT102")]
    two["pumps"] = [jaxtank.Pump(to=i, gain=3e-5, high=100.0) for i in (1, 2)]
    table = np.array([[0, 0.4, 0.5], [60, 0.6, 0.5], [90, 0.6, 0.5], [120, 0.7, 0.3]])
    changes = [[60, 1, 0.6], [120, 1, 0.7], [120, 2, 0.3]]
    stepped = jaxtank.Rig(**two, controller={**PI, "kind": "pi"}, reference=table)
    stated = {"initial": np.array([0.4, 0.5]), "changes": np.array(changes)}
    assert_same(stepped, jaxtank.Rig(**two, controller=PI, reference=stated))
    assert stepped.loop.reference.changes == ((60.0, 0), (120.0, 0), (120.0, 1))
    with pytest.raises(InputError, match="reference"):
        jaxtank.Rig(**two, controller=PI, reference=[[0.0, 0.4], [60.0]])


def test_a_controller_of_python_takes_the_place_of_its_table():
    @jaxtank.component
    class Proportional(jaxtank.controllers.Controller):
        Kc: float = jaxtank.leaf("%/m", "gain", low=0.0)

        def step(self, state, tick, estimate):
            return (self.Kc * (tick.r[0] - estimate.x[0]),), state

    case = jaxtank.Rig(
        **PARTS,
        controller=Proportional(Kc=2.0),
        free={"controller.Kc": (1.0, 50.0)},
        values={"controller.Kc": 3.0},
        reference=[[0.0, 0.5]],
        duration="10 s",
        dt=2,
    )
    run = jaxtank.simulate(case)
    np.testing.assert_allclose(run.u[:, 0], 3.0 * (0.5 - np.asarray(run.x[:, 0])), rtol=1e-12)
    assert case.clock.samples == 6 and case.free["controller.Kc"].high == 50.0


def test_every_problem_of_a_rig_is_in_one_message():
    with pytest.raises(InputError) as info:
        jaxtank.Rig(**PARTS, controler=PI, tank=[], setpoints=1)
    assert all(word in str(info.value) for word in ("controller", "tanks", "setpoints"))
    with pytest.raises(InputError) as info:
        jaxtank.Tank(voulme=3.0, aera=2.0)
    assert "area" in str(info.value) and "voulme" in str(info.value)
    bad = [jaxtank.Tank("LT101", area=-0.5, rim="1.2 s"), jaxtank.Tank(area=1.0, rim=0.0)]
    with pytest.raises(InputError) as info:
        jaxtank.Rig(tanks=bad, pumps=PARTS["pumps"], controller=PI)
    assert all(word in str(info.value) for word in ("area = -0.5", "1.2 s", "rim = 0"))
    with pytest.raises(InputError, match=r"clock\.dt is given twice"):
        jaxtank.Rig(**PARTS, controller=PI, dt=1.0, values={"clock": {"dt": 2.0}})
    with pytest.raises(InputError, match="Tank: 2 values"):
        jaxtank.Tank("LT101", 0.5)


def test_an_editor_sees_the_keywords_of_the_schema():
    tree = ast.parse(Path(keywords.__file__).with_suffix(".pyi").read_text())
    stubs = {node.name: node.args for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert stubs.keys() == {"Rig", *TABLES}
    for name, args in stubs.items():
        parameters = inspect.signature(getattr(jaxtank, name)).parameters
        listed = [a.arg for a in [*args.args, *args.kwonlyargs]]
        assert sorted(listed) == sorted(parameters)
        defaults = [*args.defaults, *args.kw_defaults]
        optional = {a for a, d in zip(listed, defaults) if d is not None}
        assert optional == {n for n, p in parameters.items() if p.default is not p.empty}


def test_the_rig_of_the_page_runs():
    text = (ROOT / "README.md").read_text()
    example = re.findall(r"jaxtank\.Rig\(.*?\n\)", text, re.S)[0]
    case = eval(example, {"jaxtank": jaxtank})
    run = jaxtank.simulate(case)
    # one explicit Euler rule of the test's own, at a hundredth of the step
    level = 0.4
    for u in np.asarray(run.u[:-1, 0]):
        for _ in range(100):
            level += 0.05 * (3e-5 * u - 4e-4 * np.sqrt(2 * 9.80665 * level)) / 0.5
    assert case.clock.samples == 241 and level == pytest.approx(float(run.x[-1, 0]), rel=1e-3)


@pytest.mark.parametrize("rows", [[[0.0], [5.0]], [[0.0, 1.0], [5.0, 1.0, 2.0]], [0.0, 1.0]])
def test_rows_of_steps_have_a_time_and_as_many_values_each(rows):
    with pytest.raises(InputError):
        keywords._steps("reference", rows)
    steps = keywords._steps("reference", [[0.0, 1.0, 2.0], [5.0, 1.0, 3.0], [9.0, 4.0, 3.0]])
    assert steps == {"initial": [1.0, 2.0], "changes": [[5.0, 2, 3.0], [9.0, 1, 4.0]]}


@pytest.mark.parametrize("first", [100.0, "100 s"])
@pytest.mark.parametrize("name", ["reference", "inputs"])
def test_rows_of_a_table_are_in_order_of_time(name, first):
    rows = {name: [[first, 0.4], [0.0, 0.6], [150.0, 0.5]]}
    with pytest.raises(InputError, match=rf"{name}: time of row 2 = 0\.0: must be later than"):
        jaxtank.Rig(dt=5.0, duration=200.0, tanks=[], pumps=[], **rows)


def test_ranges_take_names_and_units_as_those_of_a_file_do():
    tank = jaxtank.Tank("LT101", area=0.5, rim=1.2, drain="4 cm^2", level=0.4)
    pump = jaxtank.Pump("P101", to="LT101", gain=3e-5, high=100.0)
    row = {"units": ("m", "%"), "tanks": [tank], "pumps": [pump], "reference": [[0.0, 0.4]]}
    loop = jaxtank.Rig(**row, controller={"kind": "pi", "Kc": 200.0, "Ti": 300.0}).loop
    gains = {"controller.Kc[P101]": (20.0, 2e3), "controller.Ti[LT101]": ("30 s", "20 min")}
    ranges = [(bound.name, bound.low, bound.high) for bound in bounds(loop, gains)]
    assert ranges == [("controller.Kc[0]", 20.0, 2e3), ("controller.Ti[0]", 30.0, 1200.0)]
    flows = free_bounds(loop, {"LT101.drain": (1e-4, 1e-3), "P101.gain": (1e-5, 1e-4)})
    assert [bound.name for bound in flows] == ["plant.drain[0]", "plant.pump_gain[0]"]
    with pytest.raises(InputError, match=r"plant\.drain\[0\] is given twice"):
        bounds(loop, {"LT101.drain": (1e-4, 1e-3), "plant.drain[0]": (1e-4, 1e-3)})
