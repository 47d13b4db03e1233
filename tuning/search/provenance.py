"""What a result was made with: versions, machine, seed, and the fingerprint of the problem."""

import hashlib
import os
import platform

import jax
import jaxlib.version
import numpy as np

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.xla.flags import KEY
from tuning.problem.scenarios import coarse_clock


def fingerprint(problem, method, options):
    """What two runs must share for one to go on where the other ended: {what: text}."""
    try:
        text = rig.dump(problem.case)
    except InputError:  # a rig of one's own, that no file describes
        leaves, structure = jax.tree.flatten((problem.loop, problem.clock))
        text = f"{structure} {[np.asarray(v).tolist() for v in leaves]}"
    return {
        "case": hashlib.sha256(text.encode()).hexdigest(),
        "free": repr([tuple(b) for b in problem.bounds]),
        "objective": repr(problem.objective),
        "limits": repr([tuple(limit) for limit in problem.limits]),
        "scenarios": repr(
            [(s.name, sorted(s.values.items()), s.seed, s.weight) for s in problem.scenarios]
        ),
        "method": method,
        "risk": problem.risk,
        **{
            n: repr(options[n])
            for n in (
                "starts",
                "seed",
                "screening",
                "iterations",
                "batch",
                "validation",
                "tolerance",
            )
        },
        "jaxtank": jaxtank.__version__,
        "jax": jax.__version__,
        "xla_option": repr(KEY in os.environ.get("XLA_FLAGS", "")),
    }


def provenance(case, seed):
    """Versions and settings that a result depends on."""
    import optax
    import scipy

    return {
        "jaxtank": jaxtank.__version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": jaxlib.version.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "optax": optax.__version__,
        "backend": jax.default_backend(),
        "dtype": str(jax.numpy.result_type(float)),
        "xla_option": KEY in os.environ.get("XLA_FLAGS", ""),
        "seed": seed,
        "dt_s": case.clock.dt,
        "coarse_dt_s": coarse_clock(case.clock).dt,
        "integrator": case.clock.integrator,
        "rims_are_physics": case.loop.plant.overflow,
    }
