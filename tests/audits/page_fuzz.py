"""Random clicks and slider moves on a live page: every number that it shows is of its state.

python tests/audits/page_fuzz.py [CASE] [CLICKS] [SEED]     # exit code 1 where one is not
"""

import json
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

from jaxtank import presets
from jaxtank.live.page import _script, live_page

sys.path.insert(0, str(Path(__file__).parents[1]))

ACTIONS = {
    "slider": 40,
    "number": 15,
    "#filter": 6,
    "#breaks button": 8,
    "#pin": 4,
    "#plants": 5,
    "#undo": 3,
    "#reset": 2,
    "#tune": 2,
    "#nominal": 1,
    "#closer": 3,
    "#whole": 3,
    "#play": 2,
    "#time": 4,
    "#cursor-a": 3,
    "#cursor-b": 3,
    "#legend button": 2,
}
"""{what is done: how often}."""

ACT = """([what, share, pick]) => {
  const find = { slider: "#groups input[type=range]", number: "#groups input.number" };
  const every = [...document.querySelectorAll(find[what] ?? what)];
  const all = every.filter((e) => !e.closest("[hidden]")), one = all[Math.floor(pick * all.length)];
  if (!one) return "";
  const name = one.getAttribute("aria-label") ?? one.id ?? "", low = Number(one.min);
  if (one.type === "range") {
    one.value = Math.round(Number(one.max) * share);
    one.dispatchEvent(new Event("input"));
  } else if (one.type === "number") {
    one.value = share < 0.1 ? "" : share < 0.2 ? 1e9 : low + share * (one.max - low);
    one.dispatchEvent(new Event("input"));
    one.dispatchEvent(new Event("change"));
    one.dispatchEvent(new Event("blur"));
  } else one.click();
  return `${name} ${one.type === "range" ? one.value : ""}`;
}"""

CHECK = """() => {
CORE
  const engine = (window.own ??= makeEngine()), { info } = engine, faults = [];
  const state = jaxtank.state(), { values, seed } = state, filter = state.filter === true;
  const leaf = new Map(info.leaves.map(({ name, value }) => [name, value]));
  const inForce = (name, otherwise) => values[name] ?? leaf.get(name) ?? otherwise;
  const run = engine.run(values, { filter, seed, every: 100 });
  const text = (id) => document.querySelector(id).textContent;
  const same = (what, is, wanted) => is === wanted || faults.push(`${what}: ${is}, not ${wanted}`);
  const cells = (v) => [v].flat().map((one) => shown(one)).join(", ");
  for (const row of document.querySelectorAll("#measures tbody tr")) {
    const name = row.cells[0].textContent.split(" [")[0];
    same(name, row.cells[1].textContent, cells(run.measures[name]));
  }
  const margins = marginsOf(limitsIn(info, inForce), run.measures);
  const lines = [...document.querySelectorAll("#margins tbody tr")];
  same("limits", lines.length, margins.length);
  lines.forEach((row, i) => {
    same(row.cells[0].textContent, row.cells[1].textContent, shown(margins[i].value));
    same(row.cells[0].textContent, row.cells[2].textContent, shown(margins[i].margin, 3));
  });
  const [times, ...read] = [...document.querySelectorAll("#cursors tbody tr")]
    .map((row) => [...row.cells].map((cell) => cell.textContent));
  if (times) {
    const fine = engine.run(values, { filter, seed, every: 1 });
    const set = times.length === 4 ? [1, 2] : [1]; // columns, without that of differences
    const line = (name, unit, list) => {
      const head = unit === "-" ? name : `${name} [${unit}]`;
      const at = (k) => shown(interpolated(fine.t, list, [Number(times[k])])[0]);
      for (const k of set) same(`cursor, ${head}`, read.find(([h]) => h === head)?.[k], at(k));
    };
    info.tanks.forEach(({ name }, i) => line(name, info.units.length, fine.h[i]));
    info.pumps.forEach(({ name, unit }, j) => line(name, unit, fine.u[j]));
  }
  const count = text("#legend").match(/of (\\d+) plants, (\\d+) keep/);
  const astray = Number(text("#legend").match(/(\\d+) miss their setpoints/)?.[1] ?? 0);
  const plants = count && { count: Number(count[1]), kept: Number(count[2]), astray };
  const { sentence, good } = verdictOf(info, inForce, run, plants);
  same("verdict", text("#verdict"), sentence);
  same("colour", document.querySelector("#verdict").className, good ? "good" : "bad");
  const told = text("#message").match(/(\\d+) of (\\d+) (other )?plants/);
  if (told && !/^Judging|^Simul/.test(text("#message")) && !document.body.hasAttribute("aria-busy"))
    same("message", told[1], String(plants?.kept));
  for (const box of document.querySelectorAll("#groups .row input.number")) {
    const name = (box.getAttribute("aria-label") ?? "").split(" [")[0];
    const wanted = leaf.has(name) ? Number(valueOf(name).toPrecision(6)) : Number(box.value);
    same(`slider ${name}`, Number(box.value), wanted);
  }
  return faults;

  function valueOf(name) {
    const broken = [...document.querySelectorAll("#breaks [aria-pressed=true]")].length > 0;
    const box = document.querySelector(`input[aria-label^="${name}"]`);
    return broken ? Number(box.value) : inForce(name); // a fault is beside its slider
  }
}"""


def fuzz(live, clicks: int, seed: int) -> list[str]:
    """Do `clicks` random things on an opened page; return what it then shows wrongly."""
    rng, check = np.random.default_rng(seed), CHECK.replace("CORE", _script("core"))
    names, often = list(ACTIONS), np.array(list(ACTIONS.values()), dtype=float)
    found: list[str] = []
    live.page.evaluate("() => document.querySelectorAll('details').forEach((d) => (d.open = true))")
    for k in range(clicks):
        what = str(rng.choice(names, p=often / often.sum()))
        done = live(ACT, [what, float(rng.uniform()), float(rng.uniform())])
        faults: list[str] = []
        for _ in range(120):  # runs follow the sliders; a search may be under way
            live.page.wait_for_timeout(50)
            faults = live(check)
            if not faults:
                break
        if faults:
            found.append(f"{k}: after {what} {done}: {faults[:4]}")
            print(found[-1], flush=True)
    return found


def main(words: list[str]) -> int:
    """Fuzz the page of a case; 1 where it shows something wrong."""
    from browser import chromium, opened

    jax.config.update("jax_enable_x64", True)
    name, clicks, seed = [*words, *["cascaded/pi", "500", "0"][len(words) :]]
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        path = live_page(presets.find(name)).save(Path(folder, "page.html"))
        with opened(browser, path) as live:
            found = fuzz(live, int(clicks), int(seed))
    print(json.dumps({"case": name, "clicks": int(clicks), "wrong": len(found)}))
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
