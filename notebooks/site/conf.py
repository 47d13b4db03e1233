"""Sphinx: pages of this folder, the READMEs and notes of the repository, docstrings, notebooks."""

import re
import shutil
from pathlib import Path

import jaxtank

HERE = Path(__file__).parent
ROOT = HERE.parents[1]

project = "jaxtank"
author = "the jaxtank developers"
release = jaxtank.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "jaxtank"
templates_path = [str(HERE / "_templates")]  # relative to the sources otherwise
html_extra_path = ["_build/extra"]
nb_execution_mode = "off"  # outputs are stored, and compared with a run by notebooks/run.py
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4
autosummary_generate = True
autodoc_typehints = "none"  # numpydoc has them
numpydoc_show_class_members = False
copybutton_prompt_text = r"\$ |>>> |\.\.\. "
copybutton_prompt_is_regexp = True

PAGES = {
    "notebooks/README.md": "tour",
    "jaxtank/README.md": "simulation",
    "tuning/README.md": "tuning",
    "jaxtank/safety/README.md": "safety",
    "tests/benchmarks/README.md": "benchmarks",
    "CHANGELOG.md": "changes",
    ".github/CONTRIBUTING.md": "contributing",
    **{f"jaxtank/presets/notes/{p.name}": f"notes-{p.stem}"
       for p in sorted((ROOT / "jaxtank/presets/notes").glob("*.md"))},
}  # fmt: skip
"""{page of the repository: its name on the site}."""

LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def moved(text, page):
    """Return the text of a page of the repository with its links as they are on the site."""

    def link(match):
        picture, words, target = match.groups()
        words = LINK.sub(link, words)  # a picture that is a link
        if target.startswith(("http", "#")):
            return match.group()
        path, _, anchor = target.partition("#")
        file = ((ROOT / page).parent / path).resolve()
        name = file.relative_to(ROOT).as_posix()
        if name in PAGES:
            return f"[{words}]({PAGES[name]}.md{'#' * bool(anchor)}{anchor})"
        if file.suffix == ".ipynb":
            return f"[{words}](notebooks/{file.name})"
        if picture:
            (HERE / "_build/pages/images").mkdir(parents=True, exist_ok=True)
            shutil.copy(file, HERE / "_build/pages/images" / file.name)
            return f"![{words}](images/{file.name})"
        return words  # a file of the repository that is no page

    text = re.sub(r"<!--.*?-->\n?", "", text, flags=re.S)
    parts = re.split(r"(```.*?```)", text, flags=re.S)
    return "".join(part if part.startswith("```") else LINK.sub(link, part) for part in parts)
