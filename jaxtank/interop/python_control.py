"""Conversion of a rig to python-control, and of the columns of a run to pandas or xarray."""

import numpy as np

from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.errors import InputError
from jaxtank.loop.trajectory import columns

__all__ = ["columns", "to_control"]


def to_control(plant, outputs=None, *, setpoints=None, levels=None, inputs=None, inflow=None):
    """Return the rig linearised at a steady state as a `control.StateSpace` of python-control."""
    # inflow: (n,) steady inflow of each tank that no pump brings, which a plant does not hold:
    # delta x' = A delta x + B delta u, delta y = C delta x; states are named h1 .., inputs pump1
    # .., outputs y_h1 ...
    try:
        import control
    except ImportError:
        raise InputError("to_control needs python-control: pip install control") from None
    outputs = plant.outputs if outputs is None else outputs
    if not all(isinstance(i, (int, np.integer)) and 0 <= i < plant.tanks for i in outputs):
        raise InputError(
            f"to_control: outputs = {outputs!r}: must be indices of tanks from 0 to"
            f" {plant.tanks - 1}; steady levels are given as setpoints=(...)"
        )
    if inflow is not None and np.shape(inflow) != (plant.tanks,):
        raise InputError(f"to_control: inflow = {inflow!r}: must be {plant.tanks} flows")
    levels, inputs = _operating_point(plant, setpoints, levels, inputs, inflow)
    A, B, _ = (np.asarray(M) for M in linearise(plant, levels, inputs, inflow))
    return control.ss(
        A,
        B,
        np.eye(plant.tanks)[list(outputs)],
        np.zeros((len(outputs), plant.pumps)),
        states=[f"h{i + 1}" for i in range(plant.tanks)],
        inputs=[f"pump{j + 1}" for j in range(plant.pumps)],
        outputs=[f"y_h{i + 1}" for i in outputs],
    )


def _operating_point(plant, setpoints, levels, inputs, inflow):
    """(levels (n,), inputs (m,)) of a steady state; InputError unless it is given in one way."""
    if (setpoints is None) == (levels is None) or (levels is None) != (inputs is None):
        raise InputError(
            "to_control: give setpoints=(...), steady levels of the controlled tanks, or both"
            " levels and inputs"
        )
    if setpoints is not None:
        if np.shape(setpoints) != (len(plant.outputs),):
            raise InputError(
                f"to_control: setpoints = {setpoints!r}: must be {len(plant.outputs)} levels"
                f" [{plant.units[0]}]"
            )
        levels, inputs = equilibrium(plant, setpoints, inflow)
    for name, value, size in (("levels", levels, plant.tanks), ("inputs", inputs, plant.pumps)):
        if np.shape(value) != (size,) or not np.all(np.isfinite(np.asarray(value, dtype=float))):
            raise InputError(f"to_control: {name} = {value!r}: must be {size} finite numbers")
    return levels, inputs
