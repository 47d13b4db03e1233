// The page: state, sliders, one run per frame, buttons. core.js, charts.js and rig.js are above.

const $ = (id) => document.getElementById(id);

function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes))
    if (value !== null && value !== undefined) node.setAttribute(name, value);
  node.append(...children.filter((child) => child !== null));
  return node;
}

const { unpacked } = window.jaxtank; // by loader.js
const data = JSON.parse(unpacked.data);
const engine = makeEngine();
const { info } = engine;
info.measures = info.measures.filter((m) => !m.name.startsWith("time_of_")); // as simulate prints them
info.filter.default_on = data.filter;
const leaves = info.leaves.filter((leaf) => leaf.value !== null);
const byName = new Map(leaves.map((leaf) => [leaf.name, leaf]));
// the entries of what is named, as controller.Kc or plant.rim[0]
const entriesOf = (names) => leaves.map((leaf) => leaf.name)
  .filter((name) => names.includes(name) || names.includes(name.split("[")[0]));
const state = {
  values: {}, // {leaf: number} that differ from the case
  filter: info.filter.present ? data.filter : null,
  seed: 0,
  broken: new Set(), // names of data.breaks
  free: new Set(entriesOf(info.free)),
};
const view = { from: 0, to: info.duration, at: info.duration, cursors: { A: null, B: null } };
const pins = []; // {name, run, words: what differs from the case}
const unseen = new Set(); // keys of the legend that are switched off
const framed = window !== window.parent; // in a report or a notebook
let took = 100; // milliseconds of the last run
let current = null, bands = null, worker = null, helpers = [], charts = [], rig = null;

// --- what a run takes -------------------------------------------------------------------------

const valueOf = (name) => state.values[name] ?? byName.get(name)?.value;

// the values that differ from the case, with what is broken
function effective() {
  const values = { ...state.values };
  for (const fault of data.breaks) {
    if (!state.broken.has(fault.name) || !byName.has(fault.leaf)) continue;
    const before = values[fault.leaf] ?? byName.get(fault.leaf).value;
    values[fault.leaf] = fault.factor === null ? fault.value : before * fault.factor;
  }
  return values;
}

const options = () => ({ seed: state.seed, filter: state.filter === true });

// the value of a leaf or of its entry in the loop as it runs, else what the case has
const inForce = (name, otherwise) => effective()[name] ?? byName.get(name)?.value ?? otherwise;
const rimOf = (i) => rimIn(info, inForce, i);
const pumpOf = (j) => ({
  lower: inForce(`actuator.low[${j}]`, info.pumps[j].lower), upper: inForce(`actuator.high[${j}]`, info.pumps[j].upper),
});

const limitsNow = () => limitsIn(info, inForce);

// engine.run, as this page prints its measures; of: what it is the run of
function runOf({ values, options: own }) {
  return printed(engine.run(values, own), values, own);
}

function printed(found, values, own) {
  if (!own.filter) delete found.measures.filter_active_fraction;
  return Object.assign(found, { values, of: keyOf(values, own) });
}

const keyOf = (values, { seed, filter }) => JSON.stringify([values, seed, filter]);

// the value of a leaf in a run, which sliders may have left
const within = ({ values }) => (name, otherwise) => values[name] ?? byName.get(name)?.value ?? otherwise;

const request = (values, every) => ({ values, options: { ...options(), every } });

const impossible = (text) => say(`This run is not possible: ${text}`);

// a run at once, on this thread: for files, scripts and pins; null where there is none
function run(values = effective(), every = data.drawn) {
  try {
    return runOf(request(values, every));
  } catch (error) {
    impossible(error.message);
    return null;
  }
}

// --- runs while sliders move --------------------------------------------------------------------

const SLOW = 1000; // a run that takes longer waits for the button [ms]
let asked = false, resting = 0, due = false, slow = false, done = 0;

const runner = makeRunner(newWorker, runOf, {
  done(found, { values, options: own }, milliseconds) {
    took = milliseconds;
    current = printed(found, values, own);
    due = runner.busy;
    slow = (done += 1) > 1 && milliseconds > SLOW; // the first is compiled while it runs
    $("run").textContent = `Run (${shown(milliseconds / 1000, 2)} s)`;
    mark();
    if (done === 1 && milliseconds > SLOW) touch();
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      show();
      rest();
    });
  },
  failed(text) {
    due = true; // the picture is of other values
    mark();
    impossible(text);
    rest();
  },
});

// whether the picture shows the values of the sliders, and the button that updates it
function mark() {
  $("run").hidden = !slow;
  $("run").disabled = runner.busy;
  $("slow-note").hidden = !slow;
  for (const id of ["verdict", "cursors", "panels", "margins", "measures"]) $(id).classList.toggle("stale", due);
}

function touch(every = data.drawn, pressed = false) {
  due = true;
  if (!slow || pressed) runner.ask(request(effective(), every));
  mark();
}

// the run of the sliders as they are; where a run takes long, the one that is shown
function present() {
  if (due && !slow) {
    current = run() ?? current;
    show();
  }
  return current;
}

function rest() {
  clearTimeout(resting);
  resting = setTimeout(settle, 250);
}

// once nothing moves: every sample of a part, the address, words for a screen reader, the plants
function settle() {
  if (runner.busy) return;
  const rows = ((view.to - view.from) / info.dt) / data.drawn;
  if (rows < 400 && !due && data.drawn > 1 && current && current.t.length < info.samples && !slow) touch(1);
  if (!framed) history.replaceState(null, "", linkOf(linked(), leaves));
  describe();
  if (!folded.isConnected) fold();
  if ($("plants").getAttribute("aria-pressed") === "true" && !bands && !worker) manyPlants(false);
}

// the state as a link has it: faults by their numbers
const linked = () => ({ ...state, faults: data.breaks.flatMap((one, i) => (state.broken.has(one.name) ? [i] : [])) });

function describe() {
  if (!current) return;
  charts.forEach(({ spec, describe: put }) => {
    const values = current[spec.what][spec.index], [low, high] = extent([values]);
    const limits = spec.limits.map(({ words }) => words).filter(Boolean).join(", ");
    put(`${spec.title}: from ${shown(low)} to ${shown(high)}, ${shown(values[values.length - 1])} at the end${
      limits ? `; ${limits}` : ""}`);
  });
  const first = info.measures.find((m) => m.name in info.objective.measures);
  const words = first ? `${first.name} ${cells(current.measures[first.name])} ${first.unit}` : "";
  $("spoken").textContent = [$("verdict").textContent, words].filter(Boolean).join(". ");
}

