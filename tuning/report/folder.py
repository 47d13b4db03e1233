"""The folder of a result: result.json, data, pictures and report.html, all of them or none."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from tuning.problem.provenance import provenance as provenance_of
from tuning.report.document import Figure, Report, failed
from tuning.report.tables import dumps


def rig_text(case: Any) -> tuple[str | None, str | None]:
    """Return (text of the rig file of a case, None), or (None, why there is none)."""
    # A plant or controller class that is not registered has no name in a rig file.
    try:
        return rig.dump(case), None
    except InputError as error:
        return None, f"rig.toml is not written ({error})"


def pngs(drawings: Mapping[str, Any]) -> dict[str, bytes]:
    """Return {file name: bytes} of {name: figure} that can be drawn; the figures are closed."""
    from jaxtank.plots.run import png

    return {f"{n}.png": data for n, (_, data) in _drawable(drawings, png).items()}


def _drawable(drawings, render):
    """{name: (figure, render(figure))}; those that raise are closed, with a note on stderr."""
    good = {}
    for name, drawing in drawings.items():
        try:
            good[name] = drawing, render(drawing)
        except Exception as error:
            failed(name, error, drawing)
    return good


def _lay_out(drawing):
    """Set the texts of a figure, and keep its layout as it then is."""
    drawing.draw_without_rendering()
    drawing.set_layout_engine("none")


def earlier(folder: str | Path, names: Any) -> list[Path]:
    """Return report.html and the pictures `names` of an earlier result in `folder`."""
    page = Path(folder) / "report.html"
    return [page, *(page.with_name(f"{name}.png") for name in names)] if page.is_file() else []


def save_result(home: Any, result: Any, folder: str | Path, command: str | None) -> list[Path]:
    """Write the files of a result by the functions of its report module `home`."""
    payload, files = home.json_of(result), getattr(home, "files_of", lambda _: {})(result)
    draw, page = lambda: home.figures(result), lambda: home.report(result)
    of = payload.get("provenance") or provenance_of(result.case, getattr(result, "seed", 0))
    captions = home.captions_of(result) if hasattr(home, "captions_of") else home.CAPTIONS
    stale = earlier(folder, captions)
    return save(folder, payload, files, draw, page, captions, command, stale, of)


def save(
    folder: str | Path,
    payload: Any,
    files: Mapping[str, Any],
    draw: Callable[[], dict[str, Any]],
    report: Callable[[], Report],
    captions: Mapping[str, str],
    command: str | None = None,
    stale: Sequence[Path] = (),
    provenance: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write result.json and `files` {name: content}, pictures and report.html; return paths."""
    # files first, to outlive a fault in a picture; then `stale` ones of an earlier result go
    import matplotlib.pyplot as plt

    folder, provenance = Path(folder), provenance or payload.get("provenance", {})
    written = write_folder(folder, {"result.json": dumps(payload) + "\n", **files})
    for path in stale:
        path.unlink(missing_ok=True)
    drawings: dict[str, Any] = {}
    pages: dict[str, str] = {}
    open_before = plt.get_fignums()
    try:
        drawings = draw()
    except Exception as error:
        failed("the pictures", error, *set(plt.get_fignums()).difference(open_before))
    try:
        from tuning.report.html import document  # and jinja2, only where a page is written

        drawings = {n: drawing for n, (drawing, _) in _drawable(drawings, _lay_out).items()}
        caption = lambda name: captions.get(name) or captions[name.partition("_")[0]]
        figures = [Figure(name, caption(name), drawing) for name, drawing in drawings.items()]
        page = report()
        page = dataclasses.replace(page, sections=[*page.sections, *figures])
        pages["report.html"] = document(page, command, provenance)
    except Exception as error:
        failed("report.html", error)
    return written + write_folder(folder, pages | pngs(drawings))
