"""How a Case and a Trajectory are drawn, saved and explored: by folders that import them.

These folders are registered in `jaxtank/__init__`.
"""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from jaxtank.core.lazy import call
from jaxtank.core.text import html_table, with_picture


class CaseViews:
    """The pictures, files and live page of a Case."""

    def plot(self: Any) -> dict[str, Any]:
        """Return matplotlib figures {"rig": the schematic}; {} for a plant that is no network of
        tanks. A Trajectory has the figures of a run.
        """
        return call("rig", self.loop.plant, title=self.name)

    def explore(self: Any, free: Mapping[str, Any] | None = None, plants: int | None = None) -> Any:
        """Return the live page, in which the loop runs while sliders move: a notebook shows it, and
        `.save(path)` writes it.

        `free` {dotted name: (low, high)} replaces the free parameters of the case and their ranges.
        With `plants` the page shows a band of that many drawn plants (1 to 2000).

        Raises InputError for a case that cannot be run in a browser, and for names and values that
        cannot be used.
        """
        return call("live_page", self if free is None else self.replace(free=free), plants=plants)

    def save(self: Any, folder: str | Path) -> list[Path]:
        """Write case.json, rig.toml and the pictures of `plot` to a folder, made if need be; return
        the paths.

        If no rig file can describe the case (with a custom plant or controller class that has no
        name in rig files), no rig.toml is written, and a UserWarning gives the reason. Raises
        InputError for a folder that cannot be written to.
        """
        files = {"case.json": json.dumps(self.to_json(), indent=2, allow_nan=False) + "\n"}
        try:
            files["rig.toml"] = call("dump", self)
        except InputError as error:
            warnings.warn(f"rig.toml is not written ({error})", stacklevel=2)
        return write_folder(folder, files | call("pngs", self.plot()))

    def _repr_html_(self: Any) -> str:
        (_, caption), *rows = self.summary()
        return with_picture(html_table(rows, caption=caption), lambda: call("small", self.plot()))


class TrajectoryViews:
    """The pictures and files of a Trajectory."""

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {name: figure}: levels and setpoints, errors, inputs.

        `jaxtank.plots.responses.responses` draws runs over each other, with rims and limits.
        """
        return call("figures", self)

    def save(self: Any, folder: str | Path) -> list[Path]:
        """Write trajectory.csv and the pictures of `plot` to a folder, made if need be; return the
        paths.

        Raises InputError for a folder that cannot be written to.
        """
        table = {"trajectory.csv": call("csv", self, self.units)}
        return write_folder(folder, table | call("pngs", self.plot()))

    def _repr_html_(self: Any) -> str:
        caption, *lines = str(self).splitlines()
        rows = self._summary() if lines else []
        head = ("", "least", "most", "at the end") if rows else ()
        draw = lambda: call("small", self.plot()) if rows else None
        return with_picture(html_table(rows, head, caption), draw)
