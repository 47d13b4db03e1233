"""Trajectories and measures of every case, recorded: a change of structure must not change a
number.

python tests/audits/recorded_runs.py            compare every case with the record
python tests/audits/recorded_runs.py --record   record them again: after a change of numbers; with
                                                names of cases, these

On a machine with the recorded processor and versions, runs agree to the last bit; elsewhere
samples of them agree to 1e-12 of their size (1e-6 where quadratic programmes end their iterations).
A case that was added on another machine has no bits until all are recorded again.
"""

import hashlib
import json
import sys
from pathlib import Path

import jax
import numpy as np

import jaxtank
from jaxtank import presets
from jaxtank.xla.program_cache import processor

FILE = Path(__file__).parents[1] / "data" / "recorded_runs.json"
COLUMNS = ("x", "y", "u", "command")
POINTS = 12
LOOSE = 1e-6  # where quadratic programmes end their iterations
SATURATED = 2e-3  # share of samples there that may be at a limit, or within LOOSE of it


def machine():
    """Return what decides the last bits of a run: versions, and the processor by its instructions,
    for its name on a virtual machine does not include them.
    """
    return {"processor": processor(), "jax": jax.__version__, "jaxlib": jax.lib.__version__}


def run(name):
    """{bits, points, measures} of a case: a digest of its trajectory, a few samples of it, its
    measures.
    """
    case = presets.find(name)
    noisy = bool(np.any(np.asarray(case.loop.sensor.noise) > 0))
    key = jax.random.key(0) if noisy else None
    trajectory = jaxtank.simulate(case.loop, case.clock, key=key, save_every=10)
    columns = {c: np.asarray(getattr(trajectory, c), np.float64) for c in COLUMNS}
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(v).tobytes() for v in columns.values()))
    at = np.linspace(0, len(columns["x"]) - 1, POINTS).astype(int)
    wanted = [m for m in MEASURES if jaxtank.measures.serves(m, case.loop)]
    measured = jaxtank.evaluate(case.loop, case.clock, wanted, key=key)
    return {
        "bits": digest.hexdigest(),
        "points": {c: v[at].tolist() for c, v in columns.items()},
        "measures": {m: np.asarray(v).tolist() for m, v in measured.items()},
    }


MEASURES = (
    *("rms_error", "rms_error_total", "iae", "ise", "rms_input", "input_travel", "max_level"),
    *("min_level", "overflow_volume", "saturated_fraction", "estimation_rms"),
)


def differences(name, found, recorded, exact):
    """Lines that name what is not as recorded."""
    lines = []
    if exact and recorded["bits"] is not None and found["bits"] != recorded["bits"]:
        lines.append(f"{name}: the bits of its trajectory differ")
    rtol = LOOSE if "constrained" in name or "nmpc" in name else 1e-12
    for group in ("points", "measures"):
        if set(found[group]) != set(recorded[group]):
            lines.append(f"{name}: {group} {sorted(set(found[group]) ^ set(recorded[group]))}")
            continue
        for key, value in recorded[group].items():
            a, b = np.asarray(found[group][key], float), np.asarray(value, float)
            atol = rtol * max(1.0, np.nanmax(np.abs(b), initial=0.0))
            if key == "saturated_fraction" and rtol == LOOSE:
                atol = SATURATED
            if a.shape != b.shape:
                lines.append(f"{name}: {key} has another shape")
            elif not np.allclose(a, b, rtol=rtol, atol=atol, equal_nan=True):
                lines.append(f"{name}: {key} differs by {np.max(np.abs(a - b))}")
    return lines


def main():
    jax.config.update("jax_enable_x64", True)
    if "--record" in sys.argv:
        names = sys.argv[2:] or presets.names()
        cases = {name: run(name) for name in names}
        record = {"machine": machine(), "cases": cases}
        if sys.argv[2:]:
            record = json.loads(FILE.read_text())
            record["cases"] |= cases
        FILE.write_text(json.dumps(record) + "\n")
        print(f"{len(cases)} cases recorded")
        return 0
    record = json.loads(FILE.read_text())
    exact = record["machine"] == machine()
    new, lines = {"bits": "", "points": {}, "measures": {}}, []
    for name in presets.names():
        lines += differences(name, run(name), record["cases"].get(name, new), exact)
    print(
        "\n".join(lines)
        or f"{len(record['cases'])} cases as recorded, {'to the last bit' if exact else 'to 1e-12'}"
    )
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
