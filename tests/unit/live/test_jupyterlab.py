"""The live figure under the hand: JupyterLab in a real browser, its sliders moved by keys."""

import importlib.util
import json
import os
import re
import socket
import subprocess
import sys
import time
import urllib.request

import pytest
from browser import CHROMIUM, chromium
from helpers import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("jupyterlab") is None
        or importlib.util.find_spec("ipywidgets") is None,
        reason='needs JupyterLab: pip install ".[notebooks]"',
    ),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium"),
]

CELLS = (
    "import jaxtank\njaxtank.notebook()\ncase = jaxtank.presets.find('cascaded/pi')",
    "figure = case.explore(plants=50)\nfigure",
    "figure.moved.values, figure.words",
)


@pytest.fixture
def lab(tmp_path):
    """Address of a JupyterLab that serves a folder with one notebook."""
    cells = [
        {"cell_type": "code", "id": f"c{i}", "metadata": {}, "outputs": [], "source": source}
        | {"execution_count": None}
        for i, source in enumerate(CELLS)
    ]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    whole = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    (tmp_path / "live.ipynb").write_text(json.dumps(whole))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root"]
    words += [f"--ServerApp.port={port}", "--IdentityProvider.token=", f"--notebook-dir={tmp_path}"]
    env = os.environ | {"PYTHONPATH": str(ROOT), "JUPYTER_CONFIG_DIR": str(tmp_path / "config")}
    server = subprocess.Popen(words, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        for _ in range(120):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/api/status", timeout=1).close()
                break
            except OSError:
                time.sleep(0.5)
        yield f"http://127.0.0.1:{port}/lab/tree/live.ipynb"
    finally:
        server.terminate()
        server.wait(timeout=30)


def test_a_slider_moved_by_keys_moves_plants_and_words(lab, tmp_path):
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.goto(lab)
        page.get_by_text("figure = case.explore").first.wait_for(timeout=60_000)
        page.get_by_role("menuitem", name="Run").first.click()
        page.get_by_role("menuitem", name="Run All Cells", exact=True).click()
        slider = page.locator(".widget-slider .noUi-handle").first
        slider.wait_for(timeout=120_000)
        words = page.locator(".widget-html-content li")
        before = words.all_inner_texts()
        picture = page.locator(".widget-image").first.get_attribute("src")
        slider.focus()
        for _ in range(5):
            slider.press("ArrowRight")
        page.wait_for_function(
            "old => document.querySelector('.widget-image').getAttribute('src') !== old",
            arg=picture,
            timeout=60_000,
        )
        page.wait_for_timeout(2000)
        after = words.all_inner_texts()
        page.screenshot(path=str(tmp_path / "lab.png"))
        assert len(before) == len(after) >= 3 and before != after
        assert any(re.search(r"10 % more", line) for line in after)
        # the kernel has the numbers that are shown
        page.locator(".jp-Notebook .jp-CodeCell").nth(2).click()
        page.keyboard.press("Control+Enter")
        shown = page.locator(".jp-Notebook .jp-CodeCell").nth(2).locator(".jp-OutputArea-output")
        page.wait_for_timeout(2000)
        assert after[0] in shown.last.inner_text()
        page.get_by_role("button", name="values of the case").click()
        page.wait_for_timeout(2000)
        assert words.all_inner_texts() == before
        page.screenshot(path=str(tmp_path / "back.png"))
