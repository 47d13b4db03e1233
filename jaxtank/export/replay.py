"""An exported controller run against a log: its inputs beside those of the log."""

import contextlib
import ctypes
import io
import json
import re
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from jaxtank.core.errors import DataError, InputError
from jaxtank.core.quantities import factor
from jaxtank.core.stamps import is_time, join_times, seconds
from jaxtank.core.tables import numbers, read_table, unit_name
from jaxtank.core.text import printable
from jaxtank.core.units import canonical
from jaxtank.export.fmi import compiler, library, place_of
from jaxtank.export.statements import template

GROUPS = re.compile(r"(y|h|r|dr|ddr|applied|u|pump)(?:\d+|_.+)", re.IGNORECASE)
"""Names of columns: of "y1" or "y_LT101" the first part is the signal."""

ROWS = 5000  # samples of a run all of which `jaxtank simulate --out` saves


class Export(NamedTuple):
    """A controller as functions."""

    dt: float
    sizes: tuple[int, int, int]  # numbers of levels, setpoints, inputs
    run: Any  # function of a Log that returns the inputs (samples, inputs)
    units: tuple[str, ...] = ()
    """Of levels and setpoints, and of each input; () of an export that does not tell."""


class Log(NamedTuple):
    """Signals of a log, arrays (samples, entries)."""

    t: np.ndarray
    y: np.ndarray
    r: np.ndarray
    dr: np.ndarray
    ddr: np.ndarray
    u: np.ndarray


def replay(path: str | Path, data: str | Path) -> dict[str, Any]:
    """Return the largest difference of each input between a log and an export run against it."""
    # path : NAME.c (with NAME.h beside it), NAME.js or NAME.fmu; data : log with one row a period:
    # t, y1, .. (or h1, ..), r1, .., u1, .. (or pump1, ..), and applied1, .. behind which pumps have
    # a lag, delay or dead zone
    path = Path(path)
    loaders = {".c": _load_c, ".js": _load_javascript, ".fmu": _load_fmu}
    if not path.is_file():
        raise InputError(f"{printable(str(path))}: there is no such file")
    if path.suffix not in loaders:
        missing = {".st": "an interpreter of Structured Text", ".m": "MATLAB or Octave"}
        why = f"needs {missing[path.suffix]}, " if path.suffix in missing else "is none of these; "
        raise InputError(
            f"{printable(path.name)}: {why}replay runs NAME.c, NAME.js and NAME.fmu: export the"
            " same rig in one of them"
        )
    with loaders[path.suffix](path) as export:
        log, columns = read(data, export)
        inputs = export.run(log)
    apart = np.abs(inputs - log.u)
    keys, times = ("name", "largest_difference", "time_s"), log.t[np.argmax(apart, axis=0)]
    rows = zip(columns, map(float, apart.max(axis=0)), map(float, times))
    return {"samples": len(log.t), "inputs": [dict(zip(keys, row)) for row in rows]}


def read(path: str | Path, export: Export) -> tuple[Log, list[str]]:
    """Return (Log for an export, names of the columns of its inputs)."""
    table = read_table(path)
    groups = _groups(table)
    chosen = _chosen(table, groups, export)
    t = seconds(table, (join_times(table)[-1:] or groups["t"])[0])

    def array(key, columns):
        units = export.units[1:] if key == "u" else export.units[:1] * len(columns)
        rate = {"dr": "/s", "ddr": "/s^2"}.get(key, "")
        scaled = [_in_unit(table, i, f"{u}{rate}") for i, u in zip(columns, units)]
        return np.stack(scaled or [numbers(table, i)[0] for i in columns], axis=1)

    arrays = {key: array(key, columns) for key, columns in chosen.items()}
    if any(not np.all(np.isfinite(a)) for a in arrays.values()):
        raise DataError(f"{table.name}: has cells without a number; replay needs every sample")
    apart = np.abs(np.diff(t) - export.dt)
    if np.any(apart > 1e-3 * export.dt):
        k = int(np.argmax(apart))
        raise DataError(
            f"{table.name}, line {table.lines[k + 1]}: is {t[k + 1] - t[k]:.6g} s after the row"
            f" before; the export runs every {export.dt:.6g} s: log every period (of a simulation"
            f" --set clock.duration={ROWS * export.dt:.6g} or less, which saves all samples)"
        )
    arrays |= {"dr": _rates(arrays["r"], export.dt), "ddr": np.zeros_like(arrays["r"])}
    for key in ("dr", "ddr"):
        if len(groups.get(key, [])) == export.sizes[1]:
            arrays[key] = array(key, groups[key])
    return Log(t, **arrays), [table.columns[i].name for i in chosen["u"]]


