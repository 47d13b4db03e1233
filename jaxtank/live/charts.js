// Levels and inputs over time, drawn by uPlot: one panel a tank and a pump, one cursor for all.

const PINS = 3;

const colours = new Map(); // of the style sheet, until the scheme changes

// a colour of the style sheet in the current mode (light or dark)
function colour(name) {
  if (!colours.has(name))
    colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colours.get(name);
}

// One panel. view: {from, to, cursors: {A, B}}; spec: {title, name, unit, limits: [{value, words}], forbidden: above it, zero}
// on: {cursor(time), zoom(from, to), whole(), handle(spec, time, near) -> {name} or null: what is dragged,
// drag(name, value), mark(cursor, time, again)}; series: band low, band high, pins, setpoint, run
function makeChart(host, spec, view, on) {
  const title = make("span", { class: "name" }, spec.title);
  const reading = make("span", { class: "reading" });
  const box = make("div", { class: "plot", role: "img" });
  const figure = make("figure", { class: `panel ${spec.kind}` });
  figure.append(make("figcaption", {}, title, reading), box);
  host.append(figure);
  const state = { range: [0, 1], shown: null };
  const line = (name, width, dash) => ({
    stroke: () => colour(name), width, dash, points: { show: false }, spanGaps: true,
  });
  const hidden = (series) => ({ ...series, show: false });
  const dashes = [[7, 4], [8, 3, 2, 3], [2, 3]];
  const series = [
    {},
    hidden({ points: { show: false } }),
    hidden({ points: { show: false } }),
    ...dashes.map((dash, i) => hidden(line(`--pin${i}`, 1.5, dash))),
    hidden(line("--setpoint", 1.25, [2, 3])),
    line("--run", 1.9),
  ];
  const grid = { stroke: () => colour("--grid"), width: 1 };
  const axis = { stroke: () => colour("--muted"), grid, ticks: grid, font: FONT };
  const plot = new uPlot(
    {
      width: 300,
      height: 120,
      legend: { show: false },
      padding: [6, 20, 0, 0],
      scales: {
        x: { time: false, range: () => [view.from, view.to] },
        y: { range: () => state.range },
      },
      axes: [
        { ...axis, size: 24, space: 48, gap: 3, incrs: () => roundTimes(view.to - view.from),
          values: (u, at) => at.map((t, i) => (i < at.length - 1 ? moment : momentOf)(t, view.to - view.from)) },
        { ...axis, size: (u, at) => Math.max(46, ...(at ?? []).map((text) => 7 * text.length + 12)), space: 26, gap: 4, values: (u, at) => at.map((v) => shown(v, 5)) },
      ],
      series,
      bands: [{ series: [2, 1], fill: () => colour("--band") }],
      cursor: {
        sync: { key: "run", setSeries: false },
        drag: { x: true, y: false, setScale: false },
        points: { size: 6 },
        bind: { dblclick: () => () => (on.whole(), null) },
      },
      hooks: {
        drawClear: [(u) => forbidden(u, spec)],
        draw: [(u) => marks(u, spec), (u) => cursorLines(u, view)],
        setCursor: [(u) => u.cursor.event && u.cursor.left >= 0 && on.cursor(u.posToVal(u.cursor.left, "x"))],
        setSelect: [
          (u) => {
            const { left, width } = u.select;
            if (width > 4) on.zoom(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
            if (width > 0) u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
          },
        ],
      },
    },
    [[0, 1], ...series.slice(1).map(() => [null, null])],
    box,
  );
  // a setpoint or a rim follows the pointer that presses on its line; elsewhere a drag zooms
  let held = null;
  const grip = (event) => {
    const { left, top } = plot.over.getBoundingClientRect(), y = event.clientY - top;
    const near = (value) => Math.abs(plot.valToPos(value, "y") - y) < 6;
    return on.handle(spec, plot.posToVal(event.clientX - left, "x"), near);
  };
  plot.over.addEventListener("pointermove", (event) => {
    if (held) on.drag(held, Number(plot.posToVal(event.clientY - plot.over.getBoundingClientRect().top, "y").toPrecision(3)));
    else plot.over.style.cursor = grip(event) ? "ns-resize" : "";
  });
  plot.over.addEventListener("pointerdown", (event) => {
    held = event.button === 0 ? grip(event)?.name ?? null : null;
    if (held) plot.over.setPointerCapture(event.pointerId);
  });
  for (const end of ["pointerup", "pointercancel"]) plot.over.addEventListener(end, () => (held = null));
  box.addEventListener("mousedown", (event) => held && event.stopPropagation(), true); // not a zoom
  // a click sets cursor A; with shift, or by a long press of a finger, B
  let press = null, waiting = 0;
  const timeOf = (event) => plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x");
  const letGo = () => {
    press = null;
    clearTimeout(waiting);
  };
  plot.over.addEventListener("pointerdown", (event) => {
    letGo();
    if (event.button !== 0) return;
    press = event;
    if (event.pointerType === "touch" && !held) waiting = setTimeout(() => {
      letGo();
      on.mark("B", timeOf(event), false);
    }, LONG_PRESS);
  });
  plot.over.addEventListener("pointermove", (event) => {
    const least = event.pointerType === "touch" ? 12 : 4; // pixels of a drag
    if (press && Math.hypot(event.clientX - press.clientX, event.clientY - press.clientY) > least) letGo();
  });
  plot.over.addEventListener("pointercancel", letGo);
  plot.over.addEventListener("contextmenu", (event) => event.pointerType === "touch" && event.preventDefault());
  box.addEventListener("click", (event) => { // before uPlot, which takes a press on a line for a drag
    if (press) on.mark(event.shiftKey ? "B" : "A", timeOf(event), event.detail > 1);
    letGo();
  }, true);
  const show = (k, yes) => plot.series[k].show !== yes && plot.setSeries(k, { show: yes }, false);
  return {
    spec,
    figure,
    // lines: {run, setpoint or null, pins: [values], band: {t, low, high} or null}, over times t
    draw(t, lines) {
      const used = [...lines.pins.filter(Boolean), ...(lines.setpoint ? [lines.setpoint] : []), lines.run];
      const cut = envelope(t, used, view.from, view.to, Math.max(50, Math.round(plot.width)));
      const at = cut[0], none = new Array(at.length).fill(null);
      const data = [at, none, none];
      const seen = lines.pins.filter(Boolean);
      for (let i = 0; i < PINS; i += 1) data.push(lines.pins[i] ? cut[1 + seen.indexOf(lines.pins[i])] : none);
      data.push(lines.setpoint ? cut[cut.length - 2] : none, cut[cut.length - 1]);
      const { band } = lines;
      if (band) {
        data[1] = interpolated(band.t, band.low, at);
        data[2] = interpolated(band.t, band.high, at);
      }
      state.range = rangeOf(spec, [...used, ...(band ? [band.low, band.high] : [])]);
      plot.batch(() => {
        show(1, Boolean(band));
        show(2, Boolean(band));
        for (let i = 0; i < PINS; i += 1) show(3 + i, Boolean(lines.pins[i]));
        show(3 + PINS, Boolean(lines.setpoint));
        plot.setData(data, true);
      });
    },
    read(words) {
      reading.textContent = words;
    },
    describe(words) {
      box.setAttribute("aria-label", words);
    },
    at(time) {
      const left = plot.valToPos(time, "x");
      plot.setCursor({ left, top: plot.over.clientHeight / 2 }, false);
    },
    redraw: () => plot.redraw(false, true),
    size() {
      const width = Math.floor(box.clientWidth), height = Math.floor(box.clientHeight);
      if (width > 40 && (width !== plot.width || height !== plot.height))
        plot.setSize({ width, height });
    },
  };
}

const LONG_PRESS = 500; // milliseconds
const FONT = "11px system-ui, sans-serif";

// the range of the vertical axis: all values, the limits that come near, and zero for levels
function rangeOf(spec, arrays) {
  let [low, high] = extent(arrays);
  if (!Number.isFinite(low) || !Number.isFinite(high)) return [0, 1];
  for (const { value, always } of spec.limits) {
    if (always || (high > 0.6 * value && value > 0)) {
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  if (spec.zero && low > 0 && low < 0.6 * high) low = 0;
  const span = high - low || Math.abs(high) || 1;
  return [low === 0 ? 0 : low - 0.05 * span, high + 0.06 * span];
}

function forbidden(u, spec) {
  if (spec.forbidden === null || spec.forbidden === undefined) return;
  const { ctx, bbox } = u, y = Math.min(u.valToPos(spec.forbidden, "y", true), bbox.top + bbox.height);
  if (y <= bbox.top) return;
  ctx.fillStyle = colour("--beyond");
  ctx.fillRect(bbox.left, bbox.top, bbox.width, y - bbox.top);
}

function cursorLines(u, { cursors }) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.strokeStyle = ctx.fillStyle = colour("--text");
  ctx.lineWidth = devicePixelRatio;
  ctx.font = `bold ${11 * devicePixelRatio}px system-ui, sans-serif`;
  for (const [name, time] of Object.entries(cursors)) {
    const x = time === null ? -1 : u.valToPos(time, "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.fillText(name, x + 3 * devicePixelRatio, bbox.top + 10 * devicePixelRatio);
  }
  ctx.restore();
}

function marks(u, spec) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.strokeStyle = colour("--limit");
  ctx.fillStyle = colour("--limit-text");
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "right";
  ctx.textBaseline = "alphabetic";
  for (const { value, words } of spec.limits) {
    const y = u.valToPos(value, "y", true);
    if (y < bbox.top - 1 || y > bbox.top + bbox.height + 1) continue;
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    const below = y - bbox.top < 14 * devicePixelRatio;
    ctx.fillText(words, bbox.left + bbox.width - 4, y + (below ? 12 : -4) * devicePixelRatio);
  }
  ctx.restore();
}
