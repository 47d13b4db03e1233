"""The notebooks keep their form, agree with their sources, and the comparison of a stored notebook
with a run finds what has changed. The runs themselves: python notebooks/run.py --check.
"""

import copy
import json
import re
import sys

import pytest
from helpers import ROOT

FOLDER = ROOT / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
pytestmark = pytest.mark.skipif(not SOURCES, reason="the notebooks are not beside the tests")
every = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
FIELD = re.compile(r"\{\{(.+?)\}\}")


@pytest.fixture(scope="module")
def stale():
    sys.path.insert(0, str(FOLDER))
    try:
        import stale
    finally:
        sys.path.remove(str(FOLDER))
    return stale


def stored(source):
    """Cells of the notebook of a source: [(kind, text, outputs)]."""
    cells = json.loads(source.with_suffix(".ipynb").read_text())["cells"]
    return [(c["cell_type"], "".join(c["source"]), c.get("outputs", [])) for c in cells]


@pytest.mark.extended_for("01_drag_a_gain")
@every
def test_each_notebook_has_the_cells_of_its_source(source):
    jupytext = pytest.importorskip("jupytext")
    cells = jupytext.read(source, fmt="py:percent").cells
    for cell, (kind, text, _) in zip(cells, stored(source), strict=True):
        assert cell.cell_type == kind
        if kind == "code":
            assert cell.source == text
        else:  # fields are filled with values of the run, and nothing else has changed
            plain = FIELD.split(cell.source.strip())[::2]
            pattern = "(.*?)".join(re.escape(part) for part in plain)
            assert re.fullmatch(pattern, text, re.DOTALL | re.M) or "{{links}}" in cell.source


@every
def test_first_cell_has_a_source_and_a_run_time(source):
    (_, first, _), *_ = stored(source)
    assert re.search(r"\]\(https://doi\.org/10\.\d{4,}/\S+\)", first)
    seconds = int(re.search(r"Run time: about (\d+) s", first)[1])
    assert 0 < seconds <= 120  # 05 measures the 200 rows of five papers
    assert "{{run_time}}" in source.read_text() and "{{links}}" in source.read_text()


@every
def test_outputs_are_stored_and_small(source):
    assert source.with_suffix(".ipynb").stat().st_size <= 600_000
    assert (FOLDER / "images" / f"{source.stem}.png").stat().st_size <= 60_000
    outputs = [o for _, _, outputs in stored(source) for o in outputs]
    assert any("image/png" in o.get("data", {}) for o in outputs)
    assert not [o for o in outputs if o["output_type"] == "error" or o.get("name") == "stderr"]


def test_the_gallery_has_every_notebook():
    page = (FOLDER / "README.md").read_text()
    gallery = page.partition("<!-- gallery -->")[2].partition("<!-- end of gallery -->")[0]
    assert re.findall(r"\[!\[.*?\]\(images/(.*?)\.png\)\]", gallery) == [s.stem for s in SOURCES]
    assert [s.name[:2] for s in SOURCES] == [f"{i + 1:02}" for i in range(len(SOURCES))]


def notebook(legend="tuned", value="error 0.297 cm\n", prose="It falls to 0.297 cm.", tags=()):
    figure = {"image/png": "iVBOR", "text/plain": "<Figure size 640x480 with 1 Axes>"}
    drawn = ["axes  | time [s] | level [cm]", "line 0 to 12.3", f"legend {legend}"]
    table = {"text/html": f"<table><td>{value}</td></table><style>p 9</style>"}
    picture = {"data": figure, "metadata": {"image/png": {"drawn": drawn}}}
    outputs = [
        {"output_type": "stream", "name": "stdout", "text": value},
        {"output_type": "display_data", **picture},
        {"output_type": "execute_result", "data": table, "metadata": {}},
    ]
    code = {"cell_type": "code", "source": "a()", "outputs": outputs}
    text = {"cell_type": "markdown", "source": prose}
    return {"cells": [{**cell, "metadata": {"tags": list(tags)}} for cell in (code, text)]}


@pytest.mark.parametrize(
    "change, where",
    [
        ({"legend": "published"}, "figure"),
        ({"value": "error 0.303 cm\n"}, "stdout"),
        ({"value": "errors 0.297 cm\n"}, "stdout"),
        ({"value": "error 0.297 cm 3\n"}, "stdout"),
        ({"prose": "It falls to 0.320 cm."}, "text"),
        ({"prose": "It rises to 0.297 cm."}, "text"),
    ],
)
def test_a_changed_legend_number_or_word_is_found(stale, change, where):
    found = stale.differences(notebook(), notebook(**change))
    assert found and any(where in line for line in found)


def test_rounding_times_and_addresses_are_no_differences(stale):
    assert stale.differences(notebook(), notebook()) == []
    assert stale.differences(notebook(), notebook(value="error  0.298 cm\n")) == []
    slow = notebook(value="2.1 ms", tags=["times"]), notebook(value="9.4 ms", tags=["times"])
    assert stale.differences(*slow) == []
    for text in ("2 gains changed ({} s)\n", "{} s, 9 simulations with", "margin {}e-14 cm\n"):
        pair = [notebook(value=text.format(took)) for took in ("12.7", "3.1")]
        assert stale.differences(*pair) == []
    pair = [notebook(value=f"1.5 s, {n} simulations with sensitivities") for n in (123, 133)]
    assert stale.differences(*pair) == []  # a search takes another step by rounding alone
    a, b = (notebook(prose=f"Run time: about {n} s. <a at 0x7f{n}abcdef>") for n in (20, 50))
    assert stale.differences(a, b) == []


def test_print_that_a_slow_kernel_sent_in_pieces_is_no_difference(stale):
    whole, parted = notebook(), notebook()
    piece = {"output_type": "stream", "name": "stdout"}
    parted["cells"][0]["outputs"][:1] = [{**piece, "text": t} for t in ("error 0.", "297 cm\n")]
    assert stale.differences(whole, parted) == stale.differences(parted, whole) == []
    outputs = parted["cells"][0]["outputs"]
    assert stale.joined(outputs) == whole["cells"][0]["outputs"]
    apart = [outputs[0], outputs[2], outputs[1]]  # before and after a picture
    assert stale.joined(apart) == apart


def test_changed_code_kinds_and_counts_of_cells_are_found(stale):
    other = copy.deepcopy(notebook())
    other["cells"][0]["source"] = "b()"
    assert stale.differences(notebook(), other) == ["cell 1: the code differs"]
    other = copy.deepcopy(notebook())
    other["cells"][0]["outputs"].pop()
    assert "outputs" in stale.differences(notebook(), other)[0]
    other["cells"].pop()
    assert stale.differences(notebook(), other) == ["stored 2 cells, now 1"]