def _refuse_twice(table, columns):
    """Raise DataError for columns of one name."""
    names = [table.columns[i].name for i in columns]
    for name in names:
        if [other.lower() for other in names].count(name.lower()) > 1:
            raise DataError(
                f"{table.name}, line {table.head}: two columns are called {name!r}: leave one out,"
                " or rename it"
            )


def _in_unit(table, i, base):
    """Return the numbers of a column in the export's unit, that of a column without one."""
    values, unit = numbers(table, i)[0], table.columns[i].unit
    size = 1.0 if unit is None else factor(unit_name(unit), canonical(base))
    if size is None:
        raise DataError(
            f"{table.where(i)}: {unit!r} is no unit that converts to the export's, {base}: write"
            f" its numbers in {base}"
        )
    return values * size


def _groups(table):
    """{signal: its columns}, "t" the time."""
    groups: dict[str, list[int]] = {}
    for i, column in enumerate(table.columns):
        match = GROUPS.fullmatch(column.name)
        if column.name.lower() in ("t", "time") or (not match and is_time(column.cells[0])):
            groups.setdefault("t", []).append(i)
        elif match:
            groups.setdefault(match[1].lower(), []).append(i)
    number = lambda i: int("0" + re.sub(r"\D", "", table.columns[i].name))
    for name, columns in groups.items():
        if all(re.fullmatch(rf"{name}\d+", table.columns[i].name.lower()) for i in columns):
            columns.sort(key=number)  # y1 is the first level wherever it stands
    return groups


def _chosen(table, groups, export):
    """{"y", "r", "u": columns} for an export. Raises DataError for columns that are missing."""
    names = {"y": ("y", "h"), "r": ("r",), "u": ("applied", "u", "pump")}
    chosen, problems = {}, [] if "t" in groups else ["a column t"]
    for name in ("t", "dr", "ddr"):
        _refuse_twice(table, groups.get(name, []))
    for (key, words), count in zip(names.items(), export.sizes):
        chosen[key] = next((groups[name] for name in words if name in groups), [])
        _refuse_twice(table, chosen[key])
        if len(chosen[key]) != count:
            columns = " or ".join(f"{name}1, .." for name in words)
            problems.append(f"{count} of {columns} (it has {len(chosen[key])})")
    if problems:
        raise DataError(f"{table.name}: the export needs {'; '.join(problems)}")
    return chosen


def _rates(r, dt):
    """Rates of setpoints: of ramps their slope, of jumps 0."""
    ahead = np.diff(r, axis=0, append=r[-1:]) / dt
    before = np.roll(ahead, 1, axis=0)
    after = np.roll(ahead, -1, axis=0)
    same = lambda other: np.abs(other - ahead) <= 1e-3 * np.abs(ahead)
    return np.where(same(before) | same(after), ahead, 0.0)


