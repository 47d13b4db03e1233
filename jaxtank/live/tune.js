/* A search for the free numbers of a loop: least objective within limits on measures and bounds.

Levenberg and Marquardt's method on the Gauss-Newton matrix of the run, with limits linearised as in
sequential quadratic programming and an exact penalty (Nocedal & Wright 2006, secs. 10.3 and 18.5).
No DOM: a worker and node run the same text. */

/* tune(engine, values, free, limits, onProgress, shouldStop, options) -> a promise of
  {values, objective, violation, iterations, evaluations, status}

values: {name: number} to start from; free: names to change, of engine.info.leaves; limits: as
engine.info.limits; options: {filter, seed, starts, most, plants, objective, close, runs}. plants: [{values, seed}] on which
the mean of the objectives is minimised and every limit kept; [{values, seed}] of the loop alone by default. runs: the runs
of tasks (runOfTask), as an array or a promise of it; by default one after another, here.
Violation: the largest share by which a limit is passed, 0 where all hold. Status: "converged", "stopped",
"limit of iterations", "limits not met". ends: the free numbers that end on their range. The best values so
far are returned whenever shouldStop() is true. */
async function tune(engine, values, free, limits, onProgress, shouldStop, options) {
  const { filter, seed = 0, starts = 2, most = 60, plants = [{ values, seed }] } = options || {};
  const { objective = engine.info.objective.measures, close = CLOSE } = options || {};
  const { runs = (tasks) => tasks.map((task) => runOfTask(engine, task)) } = options || {};
  const search = Object.assign(searchOf(engine, values, free, limits, plants, { filter, objective }, runs), { close });
  const report = () => onProgress && onProgress(search.found());
  const stop = () => Boolean(shouldStop && shouldStop());
  let status = await local(search, search.start, most, report, stop);
  // where no point that keeps the limits was found, the least violation may be far from here
  const wanted = search.found().violation > 0 ? Math.max(starts, 4) : starts;
  const screened = status === "stopped" ? [] : await others(search, wanted, stop);
  for (const z of screened) {
    const next = await local(search, z, most, report, stop);
    if (next === "stopped") status = next;
    if (stop()) break;
  }
  if (search.found().violation > 0 && Number.isFinite(search.found().violation)) {
    for (const z of [search.best.z, ...screened]) {
      if (stop()) status = "stopped";
      else if (search.best.violation > 0) await restore(search, z, most, report, stop);
    }
    if (search.best.violation === 0 && !stop()) status = await local(search, search.best.z, most, report, stop);
  }
  const found = search.found();
  if (status === "converged" && found.violation > 0) status = "limits not met";
  return { ...found, status };
}

/* The run of a task {values, options, free, base}: with free, with derivatives by these names; base: the same without. */
function runOfTask(engine, { values, options, free, base }) {
  const { run, ...found } = free ? engine.slopes(values, free, options, base) : engine.run(values, options);
  if (!options.search) return found;
  const { measures, errors, broken } = found; // of a search, no columns that would be copied between workers
  return { measures, errors, broken };
}

const EDGE = 1e-6; // share of its range from an end at which a number ends on it