// a command designs the filter for the plant, the pumps and the noise that it is given
function noteFilter() {
  const groups = ["plant", "pumps", "sensor"];
  const moved = Object.keys(effective()).some((name) => groups.includes(byName.get(name)?.group));
  $("filter-note").hidden = !(state.filter && moved);
}

// own: by the search that runs; whatever else changes the loop ends it
function changed(own = false) {
  if (!own && tuneNow.stop) tuneNow.stop("Tuning stopped: the loop was changed");
  else if (!own && worker) stop(); // plants about other values
  noteFilter();
  if (!own && say.about) say("");
  if (bands) {
    bands = null;
    makeLegend();
  }
  touch();
}

// --- drawing ----------------------------------------------------------------------------------

function show() {
  if (!current) return;
  charts.forEach((chart) => {
    const { what, index, output } = chart.spec;
    chart.draw(current.t, {
      run: current[what][index],
      setpoint: what === "h" && output >= 0 && !unseen.has("setpoint") ? current.r[output] : null,
      pins: pins.map((pin) => (unseen.has(pin.name) ? null : onTimes(pin.run, what, index))),
      band: bands && !unseen.has("band") ? { t: bands.t, ...bands[what][index] } : null,
    });
  });
  showTables();
  showCursors();
  atTime(view.at);
  if (!offer.done) offer(current);
  if (!worker && !due) tested(current);
}

function onTimes(other, what, index) {
  const values = other[what][index];
  return other.t.length === current.t.length ? values : interpolated(other.t, values, current.t);
}

const sampleAt = (time) => clamp(indexOf(current.t, time + 1e-9) - 1, 0, current.t.length - 1);

function atTime(time) {
  view.at = clamp(time, 0, info.duration);
  if (!current) return;
  const k = sampleAt(view.at);
  const column = (list) => list.map((values) => values[k]);
  const h = column(current.h), r = column(current.r), u = column(current.u);
  const share = u.map((v, j) => {
    const { lower, upper } = pumpOf(j);
    return upper > lower ? clamp((v - lower) / (upper - lower), 0, 1) : 0.5;
  });
  const before = Math.max(0, k - 1);
  const spills = (current.spilled ?? []).map((values) => values[k] > values[before]);
  if (rig) rig.update({ h, r, u, share, spills, rims: info.tanks.map((_, i) => rimOf(i)) });
  charts.forEach(({ spec, read }) => {
    const { what, index, output, unit } = spec;
    const target = what === "h" && output >= 0 ? `, setpoint ${shown(r[output])}` : "";
    const others = pins.filter((pin) => !unseen.has(pin.name))
      .map((pin) => `, ${pin.name} ${shown(onTimes(pin.run, what, index)[k])}`).join("");
    read(`${shown((what === "h" ? h : u)[index])}${unit === "-" ? "" : ` ${unit}`}${target}${others}`);
  });
  $("now").textContent = momentOf(view.at, info.duration);
  $("time").value = Math.round((1000 * view.at) / info.duration);
  $("time").setAttribute("aria-valuetext", momentOf(view.at, info.duration));
}

// --- cursors: every line that is shown, read at one or two times ----------------------------------

let earlier = view.cursors; // before the last click

// again: by the second of two clicks, which are no cursor
function setCursor(name, time, again = false) {
  if (!current) return;
  if (!again) earlier = view.cursors;
  view.cursors = again ? earlier : { ...earlier, [name]: time === null ? null : current.t[sampleAt(time)] };
  show();
}

function clearCursors() {
  view.cursors = { A: null, B: null };
  show();
}

function showCursors() {
  const { A, B } = view.cursors, set = Object.keys(view.cursors).filter((name) => view.cursors[name] !== null);
  const row = (head, values, digits) => ({
    head, cells: [...values, ...(set.length > 1 ? [values[1] - values[0]] : [])].map((value) => shown(value, digits)),
  });
  const times = set.map((name) => view.cursors[name]);
  const line = (head, { t }, values) => row(head, interpolated(t, values, times));
  const lines = charts.flatMap(({ spec: { name, what, index, output, unit } }) => [
    line(bracketed(name, unit), current, current[what][index]),
    ...(what === "h" && output >= 0 && !unseen.has("setpoint") ? [line(bracketed(`${name}, setpoint`, unit), current, current.r[output])] : []),
    ...pins.filter((pin) => !unseen.has(pin.name)).map((pin) => line(bracketed(`${name}, ${pin.name}`, unit), pin.run, pin.run[what][index])),
  ]);
  fill($("cursors"), "Cursors", ["", ...set, ...(set.length > 1 ? ["B − A"] : [])], set.length ? [row(`time [${timeUnit(info.duration)[0]}]`, times.map((t) => t / timeUnit(info.duration)[1]), 6), ...lines] : []);
  $("cursor-a").setAttribute("aria-pressed", String(A !== null));
  $("cursor-b").setAttribute("aria-pressed", String(B !== null));
}

function zoom(from, to) {
  const least = info.duration / 2000;
  view.from = clamp(from, 0, info.duration - least);
  view.to = clamp(to, view.from + least, info.duration);
  show();
  rest();
}

const cells = (value) =>
  (typeof value === "number" || value === null || value === undefined ? [value] : Array.from(value))
    .map((v) => shown(v)).join(", ");

const bracketed = (name, unit) => (unit && unit !== "-" ? `${name} [${unit}]` : name);

function showTables() {
  const margins = marginsOf(limitsIn(info, within(current)), current.measures), { sentence, good } = verdict(current);
  $("verdict").textContent = sentence;
  $("verdict").className = `${good ? "good" : "bad"}${due ? " stale" : ""}`;
  if (!good) reveal(margins[0]);
  const pinned = pins[pins.length - 1];
  fill($("margins"), "Limits", ["", "value", "margin"], margins.map(({ limit, value, margin }) => ({
    head: `${limit.words} ${limit.lower === null || limit.lower === undefined ? "≤" : "≥"} ${
      shown(limit.upper ?? limit.lower)} ${limit.unit}`,
    cells: [shown(value), shown(margin, 3)],
    bad: margin < 0,
  })));
  const rows = info.measures.filter((m) => current.measures[m.name] !== undefined).map((m) => ({
    head: bracketed(m.name, m.unit),
    title: m.doc,
    cells: [cells(current.measures[m.name]), ...(pinned ? [cells(pinned.run.measures[m.name])] : [])],
  }));
  fill($("measures"), "Measures", ["", "now", ...(pinned ? [pinned.name] : [])], rows);
}

