/* The driver of one case's printed functions: runs, noise, measures. No DOM: a page, a worker and
node run the same text. `info`, `programs` and `inverseErf` stand above it. */

/* The deviates of jax.random.normal: threefry2x32 (Salmon et al. 2011) in counter mode, and
a quotient of polynomials for the inverse error function. */
function threefry(key, a, b) {
  const keys = [key[0], key[1], key[0] ^ key[1] ^ 0x1bd11bda];
  const turns = [13, 15, 26, 6, 17, 29, 16, 24];
  a = (a + keys[0]) | 0;
  b = (b + keys[1]) | 0;
  for (let i = 0; i < 5; ++i) {
    for (let j = 0; j < 4; ++j) {
      const turn = turns[(i % 2) * 4 + j];
      a = (a + b) | 0;
      b = ((b << turn) | (b >>> (32 - turn))) ^ a;
    }
    a = (a + keys[(i + 1) % 3]) | 0;
    b = (b + keys[(i + 2) % 3] + i + 1) | 0;
  }
  return [a >>> 0, b >>> 0];
}

/* `inverseErf`, above: two lists of coefficients, whose quotient at w = -log(1 - x^2) is erf_inv(x)/x. */
function normal(bits) {
  const least = -1 + 2 ** -53;
  const share = (bits[0] * 2 ** 20 + (bits[1] >>> 12)) * 2 ** -52;
  const x = Math.max(least, share * 2 + least), w = -Math.log((1 - x) * (1 + x));
  const [above, below] = inverseErf;
  let p = 0, q = 0;
  for (let i = above.length - 1; i >= 0; --i) {
    p = p * w + above[i];
    q = q * w + below[i];
  }
  return (Math.SQRT2 * x * p) / q;
}

/* (tanks) arrays of `samples` deviates of a seed, as a run of jaxtank draws them. */
function deviates(seed, tanks, samples) {
  const key = [Math.floor(seed / 2 ** 32), seed >>> 0], chunk = 2 ** 18;
  const out = Array.from({ length: tanks }, () => new Float64Array(samples));
  const draw = (own, first, count) => {
    for (let i = 0; i < tanks; ++i)
      for (let j = 0; j < count; ++j) {
        const at = i * count + j;
        out[i][first + j] = normal(threefry(own, Math.floor(at / 2 ** 32), at >>> 0));
      }
  };
  if (samples <= chunk) draw(key, 0, samples);
  else
    for (let first = 0, piece = 0; first < samples; first += chunk, ++piece)
      draw(threefry(key, 0, piece), first, Math.min(chunk, samples - first));
  return out;
}

info.leaves = info.leaves.flatMap(([unit, doc, group, entries]) =>
  entries.map(([name, number, lower, upper, label]) => {
    const value = typeof number === "string" ? null : number; // an infinite one has no slider
    return { name, label, unit, doc, value, fixed: Number(number), lower, upper, group };
  }));

const PIECE = 500; // samples
const RESIDUALS = 4000; // samples whose residuals make a Gauss-Newton matrix, about
const STEP = 1e-6; // of a difference, as a share of the number
const DEVIATES = 4e6; // numbers of noise that are kept: 32 MB in each worker

/* {measure: weight} of the sums of squares whose Gauss-Newton matrix stands for an objective. */
function squaresOf(objective) {
  const own = Object.entries(objective).filter(([m]) => info.squares.includes(m));
  return "rms_error_total" in objective || !own.length ? { mean_square_error: 1 } : Object.fromEntries(own);
}

/* A column of a table, of straight pieces. */
function expanded([starts, ends, counts]) {
  const column = new Float64Array(info.samples);
  let k = 0;
  starts.forEach((start, i) => {
    const slope = (ends[i] - start) / Math.max(1, counts[i] - 1);
    for (let j = 0; j < counts[i]; ++j) column[k++] = start + slope * j;
  });
  return column;
}

