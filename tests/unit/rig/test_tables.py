"""Setpoints, inputs and inflows from tables in files and arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from jaxtank.controllers import OpenLoop
from jaxtank.core.clock import Chunk, Clock
from jaxtank.core.errors import InputError
from jaxtank.export import tables
from jaxtank.loop.steady import steady_inflow
from jaxtank.signals import inflow_table, ramps

TANK = """
units = ["m", "m^3/s"]
tank = [{ name = "LT101", area = 10.0, rim = 9.0, level = 2.0 }]
pump = [{ name = "P101", gain = 1.0, to = 1, high = 1.0, initial = 0.1 }]
plant = { gravity = 9.81 }
"""
PI = 'controller = { kind = "pi", Kc = 0.5, Ti = 700.0, bias = 0.1 }\n'
PAIR = """
units = ["m", "%"]
tank = [{ name = "LT101", area = 1.0, rim = 9.0, drain = 0.01 },
        { name = "LT102", area = 1.0, rim = 9.0, drain = 0.01 }]
pump = [{ gain = 0.001, to = "LT101", high = 100.0 }, { gain = 0.001, to = "LT102", high = 100.0 }]
plant = { gravity = 9.81 }
controller = { kind = "pi", Kc = 5.0, Ti = 70.0, bias = 10.0 }
"""


def loaded(folder, text, **files):
    """The case of a rig file beside CSV files of these names and texts."""
    for name, content in files.items():
        (folder / f"{name}.csv").write_text(content)
    (folder / "rig.toml").write_text(text)
    return rig.load(folder / "rig.toml")


def course(case):
    return case.loop.reference.changes, np.asarray(case.loop.reference.targets).tolist()


def means(times, flows, between, edges):
    """Mean flow between edges, by exact sums over all breakpoints."""
    grid = np.unique(np.concatenate([edges, times[(times > 0) & (times < edges[-1])]]))
    middle = 0.5 * (grid[1:] + grid[:-1])
    if between == "linear":
        at = np.interp(middle, times, flows)
    else:
        at = flows[np.maximum(np.searchsorted(times, middle, side="right") - 1, 0)]
    volume = np.concatenate([[0.0], np.cumsum(at * np.diff(grid))])
    return np.diff(volume[np.searchsorted(grid, edges)]) / np.diff(edges)


@pytest.mark.extended_for("1-hold", "1-linear", "400-hold", "7-hold")
@pytest.mark.parametrize("between", ["hold", "linear"])
@pytest.mark.parametrize("count", [1, 7, 400])
def test_the_volume_of_a_measured_inflow_arrives_whatever_the_sampling_period(between, count):
    rng = np.random.default_rng(count)
    times = np.sort(rng.uniform(0.3, 59.0, count))
    times[: count // 2] = np.round(times[: count // 2])  # some on a sample
    times, flows = np.unique(times), rng.normal(size=len(np.unique(times)))
    table, clock = inflow_table(2, [(1, times, flows)], between), Clock(dt=0.5, duration=60.0)
    whole = jax.jit(lambda table: table.sample(clock)[0])
    none, flow = (np.asarray(v) for v in whole(table))
    edges = np.arange(clock.samples + 1) * clock.dt
    np.testing.assert_allclose(flow, means(times, flows, between, edges), atol=1e-12)
    assert not none.any()
    some = jax.jit(lambda table, first: table.sample(Chunk(first, samples=30, dt=0.5))[0][1])
    part = some(table, jnp.int32(40))
    np.testing.assert_allclose(np.asarray(part), flow[40:70], atol=1e-14)


def test_the_slope_by_a_row_is_its_share_of_each_sample():
    times, flows = np.array([0.0, 1.25, 1.5, 3.0]), np.array([1.0, 2.0, -1.0, 4.0])
    clock = Clock(dt=1.0, duration=4.0)

    table = inflow_table(1, [(0, times, flows)], "linear")

    @jax.jit
    def sampled(flow):
        return jaxtank.with_values(table, {"flow": flow}).sample(clock)[0][0]

    slope = jax.jit(jax.jacfwd(sampled))(jnp.asarray(flows))
    step = np.eye(4)
    right = np.stack([sampled(flows + e) - sampled(flows - e) for e in step], axis=1) / 2.0
    np.testing.assert_allclose(slope, right, atol=1e-13)


def test_the_program_of_a_table_does_not_grow_with_its_rows():
    clock = Clock(dt=600.0, duration=86400.0)

    def equations(count):
        times = 60.0 * np.arange(count)
        rows = ramps([2.0], [(t, 0, 2.0 + k % 7) for k, t in enumerate(times)], ramp=0.0)
        flow = inflow_table(1, [(0, times, np.cos(times))])
        return [
            str(jax.make_jaxpr(lambda s: s.sample(clock))(signal)).count("\n")
            for signal in (rows, flow)
        ]

    assert equations(100) == equations(8760)


def test_setpoints_are_read_with_the_units_of_file_and_times(tmp_path):
    text = TANK + PI + 'reference = { csv = "day.csv", column = "SP", ramp = 0.0 }'
    rows = "time [h],PV [m],SP [cm]\n0,1.9,200\n0.5,2,200\n1,2.1,250.5\n"
    case = loaded(tmp_path, text, day=rows)
    assert case.loop.reference.initial.tolist() == [2.0]
    assert course(case) == (((3600.0, 0),), [2.505])
    semicolons = "when;SP\n2026-11-03T14:00:00Z;2,0\n2026-11-03T14:10:00Z;2,5\n"
    assert course(loaded(tmp_path, text, day=semicolons)) == (((600.0, 0),), [2.5])
    case = loaded(tmp_path, text.replace("SP", "SP [cm]"), day="t,SP\n0,200\n60,210\n")
    assert course(case) == (((60.0, 0),), [2.1])


def test_a_file_has_columns_for_several_outputs_by_name_or_in_order(tmp_path):
    rows = "t [s],LT102,a,LT101\n0,1,5,2\n60,1.5,6,2\n120,1.5,7,3\n"
    right = (((60.0, 1), (120.0, 0)), [1.5, 3.0])
    for column in (
        "",
        ', column = ["LT101", "LT102"]',
        ', column = { LT101 = "LT101", 2 = "LT102" }',
    ):
        text = PAIR + f'reference = {{ csv = "sp.csv"{column} }}'
        assert course(loaded(tmp_path, text, sp=rows)) == right
    text = PAIR + 'reference = { csv = "sp.csv", column = { LT102 = "a" }, initial = [1.0, 2.0] }'
    case = loaded(tmp_path, text.replace("PAIR", ""), sp=rows)
    assert case.loop.reference.initial.tolist() == [1.0, 2.0]
    assert course(case) == (((0.0, 1), (60.0, 1), (120.0, 1)), [5.0, 6.0, 7.0])


def test_numbers_that_can_be_read_twice_are_asked_about_with_the_key_of_the_table(tmp_path):
    keys, rows = 'csv = "day.csv"', 't,SP [mm]\n0,"1,000"\n60,"1,200"\n'
    read = lambda more: loaded(tmp_path, f"{TANK}{PI}reference = {{ {keys}{more} }}", day=rows)
    with pytest.raises(InputError, match=r'Write decimal = "," or "\." beside csv'):
        read("")
    at = [float(read(f', decimal = "{sign}"').loop.reference.initial[0]) for sign in ",."]
    assert at == pytest.approx([0.001, 1.0])


def test_inputs_of_a_file_are_played_and_may_be_called_inputs_without_a_file_too(tmp_path):
    rows = "t [min],P101 [m3/h]\n0,360\n1,720\n2,720\n"
    for inputs in (
        'inputs = { csv = "u.csv", column = "P101" }',
        'controller = { kind = "open-loop", csv = "u.csv" }',
        "inputs = { initial = [0.1], changes = [[60.0, 1, 0.2]], ramp = 0.0 }",
    ):
        case = loaded(tmp_path, TANK + inputs, u=rows)
        assert isinstance(case.loop.controller, OpenLoop)
        u = np.asarray(jaxtank.simulate(case.loop, Clock(dt=30.0, duration=150.0)).u)[:, 0]
        np.testing.assert_allclose(u, [0.1, 0.1, 0.2, 0.2, 0.2, 0.2], rtol=1e-15)


INFLOWS = (
    TANK.replace("level = 2.0", "level = 2.0, inflow = -0.01")
    + PI
    + 'inflow = [{ csv = "q.csv", column = "rain [l/s]", interpolate = "linear" },'
    + ' { tank = "LT101", changes = [["1 min", "72 m3/h"], [90.0, 0.0]] }]'
)
RAIN = "t,rain\n0,10\n100,30\n"


@pytest.mark.extended
def test_measured_inflows_add_up_beside_a_steady_one(tmp_path):
    case = loaded(tmp_path, INFLOWS, q=RAIN)
    flow = np.asarray(case.loop.disturbance.sample(Clock(dt=10.0, duration=100.0))[0][0])
    t = 10.0 * np.arange(11) + 5.0
    step = np.where((t > 60.0) & (t < 90.0), 0.02, 0.0)
    right = -0.01 + np.interp(t, [0, 100], [0.01, 0.03]) + step
    np.testing.assert_allclose(flow, right, atol=1e-15)
    mean = -0.01 + 0.02 + 0.02 / 3.0  # of the rain, and of the other until its last row
    assert float(steady_inflow(case.loop)[0]) == pytest.approx(mean, rel=1e-14)


@pytest.mark.parametrize(("header", "size"), [("q [m3/h]", 1.0), ("q [m3/s]", 3600.0), ("q", None)])
def test_an_inflow_beside_inputs_in_another_flow_needs_its_unit(tmp_path, header, size):
    text = TANK.replace("m^3/s", "m3/h").replace("gain = 1.0, ", "") + PI
    text += 'inflow = [{ csv = "day.csv" }]'
    files = {"day": f"t,{header}\n0,0.2\n"}
    if size is None:
        with pytest.raises(InputError, match=r"has no unit: .* 'q \[m\^3/h\]', as the inputs"):
            loaded(tmp_path, text, **files)
        return
    flow = loaded(tmp_path, text, **files).loop.disturbance.at_start()
    np.testing.assert_allclose(flow, 0.2 * size / 3600.0)


@pytest.mark.extended
def test_a_written_rig_holds_its_tables_and_runs_alike_without_the_files(tmp_path):
    day = "t [s],SP\n" + "\n".join(f"{60 * k},{2 + 0.1 * (k % 9)}" for k in range(100))
    text = INFLOWS + '\nreference = { csv = "day.csv", column = "SP", ramp = 0.0 }'
    case = loaded(tmp_path, text, q=RAIN, day=day)
    run = jaxtank.simulate(case.loop, Clock(dt=7.0, duration=700.0))
    for written in (rig.dump(case), rig.complete(case), rig.dump(case, tankwise=True)):
        again = jaxtank.simulate(rig.loads(written).loop, Clock(dt=7.0, duration=700.0))
        assert np.array_equal(again.x, run.x) and np.array_equal(again.r, run.r)


def test_a_factor_makes_a_demand_an_outflow(tmp_path):
    text = TANK + 'inflow = [{ csv = "q.csv", column = "q", factor = -2 },'
    text += " { changes = [[0, 3.0]], factor = 0.5 }]\n"
    case = loaded(tmp_path, text + PI, q="t,q\n0,0.1\n300,0.3\n")
    flow = case.loop.disturbance.sample(Clock(dt=300.0, duration=300.0))[0][0]
    np.testing.assert_allclose(flow, [1.5 - 0.2, 1.5 - 0.6], rtol=1e-12)
    again = rig.loads(rig.dump(case)).loop.disturbance.sample(Clock(dt=300.0, duration=300.0))
    np.testing.assert_array_equal(again[0][0], flow)


DAY, DEMAND = 86400.0, "time,q\n06:00,30\n09:00,18\n17:00,36\n22:00,6\n"


@pytest.mark.parametrize("start", [0, 3, 30, 100])
def test_a_pattern_that_begins_late_is_periodic_from_the_start(start):
    rows = f'[["{start} h", 1.0], ["{start + 6} h", 2.0], ["{start + 20} h", 3.0]]'
    text = f'duration = "3 d"\ndt = 600.0\n{TANK}{PI}'
    text += f'inflow = [{{ changes = {rows}, repeat = "1 d" }}]\n'
    ((_, _, times, flows),) = rig.loads(text).loop.disturbance.tables()
    at = np.arange(150.0, 3 * DAY, 300.0)
    hours = (at / 3600.0 - start) % 24.0
    expected = np.select([hours < 6.0, hours < 20.0], [1.0, 2.0], 3.0)
    np.testing.assert_array_equal(flows[np.searchsorted(times, at, "right") - 1], expected)


@pytest.mark.parametrize(("begins", "shift"), [("", 0.0), ('begins = "2026-11-30 07:30"\n', 7.5)])
@pytest.mark.parametrize("between", ["hold", "linear"])
def test_a_table_of_a_day_repeats_until_the_run_ends(tmp_path, begins, shift, between):
    """Against the clock of each moment, modulo a day."""
    keys = f'csv = "day.csv", time_order = "h:m", repeat = "1 day", interpolate = "{between}"'
    text = f'{begins}dt = 600.0\nduration = "3 days"\n{TANK}inflow = [{{ {keys} }}]\n'
    disturbance = loaded(tmp_path, text + PI, day=DEMAND).loop.disturbance
    ((_, _, times, flows),) = disturbance.tables()
    assert times[0] == 0.0 and times[-1] == 3 * DAY and np.all(np.diff(times) > 0.0)
    hours, known = np.array([-2.0, 6.0, 9.0, 17.0, 22.0, 30.0]), np.array([6, 30, 18, 36, 6, 30.0])
    at = np.arange(150.0, 3 * DAY, 300.0)
    clock = (at / 3600.0 + shift) % 24.0
    if between == "linear":
        np.testing.assert_allclose(np.interp(at, times, flows), np.interp(clock, hours, known))
    else:
        values = flows[np.searchsorted(times, at, "right") - 1]
        np.testing.assert_array_equal(values, known[np.searchsorted(hours, clock, "right") - 1])


def test_changes_and_rows_of_setpoints_and_inputs_repeat(tmp_path):
    changes = 'reference = { initial = [2.0], changes = [["6 h", 1, 3.0], ["18 h", 1, 2.5]], '
    clock = 'dt = 600.0\nduration = "2 d"\n'
    expected = [(h * 3600.0, 0) for h in (6, 18, 30, 42)], [3.0, 2.5, 3.0, 2.5]
    case = loaded(tmp_path, clock + TANK + PI + changes + 'repeat = "24 h" }')
    assert tuple(map(list, course(case))) == expected and case.loop.reference.initial == [2.0]
    rows = "t [h],SP\n0,2.5\n6,3\n18,2.5\n24,2.5\n"  # 24:00 is 0:00 of the next day
    keys = 'csv = "day.csv", column = "SP", repeat = "24 h"'
    case = loaded(tmp_path, clock + TANK + PI + f"reference = {{ {keys} }}", day=rows)
    assert tuple(map(list, course(case))) == expected and case.loop.reference.initial == [2.5]
    rows = "t [h],P101\n6,0.3\n18,0.1\n"
    case = loaded(tmp_path, clock + TANK + 'inputs = { csv = "u.csv", repeat = "24 h" }', u=rows)
    assert [t for t, _ in case.loop.controller.signal.changes] == [t for t, _ in expected[0]]
    assert case.loop.controller.signal.initial == [0.1]
    assert course(rig.loads(rig.dump(case))) == course(case)
    longer = rig.load(tmp_path / "rig.toml", "3 d").loop.controller.signal.changes
    assert [t for t, _ in longer] == [h * 3600.0 for h in (6, 18, 30, 42, 54, 66)]


def test_the_end_of_a_day_of_two_outputs_is_its_begin():
    rows = "[[0, 1, 1.5], [0, 2, 1.4], [12, 1, 1.2], [24, 1, 1.5], [24, 2, 1.4]]"
    text = f"dt = 0.4\nduration = 48.0\n{PAIR}"
    text += f"reference = {{ initial = [1.0, 1.0], changes = {rows}, repeat = 24 }}\n"
    changes, targets = course(rig.loads(text))
    assert [*changes][:5] == [(0, 0), (0, 1), (12, 0), (24, 0), (24, 1)]
    assert targets[3:6] == [1.5, 1.4, 1.2]


def test_a_dated_record_repeats_after_its_end_and_clocks_of_a_zone_are_asked_about(tmp_path):
    begins = 'begins = "2026-12-01 00:00"\ndt = 600.0\nduration = "2 d"\n'
    keys = 'reference = { csv = "d.csv", column = "SP", repeat = "24 h", time_order = "h:m" }\n'
    rows = "date,SP\n2026-11-30 08:00,1.5\n2026-11-30 20:00,1.0\n"
    case = loaded(tmp_path, begins + TANK + PI + keys, d=rows)
    assert [t / 3600.0 for t, _ in course(case)[0]] == [8, 20, 32, 44]
    zoned = begins.replace("00:00", "00:00+01:00")
    with pytest.raises(InputError, match="of which zone these are is not known"):
        loaded(tmp_path, zoned + TANK + PI + keys, d="time,SP\n08:00,1.5\n20:00,1.0\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{ changes = [["6 h", 1.0]], repeat = "5 x" }', "unit x is unknown"),
        ("{ changes = [[0.0, 1.0], [90.0, 2.0]], repeat = 60 }", "must be longer than they are"),
        ("{ changes = [[0.0, 1.0], [60.0, 2.0]], repeat = 60 }", "must be longer than they are"),
        ("{ changes = [[0.0, 1.0]], repeat = 0 }", "be a time above 0 s"),
        ("{ changes = [[0.0, 1.0]], repeat = 1e-3 }", "rows of 1: must be at most"),
        ("{ repeat = 60, tank = 1 }", "unknown key"),
    ],
)
def test_a_repeat_that_cannot_be_is_refused(text, words):
    with pytest.raises(InputError, match=words):
        rig.loads(f"duration = 900.0\n{TANK}{PI}inflow = [{text}]\n")
    with pytest.raises(InputError, match="needs the duration of the run"):
        rig.loads(f"{TANK}{PI}inflow = [{{ changes = [[0.0, 1.0]], repeat = 60 }}]\n")
    with pytest.raises(InputError, match="and there is neither"):
        rig.loads(f"duration = 900.0\n{TANK}{PI}reference = {{ repeat = 60 }}\n")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, []),
        ({"level = 2.0": "level = 2.0, inflow = -6.0"}, ["is -21600 m^3/h"]),
        ({"level = 2.0": 'level = 2.0, inflow = "-6 m3/h"'}, []),
        ({"SENSOR": "sensor = [{ tank = 1, offset = 385.0 }]"}, ["reads 385 m (offset)"]),
        ({"SENSOR": "sensor = [{ tank = 1, offset = 0.1 }]"}, []),
    ],
)
def test_inflows_and_offsets_that_cannot_be_meant_are_noted(change, words):
    text = "reachable = false" + TANK.replace("m^3/s", "m3/h").replace("gain = 1.0, ", "")
    text = text.replace("high = 1.0", "high = 9.0") + "SENSOR\n" + PI
    for old, new in (change | {"SENSOR": change.get("SENSOR", "")}).items():
        text = text.replace(old, new)
    notes = [n for n in rig.case_warnings(rig.loads(text)) if "m^3/h" in n or "offset" in n]
    assert len(notes) == len(words) and all(w in n for w, n in zip(words, notes))


def test_a_rig_that_only_a_measured_inflow_fills_has_its_bias_and_setpoints(tmp_path):
    text = TANK.replace("to = 1", "from = 1").replace(", initial = 0.1", "")
    text += 'controller = { kind = "pi", Kc = -0.5, Ti = 700.0 }\n'
    text += 'inflow = [{ csv = "q.csv", column = "q" }]'
    case = loaded(tmp_path, text, q="t,q\n0,0.1\n300,0.3\n600,0.3\n")
    assert float(case.loop.controller.bias[0]) == pytest.approx(0.1, rel=1e-12)


def test_a_preset_takes_setpoints_and_inflows_of_files(tmp_path):
    text = 'case = "gouta2022/pi"\nreference = { csv = "a.csv", column = ["a", "b"] }\n'
    text += 'inflow = [{ csv = "a.csv", column = "q [l/s]", tank = 2 }]'
    case = loaded(tmp_path, text, a="t,a,b,q\n0,5,5,0\n50,6,5,0.01\n")
    assert case.loop.reference.first.initial.tolist() == [5.0, 5.0]
    flow = case.loop.disturbance.sample(Clock(dt=25.0, duration=50.0))[0]
    np.testing.assert_allclose(np.asarray(flow[1]), [0.0, 0.0, 10.0])


def test_a_table_of_more_pieces_than_a_page_holds_says_so(tmp_path, monkeypatch):
    case = loaded(tmp_path, INFLOWS, q=RAIN)
    monkeypatch.setattr(tables, "LARGEST", 3)
    with pytest.raises(InputError, match=r"--set clock.duration"):
        case.explore()


STAMPED = 'reference = { csv = "sp.csv" }\ninflow = [{ csv = "in.csv", column = "q" }]'
NOON = "2026-01-01 12:00"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (("2026-01-01 08:00", "2026-01-01 08:30"), ("2026-01-01 06:00", "2026-01-01 08:10")),
        (("08:00:00", "08:30:00"), ("06:00:00", "08:10:00")),
        (("1767254400", "1767256200"), ("2026-01-01T07:00+01:00", "2026-01-01T09:10+01:00")),
    ],
)
def test_stamps_of_all_tables_count_from_the_earliest(tmp_path, first, second):
    sp = f"time,SP\n{first[0]},2\n{first[1]},3\n"
    inflow = f"time,q\n{second[0]},1\n{second[1]},5\n"
    case = loaded(tmp_path, TANK + PI + STAMPED, sp=sp, **{"in": inflow})
    ((_, _, times, flows),) = case.loop.disturbance.tables()
    assert list(times) == [0.0, 7800.0] and list(flows) == [1.0, 5.0]
    assert course(case) == (((9000.0, 0),), [3.0])
    assert case.loop.reference.begins == (7200.0,)
    (note,) = [line for line in rig.case_warnings(case) if "its table" in line]
    assert note.startswith("reference: its table begins at 7200 s; until then `initial` holds")
    alone = loaded(tmp_path, TANK + PI + 'reference = { csv = "sp.csv" }')
    assert course(alone) == (((1800.0, 0),), [3.0]) and alone.loop.reference.begins == (0.0,)


@pytest.mark.parametrize("key", ["", 'time = "Date", ', 'time = "Date Time", '])
def test_dates_and_times_of_day_in_two_columns_are_joined(tmp_path, key):
    day = "Date,Time,SP\n04.05.2026,06:00:00,2\n04.05.2026,07:00:00,3\n"
    flow = "Date,Time,q\n04.05.2026,06:30:00,1\n05.05.2026,02:00:00,5\n"
    text = TANK + PI + STAMPED.replace("{ csv", f"{{ {key}csv").replace(', column = "q"', "")
    case = loaded(tmp_path, text, sp=day, **{"in": flow})
    assert course(case) == (((3600.0, 0),), [3.0])
    ((_, _, times, _),) = case.loop.disturbance.tables()
    assert list(times) == [1800.0, 72000.0]


@pytest.mark.parametrize("key", ["", ', time = "t"'])
def test_a_column_t_counts_before_dates_and_times_of_day(tmp_path, key):
    text = TANK + PI + f'reference = {{ csv = "day.csv", column = "SP"{key} }}'
    rows = "Date,Time,t [min],SP\n2026-05-04,06:00:00,0,2\n2026-05-05,06:00:00,2,3\n"
    assert course(loaded(tmp_path, text, day=rows)) == (((120.0, 0),), [3.0])


def test_a_time_of_day_that_is_missing_is_refused_with_its_line(tmp_path):
    text = TANK + PI + 'reference = { csv = "day.csv", column = "SP" }'
    rows = "Date,Time,SP\n2026-05-04,06:00:00,2\n2026-05-05,,3\n2026-05-06,06:00:00,2\n"
    with pytest.raises(InputError, match="line 3, column 'Date Time': '2026-05-05 ' is not a time"):
        loaded(tmp_path, text, day=rows)


def test_a_time_that_has_passed_is_not_joined_with_a_date(tmp_path):
    text = TANK + PI + 'reference = { csv = "day.csv", column = "SP", time = "Elapsed" }'
    rows = "Date,Elapsed,SP\n2026-05-04,0:00:00,2\n2026-05-05,25:00:00,3\n"
    assert course(loaded(tmp_path, text, day=rows)) == (((90000.0, 0),), [3.0])


@pytest.mark.parametrize(
    ("sp", "inflow", "begins"),
    [
        ("2026-01-01 12:00:00.1", NOON, 0.1),
        ("2026-01-01 23:50", "2026-01-02 00:10", 0.0),
        ("2026-01-01 00:00", "0:00:00", 0.0),  # a duration, or a time of this day
    ],
)
def test_a_table_begins_to_the_last_digit_over_midnight_and_beside_durations(
    tmp_path, sp, inflow, begins
):
    files = {"sp": f"time,SP\n{sp},2\n", "in": f"time,q\n{inflow},1\n"}
    case = loaded(tmp_path, TANK + PI + STAMPED, **files)
    ((_, _, times, _),) = case.loop.disturbance.tables()
    assert times[0] == (1200.0 if "23:50" in sp else 0.0)
    assert case.loop.reference.begins == (begins,)


def test_times_of_a_day_on_either_side_of_midnight_are_refused(tmp_path):
    files = {"sp": "time,SP\n23:50:00,2\n", "in": "time,q\n00:10:00,1\n"}
    with pytest.raises(InputError, match="at either side of midnight: give their times dates"):
        loaded(tmp_path, TANK + PI + STAMPED, **files)


@pytest.mark.parametrize(
    ("sp", "inflow"),
    [
        (NOON, "12:00:00"),
        (NOON, "0:00:00"),
        (NOON, f"{NOON}Z"),
        ("1767254400", NOON),
        ("12:00:00", "1767254400"),
    ],
)
def test_stamps_that_cannot_be_compared_are_refused(tmp_path, sp, inflow):
    files = {"sp": f"time,SP\n{sp},2\n", "in": f"time,q\n{inflow},1\n"}
    with pytest.raises(InputError, match=r"sp.csv has .* and in.csv has .*: their times cannot be"):
        loaded(tmp_path, TANK + PI + STAMPED, **files)


def test_a_table_that_begins_after_the_run_is_noted(tmp_path):
    rows = {"day": "t [min],SP\n10,2\n20,3\n"}
    text = TANK + PI + 'reference = { csv = "day.csv" }'
    notes = lambda case: [line for line in rig.case_warnings(case) if "its table" in line]
    assert len(notes(loaded(tmp_path, text, **rows))) == 1
    case = loaded(tmp_path, text.replace("{ csv", "{ initial = [2.5], csv"))
    assert notes(case) and course(case) == (((600.0, 0), (1200.0, 0)), [2.0, 3.0])
    assert notes(rig.set_values(case, {"controller.Kc": [0.7]}))
    assert not notes(rig.loads(rig.dump(case)))  # the file has changes
    inputs = TANK + 'inputs = { csv = "day.csv", column = "SP" }'
    (note,) = notes(loaded(tmp_path, inputs, day="t,SP\n30,0.5\n"))
    assert note.startswith("inputs: its table begins at 30 s")


def test_inputs_of_a_file_beyond_the_limits_of_a_pump_are_noted(tmp_path):
    rows = "t,P101\n0,0.5\n60,1.4\n90,1.0\n"
    case = loaded(tmp_path, TANK + 'inputs = { csv = "day.csv" }', day=rows)
    (note,) = [line for line in rig.case_warnings(case) if line.startswith("inputs")]
    assert "P101 goes to 1.4 m^3/s, beyond its limits of 0 and 1 m^3/s" in note


@pytest.mark.parametrize(
    ("header", "column", "level"),
    [("SP [%]", "SP", 0.45), ("SP", "SP [%]", 0.45), ("SP", "SP [m]", 5.0)],
)
def test_setpoints_of_a_sensor_in_percent_need_their_unit(tmp_path, header, column, level):
    sensor = 'sensor = [{ name = "LIC", tank = "LT101", unit = "%", span = [0.0, 9.0] }]\n'
    text = (TANK + PI).replace("Kc = 0.5", 'Kc = "2 %/%"') + sensor
    text += 'reference = { csv = "day.csv", column = "COLUMN" }'
    files = {"day": f"t,{header}\n0,5\n"}
    case = loaded(tmp_path, text.replace("COLUMN", column), **files)
    assert float(case.loop.reference.initial[0]) == pytest.approx(level)
    with pytest.raises(InputError, match=r"has no unit, and the sensor of LIC reads in %: write"):
        loaded(tmp_path, text.replace("COLUMN", "SP"), day="t,SP\n0,5\n")


@pytest.mark.parametrize(
    ("order", "time"), [("day-first", 28 * 86400.0), ("month-first", 86400.0), ("", None)]
)
def test_dates_that_can_be_read_twice_ask_for_the_order(tmp_path, order, time):
    key = f', time_order = "{order}"' if order else ""
    text = TANK + PI + f'reference = {{ csv = "day.csv"{key} }}'
    files = {"day": "time,SP\n01/02/2026,2\n01/03/2026,3\n"}
    if not order:
        with pytest.raises(InputError, match='Write time_order = "day-first" or "month-first"'):
            loaded(tmp_path, text, **files)
        return
    case = loaded(tmp_path, text, **files)
    assert course(case)[0] == ((time, 0),)


def test_all_that_is_wrong_in_a_file_is_in_one_answer_with_its_lines(tmp_path):
    text = TANK + PI + 'reference = { csv = "day.csv", column = "SP" }'
    text += '\ninflow = [{ csv = "day.csv", column = "q" }, { csv = "none.csv" }]'
    rows = "t [s],SP [l],q [m^3/h]\n0,2,1\n60,3,\n50,4,nan\n70,5,2\n"
    with pytest.raises(InputError) as refused:
        loaded(tmp_path, text, day=rows)
    for words in (
        "day.csv, line 4, column 't [s]': '50'",
        "times must increase",
        "column 'SP [l]': 'l': must be in m",
        "column 'q [m^3/h]': no number in line 3, 4",
        "none.csv' does not exist",
    ):
        assert words in str(refused.value), words


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ('csv = "day.csv", column = "S P"', "has no column 'S P'; nearest: SP"),
        ('csv = "day.csv"', "SP, PV, SP2, SP2; two columns are called 'SP2': rename one"),
        ('csv = "day.csv", column = "SP2"', "2 columns are called 'SP2'"),
        ('csv = "day.csv", column = ["SP", "PV"]', "a column for each of 1 outputs"),
        ('csv = "day.csv", column = { LT9 = "SP" }', "LT9"),
        ('csv = "day.csv", column = "SP", time = "when"', "has no column 'when'"),
        ('csv = "day.csv", column = "SP", changes = []', "give one of them"),
        ('column = "SP"', "needs csv"),
        ('csv = 3, column = "SP"', "be the name of a file"),
        ('csv = ".", column = "SP"', "is not a file"),
        ('csv = "day.csv", column = 3', "be the name of a column"),
        ('csv = "day.csv", column = "SP", decimal = ";"', "decimal"),
    ],
)
def test_a_table_that_cannot_be_read_is_refused_with_what_to_write(tmp_path, keys, words):
    rows = "t,SP,PV,SP2,SP2\n0,2,2,2,2\n60,3,2,3,3\n"
    with pytest.raises(InputError, match=words.replace("{", r"\{")):
        loaded(tmp_path, TANK + PI + f"reference = {{ {keys} }}", day=rows)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (PI + "inputs = { initial = [0.1] }", r"\[inputs\] are those of an open loop"),
        ("inputs = { Kc = 1.0 }", "unknown key of .inputs. 'Kc'"),
        (PI + "inflow = [{ changes = [[0.0, 1.0, 2.0]] }]", r"list of \[time \[s\], inflow"),
        (PI + "inflow = [{ changes = [[5.0, 1.0], [5.0, 2.0]] }]", "times that increase"),
        (PI + "inflow = [{ changes = [[5.0, 1.0]], interpolate = 'cubic' }]", "hold, linear"),
        (PI + "inflow = [{ changes = [[5.0, 1.0]], volume = 3.0 }]", "unknown key"),
        (PI + "inflow = [{ changes = [[5.0, 1.0]], interpolate = 'linear' }]", "a row at 0 s"),
    ],
)
def test_inputs_and_inflows_that_cannot_be_are_refused(text, words):
    with pytest.raises(InputError, match=words):
        rig.loads(TANK + text)


@pytest.mark.extended_for("0-24.0-words0", "0-25.0-words1", "0-72.0-words2")
@pytest.mark.parametrize(
    ("start", "hours", "words"),
    [
        (0, 24.0, ()),
        (0, 25.0, ()),  # one row more would begin where the run ends
        (0, 72.0, ("LT101", "ends at 86400 s", "2 m^3/s", "held for 172800 s")),
        (6, 24.0, ("LT101", "begins at 21600 s", "8 m^3/s", "also used from 0 s")),
    ],
)
def test_a_table_of_inflow_that_does_not_cover_the_run_is_noted(tmp_path, start, hours, words):
    rows = "t [h],q [m^3/s]\n" + "\n".join(f"{k},{2 + k % 24}" for k in range(start, 25))
    text = f'duration = "{hours} h"\ndt = 60.0\n' + TANK + "inputs = { initial = [0.1] }\n"
    case = loaded(tmp_path, text + 'inflow = [{ csv = "day.csv", column = "q" }]', day=rows)
    notes = [s for s in rig.case_warnings(case) if "table" in s]
    assert len(notes) == bool(words) and all(word in notes[0] for word in words)
    (row,) = case.loop.disturbance.tables()
    assert len(row[2]) == len(row[3]) == 25 - start  # as the file has them
    flow = np.asarray(case.loop.disturbance.sample(case.clock)[0][0])
    assert flow[0] == 2.0 + start and flow[-1] == 2.0
    again = rig.loads(rig.dump(case)).loop.disturbance
    np.testing.assert_array_equal(again.sample(case.clock)[0][0], flow)


@pytest.mark.extended
def test_before_its_first_change_an_inflow_is_none():
    case = rig.loads(
        "duration = 180.0\ndt = 60.0\n" + TANK + PI + "inflow = [{ changes = [[60, 2]] }]"
    )
    for loop in (case.loop, rig.loads(rig.dump(case)).loop):
        assert loop.disturbance.sample(case.clock)[0][0].tolist() == [0.0, 2.0, 2.0, 2.0]
    assert not [s for s in rig.case_warnings(case) if "table" in s]


def test_a_short_table_of_a_file_that_ends_early_is_noted_and_one_that_repeats_is_not(tmp_path):
    text = f'dt = 600.0\nduration = "2 days"\n{TANK}{PI}inflow = [{{ csv = "day.csv", KEYS }}]\n'
    notes = {
        keys: rig.case_warnings(loaded(tmp_path, text.replace("KEYS", keys), day=DEMAND))
        for keys in ('time_order = "h:m"', 'time_order = "h:m", repeat = "1 d"')
    }
    (alone, repeated) = notes.values()
    assert any("held for 115200 s" in note and "repeat" in note for note in alone)
    assert not any("held for" in note or "begins at" in note for note in repeated)


@pytest.mark.parametrize(("between", "flows"), [("hold", [0.2, 0.3]), ("linear", [0.25, 0.3])])
def test_a_record_that_begins_before_the_run_has_its_value_there(tmp_path, between, flows):
    rows = "date,q,SP\n2026-11-30 05:00,0.1,2.0\n2026-11-30 06:00,0.2,2.5\n"
    rows += "2026-11-30 07:00,0.3,3.0\n"
    text = (
        f'begins = "2026-11-30 06:30"\n{TANK}{PI}reference = {{ csv = "d.csv", column = "SP" }}\n'
    )
    text += f'inflow = [{{ csv = "d.csv", column = "q", interpolate = "{between}" }}]\n'
    case = loaded(tmp_path, text, d=rows)
    ((_, _, times, values),) = case.loop.disturbance.tables()
    np.testing.assert_allclose(times, [0.0, 1800.0])
    np.testing.assert_allclose(values, flows)
    assert course(case) == (((1800.0, 0),), [3.0]) and case.loop.reference.initial == [2.5]
    with pytest.raises(InputError, match="must be at or after 0 s"):
        loaded(tmp_path, text.replace("06:30", "07:30"), d=rows)


def test_a_few_steps_of_inflow_and_then_a_constant_one_are_no_short_table():
    steps = "inflow = [{ changes = [[0.0, 1.0], [60.0, 2.0], [120.0, 1.5]] }]"
    case = rig.loads("duration = 9000.0\ndt = 60.0\n" + TANK + PI + steps)
    assert not [s for s in rig.case_warnings(case) if "table" in s]


def test_arrays_that_are_no_table_are_refused():
    for table, between in (
        ((0, [1.0, 1.0], [2.0, 2.0]), "hold"),
        ((0, [-1.0], [2.0]), "hold"),
        ((0, [0.0, 1.0], [2.0]), "hold"),
        ((3, [0.0], [2.0]), "hold"),
        ((0, [0.0], [2.0]), "cubic"),
    ):
        with pytest.raises(InputError):
            inflow_table(2, [table], between)