// where the charts lie side by side: that of the tank whose limit is broken, else of the largest last error
function reveal(tightest) {
  const ofTank = tightest?.margin < 0 && ["max_level", "min_level", "overflow_volume"].includes(tightest.limit.measure);
  const errors = Array.from([current.measures.steady_state_error ?? []].flat(), (error) => error || 0);
  const tank = ofTank ? tightest.limit.entry : info.outputs[errors.indexOf(Math.max(...errors))];
  const named = charts[tank];
  if (!named || named === reveal.last) return;
  reveal.last = named;
  $("panels").scrollLeft = named.figure.offsetLeft - $("panels").offsetLeft;
}

// the verdict on a run, with the plants about it where they were simulated
const verdict = (found) => verdictOf(info, within(found), found, found.of === keyOf(effective(), options()) ? bands : null);

// a name that may be broken after each "_"
const broken = (text) => text.split(/(?<=_)/).flatMap((part, i) => (i ? [make("wbr"), part] : [part]));

// a table, its cells replaced and not made anew where its shape stays
function fill(host, caption, heads, rows) {
  const shape = JSON.stringify([heads, rows.map((row) => row.head)]);
  if (host.dataset.shape !== shape) {
    host.dataset.shape = shape;
    const head = make("tr", {}, ...heads.map((text) => make(text ? "th" : "td", text ? { scope: "col" } : {}, text)));
    const body = rows.map((row) => make("tr", {}, make("th", { scope: "row", title: row.title }, ...broken(row.head)),
      ...row.cells.map(() => make("td"))));
    host.replaceChildren(...(rows.length
      ? [make("table", {}, make("caption", {}, caption), make("thead", {}, head), make("tbody", {}, ...body))]
      : []));
  }
  const lines = host.querySelectorAll("tbody tr");
  rows.forEach((row, i) => {
    lines[i].classList.toggle("bad", Boolean(row.bad));
    row.cells.forEach((text, j) => {
      const cell = lines[i].cells[j + 1];
      if (cell.textContent !== text) cell.textContent = text;
    });
  });
}

// about: whether it is about this run or its plants, and goes with them
function say(text, about = false) {
  $("message").textContent = text;
  say.about = about;
}

// --- sliders ----------------------------------------------------------------------------------

const rows = new Map(); // {leaf name: {update, row}}

function setLeaf(name, value) {
  const leaf = byName.get(name), { low, high } = scaleOf(leaf);
  const next = clamp(value, low, high);
  if (next === leaf.value) delete state.values[name];
  else state.values[name] = next;
  rows.get(name)?.update();
  changed();
}

const DECIMAL = /^[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i;

function slider(leaf) {
  const scale = scaleOf(leaf), id = `leaf-${rows.size}`;
  const words = leaf.unit && leaf.unit !== "-" ? ` [${leaf.unit}]` : "";
  const title = `${leaf.name}: ${leaf.doc}`;
  const range = make("input", { type: "range", min: 0, max: STEPS, id, title });
  // a box of type number drops the comma of "0,2"; a keyboard of digits may have no minus
  const number = make("input", { type: "text", class: "number", autocomplete: "off",
    inputmode: scale.low < 0 ? "text" : "decimal", "aria-label": `${leaf.name}${words}` });
  const typed = () => DECIMAL.test(number.value.trim()) ? Number(number.value) : NaN;
  const label = make("label", { for: id, title }, leaf.label, make("span", { class: "unit" }, words));
  const row = make("div", { class: "row", "data-leaf": leaf.name }, label, number, range);
  let ticked = () => {};
  if (state.free.has(leaf.name)) {
    const free = make("input", { type: "checkbox", "aria-label": `tune ${leaf.label}` });
    free.checked = true;
    ticked = () => (free.checked = state.free.has(leaf.name));
    free.addEventListener("change", () => state.free[free.checked ? "add" : "delete"](leaf.name));
    row.classList.add("tunable");
    row.append(make("label", { class: "free", title: "changed by Tune" }, free, "tune"));
  }
  range.style.setProperty("--default", positionOf(leaf.value, scale) / STEPS);
  let dragged = false;
  const set = (value) => setLeaf(leaf.name, value);
  const update = () => {
    const value = valueOf(leaf.name);
    range.value = positionOf(value, scale);
    range.setAttribute("aria-valuetext", `${shown(value)} ${leaf.unit}`);
    if (document.activeElement !== number) number.value = Number(value.toPrecision(6));
    row.classList.toggle("moved", leaf.name in state.values);
    ticked();
  };
  range.addEventListener("pointerdown", () => (dragged = true));
  range.addEventListener("pointerup", () => (dragged = false));
  range.addEventListener("input", () => {
    const position = Number(range.value);
    const near = Math.abs(position - positionOf(leaf.value, scale)) <= (dragged ? 8 : 0);
    set(near ? leaf.value : valueAt(position, scale));
  });
  range.addEventListener("dblclick", () => set(leaf.value));
  let settled;
  number.addEventListener("focus", () => (settled = valueOf(leaf.name)));
  number.addEventListener("input", () => {
    const value = typed();
    const good = Number.isFinite(value) && value >= scale.low && value <= scale.high;
    number.setAttribute("aria-invalid", String(!good));
    if (good) set(value);
  });
  number.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || settled === undefined) return;
    event.stopPropagation(); // else both cursors go
    number.setAttribute("aria-invalid", "false");
    set(settled);
    number.value = Number(settled.toPrecision(6));
  });
  number.addEventListener("blur", () => update());
  number.addEventListener("change", () => {
    const value = typed();
    if (!Number.isFinite(value)) {
      const text = number.value.trim();
      set(settled ?? valueOf(leaf.name)); // not the 0 of "0,2"
      if (text) say(`${leaf.label} = ${text}: must be a number, with a decimal point`, true);
      number.value = valueOf(leaf.name);
    } else if (value < scale.low || value > scale.high) {
      number.value = clamp(value, scale.low, scale.high);
      set(clamp(value, scale.low, scale.high));
      say(`${leaf.label} = ${shown(value)} ${leaf.unit}: from ${shown(scale.low)} to ${shown(scale.high)}`, true);
    }
    settled = valueOf(leaf.name);
    number.setAttribute("aria-invalid", "false");
  });
  rows.set(leaf.name, { row, update });
  update();
  return row;
}

