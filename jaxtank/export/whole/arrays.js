/* Operations on arrays, row by row in a Float64Array; a number stands for an array of equal entries.
A text holds those that it calls. */

function flat(n, a) {
  if (a === undefined) return [];
  if (typeof a === "number") return new Float64Array(n).fill(a);
  return a.length === n ? a : new Float64Array(n).fill(a[0]);
}

function view(a, shape, strides, start) {
  const rank = shape.length, index = new Int32Array(rank);
  const out = new Float64Array(shape.reduce((s, v) => s * v, 1));
  const from = typeof a === "number" ? null : a;
  for (let i = 0, at = start; i < out.length; ++i) {
    out[i] = from === null ? a : from[at];
    for (let d = rank - 1; d >= 0; --d) {
      at += strides[d];
      if (++index[d] < shape[d]) break;
      at -= strides[d] * shape[d];
      index[d] = 0;
    }
  }
  return out;
}

function put(n, a, b, shape, strides, start) {
  const out = Float64Array.from(flat(n, a)), rank = shape.length, index = new Int32Array(rank);
  const size = shape.reduce((s, v) => s * v, 1), from = flat(size, b);
  for (let i = 0, at = start; i < size; ++i) {
    out[at] = from[i];
    for (let d = rank - 1; d >= 0; --d) {
      at += strides[d];
      if (++index[d] < shape[d]) break;
      at -= strides[d] * shape[d];
      index[d] = 0;
    }
  }
  return out;
}

function chain(outer, sizes, parts) {
  const width = sizes.reduce((s, v) => s + v, 0), out = new Float64Array(outer * width);
  let first = 0;
  parts.forEach((part, j) => {
    const from = flat(outer * sizes[j], part);
    for (let i = 0; i < outer; ++i)
      for (let k = 0; k < sizes[j]; ++k) out[i * width + first + k] = from[i * sizes[j] + k];
    first += sizes[j];
  });
  return out;
}

function running(f, rows, width, a) {
  const out = Float64Array.from(flat(rows * width, a));
  for (let i = 0; i < rows; ++i)
    for (let k = 1; k < width; ++k) out[i * width + k] = f(out[i * width + k - 1], out[i * width + k]);
  return out;
}

function matmul(batch, m, k, n, a, b, out) {
  out.fill(0);
  const x = flat(batch * m * k, a), y = flat(batch * k * n, b);
  for (let p = 0; p < batch; ++p)
    for (let i = 0; i < m; ++i)
      for (let l = 0; l < k; ++l) {
        const v = x[(p * m + i) * k + l];
        if (v !== 0)
          for (let j = 0; j < n; ++j) out[(p * m + i) * n + j] += v * y[(p * k + l) * n + j];
      }
}

/* rows x n: the transpose of g with each row times its weight */
function scaled(rows, n, g, weight, out) {
  const w = flat(rows, weight);
  for (let i = 0; i < rows; ++i) for (let j = 0; j < n; ++j) out[j * rows + i] = g[i * n + j] * w[i];
}

function pick(places, ...parts) {
  const all = chain(1, parts.map((p) => p.length), parts);
  return Float64Array.from(places, (i) => all[i]);
}

function sparse(n, places, values) {
  const out = new Float64Array(n);
  places.forEach((i, j) => (out[i] = values[j]));
  return out;
}

function within(i, most) {
  const at = typeof i === "number" ? i : i[0];
  return Math.min(Math.max(at, 0), most);
}

function solved(n, k, across, f, b) {
  const A = new Float64Array(n * n), size = n * k;
  for (let i = 0; i < n; ++i) {
    const z = new Float64Array(size);
    z[across ? i : i * k] = 1;
    const column = f(z);
    for (let j = 0; j < n; ++j) A[j * n + i] = column[across ? j : j * k];
  }
  const right = flat(size, b);
  if (!across) return solve(n, k, A, right);
  return view(solve(n, k, A, view(right, [n, k], [1, n], 0)), [k, n], [1, k], 0);
}
