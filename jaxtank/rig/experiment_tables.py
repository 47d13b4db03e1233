"""The tables of a rig file that tie it to a record: [log], its columns; [covariance], how well its
parameters were identified.
"""

import numpy as np

from jaxtank.core.errors import InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value


def check_log(plant, table):
    """{slot: header or (header, unit)} of a [log] table; InputError for a slot that the plant does
    not have.
    """
    slots = [
        "t",
        *(f"pump{j + 1}" for j in range(plant.pumps)),
        *(f"h{i + 1}" for i in range(plant.tanks)),
    ]
    found = {}
    for slot, spec in table.items():
        if slot not in slots:
            raise unknown("key of [log]", slot, slots)
        pair = [spec] if isinstance(spec, str) else spec
        if not (
            isinstance(pair, (list, tuple))
            and 1 <= len(pair) <= 2
            and all(isinstance(v, str) and v.strip() for v in pair)
        ):
            raise InputError(
                f"log {slot} = {shortened(spec)}: must be a column's header, or [header, unit]"
            )
        for other, taken in found.items():
            if (taken if isinstance(taken, str) else taken[0]).strip() == pair[0].strip() != "none":
                raise InputError(
                    f"log {slot} = {shortened(pair[0])}: that column is {other} already"
                )
        found[slot] = pair[0] if len(pair) == 1 else tuple(pair)
    return found


def check_covariance(loop, table):
    """(names, rows) of a [covariance] table; InputError unless it is a covariance of scalars of the
    loop.
    """
    for key in table:
        if key not in ("names", "matrix"):
            raise unknown("key of [covariance]", key, ("names", "matrix"))
    names, matrix = table.get("names"), table.get("matrix")
    if not (isinstance(names, list) and names and all(isinstance(n, str) for n in names)):
        raise InputError("covariance.names: must be a list of parameters")
    if len(set(names)) < len(names):
        raise InputError("covariance.names: one is given twice")
    for name in names:
        if describe(loop, name)["kind"] == "static" or np.ndim(get_value(loop, name)) != 0:
            raise InputError(f"covariance {name}: must be a number, an array's entry by name[i]")
    try:
        rows = np.asarray(matrix, dtype=float)
    except (TypeError, ValueError, OverflowError):
        rows = np.zeros(0)
    good = (
        rows.shape == (len(names),) * 2
        and np.all(np.isfinite(rows))
        and np.allclose(rows, rows.T, rtol=1e-9, atol=0)
    )
    sd = np.sqrt(np.abs(np.diag(rows))) if good else np.zeros(1)
    if (
        not good
        or np.any(np.diag(rows) <= 0)
        or np.linalg.eigvalsh(rows / np.outer(sd, sd))[0] <= 0
    ):
        raise InputError(
            f"covariance.matrix: must be a symmetric, positive definite {len(names)} by"
            f" {len(names)} matrix of finite numbers"
        )
    return tuple(names), tuple(tuple(float(v) for v in row) for row in np.atleast_2d(rows))
