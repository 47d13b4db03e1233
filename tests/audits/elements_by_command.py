"""Every key of a rig file under every command: an answer, or a refusal that says why.

    python tests/audits/elements_by_command.py [PART ...] [COMMAND,COMMAND] [RECORD.json]

runs the rigs whose name holds one of the parts (default: all) under the commands (all), and
prints a table, rigs by commands: `.` an answer, `r` a refusal (exit code 2 or 3), `X` a traceback
or a number that is none. The refusals follow. Exit code 1 where there is an X.
What a record holds is not run again; it is written after each rig.
`tests/unit/rig/test_all_elements.py` holds that the rigs below use every key of the schema.
"""

import contextlib
import io
import json
import re
import sys
import tempfile
from pathlib import Path

import jax

from tuning.cli.main import main

BASE = {
    "units": '["m", "%"]',
    "tank": '[{name = "LT101", area = 0.5, rim = 1.2, level = 0.5, noise = 0.001},'
    ' {name = "LT102", area = 0.3, rim = 1.0, level = 0.3, drain = 0.0006}]',
    "orifice": '[{from = "LT101", to = "LT102", area = 0.0005}]',
    "pump": '[{name = "P101", to = "LT101", gain = 4e-5, high = 100.0, initial = 37.0}]',
    "plant": '{outputs = ["LT101"]}',
    "controller": '{kind = "pi", Kc = 200.0, Ti = "200 s", bias = 37.0}',
    "reference": '{initial = [0.5], changes = [[100.0, "LT101", 0.6]]}',
    "free": '{"controller.Kc" = [50.0, 800.0]}',
    "uncertain": '{"plant.area" = 0.02}',
    "values": '{"clock.dt" = 2.0, "clock.duration" = 400.0}',
}
ONE = '[{name = "LT101", rim = 1.2, level = 0.5, drain = 0.0005, '
ALONE = {"orifice": "[]", "limits": '{"max_level" = [1.1]}'}
OUTLET = (
    '[{name = "LT101", area = 0.5, rim = 1.2, level = 0.5, inflow = 0.0015},'
    ' {name = "LT102", area = 0.3, rim = 1.0, level = 0.3, drain = 0.0006}]'
)
REVERSE = '{kind = "pi", Kc = 60.0, Ti = "200 s", action = "direct", bias = 50.0}'
TWO = {
    "pump": '[{name = "P101", to = "LT101", gain = 4e-5, high = 100.0, initial = 37.0},'
    ' {name = "P102", to = "LT102", gain = 2e-5, high = 100.0, initial = 0.0}]',
    "plant": '{outputs = ["LT101", "LT102"]}',
    "reference": '{initial = [0.5, 0.62], changes = [[100.0, "LT101", 0.6]]}',
    "controller": '{kind = "pi", Kc = [200.0, 200.0], Ti = ["200 s", "200 s"], bias = [37, 20]}',
    "free": '{"controller.Kc" = [50.0, 800.0]}',
}


def pump(more, gain=4e-5):
    """A [[pump]] with more keys."""
    flow = f"gain = {gain}, " if gain else ""
    return {
        "pump": f'[{{name = "P101", to = "LT101", {flow}high = 100.0, initial = 37.0, {more}}}]'
    }


def valve(more, start="LT101", end=None):
    """A [[valve]] in place of the orifice and of the pump."""
    to = f', to = "{end}"' if end else ""
    keys = f'name = "FV101", from = "{start}"{to}, area = 0.001, high = 100.0, initial = 50.0'
    return {
        **{"tank": OUTLET, "orifice": "[]", "pump": "[]", "valve": f"[{{{keys}{more}}}]"},
        **{"controller": REVERSE, "reachable": "false"},
    }


def shaped(keys):
    """One tank of a shape."""
    return {**ALONE, "tank": ONE + keys + "}]", "reachable": "false"}


def controlled(keys, **more):
    """The base rig under another controller; its own gains are free."""
    return {"controller": "{" + keys + "}", "free": None, **more}


