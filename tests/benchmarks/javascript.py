"""Time of a step of the whole loop in JavaScript (node) beside the library, in one run.

    python tests/benchmarks/javascript.py [CASE ...]

Each line: size of the text, time of a step with all measures and with derivatives by what is free
(the least of eight, so that the engine has compiled it), and that of `jaxtank.evaluate`.
"""

import json
import subprocess
import sys
import time

import jax

import jaxtank
from jaxtank import presets
from jaxtank.export.whole import served
from jaxtank.live.engine import engine

SCRIPT = """
const e = makeEngine(), n = e.info.samples, free = e.info.free;
const least = (work) => {
  let best = Infinity;
  for (let i = 0; i < 8; ++i) {
    const start = process.cpuUsage();
    work(i);
    best = Math.min(best, process.cpuUsage(start).user * 1000);
  }
  return best / n;
};
const leaf = e.info.leaves.find((one) => one.name === free[0]);
const moved = (i) => ({ [leaf.name]: leaf.value * (1 + 1e-3 * i) });
const run = least((i) => e.run(moved(i), { every: n }));
console.log(JSON.stringify([run, least((i) => e.slopes(moved(i), free)), free.length]));
"""


def measure(name):
    """Print the times of one case."""
    case = presets.find(name)
    text = engine(case)
    done = subprocess.run(["node", "-"], input=text + SCRIPT, capture_output=True, text=True)
    run, slopes, count = json.loads(done.stdout)
    names, best = served(case), float("inf")
    for _ in range(6):
        start = time.process_time()
        jax.block_until_ready(jaxtank.evaluate(case.loop, case.clock, names))
        best = min(best, time.process_time() - start)
    library = 1e9 * best / case.clock.samples
    print(
        f"{name}: {len(text) / 1e3:.0f} kB; a step {run:.0f} ns, with {count} derivatives"
        f" {slopes:.0f} ns; library {library:.0f} ns (processor time)",
        flush=True,
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for one in sys.argv[1:] or ["gouta2015/backstepping", "gouta2022/chadpc", "khalid/gpc"]:
        measure(one)
