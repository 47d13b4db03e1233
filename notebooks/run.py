"""Build the notebooks of this folder from their sources (NN_name.py, jupytext's percent format).

python notebooks/run.py            runs each, writes NN_name.ipynb, its thumbnail and the gallery
python notebooks/run.py --check    runs each, and fails where a stored notebook or the gallery
                                   differs from the run: text, numbers, figures' titles and legends
python notebooks/run.py 05 08      those alone, by the beginnings of their names

In the text of a source, {{expression}} or {{expression:format}} stands for a value of the notebook
at that place; {{run_time}} for the seconds that it took, {{links}} for links to hosts that open it.
"""

import base64
import io
import json
import math
import re
import subprocess
import sys
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from stale import differences, joined, text_differs

FOLDER = Path(__file__).resolve().parent
FIELD = re.compile(r"\{\{(.+?)\}\}")
HOSTS = {
    "Colab": "https://colab.research.google.com/github/{}/blob/HEAD/notebooks/{}",
    "Binder": "https://mybinder.org/v2/gh/{}/HEAD?labpath=notebooks/{}",
}


def sources():
    """Return the sources, in order."""
    return sorted(FOLDER.glob("[0-9][0-9]_*.py"))


def links(name):
    """Return Markdown links to hosts that open a notebook, "" without a public repository.

    The repository is `Repository` under [project.urls] of pyproject.toml, on GitHub.
    """
    project = tomllib.loads((FOLDER.parent / "pyproject.toml").read_text())["project"]
    public = re.search(
        r"github\.com/([\w.-]+/[\w.-]+)", project.get("urls", {}).get("Repository", "")
    )
    if not public:
        return ""
    opened = (f"[{host}]({url.format(public[1], name)})" for host, url in HOSTS.items())
    return "Open in " + " or ".join(opened)


def aside(client, code):
    """Execute code in the kernel that is no cell of the notebook; return what it prints."""
    first = client.nb.cells[0]
    cell = nbformat.v4.new_code_cell(code)
    client.execute_cell(cell, 0, store_history=False)
    client.nb.cells[0] = first  # nbclient had put the cell there
    return "".join(output["text"] for output in cell.outputs if output.get("name") == "stdout")


def fill(client, text, known):
    """Return a text in which each {{expression}} is replaced by its value in the kernel."""

    def value(field):
        if field[1] in known:
            return known[field[1]]
        return aside(client, f'print(f"""{{{field[1]}}}""", end="")')

    return FIELD.sub(value, text)


def tidy(notebook):
    """Remove from a notebook what differs from run to run without a meaning."""
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if "outputs" in cell:
            cell.outputs = joined(cell.outputs)
        for output in cell.get("outputs", []):
            if output.output_type == "stream":  # a warning names a file of this run alone
                output.text = re.sub(r"\S*ipykernel_\d+/\d+\.py", "notebook", output.text)
            if "<iframe" in output.get("data", {}).get("text/html", ""):  # hosts show no frame
                output.data.pop("text/html")
    notebook.metadata = nbformat.from_dict(
        {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
    )
    for index, cell in enumerate(notebook.cells):
        cell.id = f"cell-{index + 1}"


def execute(source):
    """Return the notebook of a source with its outputs, and the seconds that it took."""
    notebook = jupytext.read(source, fmt="py:percent")
    client = NotebookClient(
        notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    )
    began = time.perf_counter()
    with client.setup_kernel():
        aside(client, (FOLDER / "drawn.py").read_text())
        count = 0
        for index, cell in enumerate(notebook.cells):
            if cell.cell_type == "code":
                count += 1
                client.execute_cell(cell, index, execution_count=count)
            else:
                known = {"run_time": "{{run_time}}", "links": links(f"{source.stem}.ipynb")}
                cell.source = fill(client, cell.source, known).strip()
    took = time.perf_counter() - began
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = cell.source.replace("{{run_time}}", str(10 * math.ceil(took / 10)))
    tidy(notebook)
    return notebook, took


def picture(notebook):
    """Return the PNG of a notebook's thumbnail: of its cell tagged "thumbnail", or its last one."""
    found = None
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            png = output.get("data", {}).get("image/png")
            if png and (found is None or "thumbnail" not in found[0]):
                found = cell.metadata.get("tags", ()), base64.b64decode(png)
    return found and found[1]


def thumbnail(png, width=360):
    """Return a PNG of at most `width` pixels across."""
    from PIL import Image

    image = Image.open(io.BytesIO(png)).convert("RGB")
    image.thumbnail((width, width), Image.Resampling.LANCZOS)
    small = io.BytesIO()
    image.quantize(128).save(small, "png", optimize=True)
    return small.getvalue()


def gallery():
    """Return the table of the notebooks for README.md: picture, title, question, run time."""
    rows = ["| | notebook | run time |", "|---|---|---|"]
    for source in sources():
        path = source.with_suffix(".ipynb")
        if not path.exists():
            continue
        first = nbformat.read(path, as_version=4).cells[0].source
        title = re.search(r"^# (.+)$", first, re.M)[1]
        question = re.search(r"^\*\*Question[:.]?\*\*[:.]?\s*((?:.+\n?)+)", first, re.M)[1]
        seconds = re.search(r"Run time: about (\d+ s)", first)[1]
        picture = f"[![{title}](images/{source.stem}.png)]({path.name})"
        rows.append(
            f"| {picture} | [{title}]({path.name}). {' '.join(question.split())} | {seconds} |"
        )
    return "\n".join(rows)


def keep(source, notebook):
    """Write a notebook and its thumbnail."""
    nbformat.write(notebook, source.with_suffix(".ipynb"))
    if png := picture(notebook):
        (FOLDER / "images" / f"{source.stem}.png").write_bytes(thumbnail(png))


def one(source, check):
    """Build or check one notebook; return whether it is well."""
    try:
        notebook, took = execute(source)
    except CellExecutionError as error:  # a kernel that dies or draws badly once in many runs
        print(f"{source.stem}: run once more after\n{error}")
        notebook, took = execute(source)
    path, faults = source.with_suffix(".ipynb"), []
    if check:
        stored = json.loads(path.read_text()) if path.exists() else {"cells": []}
        faults = differences(stored, notebook)
    else:
        keep(source, notebook)
    cells = sum(cell.cell_type == "code" for cell in notebook.cells)
    print(f"{path.name}: {cells} cells ran in {took:.0f} s", *faults, sep="\n  ", flush=True)
    return not faults


def main():
    words = sys.argv[1:]
    check = "--check" in words
    wanted = tuple(word for word in words if word != "--check")
    chosen = [path for path in sources() if not wanted or path.name.startswith(wanted)]
    if not chosen:
        sys.exit(f"no notebook here begins with {' or '.join(wanted)}")
    if len(chosen) == 1:
        well = one(chosen[0], check)
    else:  # two at once, each in a process of its own
        command = [sys.executable, __file__, *(["--check"] if check else [])]
        alone = lambda path: not subprocess.run([*command, path.name]).returncode
        with ThreadPoolExecutor(2 if check else 1) as pool:
            well = all(list(pool.map(alone, chosen)))
    page = FOLDER / "README.md"
    start, end = "<!-- gallery -->\n", "\n<!-- end of gallery -->"
    head, rest = page.read_text().split(start)
    stored, tail = rest.split(end)
    if not check:
        page.write_text(head + start + gallery() + end + tail)
    elif len(chosen) == len(sources()) and (how := text_differs(stored, gallery())):
        print(f"README.md: {how}")
        well = False
    sys.exit(0 if well else "stored notebooks differ from a run: python notebooks/run.py")


if __name__ == "__main__":
    main()
