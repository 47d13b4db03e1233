"""Controllers and plants as FMUs for co-simulation (FMI 3.0, 2.0): description, sources, binary."""

import functools
import hashlib
import io
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxtank.core.labels import input_unit, label_of
from jaxtank.core.units import local
from jaxtank.export.c import C, print_c
from jaxtank.export.printer import note_of
from jaxtank.export.statements import below, template

SIGNALS = {
    "y": ("tank", "cm", "reading"),
    "r": ("output", "cm", "setpoint"),
    "dr": ("output", "cm/s", "rate of the setpoint"),
    "ddr": ("output", "cm/s^2", "second derivative of the setpoint"),
    "w": ("pump", "V", "input in manual operation"),
    "u": ("pump", "V", "input"),
    "d": ("tank", "cm^3/s", "further inflow"),
    "h": ("tank", "cm", "level"),
    "spilled": ("tank", "cm^3", "volume over the rim in the last period"),
}
"""{argument of a step: (what it has an entry for, unit of a rig in cm and V, what it is)}."""

NAMES = {"w": "manual_input"}  # {argument: its name in the FMU, where that is another}

MANUAL = "manual"


class Variable(NamedTuple):
    """A number of an FMU; its value reference is its place in the list."""

    name: str
    causality: str
    start: float
    unit: str
    words: str
    low: float | None = None
    high: float | None = None


def variables(program: Any) -> list[Variable]:
    """Return the variables of an FMU: parameters, inputs, outputs."""
    loop, numbers = program.case.loop, []
    for p in program.parameters:
        for i in np.ndindex(p.value.shape):
            name = p.name + (f"[{','.join(map(str, i))}]" if i else "")
            words, unit = note_of(p), p.meta["unit"]
            ends = p.meta["low"], p.meta["high"]
            numbers.append(Variable(name, "parameter", float(p.value[i]), unit, words, *ends))
    starts = {"y": loop.x0, "u": loop.actuator.initial}
    for causality, names in {"input": program.inputs, "output": program.outputs_of}.items():
        for name in names:
            kind, unit, words = SIGNALS[name]
            size = {"tank": program.tanks, "pump": program.pumps}.get(kind, program.outputs)
            for j in range(size):
                start = float(starts[name][j]) if name in starts else 0.0
                label = f"{words} of {label_of(loop.plant, kind, j)}"
                full, signal_unit = f"{NAMES.get(name, name)}[{j}]", local(unit, loop.units)
                if kind == "pump":
                    signal_unit = input_unit(loop.plant, j, signal_unit)
                numbers.append(Variable(full, causality, start, signal_unit, label))
    return numbers


def _attributes(**words):
    return "".join(f" {k}={quoteattr(str(v))}" for k, v in words.items() if v is not None)


def _number(value):
    return None if value is None else repr(float(value)).replace("inf", "INF")


def description(program: Any, name: str, version: str, token: str) -> str:
    """Return modelDescription.xml."""
    third = version == "3.0"
    numbers, case = variables(program), program.case
    units = sorted({v.unit for v in numbers} - {"-"})
    head = {"fmiVersion": version, "modelName": case.name, "description": case.title}
    head |= {"instantiationToken" if third else "guid": token, "generationTool": "jaxtank"}
    steps = {"canHandleVariableCommunicationStepSize": "false"}
    if third:
        steps |= {"fixedInternalStepSize": repr(float(case.clock.dt))}
    experiment = {"startTime": "0", "stopTime": repr(float(case.clock.duration))}
    experiment |= {"stepSize": repr(float(case.clock.dt))}
    outputs = [i for i, v in enumerate(numbers) if v.causality == "output"]
    if third:
        structure = [f'    <Output valueReference="{i}"/>' for i in outputs]
        structure += [f'    <InitialUnknown valueReference="{i}"/>' for i in outputs]
    else:
        unknown = [f'      <Unknown index="{i + 1}"/>' for i in outputs]
        structure = ["    <Outputs>", *unknown, "    </Outputs>"]
        structure += ["    <InitialUnknowns>", *unknown, "    </InitialUnknowns>"]
    return template(
        "modelDescription.xml",
        head=_attributes(**head),
        steps=_attributes(modelIdentifier=name, **steps),
        sources="" if third else SOURCES.format(name=name),
        units=below(f"    <Unit{_attributes(name=unit)}/>" for unit in units),
        experiment=_attributes(**experiment),
        variables=below(_rows(program, numbers, third)),
        structure=below(structure),
    )


SOURCES = '<SourceFiles><File name="{name}.c"/><File name="fmi.c"/></SourceFiles>'


