"""Time of one step of an exported controller in C on this machine."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.export.source import files

STEPS, ROUNDS = 20_000, 5
"""Steps in a round, at most, and rounds, of which the fastest counts."""

LONGEST = 0.2
"""Seconds after which a round ends."""

DRIVER = """
#include <stdio.h>
#include <time.h>
#include "law.h"
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
int main(void)
{
    const double start[] = {%(levels)s}, set[] = {%(setpoints)s};
    double y[LAW_TANKS], r[LAW_OUTPUTS], u[LAW_PUMPS], best = 1e30, sum = 0.0;
    law_state state;
    for (int round = 0; round < %(rounds)d; ++round) {
        law_init(&state, NULL, start, NULL);
        const double began = now();
        double took = 0.0;
        int k = 0;
        while (k < %(steps)d && took < %(longest)g) {
            for (int i = 0; i < LAW_TANKS; ++i) y[i] = start[i] * (1.0 + 0.01 * (double)(k %% 7));
            const double step = 1.0 + 0.1 * (double)(k / 500 %% 3);
            for (int i = 0; i < LAW_OUTPUTS; ++i) r[i] = set[i] * step;
            law_step(&state, NULL, k * law_dt, y, r, NULL, NULL, NULL, u);
            sum += u[0];
            if (++k %% 50 == 0) took = now() - began;
        }
        const double one = (now() - began) / k;
        best = one < best ? one : best;
    }
    printf("%%.6g %%.3g\\n", 1e6 * best, sum);
    return 0;
}
"""


def step_time(case: Case) -> tuple[float | None, str]:
    """(core time of a step of the controller in C by gcc -O2 [us], why it is not known)."""
    if shutil.which("gcc") is None:
        return None, "no gcc on this machine"
    try:
        texts = files(case, "c", name="law")
    except InputError as error:
        return None, str(error)
    numbers = lambda values: ", ".join(repr(float(v)) for v in np.ravel(values))
    setpoints = np.asarray(case.loop.reference.sample(case.clock)[0], dtype=float)[:, 0]
    fields = {"levels": numbers(case.loop.x0), "setpoints": numbers(setpoints)}
    driver = DRIVER % (fields | {"steps": STEPS, "rounds": ROUNDS, "longest": LONGEST})
    with tempfile.TemporaryDirectory() as folder:
        for name, text in (texts | {"time.c": driver}).items():
            (Path(folder) / name).write_text(text)
        build = ["gcc", "-std=gnu99", "-O2", "-o", "time", "time.c", "law.c", "-lm"]
        built = subprocess.run(build, cwd=folder, capture_output=True, text=True, check=False)
        if built.returncode:
            return None, f"gcc: {built.stderr.strip().splitlines()[-1]}"
        command = [str(Path(folder) / "time")]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[0]), ""