// numbers without a slider: of models, and of the safety filter, which a command designs anew
const HIDDEN = ["model", "safety filter"];

function makeSliders() {
  const groups = new Map();
  for (const leaf of leaves) {
    if (HIDDEN.includes(leaf.group)) continue;
    const own = state.free.has(leaf.name) ? "tuned gains" : leaf.group;
    if (!groups.has(own)) groups.set(own, []);
    groups.get(own).push(leaf);
  }
  const order = ["tuned gains", "controller", "reference", "plant", "pumps", "disturbance", "sensor"];
  const rank = (name) => (order.includes(name) ? order.indexOf(name) : order.length);
  for (const [name, own] of [...groups].sort((a, b) => rank(a[0]) - rank(b[0]))) {
    const count = make("span", { class: "unit" }, ` ${own.length}`);
    const group = make("details", { class: "group" }, make("summary", {}, name, count), ...own.map(slider));
    group.open = rank(name) === 0 || (!groups.has(order[0]) && rank(name) === 1);
    for (const leaf of own) rows.get(leaf.name).home = group;
    if (name === "sensor" && info.noise) group.append(seedRow());
    $("groups").append(group);
  }
  folded.addEventListener("toggle", () => folded.open && fold());
}

// sliders without effect on the current run are folded away; a second worker finds them
const folded = make("details", { class: "group", id: "idle" }, make("summary", {}, "no effect on this run",
  make("span", { class: "unit" })), make("p", { class: "hint" },
  "The run is the same at both ends of these sliders. Opening this group tries them again."));
let trying = null;

function fold() {
  if (slow || trying) return;
  const limits = new Set(info.limits.map(({ follows }) => follows));
  const tried = leaves.filter(({ name }) => rows.has(name) && !state.free.has(name) && !limits.has(name));
  const names = tried.map((leaf) => {
    const { low, high } = scaleOf(leaf);
    return { name: leaf.name, ends: [high, low] };
  });
  trying = newWorker();
  const end = () => {
    trying.terminate();
    trying = null;
  };
  trying.onerror = end;
  trying.onmessage = ({ data: answer }) => {
    end();
    if (answer.kind !== "effects") return;
    const below = new Map(); // {place: the row that stands next in it}; a row that stays keeps its focus
    for (const [name, { row, home }] of [...rows].reverse()) {
      const place = answer.without.includes(name) ? folded : home;
      if (row.parentNode !== place) place.insertBefore(row, below.get(place) ?? null);
      below.set(place, row);
    }
    if (folded !== $("groups").lastElementChild) $("groups").append(folded);
    for (const group of $("groups").children) {
      const count = group.querySelectorAll(".row").length;
      group.querySelector("summary .unit").textContent = ` ${count}`;
      group.classList.toggle("empty", !count);
    }
    search();
  };
  trying.postMessage({ kind: "effects", values: effective(), names, every: Math.ceil(info.samples / 400), ...options() });
}

function seedRow() {
  const input = make("input", { type: "number", min: 0, max: 2 ** 31 - 1, step: 1, id: "seed" });
  input.value = state.seed;
  input.addEventListener("change", () => {
    const value = Math.trunc(Number(input.value));
    state.seed = Number.isFinite(value) ? clamp(value, 0, 2 ** 31 - 1) : 0;
    input.value = state.seed;
    changed();
  });
  return make("div", { class: "row" }, make("label", { for: "seed" }, "seed of the noise"), input);
}

function search() {
  const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  let any = false;
  for (const group of $("groups").children) {
    let here = false;
    group.querySelectorAll(".row").forEach((row) => {
      const label = row.querySelector("label"), text = `${label.textContent} ${label.title}`.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
      here ||= !row.hidden;
    });
    group.hidden = !here;
    if (words.length && here && group !== folded) group.open = true;
    any ||= here;
  }
  $("nothing").hidden = any;
}

function refresh() {
  rows.forEach(({ update }) => update());
  if ($("seed")) $("seed").value = state.seed;
  $("filter").checked = state.filter === true;
  noteFilter();
  document.querySelectorAll("#breaks button").forEach((button) =>
    button.setAttribute("aria-pressed", String(state.broken.has(button.textContent))));
  changed();
}

// --- buttons ----------------------------------------------------------------------------------

function keep(name, found, words = "") {
  const old = pins.findIndex((other) => other.name === name);
  if (old >= 0) pins.splice(old, 1);
  if (pins.length === PINS) pins.shift();
  pins.push({ name, run: found, words });
}

// what sets the run apart from the case, in words
function differences() {
  const words = Object.entries(state.values).map(([name, value]) => `${byName.get(name).label} ${shown(value)}`);
  words.push(...state.broken);
  if (state.filter !== (info.filter.present ? data.filter : null)) words.push(`filter ${state.filter ? "on" : "off"}`);
  return `${words.slice(0, 2).join(", ")}${words.length > 2 ? ` and ${words.length - 2} more` : ""}` || "the case";
}

function pin(name) {
  if (!present()) return;
  keep(name, current, differences());
  makeLegend();
  show();
}

function makeLegend() {
  const key = (kind, text, name = kind) => {
    const button = make("button", { type: "button", class: `key ${kind}`, "aria-pressed": String(!unseen.has(name)),
      title: "show or hide" }, text);
    button.addEventListener("click", () => {
      unseen[unseen.has(name) ? "delete" : "add"](name);
      makeLegend();
      show();
    });
    return button;
  };
  const own = pins.map((one, i) => {
    const remove = make("button", { type: "button", "aria-label": `remove ${one.name}` }, "×");
    remove.addEventListener("click", () => {
      pins.splice(pins.indexOf(one), 1);
      unseen.delete(one.name);
      makeLegend();
      show();
    });
    const words = one.words ? `${one.name}: ${one.words}` : one.name;
    return make("span", { class: "pinned" }, key(`pin${i}`, words, one.name), remove);
  });
  $("legend").replaceChildren(make("span", { class: "key run" }, "this run"), ...own, key("setpoint", "setpoint"),
    ...(bands ? [key("band", `90 % of ${data.plants} plants${bands.words}`)] : []));
}

