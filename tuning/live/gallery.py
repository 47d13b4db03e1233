"""A gallery: the live page of every case, and one page that lists them by paper."""

import html

import numpy as np

from jaxtank import presets
from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder, write_folder
from tuning.live.drawing import drawing
from tuning.live.page import page, source_of

STYLE = """:root { color-scheme: light dark; --line: #d4d7da; --muted: #56595d; --water: #9cceeb; }
@media (prefers-color-scheme: dark) { :root { --line: #3a4046; --muted: #a9b0b6;
--water: #2b6f99; } body { background: #15181b; color: #e8eaec; } a { color: #6cc0f0; } }
body { max-width: 70rem; margin: 0 auto; padding: 1rem;
font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h2 { font-size: 1.1rem; margin: 2rem 0 .2rem; } p { margin: .2rem 0; }
.citation { color: var(--muted); font-size: .85rem; }
ul { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .8rem;
list-style: none; padding: 0; }
li { border: 1px solid var(--line); border-radius: 8px; padding: .7rem; }
li a { font-weight: 600; } li p { font-size: .85rem; overflow-wrap: anywhere; }
svg { display: block; width: 100%; height: 6rem; margin-bottom: .4rem; }
path { fill: none; stroke: currentcolor; stroke-width: .04; } .riser { stroke: #d55e00; }
.jet { stroke: #0072b2; stroke-dasharray: .09 .05; } rect { fill: var(--water); }"""


def gallery(folder, names=None, each=None):
    """Write the live page of each case and index.html, which lists them; return their paths."""
    # A case that cannot be run in a browser is listed with the reason.
    check_folder(folder)
    listed, written = {}, []
    for name in names or presets.names():
        if each is not None:
            each(name)
        case, file = presets.find(name), f"{name.replace('/', '-')}.html"
        try:
            written += write_folder(folder, {file: page(case)})
            listed[name] = case, file, ""
        except InputError as error:
            listed[name] = case, None, str(error)
    return [*write_folder(folder, {"index.html": index(listed)}), *written]


def index(listed):
    """Return the page that lists cases."""
    papers = list(dict.fromkeys(name.split("/")[0] for name in listed))
    body = ["<h1>Closed loops to explore</h1>", "<p>Each page runs its loop in the browser.</p>"]
    for paper in papers:
        body += [f"<h2>{html.escape(paper)}</h2>"]
        if paper in presets.PAPERS:
            citation = html.escape(presets.load(paper).citation)
            body.append(f'<p class="citation">{citation}</p>')
        own = {name: one for name, one in listed.items() if name.split("/")[0] == paper}
        body.append(f"<ul>{''.join(_card(name, *one) for name, one in own.items())}</ul>")
    policy = f"default-src 'none'; style-src {source_of(STYLE)}; img-src data:; base-uri 'none'"
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<title>jaxtank: closed loops to explore</title>\n<link rel="icon" href="data:,">',
            f"<style>{STYLE}</style>\n</head>\n<body>\n<main>",
            *body,
            "</main>\n</body>\n</html>\n",
        ]
    )


def _card(name, case, file, why):
    title = html.escape(name.split("/")[-1])
    link = f'<a href="{html.escape(file)}">{title}</a>' if file else f"<b>{title}</b>"
    note = f"<p>Not in the browser: {html.escape(why)}</p>" if why else ""
    return f"<li>{_picture(case)}{link}<p>{html.escape(case.title)}</p>{note}</li>"


def _picture(case):
    """The rig of a case, half full, as a small picture."""
    rig = drawing(case.loop.plant)
    if rig is None:
        return ""
    left, top = rig["left"], rig["top"]
    wide, high = rig["right"] - left, top - rig["bottom"]

    def path(points, kind):
        ends = " L".join(f"{x - left:.2f} {top - y:.2f}" for x, y in points)
        return f'<path class="{kind}" d="M{ends}"/>'

    parts = [path(points, "riser") for _, _, points in rig["risers"]]
    parts += [path(points, "jet") for _, points in rig["jets"]]
    parts += [path(((x0, y), (x1, y)), "pipe") for x0, x1, y in rig["pipes"]]
    for x, y, width, height, _ in np.asarray(rig["boxes"]).tolist():
        place = f'x="{x - left:.2f}" y="{top - y - height / 2:.2f}"'
        parts.append(f'<rect {place} width="{width:.2f}" height="{height / 2:.2f}"/>')
        wall = ((x, y + height), (x, y), (x + width, y), (x + width, y + height))
        parts.append(path(wall, "wall"))
    box = f'viewBox="0 0 {wide:.2f} {high:.2f}"'
    return f'<svg {box} role="img" aria-label="the rig">{"".join(parts)}</svg>'
