"""Objects that installed packages name by entry points; imports nothing but errors and text.

Only what a package manager has installed is found, and only what is asked for is imported.
"""

from importlib import metadata
from typing import Any

from jaxtank.core.errors import InputError
from jaxtank.core.text import one_line


def installed(group: str) -> dict[str, metadata.EntryPoint]:
    """Return {name: entry point} of a group, none of them imported."""
    return {point.name: point for point in metadata.entry_points(group=group)}


def imported(point: metadata.EntryPoint) -> Any:
    """Return the object of an entry point; InputError with the package's name where it
    cannot be.
    """
    try:
        return point.load()
    except Exception as error:  # whatever a package raises
        package = point.dist.name if point.dist else "unknown"
        why = one_line(f"{type(error).__name__}: {error}", 200)
        raise InputError(
            f"{point.name} = {point.value} of the installed package {package} cannot be imported"
            f" ({why})"
        ) from error
