// Unpacks the parts of the page in their order; each is allowed by its hash in the page's policy.

const [uplot, page, core, worker, data, engine] =
  inflate(document.getElementById("packed").textContent).split("\0");
window.jaxtank = { unpacked: { core, worker, data, engine } };
for (const text of [engine, uplot, `(() => {"use strict";\n${core}\n${page}\n})();`]) {
  const script = document.createElement("script");
  script.textContent = text;
  document.head.append(script);
}
