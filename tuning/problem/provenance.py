"""Provenance of a result: versions, settings and seed."""

# scipy has no type stubs
# pyright: reportMissingTypeStubs=false

import os
import platform
from importlib import metadata
from typing import Any

import jax
import jaxlib.version
import numpy as np

import jaxtank
from jaxtank.case import Case
from jaxtank.xla.flags import KEY
from tuning.problem.scenarios import screening_clock


def provenance(case: Case, seed: int | None) -> dict[str, Any]:
    """Return the versions and settings that a result depends on."""
    import scipy

    return {
        "jaxtank": jaxtank.__version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": jaxlib.version.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "optax": metadata.version("optax"),  # its import takes 0.07 s
        "backend": jax.default_backend(),
        "dtype": str(jax.numpy.result_type(float)),
        "xla_option": KEY in os.environ.get("XLA_FLAGS", ""),
        "seed": seed,
        "dt_s": case.clock.dt,
        "coarse_dt_s": screening_clock(case.clock).dt,
        "integrator": case.clock.integrator,
        "rims_are_physics": case.loop.plant.overflow,
    }