RIGS = {
    "base": {},
    "diameter, height": shaped('diameter = "80 cm"'),
    "volume": {
        **ALONE,
        "tank": '[{name = "LT101", area = 0.5, volume = 0.6, level = 0.5, drain = 0.0005}]',
    },
    "cone": shaped('shape = "cone", area = 0.8, height = 1.2, drain_port = 0.05'),
    "sphere": shaped('shape = "sphere", diameter = 1.2'),
    "horizontal cylinder": shaped('shape = "horizontal-cylinder", diameter = 1.2, length = 1.0'),
    "table of sections": shaped("shape = [[0.0, 0.3], [0.6, 0.6], [1.2, 0.5]]"),
    "port, exponent, linear": shaped(
        "area = 0.5, drain_port = 0.1, drain_exponent = 0.6, drain_linear = 2500.0"
    ),
    "orifice with port": {
        "orifice": '[{from = "LT101", to = "LT102", area = 6e-4, port = 0.1, exponent = 0.55,'
        " linear = 2000.0}]"
    },
    "pipe": {"orifice": "[]", "pipe": '[{between = ["LT101", "LT102"], area = 8e-4, port = 0.02}]'},
    "spill": {
        "spill": '[{from = "LT101", to = "LT102", caught = 0.8, port = 0.9}]',
        "plant": '{outputs = ["LT101"], overflow = true, bottom = true, knee = 0.001}',
    },
    "pump curve": pump("curve = [[0, 0], [30, 1e-3], [60, 2e-3], [100, 3e-3]]", gain=None),
    "head loss": pump("curve_head = [[-1.0, 1.1], [0.0, 1.0], [2.0, 0.6]]"),
    "transfer pump": {
        "orifice": "[]",
        "tank": OUTLET,
        "pump": '[{name = "P101", from = "LT101", to = "LT102", gain = 4e-5, high = 100.0,'
        " initial = 37.0}]",
        "controller": REVERSE,
    },
    "outflow pump": {
        "orifice": "[]",
        "tank": OUTLET,
        "pump": '[{name = "P101", from = "LT101", gain = 4e-5, high = 100.0, initial = 37.0}]',
        "controller": REVERSE,
    },
    "split": {
        "pump": '[{name = "P101", to = ["LT101", "LT102"], split = 0.8, gain = 5e-5, high = 100.0,'
        " initial = 37.0}]"
    },
    "dead zone": pump("dead_zone = 5.0, low = 0.0"),
    "rate": pump("rate = 2.0"),
    "lag": pump("lag = 8.0"),
    "delay": pump("delay = 6.0"),
    "outlet valve": valve(""),
    "equal-percentage valve": valve(
        ', characteristic = "equal-percentage", rangeability = 40.0, port = 0.05'
    ),
    "valve curve": valve(", characteristic = [[0, 0], [0.5, 0.2], [1, 1]], low = 5.0"),
    "valve between tanks": valve(', check = true, rate = "5 %/s"', end="LT102"),
    "slow valve": valve(", lag = 5.0, delay = 4.0, dead_zone = 2.0"),
    "gravity": {"plant": '{outputs = ["LT101"], gravity = 9.78}'},
    "sensor in %": {
        "sensor": '[{name = "LIT101", tank = "LT101", span = [0.0, 1.2], unit = "%",'
        ' noise = "0.2 %", offset = 0.0, scale = 1.01, log_unit = "%"}]',
        "controller": '{kind = "pi", Kc = "2 %/%", Ti = "200 s", bias = 37.0}',
        "reference": '{initial = ["42 %"], changes = [[100.0, "LT101", "0.6 m"]]}',
    },
    "sensor with a curve": {
        "sensor": '[{tank = "LT101", curve = [[0.0, 0.0], [0.6, 0.58], [1.2, 1.2]]}]'
    },
    "sensor with a filter": {"sensor": '[{tank = "LT101", filter = "20 s"}]'},
    "setpoints from a table": {"reference": '{csv = "sp.csv", column = "SP", time = "t [s]"}'},
    "semicolons": {
        "reference": '{csv = "semi.csv", column = "SP", decimal = ",", time_order = "h:m",'
        ' repeat = "350 s"}'
    },
    "shaped setpoints": {
        "reference": '{initial = [0.5], changes = [[100.0, "LT101", 0.6]], ramp = 40.0,'
        ' shape = "quintic", band = 0.02}'
    },
    "filtered setpoints": {
        "reference": '{initial = [0.5], changes = [[100.0, "LT101", 0.6]], filter = 20.0}'
    },
    "sine": {
        "reference": "{initial = [0.5], sine = {amplitude = 0.03, offset = 0.0, period = 120.0,"
        ' zero = 0.0, start = 50.0, end = 350.0, output = "LT101"}}'
    },
    "inflow table": {
        "inflow": '[{tank = "LT102", csv = "sp.csv", column = "q [L/s]", time = "t [s]"}]'
    },
    "inflow": {
        "inflow": '[{time = 150.0, duration = 60.0, tank = "LT102", volume = 0.02}]',
        "disturbance": "{inflow = [1e-4, 0.0], window = 20.0}",
    },
    "inflow rows": {
        "inflow": '[{tank = 2, changes = [[0.0, -1e-4], [90.0, -3e-4]], interpolate = "linear",'
        ' factor = -1, repeat = "2 min"},'
        ' {tank = 1, csv = "semi.csv", column = "q [L/s]", decimal = ",",'
        ' time_order = "h:m"}]'
    },
    "fault": {"fault": '[{of = "P101", start = 150.0, end = 250.0, factor = 0.7}]'},
    "faults of sensors": {
        "fault": '[{sensor = "LT101", kind = "offset", start = 50.0, end = 350.0, size = "8 mm"},'
        ' {sensor = 1, kind = "spikes", start = 60.0, end = 300.0, size = 0.05, every = "30 s"}]'
    },
    "frozen sensor": {
        "fault": '[{sensor = "LT102", kind = "drift", start = 50.0, end = 350.0, size = 1e-5},'
        ' {sensor = "LT101", kind = "freeze", start = 120.0, end = 160.0},'
        ' {sensor = 2, kind = "noise", start = 60.0, end = 300.0, size = "0.1 %"}]'
    },
    "leak": {"fault": '[{of = "LT101.drain", start = 150.0, end = 250.0, extra = 1e-4}]'},
    "safety filter": {
        "safety_filter": "{limit = [1.1, 0.9], low = [0.1, 0.0], rate = 0.05,"
        ' band = [0.004, 0.004], predict = true, widths = {"plant.area" = 0.02}}'
    },
    "schedule": {
        "schedule": '{variable = "h1", knots = [0.3, 0.8], gains = ["controller.Kc"]}',
        "values": '{"clock.dt" = 2.0, "clock.duration" = 400.0, '
        ' "controller.values" = [[200, 300]]}',
        "free": None,
    },
    "uncertain": {"uncertain": '{"plant.area" = "5 %", "plant.pump_gain" = 0.1}'},
    "limits": {"limits": '{"max_level.LT101" = 0.9, "max_level.LT102" = "80 %"}'},
    "two pumps": TWO,
    "open loop": {
        "controller": '{kind = "open-loop", initial = [37.0], changes = [[100.0, "P101", 45.0]]}',
        "free": None,
        "reachable": "false",
    },
    "P": controlled('kind = "p", Kc = 200.0, bias = 37.0'),
    "PID": controlled(
        'kind = "pid", Kc = 200.0, Ti = 200.0, Td = 5.0, N = 8.0, b = 0.7, bias = 37.0,'
        ' anti_windup = "conditioned"'
    ),
    "on-off": controlled('kind = "on-off", on = [0.45], off = [0.55]'),
    "cascade": controlled(
        'kind = "cascade", Kc = 1.0, Ti = 300.0, inner = ["LT101"], inner_Kc = 200.0,'
        " inner_Ti = 100.0, inner_low = 0.1, inner_high = 1.0",
        plant='{outputs = ["LT102"]}',
        reference='{initial = [0.3], changes = [[100.0, "LT102", 0.35]]}',
    ),
    "flow cascade": controlled(
        'kind = "flow-cascade", Kc = 0.01, Ti = 200.0, inner_Kc = 5e3, inner_Ti = 4.0'
    ),
    "override": controlled(
        'kind = "override", Kc = 200.0, Ti = 200.0, bias = 37.0, limited = ["LT102"],'
        " limit = [0.35], limit_Kc = [300.0], limit_Ti = [200.0]"
    ),
    "reference governor": controlled(
        'kind = "reference-governor", Kc = 200.0, Ti = 200.0, bias = 37.0, horizon = 600.0,'
        " limit = [0.6, 0.35]"
    ),
    "split range": controlled(
        'kind = "split-range", Kc = 200.0, Ti = 200.0',
        pump=TWO["pump"].replace('"LT102"', '"LT101"'),
    ),
    "ratio": controlled(
        'kind = "ratio", Kc = 200.0, Ti = 200.0, follow = ["P101"], ratio = [0.2]',
        pump=TWO["pump"].replace('to = "LT102"', 'to = "LT101"'),
    ),
}


