"""The drawing of a rig as data for the live page, in the geometry of the package's pictures."""

from jaxtank.plots.layout import jets, overflows, pipes, place


def drawing(plant):
    """Return the positions of all parts of a rig, in heights of its tallest tank."""
    if not hasattr(plant, "links"):
        return None
    where = place(plant)
    return {
        "boxes": [_rounded(box) for box in where.boxes],
        "pumps": [_rounded(p) for p in where.pumps],
        "risers": [[pump, tank, _path(path)] for pump, tank, path in where.risers],
        "pipes": [_rounded(p) for p in pipes(plant, where)],
        "jets": [[tank, _path(path)] for tank, path in jets(plant, where)],
        "overflows": [[tank, _path(path)] for tank, path in overflows(plant, where)],
        **{end: round(float(getattr(where, end)), 4) for end in ("left", "right", "bottom", "top")},
    }


def _rounded(values):
    return [round(float(v), 4) for v in values]


def _path(path):
    return [_rounded(point) for point in path]
