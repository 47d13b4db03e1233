const law = require(process.argv[1]);
if (process.argv[2] === "facts")
    console.log(JSON.stringify([law.dt, law.tanks, law.outputs, law.pumps, law.units || []]));
else {
    const d = JSON.parse(require("fs").readFileSync(0)), s = law.init(d.y[0]);
    const step = (t, k) => law.step(s, t, d.y[k], d.r[k], d.dr[k], d.ddr[k]);
    console.log(JSON.stringify(d.t.map(step)));
}