def rig_file(folder, name):
    """Write a rig, and the table that some read, to a folder; return its path."""
    folder = Path(folder)
    keys = {**BASE, **RIGS[name]}
    lines = [f"{key} = {text}" for key, text in keys.items() if text is not None]
    (folder / "sp.csv").write_text("t [s],SP [m],q [L/s]\n0,0.5,0.1\n100,0.6,0.2\n300,0.55,0\n")
    (folder / "semi.csv").write_text("t;SP [m];q [L/s]\n0:00;0,5;0\n0:02;0,6;0,1\n0:05;0,55;0\n")
    path = folder / "rig.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


COMMANDS = {
    "show": "show RIG",
    "init": "init RIG",
    "simulate": "simulate RIG --json",
    "margins": "simulate RIG --json --margins",
    "filter": "simulate RIG --json --safety-filter",
    "tune": "tune RIG --json --starts 1 --validation 16",
    "nominal": "tune RIG --json --nominal --starts 1 --screening 4 --validation 8",
    "rule": "tune RIG --json --rule simc --validation 16",
    "bound": "tune RIG --json --nominal --starts 1 --screening 4 --validation 0 --bound",
    "spread": "uncertainty RIG --json --samples 16",
    "sensitivity": "sensitivity RIG --json --method local",
    "attack": "attack RIG --json --starts 1",
    "explore": "explore RIG --out DIR/page.html --quiet",
    "c": "export RIG --lang c --out DIR/c --quiet",
    "js": "export RIG --lang js --out DIR/js --quiet",
    "matlab": "export RIG --lang m --out DIR/m --quiet",
    "st": "export RIG --lang st --out DIR/st --quiet",
    "fmu": "export RIG --lang fmu --out DIR/fmu --quiet",
    "plant": "export RIG --lang fmu --plant --out DIR/plant --quiet",
    "replay": "replay DIR/c/my_rig.c --data DIR/run/trajectory.csv --json",
    "identify": "identify RIG --data DIR/run/trajectory.csv --json --starts 1",
    "predict": "predict RIG --data DIR/run/trajectory.csv --json",
}
ANSWERS = (0, 4, 5)
"""Exit codes of a command that did what was asked (4, 5: and says that something does not hold)."""


