function makeEngine() {
  const info = INFO;
  function run(values, { every = 1, seed = 0, filter = false } = {}) {
    const v = {};
    for (const leaf of info.leaves) v[leaf.name] = values[leaf.name] ?? leaf.value;
    const n = info.samples, rows = Math.floor((n - 1) / every) + 1, dt = info.dt;
    const col = () => new Float64Array(rows);
    const t = col(), h = [col(), col()], r = [col()], u = [col()], spilled = [col(), col()];
    let a = v["x0[0]"], b = v["x0[1]"], integral = 0, most = [0, 0], sum = 0, row = 0;
    for (let k = 0; k < n; k += 1) {
      const time = k * dt, target = time < 100 ? 4 : time < 600 ? 7 : 3, e = target - b;
      integral += (e * dt) / 200;
      let w = v["controller.Kc[0]"] * (e + integral) + 2.5;
      w = Math.min(Math.max(w, 0), filter && b > 7.2 ? 2 : 10);
      if (k % every === 0) {
        t[row] = time; h[0][row] = a; h[1][row] = b; r[0][row] = target; u[0][row] = w; row += 1;
      }
      most = [Math.max(most[0], a), Math.max(most[1], b)];
      sum += e * e;
      const q = v["plant.orifice[0]"] * Math.sqrt(2 * 981 * 0.0005 * Math.max(a, 0));
      a += dt * (v["plant.pump_gain[0]"] * w - q);
      b += dt * (q - v["plant.drain[1]"] * Math.sqrt(2 * 981 * 0.0005 * Math.max(b, 0)));
    }
    return { t, h, y: h, r, u, spilled, d_hat: null, broken: false,
      measures: { rms_error_total: Math.sqrt(sum / n), max_level: most } };
  }
  return { info, run, command: (values) => `jaxtank simulate ${info.case} ${Object.entries(values)
    .map(([k, x]) => `--set ${k}=${x}`).join(" ")}` };
}
