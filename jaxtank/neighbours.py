"""Doors to other libraries: a python-control system of any rig, the columns of a run for pandas or xarray."""

import numpy as np

from jaxtank.analysis import equilibrium, linearise
from jaxtank.errors import InputError
from jaxtank.units import local


def to_control(plant, outputs=None, *, levels=None, inputs=None):
    """The rig linearised at a steady state, as a `control.StateSpace` of python-control: delta x' = A delta x + B delta u, y = C delta x.

    plant: a rig; outputs: (p,) levels of its controlled tanks at which it rests, in its unit of length; or levels (n,) and inputs (m,), where
    the operating point is known. States are named h1 .., inputs pump1 .., outputs after their tanks. Raises InputError if python-control is
    not installed (pip install control), or for an operating point that is not one.
    """
    try:
        import control
    except ImportError:
        raise InputError("to_control needs python-control: pip install control") from None
    if (outputs is None) == (levels is None) or (levels is None) != (inputs is None):
        raise InputError("to_control: give outputs to rest at, or both levels and inputs")
    if outputs is not None:
        levels, inputs = equilibrium(plant, outputs)
    for name, value, size in (("levels", levels, plant.tanks), ("inputs", inputs, plant.pumps)):
        if np.shape(value) != (size,) or not np.all(np.isfinite(np.asarray(value, dtype=float))):
            raise InputError(f"to_control: {name} = {value!r}: must be {size} finite numbers")
    A, B, C = (np.asarray(M) for M in linearise(plant, levels, inputs))
    return control.ss(
        A,
        B,
        C,
        np.zeros((len(C), plant.pumps)),
        states=[f"h{i + 1}" for i in range(plant.tanks)],
        inputs=[f"pump{j + 1}" for j in range(plant.pumps)],
        outputs=[f"y_h{i + 1}" for i in plant.outputs],
    )


FIELDS = (
    ("h", "x", "cm"),
    ("y", "y", "cm"),
    ("h_hat", "x_hat", "cm"),
    ("r", "r", "cm"),
    ("u", "u", "V"),
    ("command", "command", "V"),
    ("spilled", "spilled", "cm^3"),
    ("d_hat", "d_hat", "cm/s"),
)
"""Columns of a run: (name, field of `Trajectory`, unit)."""


def columns(run, units=("cm", "V")):
    """{column with its unit: (rows,) array} of a Trajectory: `pandas.DataFrame(columns(run))`, or xarray's variables.

    run: as `jaxtank.simulate` gives it; units: those of the rig, loop.units. Time, levels h, readings y, estimates, setpoints r, inputs u, and
    what was lost over the rims.
    """
    found = {"t [s]": np.asarray(run.t)}
    for name, field, unit in FIELDS:
        values = np.asarray(getattr(run, field))
        found |= {f"{name}{i + 1} [{local(unit, units)}]": values[:, i] for i in range(values.shape[1])}
    return found
