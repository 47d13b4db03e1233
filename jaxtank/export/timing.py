"""Time of one step of an exported controller in C on this machine."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.export.source import files
from jaxtank.export.statements import template

STEPS, ROUNDS = 20_000, 5  # steps in a round, at most, and rounds, of which the fastest counts

LONGEST = 0.2  # seconds after which a round ends


def step_time(case: Case) -> tuple[float | None, str]:
    """(core time of a step of the controller in C by gcc -O2 [us], why it is not known)."""
    if shutil.which("gcc") is None:
        return None, "no gcc on this machine"
    try:
        texts = files(case, "c", name="law")
    except InputError as error:
        return None, str(error)
    numbers = lambda values: ", ".join(repr(float(v)) for v in np.ravel(values))
    setpoints = np.asarray(case.loop.reference.sample(case.clock)[0], dtype=float)[:, 0]
    fields = {"levels": numbers(case.loop.x0), "setpoints": numbers(setpoints)}
    sizes = {"steps": STEPS, "rounds": ROUNDS, "longest": f"{LONGEST:g}"}
    with tempfile.TemporaryDirectory() as folder:
        for name, text in (texts | {"time.c": template("timing.c", **fields, **sizes)}).items():
            (Path(folder) / name).write_text(text)
        build = ["gcc", "-std=gnu99", "-O2", "-o", "time", "time.c", "law.c", "-lm"]
        built = subprocess.run(build, cwd=folder, capture_output=True, text=True, check=False)
        if built.returncode:
            return None, f"gcc: {built.stderr.strip().splitlines()[-1]}"
        command = [str(Path(folder) / "time")]
        process = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(process.stdout.split()[0]), ""
