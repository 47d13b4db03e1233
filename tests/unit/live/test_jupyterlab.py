"""The live page in a cell of JupyterLab, in a real browser."""

import importlib.util
import json
import os
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
        importlib.util.find_spec("jupyterlab") is None,
        reason='needs JupyterLab: pip install ".[notebooks]"',
    ),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium"),
]

CELLS = (
    "import jaxtank\njaxtank.notebook()\ncase = jaxtank.presets.find('cascaded/pi')",
    "case.explore(plants=50)",
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


def test_the_page_of_a_cell_runs_when_a_slider_is_moved_by_keys(lab):
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.goto(lab)
        page.get_by_text("case.explore").first.wait_for(timeout=60_000)
        page.get_by_role("menuitem", name="Run").first.click()
        page.get_by_role("menuitem", name="Run All Cells", exact=True).click()
        frame = page.frame_locator("iframe.live")
        frame.locator("#legend", has_text="90 % of 50 plants").wait_for(timeout=120_000)
        before = frame.locator("#measures").inner_text()
        slider = frame.locator("#groups input[type=range]").first
        slider.focus()
        for _ in range(5):
            slider.press("ArrowRight")
        page.wait_for_timeout(2000)
        assert frame.locator("#measures").inner_text() != before
        frame.locator("#legend", has_text="90 % of 50 plants").wait_for(timeout=60_000)