@contextlib.contextmanager
def _loaded(binary, suffix) -> Iterator[ctypes.CDLL]:
    """A shared library in this process, which stays loaded."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / f"replayed{suffix}"
        target.write_bytes(binary)
        yield ctypes.CDLL(str(target))


@contextlib.contextmanager
def _load_c(path):
    if compiler() is None:
        raise InputError(f"{printable(path.name)}: needs a C compiler (cc, gcc or clang)")
    header = path.with_suffix(".h")
    if not header.is_file():
        raise InputError(f"{printable(path.name)}: needs its header {printable(header.name)}")
    name = path.stem
    files = {p.name: p.read_text(errors="replace") for p in (path, header)}
    stated = f" {name}_units[" in files[header.name]
    units = f"{name}_units[i]" if stated else "(void)i, (const char *)0"
    # functions of double precision around the export
    harness = template("replay.c", name=name, upper=name.upper(), units=units)
    binary = library({**files, "replay.c": harness})
    if binary is None:
        raise InputError(
            f"{printable(path.name)}: does not compile as a controller that `jaxtank export --lang"
            " c` has written under this name"
        )
    with _loaded(binary, ".so") as code:
        code.period.restype, code.unit.restype = ctypes.c_double, ctypes.c_char_p
        sizes = (ctypes.c_int * 3)()
        code.sizes(sizes)
        pointer = lambda a: a.ctypes.data_as(ctypes.c_void_p)

        def run(log):
            signals = [np.ascontiguousarray(v) for v in (log.y, log.r, log.dr, log.ddr)]
            out = np.zeros_like(log.u)
            code.begin(pointer(signals[0][0]))
            for k, t in enumerate(log.t):
                code.step(ctypes.c_double(t), *(pointer(v[k]) for v in (*signals, out)))
            return out

        units = tuple(word.decode() for i in range(sizes[2] + 1) if (word := code.unit(i)))
        yield Export(code.period(), (sizes[0], sizes[1], sizes[2]), run, units)


@contextlib.contextmanager
def _load_javascript(path):
    if shutil.which("node") is None:
        raise InputError(f"{printable(path.name)}: needs node, which runs JavaScript")

    def node(what, text=""):
        words = ["node", "-e", template("replay.js"), str(path.resolve()), what]
        process = subprocess.run(words, input=text, capture_output=True, text=True, check=False)
        with contextlib.suppress(ValueError):
            return json.loads(process.stdout) if process.returncode == 0 else None
        return None

    facts = node("facts")
    if not facts or None in facts:
        raise InputError(f"{printable(path.name)}: is no controller of `jaxtank export --lang js`")

    def run(log):
        text = json.dumps({k: v.tolist() for k, v in log._asdict().items()})
        inputs = np.array(node("run", text) or [], dtype=float)
        if inputs.shape != log.u.shape:
            raise InputError(f"{printable(path.name)}: stopped with an error in node")
        return inputs

    yield Export(float(facts[0]), tuple(facts[1:4]), run, tuple(facts[4]))


@contextlib.contextmanager
def _load_fmu(path):
    name = printable(path.name)
    try:
        with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as archive:
            files = {file: archive.read(file) for file in archive.namelist()}
        root: Any = ElementTree.fromstring(files["modelDescription.xml"])
        version, kind, clock = root.attrib["fmiVersion"], *map(root.find, PARTS)
        model, dt = kind.attrib["modelIdentifier"], float(clock.attrib["stepSize"])
    except (zipfile.BadZipFile, KeyError, AttributeError, ValueError, ElementTree.ParseError):
        raise InputError(f"{name}: is no FMU of `jaxtank export --lang fmu`") from None
    references, units = _references(root)
    if not {"y", "r", "u"} <= references.keys():
        raise InputError(f"{name}: has no inputs y, r and no output u: it is no controller")
    place = place_of(version)
    binary = files.get(f"binaries/{place[0]}/{model}{place[1]}") if place else None
    is_source = re.compile(r"sources/\w+\.[ch]").fullmatch
    sources = {f[8:]: t.decode(errors="replace") for f, t in files.items() if is_source(f)}
    binary = binary or library(sources)
    if binary is None:
        raise InputError(f"{name}: has no binary for this machine, and no C compiler is at hand")
    y, r, u = (len(references[key]) for key in ("y", "r", "u"))
    with _loaded(binary, place[1] if place else ".so") as code:
        run = lambda log: _run_fmu(code, version[0], references, dt, log)
        yield Export(dt, (y, r, u), run, (units["y"][0], *units["u"]))


PARTS = ("CoSimulation", "DefaultExperiment")


def _references(root):
    """({signal: its value references}, {signal: their units}) of an FMU's inputs and outputs."""
    references: dict[str, list[int]] = {}
    units: dict[str, list[str]] = {}
    for variable in root.find("ModelVariables"):
        if variable.attrib.get("causality") in ("input", "output"):
            key = variable.attrib["name"].split("[")[0]
            references.setdefault(key, []).append(int(variable.attrib["valueReference"]))
            stated = [part.attrib["unit"] for part in variable.iter() if "unit" in part.attrib]
            units.setdefault(key, []).append((stated or ["-"])[0])
    return references, units


def _run_fmu(code, major, references, dt, log):
    """Inputs (samples, inputs) of an FMU."""
    make = code.fmi3InstantiateCoSimulation if major == "3" else code.fmi2Instantiate
    make.restype = ctypes.c_void_p
    model = ctypes.c_void_p(make(b"replay", b"", None))
    real = "Float64" if major == "3" else "Real"
    refs = {k: (ctypes.c_uint32 * len(v))(*v) for k, v in references.items()}
    more = lambda n: [ctypes.c_size_t(n)] if major == "3" else []
    flags = [ctypes.byref(ctypes.c_bool()) for _ in range(3)]
    last = [*flags, ctypes.byref(ctypes.c_double())] if major == "3" else []

    def put(name, row):
        n, values = len(row), (ctypes.c_double * len(row))(*row)
        call = getattr(code, f"fmi{major}Set{real}")
        call(model, refs[name], ctypes.c_size_t(n), values, *more(n))

    def take(n):
        values = (ctypes.c_double * n)()
        get = getattr(code, f"fmi{major}Get{real}")
        get(model, refs["u"], ctypes.c_size_t(n), values, *more(n))
        return list(values)

    put("y", log.y[0])
    getattr(code, f"fmi{major}ExitInitializationMode")(model)
    out = np.zeros_like(log.u)
    for k, t in enumerate(log.t):
        for name in ("y", "r", "dr", "ddr"):
            put(name, getattr(log, name)[k])
        step = getattr(code, f"fmi{major}DoStep")
        step(model, ctypes.c_double(t), ctypes.c_double(dt), ctypes.c_bool(True), *last)
        out[k] = take(out.shape[1])
    getattr(code, f"fmi{major}FreeInstance")(model)
    return out
