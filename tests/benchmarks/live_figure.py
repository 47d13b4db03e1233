"""Speed of the live figure in a headless kernel: twenty moves of its sliders, computed and drawn.

python tests/benchmarks/live_figure.py [CASE ...]     # on a quiet machine
"""

import sys

import nbformat
from nbclient import NotebookClient

SETUP = """
import time
import numpy as np
import jax, jaxtank
jax.config.update("jax_enable_x64", True)
from jaxtank import presets
figure = presets.find({name!r}).explore(plants=200)
figure
"""
MOVES = """
rng, spans = np.random.default_rng(0), {"compute": [], "draw": []}
cores = {"compute": [], "draw": []}
def timed(what, function):
    wall, core = time.perf_counter(), time.process_time()
    found = function()
    spans[what].append(1000 * (time.perf_counter() - wall))
    cores[what].append(1000 * (time.process_time() - core))
    return found
move, draw = figure.fan.move, figure._draw
figure.fan.move = lambda values=None: timed("compute", lambda: move(values))
figure._draw = lambda moved: timed("draw", lambda: draw(moved))
for _ in range(20):
    bound = figure.fan.bounds[int(rng.integers(len(figure.fan.bounds)))]
    figure.sliders[bound.name].value = float(bound.from_unit(rng.uniform(0.2, 0.8)))
clock, programs = figure.fan.case.clock, figure.fan.program._cache_size()
print(f"{clock.samples} samples of {clock.dt:g} s, {programs} program for 20 moves;", ", ".join(
    f"{what} {np.median(spans[what]):.1f} ms, worst {max(spans[what]):.1f} ms"
    f" ({np.median(cores[what]):.1f} ms core)" for what in spans))
"""
CASES = ("gouta2015/backstepping", "gouta2022/chadpc", "mirakhorli/smc", "cascaded/pi")


def main():
    for name in sys.argv[1:] or CASES:
        cells = [SETUP.replace("{name!r}", repr(name)), MOVES]
        notebook = nbformat.v4.new_notebook(cells=list(map(nbformat.v4.new_code_cell, cells)))
        NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
        (shown,) = notebook.cells[0].outputs
        assert "application/vnd.jupyter.widget-view+json" in shown.data, "ipywidgets is missing"
        print(f"{name}: {notebook.cells[1].outputs[0].text.strip()}", flush=True)


if __name__ == "__main__":
    main()
