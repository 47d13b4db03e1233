"""Integral action that no gains of its signs make stable, by eigenvalues of an own linear model."""

import numpy as np
import pytest

from jaxtank import rig
from jaxtank.core.errors import InputError
from tuning import tradeoff, tune, tune_robust
from tuning.problem.pairing import check_signs, unstable_signs

AREA, HOLE, GAIN, G = (28.0, 32.0, 28.0, 32.0), (0.071, 0.057, 0.071, 0.057), (3.14, 3.29), 981.0
LEVELS = np.array([12.0, 13.0])


def quadruple(g1, g2, outputs=("T1", "T2"), Kc=(1.0, 1.0), kind='"pi", Ti = [60, 60]'):
    """The rig of Johansson (2000): pump 1 to tanks 1 and 4, pump 2 to tanks 2 and 3."""
    return rig.loads(f"""
    dt = 1.0
    duration = 600.0
    tank = [
     {{ name = "T1", area = 28.0, rim = 60.0, drain = 0.071, level = 12.0 }},
     {{ name = "T2", area = 32.0, rim = 60.0, drain = 0.057, level = 13.0 }},
     {{ name = "T3", area = 28.0, rim = 60.0, level = 2.0 }},
     {{ name = "T4", area = 32.0, rim = 60.0, level = 2.0 }}]
    orifice = [
     {{ from = "T3", to = "T1", area = 0.071 }}, {{ from = "T4", to = "T2", area = 0.057 }}]
    pump = [{{ name = "P1", gain = 3.14, to = ["T1", "T4"], split = {g1}, high = 20.0 }},
     {{ name = "P2", gain = 3.29, to = ["T2", "T3"], split = {g2}, high = 20.0 }}]
    plant = {{ outputs = ["{outputs[0]}", "{outputs[1]}"] }}
    controller = {{ kind = {kind}, Kc = [{Kc[0]}, {Kc[1]}] }}
    """)


def linear(g1, g2):
    """(A, B) at rest with tanks 1 and 2 at LEVELS."""
    flows = np.array(HOLE[:2]) * np.sqrt(2.0 * G * LEVELS)
    mix = np.array([[g1, 1.0 - g2], [1.0 - g1, g2]]) * np.array(GAIN)  # flows that leave 1 and 2
    u = np.linalg.solve(mix, flows)
    upper = np.array([(1.0 - g2) * GAIN[1] * u[1], (1.0 - g1) * GAIN[0] * u[0]])
    h = np.append(LEVELS, (upper / np.array(HOLE[2:])) ** 2 / (2.0 * G))
    rates = np.array(HOLE) * np.sqrt(G / (2.0 * h)) / np.array(AREA)
    A, B = -np.diag(rates), np.zeros((4, 2))
    A[0, 2], A[1, 3] = rates[2] * AREA[2] / AREA[0], rates[3] * AREA[3] / AREA[1]
    B[0, 0], B[3, 0] = g1 * GAIN[0] / AREA[0], (1.0 - g1) * GAIN[0] / AREA[3]
    B[1, 1], B[2, 1] = g2 * GAIN[1] / AREA[1], (1.0 - g2) * GAIN[1] / AREA[2]
    return A, B


def growth(A, B, rows, Kc, Ti):
    """Largest real part of the poles of two PI loops, loop i from tank rows[i] to pump i."""
    C = np.eye(4)[list(rows)]
    K, Ki = np.diag(Kc), np.diag(np.asarray(Kc) / np.asarray(Ti))
    closed = np.block([[A - B @ K @ C, B @ Ki], [-C, np.zeros((2, 2))]])
    return np.linalg.eigvals(closed).real.max()


def draws(rng):
    return 10.0 ** rng.uniform(-3, 1, 2), 10.0 ** rng.uniform(0.5, 4, 2)


@pytest.mark.extended
def test_a_pairing_is_refused_where_no_gains_of_its_signs_are_stable():
    rng, seen = np.random.default_rng(4), []
    for g1, g2 in [(0.43, 0.34), (0.7, 0.6), (0.3, 0.35), (0.6, 0.65)]:
        A, B = linear(g1, g2)
        for rows in [(0, 1), (1, 0)]:
            for signs in [(1.0, 1.0), (1.0, -1.0)]:
                names = [f"T{i + 1}" for i in rows]
                (sentence,) = [*unstable_signs(quadruple(g1, g2, names, signs))] or [None]
                poles = []
                for _ in range(300):
                    Kc, Ti = draws(rng)
                    poles.append(growth(A, B, rows, Kc * signs, Ti))
                assert (sentence is not None) == (min(poles) > 0.0), (g1, g2, rows, signs)
                seen.append(sentence is not None)
                if sentence and signs == (1.0, 1.0):
                    other = f'plant.outputs = ["{names[1]}", "{names[0]}"]'
                    assert other in sentence
                if sentence and "change the sign" in sentence:
                    assert sentence.endswith(f"of {names[1]}")
    assert 4 <= sum(seen) < len(seen)


@pytest.mark.parametrize("kind", ['"p"', '"pi", Ti = [60, inf]'])
def test_a_loop_without_integral_action_is_not_refused_by_its_steady_gains(kind):
    assert not [*unstable_signs(quadruple(0.43, 0.34, kind=kind))]
    assert [*unstable_signs(quadruple(0.43, 0.34))]


@pytest.mark.parametrize(
    "search",
    [
        tune,
        lambda case: tune(case, nominal=True),
        tune_robust,
        lambda case: tradeoff(case, "input_travel", [80.0]),
    ],
)
def test_a_search_refuses_a_pairing_that_no_gains_in_its_ranges_can_hold(search):
    with pytest.raises(InputError, match=r'plant.outputs = \["T2", "T1"\].*relative gain 1.64'):
        search(quadruple(0.43, 0.34))
    stated = quadruple(0.43, 0.34).replace(free={"controller.Kc[0]": (-1.0, 1.0)})
    check_signs(stated, None)
