"""Scrambled Sobol points are those of SciPy, to the last bit."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import qmc

from tuning.uncertainty import sobol


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("dimensions", [1, 2, 7, 60, 300])
def test_the_points_are_those_of_scipy(dimensions, moved, monkeypatch, tmp_path):
    """Anywhere in the sequence; also where another SciPy has its table of numbers elsewhere."""
    if moved:
        monkeypatch.setattr(sobol, "NUMBERS", tmp_path / "none.npz")
        monkeypatch.setattr(sobol, "_directions", sobol._directions.__wrapped__)
    for seed in (0, [5, 1997]):
        scipy = qmc.Sobol(dimensions, rng=np.random.default_rng(seed)).random_base2(10)
        points = sobol.Sobol(dimensions, seed)
        assert np.array_equal(points.rows(0, 128), scipy[:128])
        assert np.array_equal(points.rows(333, 700), scipy[333:700])
        assert points.rows(5, 5).shape == (0, dimensions)


def test_a_search_does_not_import_scipy_stats():
    script = (
        "import sys; from tuning.search.screening import sobol; sobol(8, 3, 0);"
        "from tuning.uncertainty.sampling import Points; Points('latin', 3, 64, 0);"
        "from tuning.uncertainty.sampling import probabilities; probabilities('sobol', 3, 8, 1);"
        "import tuning.search.tuner; print('scipy.stats' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert out.stdout == "False\n", out.stderr
