"""The folder of a result: result.json, data, pictures and report.html, all of them or none."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from tuning.report.document import Report, failed
from tuning.report.tables import dumps


def rig_text(case: Any) -> tuple[str | None, str | None]:
    """Return (text of the rig file of a case, None), or (None, why there is none)."""
    # A plant or controller class that is not registered has no name in a rig file.
    try:
        return rig.dump(case), None
    except InputError as error:
        return None, f"rig.toml is not written ({error})"


def pngs(drawn: Mapping[str, Any]) -> dict[str, bytes]:
    """Return {file name: bytes} of {name: figure}; the figures are closed."""
    # One that cannot be drawn is left out, with a note on stderr.
    from jaxtank.plots.run import png

    files = {}
    for name, drawing in drawn.items():
        try:
            files[f"{name}.png"] = png(drawing)
        except Exception as error:
            failed(name, error, drawing)
    return files


def _laid_out(drawn: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures whose texts can be set, their layout as it then is."""
    good = {}
    for name, drawing in drawn.items():
        try:
            drawing.draw_without_rendering()
            drawing.set_layout_engine("none")
            good[name] = drawing
        except Exception as error:
            failed(name, error, drawing)
    return good


def earlier(folder: str | Path, names: Any) -> list[Path]:
    """Return report.html and the pictures `names` of an earlier result in `folder`; none where
    there is no report.
    """
    page = Path(folder) / "report.html"
    return [page, *(page.with_name(f"{name}.png") for name in names)] if page.is_file() else []


def save(
    folder: str | Path,
    payload: Any,
    files: Mapping[str, Any],
    draw: Callable[[], dict[str, Any]],
    report: Callable[[dict[str, Any]], Report] | None,
    command: str | None = None,
    stale: Sequence[Path] = (),
    provenance: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write result.json and `files` {name: content} of a result to `folder`, all or none, then its
    pictures and report.html, all or none; return the paths.
    """
    # draw is called once the files are written, so that they outlive a fault in a picture; stale:
    # paths of an earlier result, removed between the two; provenance: where the payload has none.
    # What cannot be drawn is left out, with a note on stderr.
    import matplotlib.pyplot as plt

    folder, made = Path(folder), provenance or payload.get("provenance", {})
    written = write_folder(folder, {"result.json": dumps(payload) + "\n", **files})
    for path in stale:
        path.unlink(missing_ok=True)
    drawn: dict[str, Any] = {}
    pages: dict[str, str] = {}
    open_before = plt.get_fignums()
    try:
        drawn = draw()
    except Exception as error:
        new = [plt.figure(n) for n in plt.get_fignums() if n not in open_before]
        failed("the pictures", error, *new)
    if report is not None:
        from tuning.report.html import document  # and jinja2, only where a page is written

        try:
            drawn = _laid_out(drawn)
            pages["report.html"] = document(report(drawn), command, made)
        except Exception as error:
            failed("report.html", error)
    return written + write_folder(folder, pages | pngs(drawn))