def outcome(words):
    """(".", "r" or "X", first line of the reason) of a command."""
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(words)
    except SystemExit as end:
        code = end.code
    except BaseException as error:
        return "X", f"{type(error).__name__}: {error}"[:300]
    text = err.getvalue().strip()
    reason = re.sub(r"\s+", " ", text.splitlines()[-1] if text else "")[:300]
    if "--json" in words and code in ANSWERS:
        try:
            json.loads(out.getvalue(), parse_constant=lambda name: 1 / 0)
        except (ValueError, ZeroDivisionError):
            return "X", "not JSON: " + out.getvalue()[:200]
    if "Traceback" in text:
        return "X", reason
    return (".", "") if code in ANSWERS else ("r" if code in (2, 3) else "X", reason)


def row_of(name, commands=tuple(COMMANDS)):
    """{command: (mark, reason)} of a rig."""
    with tempfile.TemporaryDirectory() as folder:
        path = rig_file(folder, name)
        if "replay" in commands:
            outcome(COMMANDS["c"].replace("RIG", str(path)).replace("DIR", folder).split())
        if {"identify", "predict", "replay"} & set(commands):
            outcome(["simulate", str(path), "--out", folder + "/run", "--quiet"])
        row = {}
        for command in commands:
            words = COMMANDS[command].replace("RIG", str(path)).replace("DIR", folder).split()
            mark, reason = outcome(words)
            row[command] = mark, reason.replace(folder, "DIR")
        jax.clear_caches()
        return row


def table(words=()):
    """Print the table of the rigs and commands that are asked for; return whether none has an X."""
    files = [Path(word) for word in words if word.endswith(".json")]
    record = json.loads(files[0].read_text()) if files and files[0].exists() else {}
    words = [word for word in words if not word.endswith(".json")]
    parts = [word for word in words if not set(word.split(",")) <= set(COMMANDS)]
    asked = [command for word in words if word not in parts for command in word.split(",")]
    commands = tuple(asked or COMMANDS)
    names = [n for n in RIGS if not parts or any(part in n for part in parts)]
    width = max(map(len, names))
    print(" " * width, *(f"{c[:8]:>8}" for c in commands))
    reasons, good = [], True
    for name in names:
        row = record.setdefault(name, {})
        row |= row_of(name, [c for c in commands if c not in row])
        for file in files:
            file.write_text(json.dumps(record, indent=1))
        print(f"{name:{width}}", *(f"{row[c][0]:>8}" for c in commands), flush=True)
        reasons += [f"{name}, {c}: {' '.join(row[c])}" for c in commands if row[c][0] != "."]
        good &= all(row[c][0] != "X" for c in commands)
    print(*reasons, sep="\n")
    return good


if __name__ == "__main__":
    sys.exit(0 if table(sys.argv[1:]) else 1)
