"""Coefficients that follow from the printed parameters, computed by hand from the formulas of the
papers to all digits: what every run of these rigs is made of.
"""

import numpy as np
import pytest

from jaxtank import presets

ROOT = 44.2944691807  # sqrt(2 g), g = 981 cm/s^2


def coefficients(case):
    """{name: value} of gouta2015, eqs. (1) and (2), in cm^0.5/s; c8 in cm/(V s)."""
    p = presets.find(case).loop.plant
    assert [tuple(link) for link in p.links] == [(2, 0), (2, 1), (3, 0), (3, 1)]
    g, (s31, s32, s41, s42), area = np.sqrt(2 * float(p.gravity)), p.orifice, p.area
    found = {
        **{"c1": p.drain[0] * g / area[0], "c4": p.drain[1] * g / area[1]},
        **{"c2": s31 * g / area[0], "c6": s42 * g / area[1], "c3": s41 * g / area[0]},
        **{"c5": s32 * g / area[1], "c7": (s31 + s32) * g / area[2]},
        **{"c9": (s41 + s42) * g / area[3], "c8": p.pump_gain[0] / area[2]},
        "c10": p.pump_gain[1] / area[3],
    }
    found["alpha"] = 0.5 * (found["c2"] * found["c6"] - found["c3"] * found["c5"])
    found["alpha3"] = 0.5 * (found["c2"] + found["c3"]) * found["c7"]
    return found


PRINTED = {  # Table 1: tanks with a diameter of 15 sqrt(2) cm
    **{"c1": 2.2678768221e-02, "c2": 1.4213602999e-02, "c3": 9.4593299739e-03},
    **{"c7": 2.3672932973e-02, "c8": 2.1749760845e-02},
    **{"alpha": 5.6273793333e-05, "alpha3": 2.8020387778e-04},
}
FAST = {"c1": 0.377847, "c2": 0.236810, "c3": 0.157600, "c7": 0.394410, "c8": 0.362369}
EQUAL = {"c4": "c1", "c6": "c2", "c5": "c3", "c9": "c7", "c10": "c8"}


@pytest.mark.parametrize(
    ("case", "expected", "digits"),
    [("gouta2015/ngpc-table1", PRINTED, 1e-10), ("gouta2015/ngpc", FAST, 2e-6)],
)
def test_coefficients_of_gouta2015(case, expected, digits):
    found = coefficients(case)
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=digits), name
    for name, other in EQUAL.items():
        assert found[name] == pytest.approx(found[other], rel=1e-14), name


def test_parts_of_gouta2015():
    plant = presets.find("gouta2015/ngpc").loop.plant
    assert np.sqrt(2 * float(plant.gravity)) == pytest.approx(ROOT, rel=1e-12)
    assert plant.area == pytest.approx(21.2132034356, rel=1e-11)
    assert plant.drain[:2] == pytest.approx(0.1809557368, rel=1e-9)
    assert plant.orifice == pytest.approx(
        [0.1134114948, 0.0754767635, 0.0754767635, 0.1134114948], rel=1e-9
    )
    table1 = presets.find("gouta2015/ngpc-table1").loop.plant
    assert table1.area == pytest.approx(353.4291735289, rel=1e-12)


def test_coefficients_of_calofir_and_khalid():
    p = presets.find("calofir/backstepping").loop.plant
    g = np.sqrt(2 * float(p.gravity))
    pipe, outlet = float(np.ravel(p.pipe)[0]) * g, float(np.max(p.drain)) * g
    assert pipe / p.area[0] == pytest.approx(6.601948e-3, rel=1e-6)  # m^0.5/s
    assert outlet / p.area[-1] == pytest.approx(1.1203247e-2, rel=1e-6)
    p = presets.find("khalid/gpc").loop.plant
    g = np.sqrt(2 * float(p.gravity))
    assert np.max(p.drain) * g == pytest.approx(3.475343e-4, rel=1e-6)  # m^2.5/s
    assert np.ravel(p.pipe) * g == pytest.approx(1.737672e-4, rel=1e-6)


def test_the_error_of_ngpc_and_enmpc_decays_as_their_horizons_say():
    """e'' + K2 e' + K1 e = 0 with Tp = 11 s, and k = 3/(2 Tp) with Tp = 0.13 s."""
    Tp = float(presets.find("gouta2015/ngpc").loop.controller.Tp)
    assert (10 / (3 * Tp**2), 5 / (2 * Tp)) == pytest.approx((0.0275482094, 0.2272727273))
    Tp = float(np.ravel(presets.find("gouta2022/enmpc").loop.controller.Tp)[0])
    assert 3 / (2 * Tp) == pytest.approx(11.5385, rel=1e-5)
