"""Pictures of what lies behind a run: the numbers in them are those of the run, and what matters is
said.
"""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.text import Text

from jaxtank import Pump, Rig, Tank, presets, rig
from jaxtank.core.errors import InputError
from jaxtank.loop.trajectory import Trajectory
from jaxtank.plots import diagnostics, fit, responses, style, uncertainty
from jaxtank.plots.schematic import schematic


@pytest.fixture
def ax():
    figure, axes = plt.subplots()
    yield axes
    plt.close(figure)


def made(rows=1001, **fields):
    """A run of two outputs, four tanks and two pumps that stands still, but for the fields that are
    given.
    """
    t, shapes = np.linspace(0.0, 100.0, rows), dict.fromkeys(("x", "y", "x_hat", "d_hat"), 4)
    shapes |= {"r": 2, "e": 2, "command": 2, "applied": 2, "u": 2, "spilled": 4}
    return Trajectory(**({"t": t} | {n: np.ones((rows, m)) for n, m in shapes.items()} | fields))


def columns(*values):
    return np.stack(values, axis=1)


def test_a_style_takes_back_its_own_settings_and_no_others():
    """A notebook's backend starts with the first figure and switches the interactive mode on; where
    that is inside, it must stay on.
    """
    before = dict(plt.rcParams)
    try:
        with style.styled({"lines.linewidth": 7.0}):
            assert plt.rcParams["figure.dpi"] == style.STYLE["figure.dpi"] != before["figure.dpi"]
            assert plt.rcParams["lines.linewidth"] == 7.0
            plt.rcParams["interactive"] = True
        assert plt.rcParams["interactive"] is True
        assert {**plt.rcParams, "interactive": before["interactive"]} == before
        with pytest.raises(ValueError), style.styled():
            raise ValueError
        assert plt.rcParams["figure.dpi"] == before["figure.dpi"]
    finally:
        plt.rcParams.update({"interactive": before["interactive"]})


def test_phase_is_one_level_over_the_other_with_both_rims(ax):
    t = np.linspace(0.0, 1.0, 1001)
    run = made(x=columns(t, t, 5 * t, 29 * t**2))
    diagnostics.phase(ax, {"after": (run, style.AFTER, "-")}, (2, 3), [30.0] * 4, "cm")
    line, first, last = ax.lines
    np.testing.assert_array_equal(line.get_xydata(), run.x[:, 2:])
    assert tuple(first.get_xydata()[0]) == (0.0, 0.0) and tuple(last.get_xydata()[0]) == (5.0, 29.0)
    assert ax.get_xlabel() == "level of tank 3 [cm]" and ax.get_ylabel() == "level of tank 4 [cm]"
    assert ax.get_ylim()[1] > 30.0 and ax.get_xlim()[1] < 30.0  # only the rim that is near


def test_saturation_tells_the_share_and_when(ax):
    t = np.linspace(0.0, 100.0, 1001)
    # 12 V is not past 12 V
    run = made(command=columns(np.where(t < 25.0, 13.0, 5.0), np.where(t >= 90.0, -1.0, 12.0)))
    diagnostics.saturation(ax, {"run": run}, [0.0, 0.0], [12.0, 12.0])
    assert [label.get_text() for label in ax.get_yticklabels()] == [
        "pump 1\n25 % up, 0 % down",
        "pump 2\n0 % up, 10.1 % down",
    ]
    strips = [
        c
        for c in ax.collections
        if isinstance(c, PolyCollection) and len(c.get_paths()) and len(c.get_paths()[0].vertices)
    ]
    up, _, _, down = (c.get_paths()[0].vertices for c in strips[:4])
    y = ax.get_yticks()
    near = {"abs": 100.0 / diagnostics.SLICES}
    assert up[np.abs(up[:, 1] - y[0]) > 1e-9, 0].max() == pytest.approx(25.0, **near)
    assert down[np.abs(down[:, 1] - y[1]) > 1e-9, 0].min() == pytest.approx(90.0, **near)
    assert up[:, 1].max() > y[0] and down[:, 1].min() < y[1]


