// The rig as a drawing: tanks with their levels at the cursor, pumps, pipes, jets, overflow.

const SVG = "http://www.w3.org/2000/svg";
const UNIT = 100; // of the drawing, for the height of the tallest tank

function draw(tag, attributes, text) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== undefined) node.textContent = text;
  return node;
}

// a name as long as a tank is wide
const shortened = (name) => (name.length > 12 ? `${name.slice(0, 11)}…` : name);

// rig: data of jaxtank/live/page.py; movable(name) -> {leaf, value(), set(value)} or false; returns
// {update({h, r, u, spills})}
function makeRig(svg, rig, info, movable) {
  const { left, right, bottom, top } = rig;
  const X = (x) => (x - left) * UNIT, Y = (y) => (top - y) * UNIT;
  const points = (path) => path.map(([x, y]) => `${X(x).toFixed(1)},${Y(y).toFixed(1)}`).join(" ");
  svg.setAttribute("viewBox", `0 0 ${(right - left) * UNIT} ${(top - bottom) * UNIT}`);
  const add = (...args) => svg.appendChild(draw(...args));
  const line = (path, name, more = {}) =>
    add("polyline", { points: points(path), class: name, fill: "none", ...more });
  add("rect", { class: "water basin", x: X(left + 0.06), y: Y(bottom + 0.2), height: 14,
    width: (right - left - 0.12) * UNIT });
  line([[left + 0.06, -0.82], [left + 0.06, bottom + 0.06], [right - 0.06, bottom + 0.06],
    [right - 0.06, -0.82]], "glass");
  const risers = rig.risers.map(([pump, , path]) => [pump, line(path, `riser pump${pump % 4}`)]);
  rig.suctions.forEach(([pump, , path]) => line(path, `riser suction pump${pump % 4}`));
  const valves = rig.valves.map(([path, [x, y], name], k) => {
    const across = path[0][1] === path[1][1] && path[0][1] === y;
    const node = line(path, "jet");
    const wings = [-1, 1].map((s) => across ? [[x, y], [x + s * 0.1, y + 0.07], [x + s * 0.1, y - 0.07]]
      : [[x, y], [x + 0.07, y + s * 0.1], [x - 0.07, y + s * 0.1]]);
    wings.forEach((wing) => add("polygon", { points: points(wing), class: "valve" }));
    const words = add("text", { x: X(x) + (across ? 0 : 12), y: Y(y) - (across ? 12 : -4), class: "halo small",
      "text-anchor": across ? "middle" : "start" });
    return { j: rig.pumps.length + k, node, words, x, y, name };
  });
  const jets = rig.jets.map(([tank, path, name]) => ({ tank, node: line(path, "jet"), name }));
  const spills = rig.overflows.map(([tank, path]) => [tank, line(path, "spill")]);
  const tanks = rig.boxes.map(([x, y, width, height, scale], i) => {
    const place = { x: X(x), width: width * UNIT };
    const inside = add("rect", { class: "inside", ...place, y: Y(y + height), height: height * UNIT });
    const water = add("rect", { class: "water", ...place, y: Y(y), height: 0 });
    return { x, y, width, height, scale, inside, water, controlled: info.outputs.includes(i) };
  });
  const pipes = rig.pipes.map(([x0, x1, y, name]) =>
    ({ name, nodes: ["pipe", "pipe inner"].map((kind) => line([[x0, y], [x1, y]], kind)) }));
  tanks.forEach((tank, i) => {
    const { x, y, width, height } = tank;
    const wall = [[x, y + height], [x, y], [x + width, y], [x + width, y + height]];
    tank.wall = line(wall, tank.controlled ? "wall controlled" : "wall");
    const middle = { x: X(x + width / 2), "text-anchor": "middle" };
    const small = width < 0.7 ? " small" : "";
    add("text", { ...middle, y: Y(y + height / 2) - 4, class: `halo${small}` }, shortened(info.tanks[i].name));
    if (rig.shapes[i]) add("text", { ...middle, y: Y(y) - 6, class: "halo small" }, rig.shapes[i]);
    tank.text = add("text", { ...middle, y: Y(y + height / 2) + 11, class: `halo value${small}` });
    if (tank.controlled) tank.mark = line([[0, 0], [0, 0]], "setpoint");
  });
  rig.pumps.forEach(([x, y], j) => {
    add("circle", { cx: X(x), cy: Y(y), r: 17, class: `pump pump${j % 4}` });
    add("polygon", { points: points([[x - 0.1, y - 0.08], [x + 0.1, y - 0.08], [x, y + 0.13]]),
      class: `rotor pump${j % 4}` });
    add("text", { x: X(x), y: Y(y) - 22, "text-anchor": "middle", class: "halo small" }, `${j + 1}`);
  });
  // a rim, an outlet, a pipe or a valve follows a pointer: moved(start value, pixels of the drawing upwards) is its next value
  function handle(node, name, moved) {
    const one = movable(name);
    if (!one) return;
    let from = null;
    const height = () => (svg.getScreenCTM()?.d ?? 1);
    node.classList.add("handle");
    node.append(draw("title", {}, `${one.leaf.label}: drag up or down`));
    node.addEventListener("pointerdown", (event) => {
      from = { y: event.clientY, value: one.value() };
      node.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    node.addEventListener("pointermove", (event) => {
      if (from) one.set(Number(moved(from.value, (from.y - event.clientY) / height()).toPrecision(3)));
    });
    for (const end of ["pointerup", "pointercancel"]) node.addEventListener(end, () => (from = null));
  }
  const opened = (value, up) => value * Math.exp(up / 40);
  tanks.forEach((tank, i) => {
    const grip = add("rect", { class: "grip", x: X(tank.x) - 6, width: tank.width * UNIT + 12, height: 12 });
    tank.grip = grip;
    const name = movable(`plant.rim[${i}]`) ? `plant.rim[${i}]` : "plant.rim";
    handle(grip, name, (value, up) => value + up / UNIT / tank.scale);
  });
  const grip = (path) => add("polyline", { points: points(path), class: "grip", fill: "none" });
  rig.jets.forEach(([, path, name]) => handle(grip(path), name, opened));
  rig.pipes.forEach(([x0, x1, y, name]) => handle(grip([[x0, y], [x1, y]]), name, opened));
  valves.forEach(({ j, x, y, name }) => {
    const { lower, upper } = info.pumps[j];
    handle(grip([[x, y + 0.1], [x, y - 0.1]]), name, (value, up) => clamp(value + (up / UNIT) * (upper - lower), lower, upper));
  });
  // as wide as its slider says, beside what it is in the case
  const widen = (node, name, width) => {
    const one = movable(name);
    if (one) node.style.strokeWidth = `${width * clamp(Math.sqrt(one.value() / one.leaf.value), 0.3, 3)}px`;
  };
  return {
    update(now) {
      tanks.forEach((tank, i) => {
        const level = now.h[i], rim = now.rims[i];
        if (Number.isFinite(rim) && rim !== null && rim !== tank.rim) { // as high as its slider says
          const { x, y, width } = tank;
          tank.rim = rim;
          tank.height = Math.min(rim * tank.scale, 1.2);
          tank.wall.setAttribute("points", points([[x, y + tank.height], [x, y], [x + width, y], [x + width, y + tank.height]]));
          tank.inside.setAttribute("y", Y(y + tank.height));
          tank.inside.setAttribute("height", tank.height * UNIT);
          tank.grip.setAttribute("y", Y(y + tank.height) - 6);
        }
        const deep = clamp((Number.isFinite(level) ? level : 0) * tank.scale, 0, 1.05 * tank.height);
        tank.water.setAttribute("y", Y(tank.y + deep));
        tank.water.setAttribute("height", deep * UNIT);
        tank.text.textContent = `${shown(level, 3)} ${info.units.length}`;
        if (!tank.mark) return;
        const target = clamp(now.r[info.outputs.indexOf(i)] * tank.scale, 0, 1.05 * tank.height);
        const end = tank.x + tank.width, y = tank.y + target;
        const arrow = [[end - 0.12, y], [end + 0.03, y], [end + 0.12, y + 0.05], [end + 0.12, y - 0.05],
          [end + 0.03, y]];
        tank.mark.setAttribute("points", points(arrow));
      });
      risers.forEach(([pump, node]) => node.setAttribute("stroke-opacity", 0.25 + 0.75 * now.share[pump]));
      valves.forEach(({ j, node, words }) => {
        const { name, unit } = info.pumps[j];
        node.setAttribute("stroke-opacity", 0.2 + 0.8 * clamp(now.share[j], 0, 1));
        words.textContent = `${name} ${shown(unit === "%" ? now.u[j] : 100 * now.u[j], 3)} %`;
      });
      pipes.forEach(({ nodes: [outer, inner], name }) => {
        widen(outer, name, 14);
        widen(inner, name, 8);
      });
      jets.forEach(({ tank, node, name }) => {
        widen(node, name, 2.5);
        const part = now.h[tank] / now.rims[tank] || 0;
        node.setAttribute("stroke-opacity", clamp(0.15 + Math.sqrt(Math.max(part, 0)), 0, 1));
      });
      spills.forEach(([tank, node]) => node.setAttribute("stroke-opacity", now.spills[tank] ? 1 : 0.2));
    },
  };
}
