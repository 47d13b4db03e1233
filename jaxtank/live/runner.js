// Runs for the picture, in a worker: one at a time, and of those asked for meanwhile only the newest.

// make(): a new worker of worker.js; alone(request): the same run without one, where there is none
// on: {done(run, request, milliseconds), failed(text)}
function makeRunner(make, alone, on) {
  let worker = null, busy = null, next = null, old = null;

  function here(request) {
    const start = performance.now();
    try {
      on.done(alone(request), request, performance.now() - start);
    } catch (error) {
      on.failed(String((error && error.message) || error));
    }
  }

  function answered({ data: answer }) {
    const request = busy;
    busy = null;
    if (next) send(next); // before the answer is drawn, so that both are done at the same time
    if (request === old) return;
    if (answer.kind === "run") on.done(answer.run, request, answer.milliseconds);
    else on.failed(answer.text);
  }

  function send(request) {
    next = null;
    busy = request;
    worker.postMessage({ kind: "run", ...request });
  }

  function without() { // a page whose surroundings allow no workers
    const request = next || busy;
    worker = false;
    busy = next = null;
    if (request) setTimeout(here, 0, request);
  }

  return {
    ask(request) {
      try {
        worker ??= make();
      } catch {
        worker = false;
      }
      if (!worker) return void here(request);
      worker.onmessage = answered;
      worker.onerror = without;
      if (busy) next = request;
      else send(request);
    },
    drop() { old = busy; }, // the run that is under way is not shown
    get busy() { return busy !== null; },
  };
}
