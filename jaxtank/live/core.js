// Pure functions of the page: numbers, scales of sliders, links, files, decimation. No DOM.

const LINK = "v1";

// a number as people read it, with `digits` significant digits
function shown(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size > 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(digits - 1);
  return String(Number(value.toPrecision(digits)));
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

// the ends of a slider, wide enough for its default; logarithmic for gains and times
function scaleOf(leaf) {
  const low = Math.min(leaf.lower, leaf.value), high = Math.max(leaf.upper, leaf.value);
  const log = leaf.scale ? leaf.scale === "log" : low > 0 && high / low >= 30;
  return { low, high, log: log && low * high > 0 };
}

const STEPS = 1000;

function positionOf(value, s) {
  if (s.high === s.low) return 0;
  const part = s.log
    ? Math.log(clamp(value, s.low, s.high) / s.low) / Math.log(s.high / s.low)
    : (clamp(value, s.low, s.high) - s.low) / (s.high - s.low);
  return Math.round(STEPS * part);
}

function valueAt(position, s) {
  if (position <= 0) return s.low;
  if (position >= STEPS) return s.high;
  const part = position / STEPS;
  const value = s.log ? s.low * (s.high / s.low) ** part : s.low + part * (s.high - s.low);
  const span = s.log ? value : s.high - s.low; // four digits of what one sees
  const unit = 10 ** (Math.floor(Math.log10(Math.abs(span))) - 3);
  return clamp(Number((Math.round(value / unit) * unit).toPrecision(12)), s.low, s.high);
}

// the state of the page as the fragment of its address
function linkOf(state, leaves) {
  const parts = [LINK];
  for (const leaf of leaves) {
    const value = state.values[leaf.name];
    if (value !== undefined && value !== leaf.value)
      parts.push(`${encodeURIComponent(leaf.name)}=${value}`);
  }
  if (state.filter !== null) parts.push(`filter=${state.filter ? 1 : 0}`);
  if (state.seed) parts.push(`seed=${state.seed}`);
  if (state.faults.length) parts.push(`faults=${state.faults.join(",")}`);
  return `#${parts.join("&")}`;
}

// {values, filter, seed, faults: indices, notes} of a fragment; what is unknown or no number is left out and noted
function readLink(text, leaves, hasFilter) {
  const found = { values: {}, filter: null, seed: 0, faults: [], notes: [] };
  const parts = text.replace(/^#/, "").split("&");
  if (!parts[0]) return found;
  if (parts[0] !== LINK) {
    found.notes.push("The link is of another version of this page and was not read.");
    return found;
  }
  const known = new Map(leaves.map((leaf) => [leaf.name, leaf]));
  for (const part of parts.slice(1, 1000)) {
    const cut = part.indexOf("=");
    let name = "";
    try {
      name = decodeURIComponent(part.slice(0, cut));
    } catch {
      name = "";
    }
    const word = part.slice(cut + 1), value = word.trim() === "" ? NaN : Number(word);
    if (name === "filter" && hasFilter && (word === "0" || word === "1")) {
      found.filter = word === "1";
    } else if (name === "seed" && Number.isInteger(value) && value >= 0 && value < 2 ** 31) {
      found.seed = value;
    } else if (name === "faults" && /^\d{1,4}(,\d{1,4})*$/.test(word)) {
      found.faults = word.split(",").map(Number);
    } else if (known.has(name) && Number.isFinite(value)) {
      const s = scaleOf(known.get(name));
      found.values[name] = clamp(value, s.low, s.high);
      if (found.values[name] !== value) found.notes.push(`${name} was moved to the end of its range.`);
    } else {
      const here = known.has(name) || name === "seed" || (name === "filter" && hasFilter);
      found.notes.push(`The link sets ${name.slice(0, 60) || "something"}${here ? ` to "${word.slice(0, 20)}", which it cannot be` : ", which this page does not have"}.`);
    }
  }
  return found;
}

// a leaf's array as TOML: every entry of `base`, from the current values
function arrayOf(base, leaves, values) {
  const root = [];
  let scalar = null;
  for (const leaf of leaves) {
    const cut = leaf.name.indexOf("[");
    if ((cut < 0 ? leaf.name : leaf.name.slice(0, cut)) !== base) continue;
    const value = values[leaf.name] ?? leaf.fixed;
    if (cut < 0) scalar = value;
    else {
      const [i, j] = leaf.name.slice(cut + 1, -1).split(",").map(Number);
      if (j === undefined) root[i] = value;
      else (root[i] ??= [])[j] = value;
    }
  }
  return scalar === null ? listOf(root) : real(scalar);
}

function listOf(entry) {
  if (Array.isArray(entry)) return `[${entry.map(listOf).join(",")}]`;
  return Math.abs(entry) === Infinity ? String(entry).replace("Infinity", "inf") : JSON.stringify(entry);
}

function real(value) {
  const text = String(value);
  return /^-?\d+$/.test(text) ? `${text}.0` : text;
}

// the rig file `text` with `values` {name: number} in its table [values], and with or without filter
function tomlOf(text, leaves, values, filter) {
  let lines = text.split("\n");
  const guard = lines.findIndex((line) => line.trim() === "[safety_filter]");
  if (filter === true && guard < 0) lines.push("[safety_filter]", "");
  if (filter === false && guard >= 0) {
    const end = lines.findIndex((line, k) => k > guard && /^\s*\[/.test(line));
    lines = lines.filter((_, k) => k < guard || (end >= 0 && k >= end));
  }
  const bases = [...new Set(Object.keys(values).map((name) => name.split("[")[0]))];
  // in a file the models follow the plant unless they are set
  for (const base of bases.filter((name) => name.startsWith("plant.")))
    for (const part of ["controller.model", "controller.law.model", "observer.model"]) {
      const model = base.replace("plant", part);
      if (leaves.some((leaf) => leaf.name.split("[")[0] === model)) bases.push(model);
    }
  let start = lines.findIndex((line) => line.trim() === "[values]");
  if (bases.length && start < 0) {
    start = lines.findIndex((line) => /^\s*\[/.test(line));
    start = start < 0 ? lines.length : start;
    lines.splice(start, 0, "[values]", "");
  }
  for (const base of bases) {
    const line = `${JSON.stringify(base)} = ${arrayOf(base, leaves, values)}`;
    let end = lines.findIndex((other, k) => k > start && /^\s*\[/.test(other));
    end = end < 0 ? lines.length : end;
    const old = lines.findIndex(
      (other, k) => k > start && k < end && other.startsWith(`${JSON.stringify(base)} =`),
    );
    if (old < 0) lines.splice(start + 1, 0, line);
    else lines[old] = line;
  }
  return lines.join("\n");
}

// [unit, seconds in it] of the times of a span [s]
const timeUnit = (span) => span >= 864000 ? ["d", 86400] : span >= 10800 ? ["h", 3600] : ["s", 1];

// a time [s] in the unit of a span, without and with its name
const moment = (t, span) => shown(t / timeUnit(span)[1], 6);
const momentOf = (t, span) => `${moment(t, span)} ${timeUnit(span)[0]}`;

// steps between the times on an axis: round numbers of the span's unit
const roundTimes = (span) => Array.from({ length: 36 }, (_, i) =>
  (timeUnit(span)[0] === "s" ? [1, 2, 2.5, 5] : [1, 2, 3, 6])[i % 4] * 10 ** (Math.floor(i / 4) - 3) * timeUnit(span)[1]);

// a run as CSV, the trajectory.csv of the command
function csvOf(run, { units, pumps, columns: known }) {
  const columns = [["t [s]", run.t]];
  const add = (name, unit, list, kind = "tank") =>
    (list || []).forEach((values, i) => columns.push([`${name}${known[kind][i]} [${kind === "pump" ? pumps[i].unit : unit}]`, values]));
  add("h", units.length, run.h);
  add("y", units.length, run.y);
  add("r", units.length, run.r, "output");
  add("u", units.drive, run.u, "pump");
  add("command", units.drive, run.command, "pump");
  if (run.applied.some((column, j) => column.some((v, k) => v !== run.u[j][k])))
    add("applied", units.drive, run.applied, "pump");
  add("spilled", units.length === "-" ? "-" : `${units.length}^3`, run.spilled);
  if (run.d_hat && run.d_hat.some((d) => d.some((v) => v !== 0)))
    add("d_hat", `${units.length}/s`, run.d_hat);
  const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const rows = [columns.map((c) => quoted(c[0])).join(",")];
  for (let k = 0; k < run.t.length; k += 1) rows.push(columns.map((c) => c[1][k]).join(","));
  return `${rows.join("\n")}\n`;
}

// first index of sorted `t` with t[k] >= x
function indexOf(t, x) {
  let low = 0, high = t.length;
  while (low < high) {
    const mid = (low + high) >> 1;
    if (t[mid] < x) low = mid + 1;
    else high = mid;
  }
  return low;
}

// [t, ...series] from `from` to `to` with at most 2 `buckets` points, the extremes of each kept
function envelope(t, series, from, to, buckets) {
  const first = Math.max(0, indexOf(t, from) - 1), end = Math.min(t.length, indexOf(t, to) + 2);
  const count = end - first;
  if (count <= 2 * buckets) return [t, ...series].map((v) => v.slice(first, end));
  const out = [t, ...series].map(() => new Float64Array(2 * buckets));
  for (let b = 0; b < buckets; b += 1) {
    const i = first + Math.floor((b * count) / buckets);
    const j = first + Math.floor(((b + 1) * count) / buckets);
    out[0][2 * b] = t[i];
    out[0][2 * b + 1] = t[(i + j) >> 1];
    for (let s = 0; s < series.length; s += 1) {
      const v = series[s];
      let least = i, most = i;
      for (let k = i + 1; k < j; k += 1) {
        if (v[k] < v[least]) least = k;
        else if (v[k] > v[most]) most = k;
      }
      out[s + 1][2 * b] = v[Math.min(least, most)];
      out[s + 1][2 * b + 1] = v[Math.max(least, most)];
    }
  }
  // the last bucket ends at the last sample
  out.forEach((v, s) => (v[v.length - 1] = (s ? series[s - 1] : t)[end - 1]));
  return out;
}

// values of `v` over `t`, linearly at the times `at`
function interpolated(t, v, at) {
  return Float64Array.from(at, (x) => {
    const k = clamp(indexOf(t, x), 1, t.length - 1);
    const part = clamp((x - t[k - 1]) / (t[k] - t[k - 1]), 0, 1);
    return v[k - 1] + part * (v[k] - v[k - 1]);
  });
}

// least and greatest of several arrays
function extent(arrays) {
  let low = Infinity, high = -Infinity;
  for (const v of arrays)
    for (let k = 0; k < v.length; k += 1) {
      if (v[k] < low) low = v[k];
      if (v[k] > high) high = v[k];
    }
  return [low, high];
}

// of the loop as it runs, where inForce(name, otherwise) is the value of a leaf: the rim of a tank, and the
// limits, of which those at a rim follow it
const rimIn = (info, inForce, i) => inForce(`plant.rim[${i}]`, inForce("plant.rim", info.tanks[i].rim));
const limitsIn = (info, inForce) => info.limits.map((limit) => {
  const upper = limit.follows ? inForce(limit.follows, limit.upper) : null;
  return upper === null ? limit : { ...limit, upper, scale: upper };
});

const entryOf = (value, entry) => (typeof value === "number" ? value : value[entry ?? 0]);

// margins of the limits in a run: [{limit, value, margin}], the smallest first; by jaxtank.limits
function marginsOf(limits, measures) {
  const found = limits.filter(({ measure }) => measures[measure] !== undefined && measures[measure] !== null)
    .map((limit) => {
      const value = entryOf(measures[limit.measure], limit.entry);
      const margin = (limit.upper ?? null) === null ? value - limit.lower : limit.upper - value;
      const undefined_ = limit.nan_holds ? 1e6 : -1e6;
      return { limit, value, margin: Number.isNaN(value) ? undefined_ : clamp(margin, -1e6, 1e6) };
    });
  // the tightest first, as a share of its limit: units differ
  const share = ({ limit, margin }) => margin / (limit.scale || Math.abs(limit.upper ?? limit.lower) || 1);
  return found.sort((a, b) => share(a) - share(b));
}

// The verdict on a run: the rules and words of tuning/report/verdict.py, which judges for commands.

const OFF = 0.05; // share of a tank's height by which a level may miss its setpoint
const SHARE = 0.5, SMALL = 0.005; // of the largest step that it may miss, where steps are above SMALL of the height
const SATURATED = 0.5; // share of the samples at a pump limit
// shares of a height below which a tank is empty, and above which it is not, whatever a pump draws from it in a step
const EMPTY = 1e-4, DREGS = 0.01, PASSED = 2e-3;
const EXACT = 1e-4; // share below which a miss is not worth a number

// {good, words} of the measures of a run, null for a loop without feedback
function trackingOf(info, inForce, measures) {
  if (!info.tracks) return null;
  const { outputs } = info, unit = info.units.length;
  const list = (name) => Array.from(typeof measures[name] === "number" ? [measures[name]] : measures[name]);
  const rms = list("rms_error"), highest = list("max_level"), swing = list("steady_state_swing");
  const steady = list("steady_state_error").map((error, o) => Math.max(error, swing[o]));
  if (!rms.every(Number.isFinite)) return { good: false, words: "the run diverged: a level is not a finite number" };
  const heights = outputs.map((tank) => {
    const rim = rimIn(info, inForce, tank), height = Number.isFinite(rim) ? rim : Math.abs(highest[tank]);
    return height > 0 ? height : 1;
  });
  const allowed = heights.map((height, o) => {
    const values = info.setpoints.filter(([, output]) => output === o).map(([name]) => inForce(name));
    const step = values.length ? Math.max(...values) - Math.min(...values) : 0;
    return step > SMALL * height ? Math.min(OFF * height, SHARE * step) : OFF * height;
  });
  const largest = (list) => list.indexOf(Math.max(...list));
  const among = (sizes, where) => largest(sizes.map((size, o) => (where[o] ? size : -Infinity)));
  const total = `RMS error ${shown(measures.rms_error_total, 3)} ${unit}`;
  const off = steady.map((error, o) => error > allowed[o]);
  if (off.includes(true)) {
    const o = among(steady.map((error, o) => error / allowed[o]), off);
    const tank = info.tanks[outputs[o]].name, amount = `${shown(steady[o], 3)} ${unit}`;
    const words = swing[o] === steady[o] ? `${tank} swings ${amount} to either side of its setpoint`
      : `${tank} is ${amount} off its setpoint at ${shown(list("time_of_steady_state_error")[o], 5)} s`;
    return { good: false, words: `${words}, ${total}` };
  }
  const busy = list("saturated_fraction"), pump = largest(busy), stuck = busy[pump] > SATURATED;
  const large = rms.map((error, o) => error > OFF * heights[o] && (Number.isNaN(steady[o]) || stuck));
  if (large.includes(true)) {
    const o = among(rms.map((error, o) => error / heights[o]), large);
    const words = `${info.tanks[outputs[o]].name} has an RMS error of ${shown(rms[o], 3)} ${unit}`;
    const at = stuck ? `, ${info.pumps[pump].name} is at a limit in ${shown(100 * busy[pump], 3)} % of the samples` : "";
    return { good: false, words: words + at };
  }
  const settled = steady.filter((error) => !Number.isNaN(error));
  if (!settled.length) return { good: true, words: `tracks with ${total}` };
  if (steady.every((error, o) => Number.isNaN(error) || error / heights[o] < EXACT))
    return { good: true, words: `settles on its setpoints, ${total}` };
  return { good: true, words: `comes within ${shown(Math.max(...settled), 3)} ${unit} of each setpoint, ${total}` };
}

// {good, words} of marginsOf, null without limits
function limitsOf(margins, measures) {
  if (!margins.length) return null;
  const { limit, value, margin } = margins[0], overflow = limit.measure === "overflow_volume";
  const broken = margins.filter((one) => !(one.margin >= 0)).length;
  const of = (text) => (limit.unit === "-" ? text : `${text} ${limit.unit}`);
  if (!broken) {
    const spare = `, smallest margin ${of(shown(margin, 3))} (${limit.words})`;
    return { good: true, words: `every limit holds${overflow || !Number.isFinite(value) ? "" : spare}` };
  }
  const bound = of(shown(limit.upper ?? limit.lower, 5)), side = (limit.upper ?? null) === null ? "below" : "above";
  const time = limit.reached ? ` at ${shown(entryOf(measures[limit.reached], limit.entry), 5)} s` : "";
  let words = `${limit.words} is ${of(shown(value, 3))}`;
  if (!Number.isFinite(value)) words = `${limit.words} is undefined, for a limit of ${bound}`;
  else if (!overflow) words += `${time}, ${of(shown(-margin, 3))} ${side} its limit of ${bound}`;
  const more = broken === 2 ? "; 1 other limit is broken" : `; ${broken - 1} other limits are broken`;
  return { good: false, words: words + (broken > 1 ? more : "") };
}

// what is wrong though no limit names it: a level above its rim, liquid that spills, a pump that draws from an empty tank
// the level at and below which a tank is empty for a pump that draws from it; share: at the values of the rig, of
// what the tank holds up to DREGS of its rim, what one step of the pump at its upper limit takes
function dryLevel(info, inForce, pump, tank, share) {
  const ratio = (name) => {
    const usual = info.leaves.find((leaf) => leaf.name === name)?.value;
    return usual ? inForce(name, usual) / usual : 1;
  };
  const drawn = share * ratio(`plant.pump_gain[${pump}]`) * ratio(`actuator.high[${pump}]`);
  const held = ratio(`plant.area[${tank}]`) * ratio(`plant.rim[${tank}]`);
  return Math.max(EMPTY, DREGS * Math.min(1, drawn / held)) * rimIn(info, inForce, tank);
}

function beyond(info, inForce, measures) {
  const unit = info.units.length, highest = measures.max_level, lowest = measures.min_level, spilled = measures.overflow_volume;
  const spills = (entry) => spilled !== undefined && entryOf(spilled, entry) > 0;
  const below = (upper, rim, entry) => (spills(entry) ? upper < rim : upper <= 2 * rim);
  const named = new Set(limitsIn(info, inForce).filter(({ measure, entry, upper }) =>
    measure === "overflow_volume" || measure === "max_level" && below(upper, rimIn(info, inForce, entry), entry))
    .map(({ entry }) => entry));
  const words = [];
  info.tanks.forEach(({ name }, i) => {
    const rim = rimIn(info, inForce, i);
    if (named.has(i) || rim === null || !Number.isFinite(rim)) return;
    if (entryOf(highest, i) > rim * (1 + 1e-9)) words.push(`${name} rises to ${shown(entryOf(highest, i), 3)} ${unit}, above its rim of ${shown(rim, 3)} ${unit}`);
    else if (spills(i)) words.push(`${shown(entryOf(spilled, i), 3)} ${unit}^3 spill over the rim of ${name}`);
  });
  if (info.predicts) info.tanks.forEach(({ name }, i) => {
    for (const [leaf, level, sign, moves, side] of [["limit", highest, 1, "rises to", "above"], ["lowest", lowest, -1, "falls to", "below"]]) {
      const limit = inForce(`controller.${leaf}[${i}]`, null);
      if (limit !== null && sign * (entryOf(level, i) - limit) > PASSED * Math.abs(limit))
        words.push(`${name} ${moves} ${shown(entryOf(level, i), 3)} ${unit}, ${side} controller.${leaf} of ${shown(limit, 3)} ${unit}`);
    }
  });
  for (const [pump, tank, share] of info.draws)
    if (entryOf(lowest, tank) <= dryLevel(info, inForce, pump, tank, share))
      words.push(`${info.tanks[tank].name}, from which ${info.pumps[pump].name} draws, runs empty`);
  return words;
}

// the tracking of a run beside that of many plants
function withPlants(tracking, plants) {
  if (!tracking || !plants?.astray) return tracking;
  return { good: false, words: `${tracking.words}${tracking.good ? ", but " : "; "}${astrayWords(plants)}` };
}

const astrayWords = ({ astray, count }) => `${astray} of ${count} plants do not keep to their setpoints`;

// {good, sentence} of a run; plants: {kept, astray, count} where many were simulated
function verdictOf(info, inForce, { measures }, plants = null) {
  const margins = marginsOf(limitsIn(info, inForce), measures);
  const wrong = beyond(info, inForce, measures);
  let limits = limitsOf(margins, measures);
  if (wrong.length) limits = { good: false, words: [...(limits && !limits.good ? [limits.words] : []), ...wrong].join("; ") };
  const parts = [withPlants(trackingOf(info, inForce, measures), plants), limits];
  if (plants && margins.length) {
    const good = plants.kept === plants.count;
    if (good && parts[1].good) parts.pop();
    parts.push({ good, words: `limits hold on ${plants.kept} of ${plants.count} plants` });
  }
  const known = parts.filter((part) => part !== null);
  return { good: known.every((part) => part.good), sentence: known.map((part) => part.words).join("; ") };
}

// a quantile of numbers, between the nearest two
function quantile(sorted, share) {
  const at = share * (sorted.length - 1), k = Math.floor(at);
  return k + 1 < sorted.length ? sorted[k] + (at - k) * (sorted[k + 1] - sorted[k]) : sorted[k];
}

// uniform numbers in [0, 1) from a seed (mulberry32), for the plants of the band
function uniform(seed) {
  let a = seed >>> 0;
  return () => {
    a = (a + 0x6d2b79f5) >>> 0;
    let t = Math.imul(a ^ (a >>> 15), 1 | a);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}
