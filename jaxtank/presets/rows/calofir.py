"""calofir, secs. 2 to 5: further rows of `jaxtank compare`."""

import numpy as np

from jaxtank.presets.paper import Claim

GAINS = ((0.01, 0.01), (0.02, 0.02), (0.02, 0.1), (0.1, 0.1))  # K_phi, K_y of notes S7.1 [1/s]
FINE = 0.05  # sampling period that stands for continuous time [s]


def settling(trajectory):
    """Return when h1 has entered 2 % of its first step for the last time [s]."""
    first = trajectory.e[:600, 0]
    step = abs(float(trajectory.r[0, 0] - trajectory.x[0, 0]))
    outside = np.flatnonzero(np.abs(first) > 0.02 * step)
    return float(trajectory.t[outside[-1] + 1]) if outside.size else 0.0


def measured(run):
    """Return {quantity: Claim} of the published rows, but for what cannot be measured."""
    (case, plain), hurt = run("backstepping"), run("backstepping-perturbed")[1]
    runs = [run("backstepping", _gains(*pair))[1] for pair in GAINS]
    times = [settling(t) for t in runs]
    limits = [float(case.loop.actuator.low[0]), float(case.loop.actuator.high[0])]
    full = [100.0 * float(np.isin(t.u, limits).mean()) for t in runs]
    sooner = np.diff(times) < 0.0
    listed = ", ".join(f"{a:g} and {b:g} 1/s" for a, b in GAINS)
    drain = np.asarray(case.loop.plant.drain)
    off = run("backstepping", {"plant.drain": (0.75 * drain).tolist()})[1]
    ends = np.abs(off.e[[599, 1199], 0])
    share = plain.x[[599, 1199], 1] / plain.x[[599, 1199], 0]
    above = min(float((t.x[:, 0] - t.x[:, 1]).min()) for t in (plain, hurt))
    fine = run("backstepping", {"clock.dt": FINE}, round(1.0 / FINE))[1]
    apart = np.abs(plain.x[:, 0] - fine.x[:, 0])
    alike = float(np.corrcoef(plain.x[:, 0], plain.x[:, 1])[0, 1])
    return {
        "h1 is at least h3": Claim(
            above >= 0.0, f"h1 - h3 is at least {above:.4f} m, with and without faults"
        ),
        "sampling period of 1 s": Claim(
            bool(apart.max() < 1e-3),
            f"h1 is at most {1e3 * apart.max():.3f} mm from that with {FINE:g} s, at"
            f" {plain.t[np.argmax(apart)]:.0f} s (counts if below 1 mm)",
        ),
        "larger gains settle sooner": Claim(
            sooner, f"step to 0.48 m with {listed}: {', '.join(f'{t:.0f} s' for t in times)}"
        ),
        "larger gains saturate the pump": Claim(
            bool(np.all(np.diff(full) >= 0.0)) and full[-1] > full[0],
            f"at a limit with {listed}: {', '.join(f'{s:.3g} %' for s in full)} of the time",
        ),
        "level of the second tank": Claim(
            (alike > 0.9, bool(abs(share[0] / share[1] - 1.0) < 0.01)),
            f"correlation with h1 {alike:.3f}; h3/h1 {share[0]:.4f} and {share[1]:.4f} at the ends"
            " of the plateaus",
        ),
        "needs an exact model": Claim(
            bool(ends.max() > 1e-3),
            f"c2 smaller by 25 % than in the model leaves {ends[0]:.4f} and {ends[1]:.4f} m (counts"
            " if above 0.001 m)",
        ),
    }


def _gains(phi, y):
    return {"controller.K_phi": phi, "controller.K_y": y}