/* The search in z, the free numbers between their bounds as 0 to 1, with the best point so far. */
function searchOf(engine, values, free, limits, plants, common, runsOf) {
  const info = engine.info, logs = new Set(info.logarithmic || []);
  const boxes = free.map((name) => boxOf(info, name, values, logs));
  const weights = Object.entries(common.objective);
  const start = boxes.map((box, j) => box.to(valueOf(info, values, free[j])));
  const known = new Map(), ends = []; // points by where they are, where local searches ended
  let best = null, iterations = 0, evaluations = 0, scale = null, last = {};

  const at = (z, plant = values) => {
    const out = { ...plant };
    boxes.forEach((box, j) => (out[free[j]] = box.from(z[j])));
    return out;
  };
  const optionsOf = (plant) => ({ ...common, seed: plant.seed });

  function judged(z, runs) {
    let cost = 0;
    for (const [m, w] of weights) for (const { measures } of runs) cost += (w * sum(measures[m])) / runs.length;
    const margins = runs.flatMap(({ measures }) => limits.map((limit) => marginOf(limit, measures)));
    const broken = runs.some((run) => run.broken);
    const violation = Math.max(0, ...margins.map((m) => -m));
    const finite = !broken && Number.isFinite(cost);
    const point = { z, cost, margins, violation, finite };
    const better = finite && (best === null || (violation === 0 && best.violation === 0
      ? cost < best.cost : violation < best.violation));
    if (better) best = point;
    if (scale === null && finite) scale = Math.abs(cost) || 1;
    evaluations += 1;
    known.set(z.join(), point);
    return point;
  }

  return {
    start, size: free.length, ends,
    get scale() { return scale; },
    get best() { return best; },
    next() { iterations += 1; },
    found() {
      const z = best ? best.z : start;
      return {
        values: at(z),
        objective: best ? best.cost : NaN,
        violation: best ? best.violation : Infinity,
        ends: free.filter((_, j) => z[j] < EDGE || z[j] > 1 - EDGE),
        iterations, evaluations,
      };
    },
    async value(z) {
      if (known.has(z.join())) return known.get(z.join());
      const runs = await runsOf(plants.map((plant) => (
        { values: at(z, plant.values), options: { ...optionsOf(plant), every: engine.every, search: true } })));
      delete last.runs; // a hundred points of many plants are not held
      return (last = Object.assign(judged(z, runs), { runs }));
    },
    async point(z) {
      const before = known.get(z.join());
      if (before && before.gradient) return before;
      const P = free.length, per = boxes.map((box, j) => box.slope(z[j]));
      const runs = await runsOf(plants.map((plant, k) => (
        { values: at(z, plant.values), free, options: optionsOf(plant), base: before && before.runs && before.runs[k] })));
      const point = before || judged(z, runs);
      const gradient = new Float64Array(P), slopes = [], curvature = new Float64Array(P * P);
      runs.forEach((run, k) => {
        const row = (m, i, j) => run.jacobian[m][i * P + j] * per[j];
        for (const [m, w] of weights)
          for (let j = 0; j < P; ++j)
            for (let i = 0; i < run.jacobian[m].length / P; ++i) gradient[j] += (w * row(m, i, j)) / runs.length;
        limits.forEach((limit, i) => {
          const { measure, entry } = limit, sign = limit.upper === null ? 1 : -1;
          if (!run.jacobian[measure]) throw new Error(`${measure}: no derivatives to keep its limit`);
          const margin = point.margins[k * limits.length + i];
          slopes.push(Float64Array.from({ length: P }, (_, j) =>
            Math.abs(margin) > 1e5 ? 0 : (sign * row(measure, entry || 0, j)) / scaleOf(limit)));
        });
        curvatureOf(run, per, weights).forEach((v, i) => (curvature[i] += v / runs.length));
      });
      delete point.runs;
      return Object.assign(point, { gradient, slopes, curvature });
    },
  };
}

/* The second derivative of the objective by z but for the curvature of its residuals. */
function curvatureOf(run, per, weights) {
  const P = per.length, G = Array.from(run.gauss_newton, (v, i) => v * per[(i / P) | 0] * per[i % P]);
  const weight = new Map(weights).get("rms_error_total");
  if (weight === undefined) return G;
  // of a root: (matrix of its square / 2 - slope slope') / root, here without its negative part
  const root = Math.max(1e-12, run.measures.rms_error_total);
  return G.map((v) => (weight * v) / (2 * root));
}

function valueOf(info, values, name) {
  return name in values ? values[name] : info.leaves.find((leaf) => leaf.name === name).fixed;
}

/* A free number as 0 to 1, logarithmic where a search of the command has it so. */
function boxOf(info, name, values, logs) {
  const leaf = info.leaves.find((one) => one.name === name);
  if (!leaf) throw new Error(`${name}: no parameter of this loop has this name`);
  const [low, high] = info.bounds[name] || info.bounds[name.split("[")[0]] || [leaf.lower, leaf.upper];
  const clip = (z) => Math.min(1, Math.max(0, z));
  if (low * high > 0 && (logs.has(name) || leaf.scale === "log")) {
    const span = Math.log(high / low);
    const from = (z) => (z <= 0 ? low : z >= 1 ? high : low * Math.exp(z * span));
    return { to: (v) => clip(Math.log(v / low) / span), from, slope: (z) => from(z) * span };
  }
  const from = (z) => (z <= 0 ? low : z >= 1 ? high : low + z * (high - low));
  return { to: (v) => clip((v - low) / (high - low)), from, slope: () => high - low };
}