function makeEngine() {
  const defaults = new Map(info.leaves.map((leaf) => [leaf.name, leaf.fixed]));
  const noisy = info.leaves.filter((leaf) => leaf.name.startsWith("sensor.noise"));
  const samples = info.samples, tanks = info.tanks.length;
  const tables = info.tables.map(expanded);
  const kept = new Map();
  const drawn = new Map();
  let still = null;

  function numberOf(values, name) {
    return values && name in values ? Number(values[name]) : defaults.get(name);
  }

  function numbers(program, values) {
    for (const name of Object.keys(values || {}))
      if (!defaults.has(name)) throw new Error(`${name}: no parameter of this loop has this name`);
    return Float64Array.from(program.leaves, (name) => numberOf(values, name));
  }

  function chosen(filter) {
    const on = filter === undefined ? info.filter.default_on : Boolean(filter);
    return on && info.filter.present ? 1 % programs.length : 0;
  }

  function noise(values, seed) {
    if (!noisy.some((leaf) => numberOf(values, leaf.name) > 0)) {
      still = still || new Float64Array(samples);
      return Array(tanks).fill(still);
    }
    if (!drawn.has(seed)) {
      if ((drawn.size + 1) * tanks * samples > DEVIATES) drawn.clear();
      drawn.set(seed, deviates(seed, tanks, samples));
    }
    return drawn.get(seed);
  }

  /* What is known of each sample, computed again where the numbers that it depends on changed. */
  function signals(program, q) {
    if (!kept.has(program)) kept.set(program, { signals: null, of: null });
    const own = kept.get(program);
    if (own.of !== null && !q.A && own.of.every((v, i) => Object.is(v, q[i]))) return own.signals;
    own.signals = own.signals ||
      Array.from({ length: program.streams }, () => new Float64Array(samples));
    pieces((k, K) => program.signals(q, k, K, own.signals, tables));
    own.of = q;
    return own.signals;
  }

  /* All samples in short calls: V8 compiles a function that is called often for good, and one that is
  in a long loop for this call alone. */
  function pieces(work) {
    for (let k = 0; k < samples; k += PIECE) work(k, Math.min(k + PIECE, samples));
  }

  function measuresOf(program, values) {
    const found = {};
    let at = 0;
    for (const { name, size } of program.search ? info.measures : [])
      found[name] = size === null ? NaN : Array(size).fill(NaN);
    for (const [name, size] of program.measures) {
      found[name] = size === null ? values[at++] : values.slice(at, at += size);
    }
    return found;
  }

  function run(values, options) {
    const { every = info.save_every_default, seed = 0, filter, measures = true, search } = options || {};
    const whole = programs[chosen(filter)], program = search ? whole.search : whole, p = numbers(program, values);
    const [forSignals, forRun, forRead, state, lines] = program.lead(p);
    const S = signals(program, forSignals), N = noise(values, seed);
    const width = program.columns.reduce((sum, [, size]) => sum + size, 0);
    const rows = Math.floor((samples - 1) / every) + 1, R = new Float64Array(rows * width);
    let written = 0;
    pieces((k, K) => {
      written += program.run(forRun, state, lines, S, N, k, K, every, R.subarray(written));
    });
    const out = { t: Float64Array.from({ length: rows }, (_, i) => i * every * info.dt) };
    let first = 0;
    for (const [name, size] of program.columns) {
      out[name] = Array.from({ length: size }, (_, j) => {
        const column = new Float64Array(rows);
        for (let i = 0, at = first + j; i < rows; ++i, at += width) column[i] = R[at];
        return column;
      });
      first += size;
    }
    out.h = out.x;
    delete out.x;
    if (!search && !out.d_hat.some((column) => column.some((v) => v !== 0))) out.d_hat = null;
    if (measures) out.measures = measuresOf(program, program.read(forRead, state));
    out.broken = diverged(state);
    return out;
  }

  /* Measures, their derivatives by `names` and the Gauss-Newton matrix of options.objective (of the case
  by default), by differences of runs. base: the run at `values`, if known. */
  const every = Math.max(1, Math.floor(samples / RESIDUALS));

  function slopes(values, names, options, base = null) {
    const P = names.length;
    const { objective = info.objective.measures, filter } = options || {}, squares = squaresOf(objective);
    const weights = programs[chosen(filter)].search.weights.map(([m, w]) => w * (squares[m] || 0));
    const go = (at) => run(at, { ...options, every, search: true });
    const before = base || go(values), jacobian = {}, G = new Float64Array(P * P);
    const moved = names.map((name) => {
      const leaf = info.leaves.find((one) => one.name === name), at = numberOf(values, name);
      const size = STEP * (Math.abs(at) || leaf.upper - leaf.lower);
      const next = at > (leaf.lower + leaf.upper) / 2 ? at - size : at + size;
      return { h: next - at, after: go({ ...values, [name]: next }) };
    });
    for (const [m, value] of Object.entries(before.measures)) {
      const found = [].concat(value);
      jacobian[m] = new Float64Array(found.length * P);
      moved.forEach(({ h, after }, j) => {
        const other = [].concat(after.measures[m]);
        found.forEach((v, i) => (jacobian[m][i * P + j] = (other[i] - v) / h));
      });
    }
    const changes = moved.map(({ h, after }) => after.errors.map((column, i) =>
      column.map((v, k) => (v - before.errors[i][k]) / h)));
    for (let a = 0; a < P; ++a)
      for (let b = 0; b <= a; ++b) {
        let s = 0;
        weights.forEach((w, i) => {
          if (w === 0) return;
          const x = changes[a][i], y = changes[b][i];
          for (let k = 0; k < x.length; ++k) s += w * x[k] * y[k];
        });
        G[b * P + a] = G[a * P + b] = 2 * every * s;
      }
    return { run: before, measures: before.measures, jacobian, gauss_newton: G, broken: before.broken };
  }

  function diverged(state) {
    let level = 0;
    for (let i = 0; i < tanks; ++i) level += state[i];
    return !Number.isFinite(level);
  }

  function command(values, options) {
    const { filter, seed = 0, dt } = options || {};
    const words = ["jaxtank", "simulate", quoted(info.case)];
    for (const [name, value] of Object.entries(values || {}))
      if (!Object.is(Number(value), defaults.get(name)))
        words.push("--set", quoted(`${name}=${Number(value)}`));
    if (dt !== undefined && dt !== info.dt) words.push("--dt", String(dt));
    if (seed) words.push("--seed", String(seed));
    if (info.filter.present && filter !== undefined && Boolean(filter) !== info.filter.default_on)
      words.push(filter ? "--safety-filter" : "--no-safety-filter");
    return words.join(" ");
  }

  return { info, run, slopes, every, command };
}

function quoted(text) {
  return /^[\w@%+=:,.\/-]+$/.test(text) ? text : `'${text.replace(/'/g, `'\\''`)}'`;
}
