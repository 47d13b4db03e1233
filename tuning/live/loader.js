// Unpacks the parts of the page in their order; each is allowed by its hash in the page's policy.

const unpacked = {};
for (const id of ["data", "core", "worker", "engine", "uplot", "page"]) {
  unpacked[id] = inflate(document.getElementById(id).textContent);
}
window.jaxtank = { unpacked };
const { engine, uplot, core, page } = unpacked;
for (const text of [engine, uplot, `(() => {"use strict";\n${core}\n${page}\n})();`]) {
  const script = document.createElement("script");
  script.textContent = text;
  document.head.append(script);
}