function sum(value) {
  return typeof value === "number" ? value : value.reduce((a, b) => a + b, 0);
}

function scaleOf(limit) {
  return limit.scale || Math.abs(limit.upper === null ? limit.lower : limit.upper) || 1;
}

/* Share by which a measure is within its limit; negative where it passes it. */
function marginOf(limit, measures) {
  const found = measures[limit.measure];
  const value = limit.entry === null || limit.entry === undefined ? sum(found) : found[limit.entry];
  if (Number.isNaN(value)) return limit.nan_holds ? 1e6 : -1e6;
  const away = limit.upper === null ? value - limit.lower : limit.upper - value;
  return Math.max(-1e6, Math.min(1e6, away / scaleOf(limit)));
}

const INSIDE = 1e-7; // share of a limit that a search stays away from it
const CLOSE = 1e-7; // predicted fall of the merit at which a search has converged, where no other is asked for

const NEAR = 0.03; // of the end of another search, where nothing new is expected

/* A local search from z; returns its status. */
async function local(search, z, most, report, stop) {
  const P = search.size;
  let point = await search.point(z), damping = 1e-3, penalty = 10, taken = true, more = 8;
  if (!point.finite) return "not finite";
  const scale = search.scale;
  const merit = (p) => (p.finite
    ? p.cost / scale + penalty * p.margins.reduce((s, m) => s + Math.max(0, INSIDE - m), 0) : Infinity);
  const known = () => search.ends.some((end) => merit(end) <= merit(point) &&
    end.z.every((v, j) => Math.abs(v - point.z[j]) < NEAR));
  for (let i = 0; i < most; ++i) {
    if (stop()) return "stopped";
    search.next();
    report();
    let now = stepOf(point, P, damping, penalty, scale);
    // a larger penalty, where it brings the limits closer by their slopes
    while (penalty < 1e5 && now.left > 1e-9) {
      const other = stepOf(point, P, damping, 10 * penalty, scale);
      if (other.left > 0.9 * now.left) break;
      penalty *= 10;
      now = other;
    }
    const { step, fall, forces } = now;
    const stuck = point.margins.some((m, j) => m < 0 && forces[j] >= penalty * (1 - 1e-9));
    if (fall < search.close) {
      if (!(stuck && penalty < 1e5)) break;
      if (i === most - 1) return "limit of iterations";
      penalty *= 10;
      continue;
    }
    const next = moved(point.z, step), tried = await search.value(next);
    const gained = (merit(point) - merit(tried)) / fall;
    taken = gained > 1e-4;
    if (taken) {
      point = await search.point(tried.z);
      damping = Math.max(1e-9, damping * (gained > 0.75 ? 0.1 : gained > 0.25 ? 0.5 : 2));
      more = 8;
      if (known()) return "converged";
    } else {
      damping = Math.max(damping, 1e-6) * more;
      more *= 2;
      if (damping > 1e8) break;
    }
    if (i === most - 1) return "limit of iterations";
  }
  search.ends.push(point);
  return "converged";
}

/* A search from z for the least violation, the largest share by which a limit is passed: the least t
with margins + slopes d >= -t, by bisection, for steps d within a trust region. */
async function restore(search, z, most, report, stop) {
  const P = search.size, none = new Float64Array(P);
  let point = await search.point(z), reach = 0.25;
  for (let i = 0; i < most && point.finite && point.violation > 0 && reach > 1e-5; ++i) {
    if (stop()) return;
    search.next();
    report();
    let step = null, low = 0, high = point.violation;
    for (let k = 0; k < 20; ++k) {
      const t = (low + high) / 2, curvature = new Float64Array(P * P);
      const relaxed = { ...point, gradient: none, curvature, margins: point.margins.map((m) => m + t + INSIDE) };
      const found = stepOf(relaxed, P, 1e3, 1e3, 1, reach);
      if (found.left < 1e-7) [high, step] = [t, found.step];
      else low = t;
    }
    const fall = point.violation - high;
    if (step === null || fall < CLOSE) return;
    const tried = await search.value(moved(point.z, step));
    if (tried.finite && tried.violation < point.violation - 0.1 * fall) {
      point = await search.point(tried.z);
      reach = Math.min(1, 2 * reach);
    } else reach /= 4;
  }
}

const moved = (z, step) => Array.from(z, (v, j) => Math.min(1, Math.max(0, v + step[j])));

