"""Speed of the live page in headless Chromium: a run, frames while a slider moves, a search.

python tests/benchmarks/live_page.py [CASE ...]     # on a quiet machine
"""

import sys
import tempfile
from pathlib import Path

import jax

from jaxtank import presets
from jaxtank.live.page import live_page

DRAG = """async () => {
  const own = document.querySelector("#groups input[type=range]"), frame = () =>
    new Promise((done) => requestAnimationFrame(done));
  const times = [];
  let pictures = 0;
  const watch = new MutationObserver(() => (pictures += 1));  // once for each new run
  for (let i = 0; i < 120; i += 1) {
    const measures = document.querySelector("#measures");
    if (i === 30) watch.observe(measures, { subtree: true, childList: true });
    own.value = 200 + 5 * i;
    own.dispatchEvent(new Event("input"));
    const start = performance.now();
    await frame();
    if (i >= 30) times.push(performance.now() - start);
  }
  const seconds = times.reduce((a, b) => a + b) / 1000;
  return [times.sort((a, b) => a - b), pictures / seconds];
}"""
RUN = """() => {
  const engine = makeEngine(), times = [];
  for (let i = 0; i < 12; i += 1) {
    const start = performance.now();
    engine.run({}, { every: 21 });
    times.push(performance.now() - start);
  }
  return Math.min(...times);
}"""
TUNE = """async () => {
  const start = performance.now(), found = await jaxtank.tune();
  return [(performance.now() - start) / 1000, found.objective, found.violation];
}"""


def measure(browser, name, folder):
    """Print one line of a case."""
    from browser import opened

    path = live_page(presets.find(name)).save(Path(folder, "page.html"))
    with opened(browser, path) as live:
        run = live(RUN)
        drag, pictures = live(DRAG)
        seconds, objective, violation = live(TUNE)
    middle, slow = drag[len(drag) // 2], drag[int(0.95 * len(drag))]
    print(
        f"{name}: {path.stat().st_size / 1000:.0f} kB; run {run:.1f} ms; frame {middle:.1f} ms"
        f" (95 %: {slow:.1f} ms), {pictures:.0f} runs drawn a second; search {seconds:.2f} s,"
        f" objective {objective:.6g}, limits passed by {100 * violation:.2g} %"
    )


def main(names):
    """Measure each case."""
    jax.config.update("jax_enable_x64", True)
    from browser import chromium  # of tests/

    with chromium() as browser, tempfile.TemporaryDirectory() as folder:
        for name in names or ["gouta2015/backstepping", "cascaded/pi"]:
            measure(browser, name, folder)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    main(sys.argv[1:])