def test_estimate_and_disturbance_are_the_runs_own(ax):
    t = np.linspace(0.0, 1.0, 1001)
    run = made(
        x=columns(t, t, t, t),
        y=columns(t + 0.1, t, t, t),
        x_hat=columns(t + 0.2, t, t, t),
        d_hat=columns(t - 1, t, t, t),
    )
    diagnostics.estimate(ax, run, 0, "m")
    found = {line.get_label(): line.get_ydata() for line in ax.lines}
    assert ax.get_ylabel() == "level [m]"
    for name, offset in (("measured", 0.1), ("true", 0.0), ("estimated", 0.2)):
        np.testing.assert_allclose(found[name], t + offset)
    ax.clear()
    diagnostics.estimate(ax, run, 1)
    assert "measured" not in {line.get_label() for line in ax.lines}  # it is what is true
    ax.clear()
    diagnostics.disturbance(ax, run, 0, inflow=2 * t, unit="m/s")
    found = {line.get_label(): line.get_ydata() for line in ax.lines}
    np.testing.assert_allclose(found["estimated"], t - 1)
    np.testing.assert_allclose(found["inflow disturbance"], 2 * t)
    assert ax.get_ylabel() == "d_hat [m/s]"


def limit(name, value, bound):
    return {"name": name, "limit": bound, "value": value, "margin": bound - value, "unit": "cm"}


def test_margins_are_shares_of_the_limit_with_the_nearest_first(ax):
    rows = [limit("far", 15.0, 30.0), limit("broken", 33.0, 30.0), limit("met", 30.0, 30.0)]
    diagnostics.margins(ax, rows)
    np.testing.assert_allclose(
        [bar.get_width() for bar in ax.patches], [-10.0, 0.0, 50.0], atol=1e-12
    )
    assert [bar.get_facecolor() for bar in ax.patches] == [
        to_rgba(c) for c in (style.FORBIDDEN, style.AFTER, style.AFTER)
    ]
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["broken\n33 of 30 cm", "met\n30 of 30 cm", "far\n15 of 30 cm"]
    assert ax.yaxis_inverted()
    assert list(ax.lines[0].get_ydata()) == [1]  # a bar without length is marked


def test_tradeoff_joins_the_points_that_keep_the_limit(ax):
    points = [
        {"limit": 12.0, "status": "converged", "objective": 0.1},
        {"limit": 10.0, "status": "not_converged", "objective": 0.2},
        {"limit": 8.0, "status": "infeasible", "objective": 0.3},
    ]
    diagnostics.tradeoff(ax, points, "max_level", "cm", "cm")
    joined, *marks = ax.lines
    np.testing.assert_array_equal(joined.get_xydata(), [[10.0, 0.2], [12.0, 0.1]])
    assert {line.get_label(): line.get_xydata().tolist() for line in marks} == {
        "converged": [[12.0, 0.1]],
        "not converged": [[10.0, 0.2]],
        "limit cannot be held": [[8.0, 0.3]],
    }
    assert ax.get_xlabel() == "limit of max_level [cm]" and ax.get_ylabel() == "objective [cm]"


@pytest.mark.parametrize(
    ("end", "unit", "ticks"),
    [
        (2000.0, "s", ["0", "500", "1000", "1500", "2000"]),
        (86400.0, "h", ["0", "6", "12", "18", "24"]),
        (20.0 * 86400.0, "d", ["0", "6", "12", "18"]),
    ],
)
def test_long_times_are_in_hours_or_days(ax, end, unit, ticks):
    ax.plot([0.0, end], [0.0, 1.0])
    ax.set_xlim(0.0, end)
    style.label_time(ax)
    ax.figure.set_size_inches(2.5, 2.0)
    ax.figure.canvas.draw()
    inside = [at for at in ax.get_xticks() if 0.0 <= at <= end]
    texts = [text.get_text() for text in ax.get_xticklabels()]
    assert ax.get_xlabel() == f"time [{unit}]" and texts[: len(ticks)] == ticks, texts
    seconds = {"s": 1.0, "h": 3600.0, "d": 86400.0}[unit]
    np.testing.assert_allclose(inside, [seconds * float(text) for text in ticks])


