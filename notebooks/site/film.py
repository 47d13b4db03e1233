"""The film of the README: the live page while a gain moves, a tank spills, and Tune keeps it dry.

python notebooks/site/film.py      writes notebooks/images/page.gif; needs playwright and Chromium
"""

import io
import shutil
import tempfile
from pathlib import Path

import jax
from PIL import Image
from playwright.sync_api import sync_playwright

from jaxtank import presets

CASE, GAIN, SPILL = "gouta2015/backstepping", "controller.k1", 334.0
GAINS = (0.02, 0.03, 0.045, 0.06, 0.08, 0.1)
SIZE, WIDTH, COLOURS = {"width": 1100, "height": 640}, 660, 48
OUT = Path(__file__).parents[1] / "images" / "page.gif"


def main():
    """Write the film."""
    jax.config.update("jax_enable_x64", True)
    frames = []

    def shoot(milliseconds):
        image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        height = round(image.height * WIDTH / image.width)
        frames.append((image.resize((WIDTH, height), Image.Resampling.LANCZOS), milliseconds))

    def until(condition):  # the page allows no text as code, as wait_for_function would need
        for _ in range(600):
            if page.evaluate(condition):
                return
            page.wait_for_timeout(200)

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = Path(folder) / "page.html"
        presets.find(CASE).explore().save(file)
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE)
        page.goto(file.as_uri())
        until("document.querySelector('#verdict').textContent !== ''")
        at = f"document.querySelector('#time').value = {1000 * SPILL / 1200}"
        input_ = "document.querySelector('#time').dispatchEvent(new Event('input'))"
        for gain in GAINS:
            page.evaluate(f"jaxtank.run({{ '{GAIN}': {gain} }}); {at}; {input_}")
            page.wait_for_timeout(1200)
            shoot(900 if gain in (GAINS[0], GAINS[-1]) else 400)
        page.evaluate("document.querySelector('#filter').click()")
        page.wait_for_timeout(2500)
        page.evaluate("() => { window.found = jaxtank.tune(); }")
        until("document.querySelector('#message').textContent.startsWith('Tuning')")
        shoot(700)
        page.evaluate("window.found")
        page.evaluate(f"{at}; {input_}")
        page.wait_for_timeout(4000)
        shoot(1800)
    images = [
        image.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        for image, _ in frames
    ]
    times = [milliseconds for _, milliseconds in frames]
    images[0].save(
        OUT, save_all=True, append_images=images[1:], duration=times, loop=0, optimize=True
    )
    print(
        f"{OUT.name}: {len(frames)} frames, {sum(times) / 1000:.1f} s, {OUT.stat().st_size} bytes"
    )


if __name__ == "__main__":
    main()