function newWorker() {
  const text = [unpacked.engine, unpacked.core, unpacked.worker];
  const url = URL.createObjectURL(new Blob([text.join("\n")], { type: "text/javascript" }));
  const made = new Worker(url);
  URL.revokeObjectURL(url);
  return made;
}

function stop() {
  for (const each of [worker, ...helpers]) each?.terminate();
  worker = tuneNow.stop = null;
  helpers = [];
  $("tune").textContent = "Tune";
  document.body.removeAttribute("aria-busy");
}

const WORKERS = Math.min(8, navigator.hardwareConcurrency || 1); // that share the runs of many plants

// starts a worker and its helpers; answers: {kind: function}, each called with the message
function ask(message, answers) {
  stop();
  worker = newWorker();
  helpers = Array.from({ length: WORKERS - 1 }, newWorker);
  const ports = helpers.map((helper) => {
    const { port1, port2 } = new MessageChannel();
    helper.postMessage({ kind: "serve" }, [port1]);
    return port2;
  });
  document.body.setAttribute("aria-busy", "true");
  worker.onmessage = ({ data: answer }) => {
    if (answer.kind !== "progress") stop();
    answers[answer.kind](answer);
  };
  const failed = (event) => {
    stop();
    answers.failed({ text: event.message });
  };
  for (const each of [worker, ...helpers]) each.onerror = failed;
  worker.postMessage(message, ports);
}

// what a search on plants sets beside the sliders: noise where there is none, and a safety filter for it
function taskValues(now) {
  const noisy = leaves.some(({ name, value }) => name.startsWith("sensor.noise") && (now[name] ?? value) > 0);
  return Object.fromEntries(Object.entries(info.task.values).filter(([name]) => !(name.startsWith("sensor.noise") && noisy)));
}

// values of the loop, and the shares by which plants differ from it; task: as a search on plants has them
function plantsNow(task = false) {
  const spread = {}, now = effective(), values = { ...(task ? taskValues(now) : {}), ...now };
  for (const leaf of leaves) {
    const share = data.uncertain[leaf.name] ?? data.uncertain[leaf.name.split("[")[0]];
    if (share === undefined || HIDDEN.includes(leaf.group)) continue;
    spread[leaf.name] = share;
    values[leaf.name] = now[leaf.name] ?? leaf.value;
  }
  const measures = [...new Set(["rms_error_total", ...info.limits.map((limit) => limit.measure)])];
  return { values, spread, measures, limits: limitsNow(), every: Math.max(1, Math.ceil(info.samples / 400)), ...options() };
}

const SEARCHED = { least: 16, most: 64, milliseconds: 15 }; // plants of a search: fewer where a run takes longer

// plants: how many the search runs on, 1: this loop alone
function tuneNow(plants = null) {
  let best = null, finish = null;
  const names = [...state.free], before = { ...state.values }, filtered = state.filter;
  const base = plantsNow(plants !== 1);
  const varied = Object.keys(base.spread).length > 0;
  const quick = Math.floor((WORKERS * SEARCHED.least * SEARCHED.milliseconds) / Math.max(1, took));
  const searched = varied ? plants ?? clamp(quick, SEARCHED.least, SEARCHED.most) : 1;
  const promise = new Promise((resolve, reject) => (finish = { resolve, reject }));
  const apply = (found) => {
    for (const name of names)
      if (found.values && Number.isFinite(found.values[name])) state.values[name] = found.values[name];
    rows.forEach(({ update }) => update());
    changed(true);
  };
  if (!names.length) {
    say("Mark at least one parameter with tune.");
    return Promise.reject(new Error("no free parameter"));
  }
  pin("before tuning");
  const alone = data.scenarios ? ` For this run alone; jaxtank tune takes the mean of ${data.scenarios} scenario${data.scenarios > 1 ? "s" : ""}.` : "";
  const words = (found) => `objective ${shown(found.objective)}${
    found.violation > 0 ? `, limits exceeded by ${shown(100 * found.violation, 3)} %` : ""}`;
  const on = searched > 1 ? ` on ${searched} plants` : "";
  ask({ kind: "tune", ...base, free: names, searched, judged: varied ? data.plants : 1 }, {
    progress(now) {
      if (now.of) return say(`Judging on ${now.of} plants: ${now.done} done`);
      if (!best || now.values) best = now;
      say(`Tuning ${names.length === 1 ? "one parameter" : `${names.length} parameters`}${on}: iteration ${now.iterations}, ${words(now)}`);
      if (now.values) apply(now);
    },
    tuned(found) {
      const { kept, count, error } = found.plants, unit = info.units.length;
      const switched = found.filter && !state.filter;
      if (switched) {
        state.filter = $("filter").checked = true;
        noteFilter();
      }
      apply(found);
      runner.drop(); // of other values than these plants
      current = run() ?? current;
      if (varied) {
        bands = { ...found.plants, words: keptWords(found.plants) };
        $("plants").setAttribute("aria-pressed", "true");
        makeLegend();
      }
      due = false;
      show();
      touch(data.drawn, true);
      const holds = (varied && info.limits.length ? `; limits hold on ${kept} of ${count} other plants` : "") +
        (varied && found.plants.astray ? `; ${astrayWords(found.plants)}` : "");
      const errors = `error ${shown(found.before, 3)} to ${shown(error, 3)} ${unit}${varied ? " in the mean" : ""}`;
      const ends = found.ends.map((name) => `; ${name} ends on its range`).join("");
      const noise = searched > 1 ? " with noise and a price on input changes" : "";
      const peak = searched > 1 ? " Ms is not computed here; jaxtank tune keeps it at most 2.5 where it can." : "";
      const guard = state.filter && !filtered ? ", safety filter switched on" : "";
      say(`Tuned${on}${noise}${guard} in ${found.iterations} iterations (${found.status})${holds}; ${errors}${ends}.${peak}${alone}${mission?.tuned?.(current) ?? ""}`, true);
      const tuned = { ...state.values };
      $("undo").hidden = false;
      $("undo").onclick = () => {
        for (const name of names) {
          if (state.values[name] !== tuned[name]) continue; // changed since
          if (name in before) state.values[name] = before[name];
          else delete state.values[name];
        }
        if (switched) state.filter = false;
        $("undo").hidden = true;
        refresh();
        say("The values before tuning are set again.");
      };
      const { objective, violation, filter } = found;
      const values = Object.fromEntries(names.map((name) => [name, found.values[name]]));
      finish.resolve({ values, objective, violation, filter, holds: kept, of: count, ends: found.ends });
    },
    failed({ text }) {
      say(`Tuning failed: ${text}`);
      finish.reject(new Error(text));
    },
  });
  $("undo").hidden = true;
  $("tune").textContent = "Stop";
  tuneNow.stop = (why = "Tuning stopped") => {
    stop();
    say(`${why}; ${best ? `the best so far is set: ${words(best)}` : "nothing was found yet"}.`);
    finish.resolve(best);
  };
  return promise;
}