def _rows(program, numbers, third):
    """The variables as elements: numbers, time, the switch of manual operation."""
    real, rows = "Float64" if third else "Real", []

    def add(kind, name, i, causality, variability, words=None, **value):
        outer = {"name": name, "valueReference": i, "causality": causality}
        outer |= {"variability": variability, "description": words}
        outer, inner = _attributes(**outer), _attributes(**value)
        fmi3, fmi2 = f"<{kind}{outer}{inner}/>", f"<ScalarVariable{outer}><{kind}{inner}/>"
        rows.append(f"    {fmi3 if third else f'{fmi2}</ScalarVariable>'}")

    for i, v in enumerate(numbers):
        variability = "tunable" if v.causality == "parameter" else "discrete"
        value = {"unit": None if v.unit == "-" else v.unit, "min": _number(v.low)}
        value |= {"max": _number(v.high)}
        value |= {} if v.causality == "output" else {"start": _number(v.start)}
        add(real, v.name, i, v.causality, variability, v.words, **value)
    add(real, "time", len(numbers) + 1, "independent", "continuous")
    if not program.plant:
        words = "true: u is manual_input"
        add("Boolean", MANUAL, len(numbers), "input", "discrete", words, start="false")
    return rows


def interface(program: Any, name: str, version: str) -> str:
    """Return the functions of FMI as C99, around those of the controller or plant."""
    numbers = variables(program)
    parameters = sum(v.causality == "parameter" for v in numbers)
    place, places = 0, {}
    for group in (program.inputs, program.outputs_of):
        for argument, entries in group.items():
            places[argument] = f"m->v + {place}"
            place += entries if isinstance(entries, int) else len(entries)
    inputs = [places[v] for v in program.inputs if v != "w"]
    outputs = [places[v] for v in program.outputs_of]
    manual = [] if program.plant else [f"m->manual ? {places['w']} : NULL"]
    clock = [] if program.plant else [f"t + i * {name}_dt"]
    step = ", ".join(["&m->state", "&m->p", *clock, *inputs, *manual, *outputs])
    results = outputs if program.plant else [places["y"], places["u"]]
    init = ", ".join(["&m->state", "&m->p", *results])
    words = {"name": name, "parameters": parameters, "numbers": len(numbers)}
    words |= {"start": ", ".join(C().value(v.start) for v in numbers[parameters:])}
    words |= {"init": f"{name}_init({init})", "step": f"{name}_step({step})"}
    return f"{template('fmi.c', **words)}\n{template(f'fmi{version[0]}.c')}"


def place_of(version: str) -> tuple[str, str] | None:
    """Return (folder of binaries in an FMU, suffix) of this machine, None where it has none."""
    system = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib")}
    system |= {"win32": ("windows", ".dll")}
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower())
    name, suffix = system.get(sys.platform, ("", ""))
    if not name:
        return None
    if version[0] == "3":
        return f"{machine or platform.machine()}-{name}", suffix
    return {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}[name], suffix


def compiler() -> str | None:
    """Return the C compiler at hand, None if there is none."""
    return next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)


def library(files: dict[str, str], suffix: str = ".so") -> bytes | None:
    """Return a shared library compiled from C sources, None where no compiler is at hand."""
    command = compiler()
    if command is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        for file, text in files.items():
            (Path(folder) / file).write_text(text)
        target = Path(folder) / f"out{suffix}"
        flags = ["-std=c99", "-O1", "-shared", "-fPIC", "-fvisibility=hidden", "-o", str(target)]
        words = [command, *flags, *(file for file in files if file.endswith(".c")), "-lm"]
        process = subprocess.run(words, cwd=folder, capture_output=True, check=False)
        return target.read_bytes() if process.returncode == 0 else None


def print_fmu(program: Any, name: str, precision: str, version: str = "3.0") -> dict[str, bytes]:
    """Return {file: content} of a Program as an FMU."""
    sources = {**print_c(program, name, precision), "fmi.c": interface(program, name, version)}
    token = hashlib.sha256("".join(sources.values()).encode()).hexdigest()[:32]
    files: dict[str, Any] = {"modelDescription.xml": description(program, name, version, token)}
    files |= {f"sources/{file}": text for file, text in sources.items()}
    if version[0] == "3":
        files["sources/buildDescription.xml"] = template("buildDescription.xml", name=name)
    place = place_of(version)
    binary = library(sources, place[1]) if place else None
    if place and binary:
        files[f"binaries/{place[0]}/{name}{place[1]}"] = binary
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in files.items():
            archive.writestr(zipfile.ZipInfo(file, (2000, 1, 1, 0, 0, 0)), content)
    return {f"{name}.fmu": out.getvalue()}


print_fmu2 = functools.partial(print_fmu, version="2.0")