/* The step of least g'd + d'(B + damping) d / 2 + penalty (passed limits) within 0 <= z + d <= 1 and
|d| <= reach, how far the merit falls by it, and what is left of the passed limits by their slopes.
By coordinate ascent in the forces of limits and bounds. */
function stepOf(point, P, damping, penalty, scale, reach = 1) {
  const B = point.curvature.map((v) => v / scale), g = Array.from(point.gradient, (v) => v / scale);
  const size = Math.max(1e-12, ...Array.from({ length: P }, (_, j) => B[j * P + j]));
  const H = B.map((v, i) => v + (i % (P + 1) === 0 ? damping * Math.max(size, 1e-3) : 0));
  const rows = point.slopes.map((a, i) => ({ a, b: point.margins[i] - INSIDE, top: penalty }));
  for (let j = 0; j < P; ++j) {
    const unit = (sign) => Float64Array.from({ length: P }, (_, i) => (i === j ? sign : 0));
    const [down, up] = [Math.min(reach, point.z[j]), Math.min(reach, 1 - point.z[j])];
    rows.push({ a: unit(1), b: down, top: Infinity }, { a: unit(-1), b: up, top: Infinity });
  }
  const inverse = inverseOf(H, P);
  const times = (v) => Array.from({ length: P }, (_, i) => dot(inverse.subarray(i * P, i * P + P), v));
  const back = rows.map((row) => times(row.a)), d = times(g).map((v) => -v);
  const forces = new Float64Array(rows.length);
  for (let sweep = 0; sweep < 3000; ++sweep) {
    let moved = 0;
    rows.forEach((row, i) => {
      const stiff = dot(row.a, back[i]);
      if (!(stiff > 1e-300)) return;
      const next = Math.min(row.top, Math.max(0, forces[i] - (row.b + dot(row.a, d)) / stiff));
      const change = next - forces[i];
      if (change === 0) return;
      forces[i] = next;
      for (let j = 0; j < P; ++j) d[j] += change * back[i][j];
      moved = Math.max(moved, Math.abs(change) * stiff);
    });
    if (moved < 1e-12) break;
  }
  const passed = (step) => rows.reduce(
    (s, row) => s + (row.top < Infinity ? penalty * Math.max(0, -row.b - (step ? dot(row.a, d) : 0)) : 0), 0);
  let bend = 0;
  for (let i = 0; i < P; ++i) for (let j = 0; j < P; ++j) bend += d[i] * B[i * P + j] * d[j];
  return { step: d, forces, left: passed(true) / penalty, fall: passed(false) - passed(true) - dot(g, d) - bend / 2 };
}

function dot(a, b) {
  let s = 0;
  for (let i = 0; i < a.length; ++i) s += a[i] * b[i];
  return s;
}

/* The inverse of a symmetric positive definite matrix, row by row. */
function inverseOf(H, n) {
  const a = Float64Array.from(H), out = new Float64Array(n * n);
  for (let i = 0; i < n; ++i) out[i * n + i] = 1;
  for (let j = 0; j < n; ++j) {
    const pivot = a[j * n + j];
    for (let l = 0; l < n; ++l) {
      a[j * n + l] /= pivot;
      out[j * n + l] /= pivot;
    }
    for (let i = 0; i < n; ++i) {
      const f = a[i * n + j];
      if (i === j || f === 0) continue;
      for (let l = 0; l < n; ++l) {
        a[i * n + l] -= f * a[j * n + l];
        out[i * n + l] -= f * out[j * n + l];
      }
    }
  }
  return out;
}

/* Starts after the first: the best of points spread over the box (Halton's), one for each. */
async function others(search, starts, stop) {
  const points = [], primes = [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37];
  const count = starts > 1 ? 8 * (starts - 1) : 0;
  for (let i = 1; i <= count && !stop(); ++i)
    points.push(await search.value(Array.from({ length: search.size }, (_, j) => {
      let share = 1, at = 0;
      const prime = primes[j % primes.length];
      for (let rest = i; rest > 0; rest = Math.floor(rest / prime)) at += (share /= prime) * (rest % prime);
      return at;
    })));
  const ranked = points.filter((p) => p.finite).sort((a, b) =>
    a.violation - b.violation || a.cost - b.cost);
  return ranked.slice(0, starts - 1).map((p) => p.z);
}