const keptWords = ({ kept, astray }) =>
  (info.limits.length ? `, ${kept} keep every limit` : "") + (astray ? `, ${astray} miss their setpoints` : "");

// spoken: whether the message says how many; not where they follow a slider or a search
function manyPlants(spoken = true) {
  tuneNow.stop?.();
  ask({ kind: "plants", count: data.plants, ...plantsNow() }, {
    progress: ({ done, of }) => spoken && say(`Simulating ${of} plants: ${done} done`),
    plants(found) {
      bands = { ...found, words: keptWords(found) };
      const kept = info.limits.length ? `${found.kept} of ${found.count} plants keep every limit` :
        `${found.count} plants simulated`;
      if (spoken) say(`${kept}${found.astray ? `; ${found.astray} do not keep to their setpoints` : ""}${found.broken ? `; ${found.broken} diverged` : ""}. The band holds 90 % of them at each time.`, true);
      makeLegend();
      show();
    },
    failed: ({ text }) => say(`The plants could not be simulated: ${text}`),
  });
}

async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    say(`${what} copied.`);
  } catch {
    const area = make("textarea", { readonly: "", "aria-label": what });
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    say(done ? `${what} copied.` : text);
  }
}

function download(name, blob) {
  const url = URL.createObjectURL(blob);
  const link = make("a", { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 1000);
}

// the charts as one picture, two in a row, their titles above them, below all the keys of the lines
function png() {
  const all = charts.map(({ figure, spec }) => ({ canvas: figure.querySelector("canvas"), title: spec.title }));
  const scale = devicePixelRatio, head = 22 * scale, across = all.length > 2 ? 2 : 1;
  const width = Math.max(...all.map(({ canvas }) => canvas.width)), height = head + Math.max(...all.map(({ canvas }) => canvas.height));
  const keys = [["this run", "--run"], ["setpoint", "--setpoint"], ...pins.map((pin, i) => [`${pin.name}: ${pin.words}`, `--pin${i}`, pin.name])]
    .filter(([name, , own = name]) => !unseen.has(own));
  const below = Math.ceil(all.length / across) * height;
  const whole = make("canvas", { width: across * width, height: below + head * keys.length });
  const ctx = whole.getContext("2d");
  ctx.fillStyle = colour("--back");
  ctx.fillRect(0, 0, whole.width, whole.height);
  ctx.fillStyle = colour("--text");
  ctx.font = `${12 * scale}px system-ui, sans-serif`;
  all.forEach(({ canvas, title }, i) => {
    const x = (i % across) * width, y = Math.floor(i / across) * height;
    ctx.fillText(title, x + 8 * scale, y + 15 * scale);
    ctx.drawImage(canvas, x, y + head);
  });
  keys.forEach(([words, name], i) => {
    ctx.fillStyle = colour(name);
    ctx.fillText(`— ${words}`, 8 * scale, below + 15 * scale + i * head);
  });
  whole.toBlob((blob) => download(`${fileName}.png`, blob), "image/png");
}

const fileName = info.case.replace(/[^\w-]+/g, "-");

const csv = () => {
  const found = run(effective(), data.every);
  return found && csvOf(found, info);
};

// the command that repeats the run: all that differs from the preset or the file
function command() {
  const now = effective(), { origin } = data, words = ["jaxtank simulate", origin.words];
  for (const leaf of leaves) {
    const value = now[leaf.name] ?? leaf.value;
    if (value !== (origin.values[leaf.name] ?? leaf.value)) words.push(`--set ${leaf.name.includes("[") ? `'${leaf.name}=${value}'` : `${leaf.name}=${value}`}`);
  }
  if (state.filter && origin.guard) words.push(origin.guard);
  if (state.filter !== null && state.filter !== origin.filtered)
    words.push(state.filter ? "--safety-filter" : "--no-safety-filter");
  if (state.seed) words.push(`--seed ${state.seed}`);
  return words.join(" ");
}

const toml = () => tomlOf(data.toml, info.leaves, effective(), state.filter);

function initial() {
  state.values = {};
  state.broken.clear();
  state.seed = 0;
  state.filter = info.filter.present ? data.filter : null;
}

function reset() {
  mission = null;
  tuneNow.stop?.();
  stop();
  initial();
  state.free = new Set(entriesOf(info.free));
  pins.length = 0;
  $("undo").hidden = true;
  bands = null;
  $("plants").setAttribute("aria-pressed", String(data.band));
  clearCursors();
  zoom(0, info.duration);
  makeLegend();
  refresh();
  say("Reset to the case.");
}

let played = 0;

function play(yes) {
  cancelAnimationFrame(played);
  $("play").setAttribute("aria-pressed", String(yes));
  $("play").textContent = yes ? "Pause" : "Play";
  if (!yes) return;
  if (view.at >= info.duration) atTime(0);
  let last = performance.now();
  const frame = (now) => {
    const next = view.at + ((now - last) / 12000) * info.duration;
    last = now;
    moveCursor(next);
    if (next >= info.duration) play(false);
    else played = requestAnimationFrame(frame);
  };
  played = requestAnimationFrame(frame);
}

function moveCursor(time) {
  atTime(time);
  charts.forEach((chart) => chart.at(view.at));
}

// --- missions ---------------------------------------------------------------------------------

let mission = null; // {solved(found) -> words or null}: what the run that is shown is tested for

const exceeded = (found) => marginsOf(limitsNow(), found.measures).filter(({ margin }) => margin < 0);

function begin(one) {
  reset();
  say(one.start());
  $("runs").scrollIntoView?.({ block: "nearest" });
}

function tested(found) {
  const words = mission?.solved(found);
  if (!words) return;
  mission = null;
  say(words);
}

// one gain against all limits, a fault by its traces, and the least error within the limits
const MISSIONS = [{
  name: "One gain alone",
  text: "Keep every limit with one gain",
  possible: (found) => info.free.length && exceeded(found).length && !state.filter,
  start() {
    const name = entriesOf(info.free).at(-1), { label } = byName.get(name);
    mission = {
      solved: (found) => Object.keys(state.values).every((moved) => moved === name) && !state.broken.size && !state.filter &&
        !exceeded(found).length && `Done: with ${label} = ${shown(valueOf(name))} every limit holds, and the error is ${
          shown(found.measures.rms_error_total)} ${info.units.length}.`,
    };
    return `Mission: make every limit hold by moving ${label} alone. The verdict names the limit that is broken.`;
  },
}, {
  name: "Find the fault",
  text: "Something is broken: find out what",
  possible: () => $("breaks").querySelectorAll("button").length > 1,
  start() {
    const known = data.breaks.filter((one) => byName.has(one.leaf));
    const secret = known[Math.floor(Math.random() * known.length)].name;
    state.broken.add(secret);
    const faulty = run();
    state.broken.clear();
    if (!faulty) return "";
    keep("the plant", faulty, "with a fault");
    makeLegend();
    refresh();
    $("breaks").open = true;
    mission = {
      solved: () => state.broken.size === 1 && (state.broken.has(secret) ? `Done: ${secret} it is.`
        : (say(`Not ${[...state.broken][0]}: compare the curves with those of the plant, tank by tank.`), null)),
    };
    return "Mission: the dashed curves are of a plant with one fault. Which button under Break something gives the same?";
  },
}, {
  name: "Guess the frontier",
  text: "How small can the error be within the limits?",
  possible: () => info.tracks && info.free.length && info.limits.length,
  start() {
    let least = Infinity;
    mission = {
      solved: (found) => {
        if (!exceeded(found).length) least = Math.min(least, found.measures.rms_error_total);
        return null;
      },
      tuned(found) {
        const { length } = info.units, reached = found.measures.rms_error_total;
        const own = Number.isFinite(least) ? `${shown(least)} ${length}` : "no run within the limits";
        return ` Your best within the limits: ${own}; the search: ${shown(reached)} ${length}${
          exceeded(found).length ? ", past a limit" : least <= 1.02 * reached ? ". You have found the frontier" : ""}.`;
      },
    };
    return "Mission: move the gains to the smallest error with every limit kept, then press Tune this plant to compare.";
  },
}];

// those that the first run allows
function offer(found) {
  const offered = MISSIONS.filter(({ possible }) => possible(found));
  chips($("missions").querySelector(".chips"), offered, false, begin);
  $("missions").hidden = !offered.length;
  offer.done = true;
}

// --- start ------------------------------------------------------------------------------------

function makeCharts() {
  let drawn = false; // the charts that share the cursor report the same selection
  const once = (from, to) => {
    if (drawn) return;
    drawn = true;
    zoom(from, to);
    setTimeout(() => (drawn = false));
  };
  const on = { cursor: atTime, zoom: once, whole: () => zoom(0, info.duration), handle: handleOf, drag: setLeaf,
    mark: setCursor };
  const { length } = info.units;
  info.tanks.forEach((tank, i) => {
    const rim = rimOf(i), output = info.outputs.indexOf(i);
    const limits = rim === null || rim === undefined ? [] : [{
      get value() { return rimOf(i); },
      get words() { return `rim ${shown(rimOf(i))} ${length}`; },
    }];
    for (const { measure, entry, upper, lower, follows } of info.limits) {
      const value = upper ?? lower;
      if (entry === i && !follows && ["max_level", "min_level"].includes(measure) && value !== rim && value > 0)
        limits.push({ value, words: `limit ${shown(value)} ${length}` });
    }
    charts.push(makeChart($("panels"), {
      kind: "level", name: tank.name, what: "h", index: i, output, unit: length, zero: true, limits,
      get forbidden() { return rimOf(i); }, title: `${tank.name}${output >= 0 ? ", controlled" : ""} [${length}]`,
    }, view, on));
  });
  info.pumps.forEach((pump, j) => {
    const ends = ["lower", "upper"].map((end) => ({
      get value() { return pumpOf(j)[end]; },
      get words() { return end === "upper" ? `at most ${shown(pumpOf(j).upper)} ${pump.unit}` : ""; },
    }));
    charts.push(makeChart($("panels"), {
      kind: "input", name: pump.name, what: "u", index: j, unit: pump.unit, zero: true, title: bracketed(pump.name, pump.unit),
      limits: ends.filter(({ value }) => Number.isFinite(value) && Math.abs(value) < 100 * (1 + Math.abs(info.pumps[j].typical ?? 1))),
    }, view, on));
  });
  $("panels").dataset.count = charts.length;
  // beside the charts, which do not move when it appears; where they fill the width below them
  const narrow = matchMedia("(max-width: 700px)");
  const place = () => (narrow.matches ? $("runs").append($("cursors")) : $("side").prepend($("cursors")));
  narrow.addEventListener("change", place);
  place();
  new ResizeObserver(() => {
    charts.forEach((chart) => chart.size());
    show();
  }).observe($("panels"));
  charts.forEach((chart) => chart.size());
}

// the parameter whose line in a chart is at a time and near a value, as {name, value}; the setpoint before the rim
function handleOf({ what, index, output }, time, near) {
  if (what !== "h") return null;
  const steps = info.setpoints.filter(([name, channel, from]) => channel === output && from <= time && byName.has(name));
  const names = output >= 0 ? steps.slice(-1).map(([name]) => name) : [];
  const rim = byName.has(`plant.rim[${index}]`) ? `plant.rim[${index}]` : "plant.rim";
  return [...names, rim].filter((name) => byName.has(name)).map((name) => ({ name, value: inForce(name) }))
    .find(({ value }) => near(value)) ?? null;
}

function chips(host, list, pressed, act) {
  host.replaceChildren(...list.map((one) => {
    const button = make("button", { type: "button", title: one.text, "aria-pressed": pressed ? "false" : null }, one.name);
    button.addEventListener("click", () => act(one, button));
    return button;
  }));
}

function listen() {
  $("search").addEventListener("input", search);
  $("filter").addEventListener("change", () => {
    state.filter = $("filter").checked;
    changed();
  });
  let number = 0;
  $("pin").addEventListener("click", () => pin(`run ${(number += 1)}`));
  $("reset").addEventListener("click", reset);
  $("run").addEventListener("click", () => touch(data.drawn, true));
  $("tune").addEventListener("click", () => (tuneNow.stop ? tuneNow.stop() : tuneNow().catch(() => {})));
  $("nominal").addEventListener("click", () => tuneNow(1).catch(() => {}));
  $("plants").addEventListener("click", () => {
    const on = $("plants").getAttribute("aria-pressed") !== "true";
    $("plants").setAttribute("aria-pressed", String(on));
    if (on) manyPlants();
    else {
      if (!tuneNow.stop) stop();
      bands = null;
      makeLegend();
      show();
    }
  });
  $("copy-command").addEventListener("click", () => copy(command(),
    data.origin.copied ? "Command (of the rig file of Copy TOML, saved as rig.toml)" : "Command"));
  $("copy-toml").addEventListener("click", () => copy(toml(), "Rig file"));
  $("csv").addEventListener("click", () => {
    const text = csv();
    if (text) download(`${fileName}.csv`, new Blob([text], { type: "text/csv" }));
  });
  $("png").addEventListener("click", png);
  $("link").addEventListener("click", () => {
    const link = linkOf(linked(), leaves);
    copy(location.href.split("#")[0] + link, "Link");
  });
  $("time").addEventListener("input", () => moveCursor((Number($("time").value) / 1000) * info.duration));
  $("play").addEventListener("click", () => play($("play").getAttribute("aria-pressed") !== "true"));
  for (const name of ["A", "B"]) $(`cursor-${name.toLowerCase()}`).addEventListener("click", () =>
    setCursor(name, view.cursors[name] === null ? view.at : null));
  document.addEventListener("keydown", ({ key, target }) => key === "Escape" && target !== $("search") && clearCursors());
  $("closer").addEventListener("click", () => {
    const half = (view.to - view.from) / 4;
    zoom(view.at - half, view.at + half);
  });
  $("whole").addEventListener("click", () => zoom(0, info.duration));
  window.addEventListener("hashchange", open);
  for (const query of ["(prefers-color-scheme: dark)", "(resolution: 1dppx)"])
    matchMedia(query).addEventListener("change", () => {
      colours.clear();
      charts.forEach((chart) => chart.redraw());
    });
}

function preset(one) {
  state.values = { ...one.values };
  if (info.filter.present && typeof one.filter === "boolean") state.filter = one.filter;
}

// the state of the fragment, else the last preset, the others pinned
function open() {
  const found = readLink(location.hash, leaves, info.filter.present);
  const asked = location.hash.length > 1;
  initial();
  if (asked) {
    state.values = found.values;
    state.seed = found.seed;
    for (const i of found.faults) if (i < data.breaks.length) state.broken.add(data.breaks[i].name);
    if (found.filter !== null) state.filter = found.filter;
    if (found.notes.length) say(found.notes.slice(0, 3).join(" "));
  } else {
    for (const one of data.presets) {
      preset(one);
      if (one === data.presets[data.presets.length - 1]) break;
      const found = run(); // not drawn: it would stand as the last one until that is computed
      if (found) keep(one.name, found);
    }
    makeLegend();
  }
  refresh();
}

function start() {
  $("case").textContent = info.case;
  $("title").textContent = info.title;
  document.title = `${info.case}: live`;
  $("foot").textContent = `jaxtank ${data.version}: ${info.samples} samples of ${shown(info.dt)} s. Charts by uPlot (MIT).`;
  $("link").hidden = framed;
  $("tune").hidden = $("nominal").hidden = !info.free.length;
  $("plants").textContent = `${data.plants} plant${data.plants > 1 ? "s" : ""}`;
  $("plants").setAttribute("aria-pressed", String(data.band));
  if (!info.filter.present) $("filter-row").hidden = true;
  const movable = (name) => byName.has(name) && { value: () => valueOf(name), set: (value) => setLeaf(name, value), leaf: byName.get(name) };
  if (data.rig) rig = makeRig($("rig"), data.rig, info, movable);
  else $("rig").parentNode.hidden = true;
  makeSliders();
  const known = data.breaks.filter((one) => byName.has(one.leaf));
  chips($("breaks").querySelector(".chips"), known, true, (one, button) => {
    const on = !state.broken.has(one.name);
    state.broken[on ? "add" : "delete"](one.name);
    button.setAttribute("aria-pressed", String(on));
    changed();
  });
  $("breaks").hidden = !known.length;
  chips($("presets"), data.presets, false, (one) => {
    preset(one);
    refresh();
  });
  $("presets").hidden = data.presets.length < 2;
  makeCharts();
  makeLegend();
  listen();
  open();
}

window.jaxtank = {
  names: leaves.filter((leaf) => !HIDDEN.includes(leaf.group)).map((leaf) => leaf.name),
  // sets the sliders to `values` (others as in the case), shows the run and returns it
  run(values = {}) {
    for (const name of Object.keys(values))
      if (!byName.has(name)) throw new Error(`no parameter is named ${name}`);
    state.values = { ...values };
    state.broken.clear();
    const found = run(effective(), data.every);
    refresh();
    if (found === null) throw new Error($("message").textContent);
    current = found;
    due = !slow;
    mark();
    show();
    const plain = (list) => list.map((one) => Array.from(one));
    const finite = (v) => (Number.isFinite(v) ? v : null);
    const measures = Object.fromEntries(info.measures.filter(({ name }) => name in found.measures).map(({ name }) => {
      const value = found.measures[name];
      return [name, typeof value === "number" ? finite(value) : Array.from(value, finite)];
    }));
    return { measures, t: Array.from(found.t), h: plain(found.h), u: plain(found.u) };
  },
  // {plants}: how many the search runs on (1: this loop alone); holds, of: limits on plants it has not seen
  tune: ({ plants = null } = {}) => tuneNow(plants),
  verdict: () => verdict(present()),
  csv,
  command,
  toml,
  state: () => ({
    values: effective(), filter: state.filter, seed: state.seed, shown: [view.from, view.to],
  }),
};

start();