@pytest.mark.parametrize(("tanks", "labelled"), [(1, {0}), (3, {1, 2})])
def test_every_column_of_a_fan_has_its_times_below(tanks, labelled):
    """With three tanks the panel below the second stays empty: the times stand below the second."""
    table = {
        "tank": [{"area": 10.0, "rim": 30.0, "drain": 0.1, "level": 3.0}] * tanks,
        "pump": [{"gain": 5.0, "to": 1, "high": 12.0}],
        "controller": {"kind": "open-loop", "initial": [3.0]},
        "reachable": False,
    }
    t = np.linspace(0.0, 10.0, 11)
    bands = {"t": t, "r": np.full((11, 1), 3.0), "x": np.full((5, 11, tanks), 3.0)}
    figure = uncertainty.fan(rig.from_table(table).loop, bands, "bands")
    figure.canvas.draw()
    panels = figure.axes[:tanks]
    assert {i for i, ax in enumerate(panels) if ax.get_xlabel() == "time [s]"} == labelled
    assert {
        i
        for i, ax in enumerate(panels)
        if any(label.get_visible() and label.get_text() for label in ax.get_xticklabels())
    } == labelled
    plt.close(figure)


def test_a_rig_of_many_tanks_is_drawn_on_one_page():
    """Four panels side by side, and of thirty tanks between the sixteen that come nearest to their
    rims.
    """
    n, t = 32, np.linspace(0.0, 10.0, 5)
    plant = SimpleNamespace(tanks=n, pumps=2, outputs=(0, 31), rim=np.full(n, 10.0))
    pumps = SimpleNamespace(low=np.zeros(2), high=np.full(2, 9.0))
    loop = SimpleNamespace(plant=plant, units=("cm", "V"), actuator=pumps)
    x = np.ones((5, 1)) * np.linspace(1.0, 9.0, n)
    run = SimpleNamespace(t=t, x=x, r=x[:, [0, 31]], e=0.0 * x[:, [0, 31]], u=np.ones((5, 2)))
    figure = responses.responses(loop, {"run": run}, title="battery")
    titles = [ax.get_title() for ax in figure.axes if ax.get_visible()]
    tanks = [1, 32, *range(16, 32)]
    assert [w for w in titles if w.startswith("tank ")] == [f"tank {i}" for i in tanks]
    assert figure.get_size_inches()[0] < 20 and "the 16 that" in figure.get_suptitle()
    plt.close(figure)


@pytest.mark.extended_for("12")
@pytest.mark.parametrize("count", [1, 12])
def test_every_run_is_drawn_and_distinguished_from_the_others(count):
    loop = presets.find("mirakhorli/sfc").loop
    runs = {f"run {i}": made(x=columns(*np.full((4, 1001), 1.0 + 0.1 * i))) for i in range(count)}
    figure = responses.responses(loop, runs)
    panels = [ax for ax in figure.axes if ax.get_visible()]
    assert len(panels) == 8
    for ax in panels:
        lines = [line for line in ax.lines if line.get_label() in runs]
        assert [line.get_label() for line in lines] == list(runs)
        assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == count
    (legend,) = figure.legends
    figure.canvas.draw()
    extent = legend.get_window_extent()
    assert {text.get_text() for text in legend.get_texts()} >= set(runs)
    assert extent.x0 >= 0 and extent.x1 <= figure.bbox.x1
    plt.close(figure)


def test_a_limit_below_the_rim_is_in_its_panel_of_a_fan():
    loop = presets.find("cascaded/pi").loop
    bands = {"t": np.arange(3.0), "r": np.ones((3, 1)), "x": np.full((5, 3, 2), 6.0)}
    first, second = uncertainty.fan(loop, bands, "fan", {0: 7.0, 1: float(loop.plant.rim[1])}).axes
    assert [7.0, 7.0] in [list(line.get_ydata()) for line in first.lines]
    assert not [line for line in second.lines if line.get_label().startswith("limit")]


