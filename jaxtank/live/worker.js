// In a worker, after the text of the engine, the tuner and core.js: runs, searches, many plants.

const engine = makeEngine();
let helpers = []; // ports to other workers, which take a share of the runs

// runs of tasks (runOfTask of tune.js), in their order: of n workers each makes every n-th
async function runs(tasks) {
  const n = helpers.length + 1, share = (k) => tasks.filter((_, i) => i % n === k);
  const others = helpers.map((port, k) => new Promise((resolve, reject) => {
    port.onmessage = ({ data: { found, failed } }) => (failed ? reject(new Error(failed)) : resolve(found));
    port.postMessage(share(k + 1));
  }));
  const parts = await Promise.all([share(0).map((task) => runOfTask(engine, task)), ...others]);
  return tasks.map((_, i) => parts[i % n][Math.floor(i / n)]);
}

// runs tasks that come by a port
function serve(port) {
  port.onmessage = ({ data: tasks }) => {
    try {
      port.postMessage({ found: tasks.map((task) => runOfTask(engine, task)) });
    } catch (error) {
      port.postMessage({ failed: String((error && error.message) || error) });
    }
  };
}

// values of `count` plants about `values`: each leaf of `spread` {name: share} times 1 +- share
// the models of controller and observer are separate leaves and do not change
function plantsOf(message) {
  const next = uniform(message.seed + 1);
  return Array.from({ length: message.count }, () => {
    const values = { ...message.values };
    for (const [name, share] of Object.entries(message.spread)) {
      const factor = 1 + share * (2 * next() - 1);
      values[name] = message.values[name] * factor;
    }
    return values;
  });
}

// whether a run of a plant misses its setpoints, as the verdict on it alone would say
function isAstray({ measures }, values) {
  const usual = (name) => engine.info.leaves.find((leaf) => leaf.name === name)?.value;
  const tracking = trackingOf(engine.info, (name, otherwise) => values[name] ?? usual(name) ?? otherwise, measures);
  return tracking !== null && !tracking.good;
}

// the runs of `count` plants: bands of levels and inputs and how many miss their setpoints (unless brief), how many
// keep the limits, their mean error
async function many(message) {
  const { every, filter, measures, brief } = message, block = 4 * (helpers.length + 1);
  const whole = [];
  let astray = 0;
  const tasks = plantsOf(message).map((values, i) => {
    const seed = message.seed + (i % (message.noises ?? Infinity));
    return { values, options: { every, seed, filter, search: brief, measures } };
  });
  for (let i = 0; i < tasks.length; i += block) {
    const found = await runs(tasks.slice(i, i + block));
    whole.push(...found.filter((run) => !run.broken));
    if (!brief) astray += found.filter((run, k) => !run.broken && isAstray(run, tasks[i + k].values)).length;
    postMessage({ kind: "progress", done: Math.min(i + block, tasks.length), of: tasks.length });
  }
  const bands = (what) =>
    (whole.length && !brief ? whole[0][what] : []).map((_, i) => {
      const low = new Float64Array(whole[0].t.length), high = new Float64Array(low.length);
      for (let k = 0; k < low.length; k += 1) {
        const sorted = Float64Array.from(whole, (run) => run[what][i][k]).sort();
        low[k] = quantile(sorted, 0.05);
        high[k] = quantile(sorted, 0.95);
      }
      return { low, high };
    });
  const kept = whole.filter((run) => marginsOf(message.limits, run.measures).every((m) => m.margin >= 0));
  const errors = whole.map((run) => run.measures.rms_error_total);
  return {
    t: whole.length && !brief ? whole[0].t : new Float64Array(0),
    h: bands("h"),
    u: bands("u"),
    kept: kept.length,
    astray,
    count: message.count,
    broken: message.count - whole.length,
    error: errors.reduce((a, b) => a + b, 0) / errors.length,
  };
}

// a search on the loop and `searched` - 1 plants about it; the answer and the start on `judged` others. On plants
// it is that of `jaxtank tune`: its objective, with noise, and with the safety filter where limits break without it.
async function search(message) {
  const { values, free, limits, filter, seed, searched, judged } = message, { info } = engine, several = searched > 1;
  const others = several ? plantsOf({ ...message, count: searched - 1 }) : [];
  const plants = [values, ...others].map((plant, i) => ({ values: plant, seed: seed + (i % NOISES) }));
  const guard = filter || (several && info.filter.present);
  const keep = limits.filter(({ measure }) => !(guard && several && info.task.proved && measure === "max_level"));
  const own = { runs, seed, ...(several ? { filter: guard, objective: info.task.objective, close: CLOSE_ENOUGH } : { filter }) };
  const progress = (now) => postMessage({ kind: "progress", ...now });
  const from = (start, more) => tune(engine, start, free, keep, progress, () => false, { ...own, ...more });
  const on = (at, guarded, brief) => many({
    ...message, values: { ...values, ...at }, count: judged, seed: seed + UNSEEN, noises: NOISES, filter: guarded, brief,
  });
  // from several starts on few plants, then from the best end on all
  const first = several ? await from(values, { plants: plants.slice(0, FEW) }) : { iterations: 0 };
  const found = await from({ ...values, ...first.values }, several ? { plants, starts: 1 } : { plants });
  found.iterations += first.iterations;
  const before = (await on({}, filter, true)).error;
  const needed = guard && (filter || (await on(found.values, false, true)).kept < judged);
  return { ...found, before, filter: needed, plants: await on(found.values, needed) };
}

const FEW = 4; // plants of the first search
const NOISES = 4; // different sequences of noise: one of 480,000 numbers takes a tenth of a second
const CLOSE_ENOUGH = 1e-4; // share of the objective that the next step of a search on plants may still gain
const UNSEEN = 104729; // added to the seed of plants that judge a search

// names of the sliders {name, ends} at whose ends the run is what it is at `values`
function effects(message) {
  const { seed, filter, every } = message;
  const run = (values) => engine.run(values, { every, seed, filter });
  const before = run(message.values);
  const equal = (a, b) => (ArrayBuffer.isView(a) || Array.isArray(a)
    ? a.length === b.length && a.every((v, i) => equal(v, b[i])) : Object.is(a, b));
  const same = (after) => ["h", "u"].every((what) => equal(before[what], after[what])) &&
    Object.keys(before.measures).every((m) => equal(before.measures[m], after.measures[m]));
  const without = message.names.filter(({ name, ends }) =>
    ends.every((value) => same(run({ ...message.values, [name]: value }))));
  postMessage({ kind: "effects", without: without.map(({ name }) => name) });
}

// the run that is asked for; its columns are handed over, not copied
function one(message) {
  const start = performance.now();
  const run = engine.run(message.values, message.options);
  const columns = Object.values(run).flatMap((v) => (ArrayBuffer.isView(v) ? [v] : Array.isArray(v) ? v : []));
  const milliseconds = performance.now() - start;
  postMessage({ kind: "run", run, milliseconds }, columns.map((column) => column.buffer));
}

onmessage = async (event) => {
  const message = event.data;
  helpers = [...event.ports];
  try {
    if (message.kind === "run") one(message);
    else if (message.kind === "serve") serve(helpers.pop());
    else if (message.kind === "plants") postMessage({ kind: "plants", ...(await many(message)) });
    else if (message.kind === "effects") effects(message);
    else postMessage({ kind: "tuned", ...(await search(message)) });
  } catch (error) {
    postMessage({ kind: "failed", text: String((error && error.message) || error) });
  }
};
