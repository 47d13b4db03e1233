"""Files of a result: trajectories, pictures, and a folder that takes all of them or none."""

from pathlib import Path

import jax
import numpy as np

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder, write_folder
from jaxtank.loop import run as lp
from jaxtank.loop.trajectory import csv, stride
from tuning.report import figures
from tuning.report.figures import failed
from tuning.report.tables import dumps


def rig_text(case):
    """Return (text of the rig file of a case, None), or (None, why there is none)."""
    # A plant or controller class that is not registered has no name in a rig file.
    try:
        return rig.dump(case), None
    except InputError as error:
        return None, f"rig.toml is not written ({error})"


def run_for_people(case, key=None, rows=3000):
    """A Trajectory of about `rows` rows, as host arrays."""
    every = stride(case.clock.samples, rows)
    run = lp.simulate(case.loop, case.clock, key, save_every=every)
    return jax.tree.map(np.asarray, run)


def pngs(drawn):
    """{file name: bytes} of {name: figure}; the figures are closed."""
    # One that cannot be drawn is left out, with a note on stderr.
    from jaxtank.plots.run import png

    found = {}
    for name, figure in drawn.items():
        try:
            found[f"{name}.png"] = png(figure)
        except Exception as error:
            failed(name, error, figure)
    return found


def earlier(folder, names):
    """Paths of report.html and of the pictures `names` that an earlier result left in `folder`;
    none where there is no report.
    """
    page = Path(folder) / "report.html"
    return [page, *(page.with_name(f"{name}.png") for name in names)] if page.is_file() else []


def write_result(folder, files, draw, page=None, stale=()):
    """Write `files` {name: text, its parts, or bytes} of a result to `folder`, all or none, then
    its pictures, all or none; returns the paths.
    """
    # draw: function that returns {name: figure}, called once the files are written; page: function
    # of these that returns report.html; stale: paths of an earlier result, removed between the two.
    # What cannot be drawn is left out, with a note on stderr.
    folder = Path(folder)
    written = write_folder(folder, files)
    for path in stale:
        path.unlink(missing_ok=True)
    import matplotlib.pyplot as plt

    drawn, more, open_before = {}, {}, plt.get_fignums()
    try:
        drawn = draw()
    except Exception as error:
        failed(
            "the pictures",
            error,
            *(plt.figure(n) for n in plt.get_fignums() if n not in open_before),
        )
    try:
        more = {} if page is None else {"report.html": page(drawn)}
    except Exception as error:
        failed("report.html", error)
    return written + write_folder(folder, more | pngs(drawn))


def save_run(case, run, payload, folder, gif=False, page=None, against=None, columns=None):
    """Write result.json, trajectory.csv, responses.png and, if asked, run.gif and its still
    film.png of one simulation to `folder`, from which those of an earlier one are removed; page:
    function of the pictures that returns report.html; against: (Case, Trajectory) of a rig that the
    film shows beside it; columns: of a journal, for which the responses are also written as
    print.svg and print.png of 300 dpi.
    """
    from jaxtank.plots import responses

    check_folder(folder)
    files = {"result.json": dumps(payload) + "\n", "trajectory.csv": csv(run, case.loop.units)}
    # of an earlier run, known by its trajectory: its tanks must not be taken for those of this one
    old = (Path(folder) / "trajectory.csv").exists()
    names = ("responses.png", "estimates.png", "shares.png", "run.gif", "film.png")
    names += ("report.html", "print.svg", "print.png")
    stale = [Path(folder) / name for name in names] if old else []

    def pictures():
        return {
            "responses": responses.responses(case.loop, {case.name: run}, case.title),
            **figures.estimates(case.loop, case.clock, run, f"{case.name}: estimates"),
            **figures.shares(run, f"{case.name}: shares of the blended controllers"),
        }

    written = write_result(folder, files, pictures, page, stale)
    if columns is not None:
        written += _for_journal(case, run, folder, columns)
    if gif:
        from jaxtank.plots.animation import film

        beside = None if against is None else (against[0].loop, against[1])
        titles = _titles([case, *([] if against is None else [against[0]])])
        try:
            moving, still = film(case.loop, run, against=beside, titles=titles)
        except Exception as error:
            failed("run.gif", error)
        else:
            written += write_folder(Path(folder), {"run.gif": moving, "film.png": still})
    return written


def _titles(cases):
    """Names of the cases of a film, with the safety filter where not all of them have one."""
    some = len({case.loop.safety_filter is None for case in cases}) > 1
    filtered = lambda case: some and case.loop.safety_filter is not None
    return tuple(case.name + ", safety filter" * filtered(case) for case in cases)


def _for_journal(case, run, folder, columns):
    """Write the responses of a run for a journal; returns the paths."""
    from jaxtank.plots import responses
    from jaxtank.plots.run import save_for_print

    try:
        with responses.for_print(columns):
            figure = responses.responses(case.loop, {case.name: run})
        return save_for_print({"print": figure}, folder, columns)
    except InputError:
        raise
    except Exception as error:
        failed("print.svg", error)
        return []
