// Unpacks the parts of the page in their order; each is allowed by its hash in the page's policy.

const unpacked = {};
for (const id of ["data", "worker", "engine", "uplot", "page"]) {
  unpacked[id] = inflate(document.getElementById(id).textContent);
  if (id === "data" || id === "worker") continue;
  if (id === "page") window.jaxtank = { unpacked };
  const script = document.createElement("script");
  script.textContent = unpacked[id];
  document.head.append(script);
}