def test_the_rim_is_in_every_panel_of_a_fan():
    """As a line, or in words where it stands far above all levels."""
    loop = presets.find("mirakhorli/sfc").loop
    rims = np.asarray(loop.plant.rim)
    t = np.linspace(0.0, 10.0, 11)
    top = rims * [1.1, 0.6, 0.3, 0.2]
    figure = uncertainty.fan(
        loop, {"t": t, "r": np.ones((11, 2)), "x": np.ones((5, 11, 4)) * top}, "fan"
    )
    for i, ax in enumerate(figure.axes):
        (line,) = [line for line in ax.lines if line.get_label().startswith("rim")]
        if i < 3:
            assert list(line.get_ydata()) == [rims[i]] * 2 and ax.get_ylim()[1] > rims[i]
        else:
            assert line.get_label() == f"rim {rims[i]:g} cm, above the picture"
            assert ax.get_ylim()[1] < rims[i]
    plt.close(figure)


def test_no_responses_of_no_run(gouta):
    with pytest.raises(InputError, match="no run to draw"):
        responses.responses(gouta("ngpc").loop, {})


def test_a_landscape_of_negative_gains_has_an_axis_of_their_sizes(ax):
    x, y = np.meshgrid(-np.geomspace(30.0, 0.03, 7), np.geomspace(1.0, 100.0, 5))
    K, T = (
        SimpleNamespace(name=name, unit="s", scale="log", low=ends[0], high=ends[1])
        for name, ends in (("K", (-30.0, -0.03)), ("T", (1.0, 100.0)))
    )
    responses.contours(ax, (x, y), x * x + y, y - 200, (K, T), "cm", (-1.0, 3.0), (-2.0, 4.0))
    ax.figure.canvas.draw()
    shares = ax.transAxes.inverted().transform(ax.transData.transform([[-3.0, 10.0], [-0.3, 10.0]]))
    np.testing.assert_allclose(shares[:, 0], [1 / 3, 2 / 3], atol=0.05)


def test_units_of_parameters_are_never_set_as_mathematics(ax):
    """Texts of a custom controller may be anything."""
    odd = r"$\x{$"
    x = np.linspace(1.0, 2.0, 5)
    K, L = (SimpleNamespace(name=name, unit=odd, scale="linear") for name in "KL")
    responses.curve(ax, x, x, 0 * x, K, "cm", (1.0, 1.0), (2.0, 2.0))
    ax.figure.canvas.draw()
    ax.clear()
    a, b = np.meshgrid(x, x)
    responses.contours(ax, (a, b), a + b, a - 3, (K, L), "cm", (1.0, 1.0), (2.0, 2.0))
    ax.figure.canvas.draw()


ODD, SERIES = r"$\frac$", np.linspace(1.0, 2.0, 5)
LIKELIHOOD = {"values": [1.0, 2.0], "rise": [0.0, 5.0], "interval95": (None, 1.5)}
DRAWINGS = {
    "a level": lambda ax: fit.measured(ax, SERIES, SERIES, SERIES, ODD, "cm"),
    "a residual": lambda ax: fit.residual(ax, SERIES, SERIES, ODD, "cm"),
    "its autocorrelation": lambda ax: fit.autocorrelation(ax, SERIES, 5, ODD),
    "correlations": lambda ax: fit.correlation(ax, [ODD, "b"], np.eye(2)),
    "a likelihood": lambda ax: fit.profile(ax, LIKELIHOOD | {"name": ODD, "unit": "-"}),
    "effects": lambda ax: responses.tornado(ax, [ODD], [1.0], "cm", f"level of {ODD}"),
    "a rig": lambda ax: schematic(ax, odd_rig().loop.plant),
}


def odd_rig():
    return Rig(
        name=ODD, tanks=[Tank(ODD, area=50.0, rim=30.0, drain=0.5)],
        pumps=[Pump(f"P {ODD}", to=ODD, gain=20.0, high=10.0)], controller={"kind": "open-loop"},
        inputs=[[0.0, 2.0]], reference=[[0.0, 10.0]], dt=1.0, duration=10.0,
    )  # fmt: skip


@pytest.mark.parametrize("name", DRAWINGS)
def test_dollar_signs_of_names_are_drawn_as_they_are(ax, name):
    DRAWINGS[name](ax)
    ax.figure.canvas.draw()
    labels = [text.get_text() for text in ax.figure.findobj(Text)]
    assert any(r"\$\frac\$" in label for label in labels)
