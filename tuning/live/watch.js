(() => {
  "use strict";
  const main = document.querySelector("main"), status = () => document.getElementById("status");
  const running = () => status().className === "running";
  const words = (seconds) => {
    const whole = Math.max(0, Math.round(seconds));
    return whole >= 60 ? `${Math.floor(whole / 60)} min ${whole % 60} s` : `${whole} s`;
  };
  let shown = "", script = null, count = 0;
  window.jaxtankWatch = ({ title, body }) => {
    if (body === shown) return;
    shown = body;
    document.title = title;
    main.innerHTML = body; // escaped where it is written
  };
  function clock() {
    if (!running()) return;
    const { began, now } = status().dataset, age = Date.now() / 1000 - Number(now);
    document.getElementById("time").textContent = words(Date.now() / 1000 - Number(began));
    const note = document.getElementById("age");
    note.hidden = age < 30;
    note.textContent = `No update for ${words(age)}: a program is being compiled, or the search was killed.`;
  }
  // a page of a file can read no other file but a script
  function again() {
    clock();
    if (!running()) return;
    if (script) script.remove();
    script = document.createElement("script");
    script.src = `watch.js?${(count += 1)}`;
    document.head.append(script);
  }
  setInterval(again, 1000);
})();
