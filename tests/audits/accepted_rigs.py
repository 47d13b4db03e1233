"""Random complete rig files: what is accepted is run, and trial by oracles of its own.

    python tests/audits/accepted_rigs.py COUNT [SEED] [--record]

reads rigs SEED (0) to SEED + COUNT - 1 of `drawn_rigs`, each in one order and units. A file that is
refused is counted. Of the others it asks whether the answer is finite and strict JSON; whether
each sample follows from the one before by `drawn_physics`, which shares no code with the plant;
whether half the step, other units, another order of the tanks, the file that the tool writes,
arrays in place of scalars, C and JavaScript give the same run; and which keys change nothing. It
prints failures with their seed, and keys that never changed a run. Exit code 1 where one fails.
"""

import collections
import contextlib
import dataclasses
import functools
import io
import json
import resource
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple

import drawn_rigs
import jax
import numpy as np
import survived
from drawn_physics import balance_errors
from rig_text import FLOWS, LENGTHS, RANGES, text

from jaxtank import rig as rigs
from jaxtank.core import vectors
from jaxtank.core.errors import InputError, NonFiniteError
from jaxtank.export import source
from jaxtank.export.replay import replay
from jaxtank.loop import saved_rows
from jaxtank.loop.closed_loop import draws_bursts
from jaxtank.loop.halving import halving_warnings
from jaxtank.loop.step_size import step_warnings
from jaxtank.loop.trajectory import columns
from jaxtank.loop.validation import check
from tuning.cli.main import main as command

SAME = 1e-9
"""Share of a tank's height, or of an input's range, by which equal runs may differ [-]."""
SLOWEST = 10.0
"""Longest time of a rig, without programs that are compiled for its group [s]."""
FIELDS = ("x", "y", "u", "r", "spilled")


class Run(NamedTuple):
    """A run in m, s and shares: x, y, u, r, spilled (samples, .)."""

    x: np.ndarray
    y: np.ndarray
    u: np.ndarray
    r: np.ndarray
    spilled: np.ndarray


def key_of(case):
    """The key of a run with noise; None of another."""
    noisy = np.any(np.asarray(case.loop.sensor.noise) > 0) or draws_bursts(case.loop)
    return jax.random.key(0) if noisy else None


def run_of(case, clock=None, program=saved_rows.simulate_compiled):
    """(trajectory of a case, whether all of it is finite)."""
    run, broken = program(case.loop, clock or case.clock, key_of(case), 1)
    columns = (np.asarray(getattr(run, name)) for name in (*FIELDS, "command", "x_hat", "e"))
    return run, not bool(broken) and all(np.all(np.isfinite(c)) for c in columns)


def in_si(run, rig, style):
    """The Run of a trajectory in the units of a style, tanks in the order of the rig."""
    length, valves = LENGTHS[style.length], len(rig.get("valve", []))
    order = np.argsort(style.order) if style.order else slice(None)
    full = [style.range] * len(rig.get("pump", []))
    full += [100.0 if style.drive == "%" else 1.0] * valves
    x, y, spilled = (np.asarray(getattr(run, name))[:, order] for name in ("x", "y", "spilled"))
    u, r = np.asarray(run.u) / full, np.asarray(run.r)
    return Run(x / length, y / length, u, r / length, spilled / length**3)


def apart(run, other):
    """Largest difference of two runs as a share of the levels and inputs in them."""
    worst = 0.0
    for name in FIELDS:
        a, b = getattr(run, name), getattr(other, name)
        size = 1.0 if name == "u" else max(float(np.max(np.abs(a), initial=0.0)), 1e-12)
        worst = max(worst, float(np.max(np.abs(a - b), initial=0.0)) / size)
    return worst


def amplified(case, rig, style):
    """By how much a start and a plant that are 1e-13 off move a run, as `apart`."""
    off = lambda part: jax.tree.map(lambda leaf: np.asarray(leaf) * (1.0 - 1e-13), part)
    loop = dataclasses.replace(case.loop, x0=off(case.loop.x0), plant=off(case.loop.plant))
    moved = run_of(case.replace(loop=loop))[0]
    return apart(in_si(run_of(case)[0], rig, style), in_si(moved, rig, style))


def said(words):
    """(exit code, stdout, stderr) of a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = command(words)
    return code, out.getvalue(), err.getvalue()


@functools.cache
def array_program(_):
    """The program of a run with vectors as arrays."""
    function = functools.partial(saved_rows.simulate_compiled.__wrapped__)  # a cache of its own
    return jax.jit(function, static_argnums=(1, 3))


class Judged:
    """A rig file under the oracles: `failures` in words, and what else is counted."""

    def __init__(self, seed, folder):
        self.seed, self.folder, self.failures = seed, Path(folder), []
        self.rig, self.style = drawn_rigs.draw(seed), drawn_rigs.style_of(seed)
        self.text = text(self.rig, self.style)
        self.refusal, self.removed, self.notes = "", None, ""

    def fail(self, oracle, words):
        """Keep a failure."""
        self.failures.append(f"{oracle}: {words}")

    def read(self):
        """Read the file; False where it is refused."""
        try:
            for name, content in self.rig.get("files", {}).items():
                (self.folder / name).write_text(content)
            self.case = rigs.loads(self.text, folder=self.folder)
            check(self.case.loop, self.case.clock, key_of(self.case))
        except (InputError, NonFiniteError) as error:
            self.refusal = str(error)
            return False
        return True

    def judge(self):
        """Run the file under all oracles."""
        if not self.read():
            return self
        if not (self.answered() if self.seed // drawn_rigs.GROUP % 3 == 0 else self.noted()):
            return self
        trajectory, finite = run_of(self.case)
        if not finite:
            self.fail("finite", "a column of the trajectory is not")
            return self
        self.trajectory, self.base = trajectory, in_si(trajectory, self.rig, self.style)
        oracles = [self.balance, self.halved, self.units, self.permuted, self.reloaded, self.arrays]
        oracles += [self.code] * (self.seed % 4 == 0) + [self.without] * (self.seed % 4 == 1)
        for oracle in oracles:
            oracle()
        return self

    def answered(self):
        """Run the command; False where it refuses."""
        path = self.folder / "rig.toml"
        path.write_text(self.text)
        code, out, self.notes = said(["simulate", str(path), "--json"])
        if code == 0:
            self.strict(out)
            return True
        self.refusal = self.notes.strip().splitlines()[-1]
        if code != 2:
            self.fail("answer", f"exit code {code}: {self.refusal}")
        return False

    def noted(self):
        """What the command notes, without its measures, which take as long to compile as the run;
        False where it refuses.
        """
        loop, clock = self.case.loop, self.case.clock
        try:
            lines = halving_warnings(loop, clock, key_of(self.case))
        except InputError as error:
            self.refusal = str(error)
            return False
        lines += rigs.case_warnings(self.case) + step_warnings(loop, clock)
        self.notes = "\n".join(lines)
        return True

    def strict(self, out):
        """The JSON has no NaN, and of each null a reason."""
        try:
            answer = json.loads(out, parse_constant=lambda name: 1 / 0)
        except (ValueError, ZeroDivisionError):
            return self.fail("json", out[:200])
        for name, value in answer["measures"].items():
            empty = value is None or (isinstance(value, list) and None in value)
            if empty and name not in answer["reasons"]:
                self.fail("json", f"{name} is null without a reason")

    def compare(self, oracle, rig, style, other, base=None, case=None):
        """Fail where a run is another one, unless rounding is multiplied by the loop."""
        base = self.base if base is None else base
        off = apart(base, in_si(other, rig, style))
        if off > SAME:
            moves = amplified(case or self.case, self.rig, self.style)
            if off > 1e3 * moves:
                self.fail(oracle, f"{off:.3g} apart, and {moves:.3g} by 1e-13 of the plant")

    def balance(self):
        """Each sample from the one before, by formulas of its own."""
        for words in balance_errors(self.rig, self.base, self.case.clock):
            self.fail("balance", words)

    def halved(self):
        """Half the step of integration."""
        finer = dataclasses.replace(self.case.clock, substeps=2 * self.case.clock.substeps)
        other, finite = run_of(self.case, finer)
        tops = np.asarray(self.case.loop.plant.rim)
        off = np.max(np.abs(np.asarray(other.x) - np.asarray(self.trajectory.x)), axis=0) / tops
        warned = any(words in self.notes for words in ("half the step", "faster than the steps"))
        if finite and (np.max(off) <= 0.01 or warned):
            return
        moves = amplified(self.case, self.rig, self.style)
        if not finite or moves < 1e-9:
            self.fail("halving", f"{np.max(off):.3g} of a rim, no note; 1e-13 moves {moves:.2g}")

    def other(self, oracle, style, rig=None):
        """The case of the rig in another style, and its trajectory; None where it is refused."""
        try:
            case = rigs.loads(text(rig or self.rig, style), folder=self.folder)
            return case, run_of(case)[0]
        except (InputError, NonFiniteError) as error:
            if "must be the share of it" not in str(error):  # the gain of an input that is a flow
                self.fail(oracle, f"refused: {error}")
            return None

    def units(self):
        """The rig in other units."""
        rng = np.random.default_rng([self.seed // drawn_rigs.GROUP, 4])
        length = str(rng.choice([name for name in LENGTHS if name != self.style.length]))
        drive = str(rng.choice([name for name in (*RANGES, *FLOWS) if name != self.style.drive]))
        style = self.style._replace(length=length, drive=drive, texts=None)
        if other := self.other("units", style):
            self.compare(f"units {length}, {drive}", self.rig, style, other[1])

    def permuted(self):
        """The tanks in another order; without noise, whose draws go by the order, and not with an
        unscented filter, whose points are the columns of a triangular root: they depend on it.
        """
        count = len(self.rig["tank"])
        unscented = self.rig.get("observer", {}).get("kind") == "unscented-kalman"
        if count == 1 or unscented or draws_bursts(self.case.loop):
            return
        rng = np.random.default_rng([self.seed // drawn_rigs.GROUP, 5])
        order = tuple(int(i) for i in np.roll(np.arange(count), 1 + rng.integers(count - 1)))
        quiet = drawn_rigs.without_noise(self.rig)
        style = self.style._replace(order=order)
        first, other = (self.other("order", s, quiet) for s in (self.style, style))
        if first and other:
            base = in_si(first[1], quiet, self.style)
            self.compare("order", quiet, style, other[1], base, first[0])

    def reloaded(self):
        """The file that the tool writes gives the same bits."""
        try:
            written = rigs.dump(self.case)
            again = rigs.loads(written)
        except InputError as error:
            return self.fail("written", f"{error}")
        run = run_of(again)[0]
        for name in FIELDS:
            if not np.array_equal(getattr(run, name), getattr(self.trajectory, name)):
                off = apart(self.base, in_si(run, self.rig, self.style))
                return self.fail("written", f"{name} differs, {off:.3g}")
        if rigs.dump(again) != written:
            self.fail("written", "written again it is another text")

    def arrays(self):
        """Vectors as arrays in place of tuples."""
        before, vectors.FROM = vectors.FROM, 1
        try:
            run = run_of(self.case, program=array_program(self.seed // drawn_rigs.GROUP))[0]
        finally:
            vectors.FROM = before
        self.compare("arrays", self.rig, self.style, run)

    def code(self):
        """C and JavaScript of the controller against the run; they start from the first reading."""
        if not np.array_equal(self.base.x[0], self.base.y[0]):
            return
        data = self.folder / "run.csv"
        log = columns(self.trajectory, self.case.loop.units)
        rows = np.column_stack([v for name, v in log.items() if not name.startswith("d_hat")])
        names = ",".join(name for name in log if not name.startswith("d_hat"))
        np.savetxt(data, rows, "%.17g", ",", header=names, comments="")
        for language in ("c", "js"):
            try:
                files = source.files(self.case, language, name="rig")
            except InputError:
                continue  # it says why
            for name, content in files.items():
                (self.folder / name).write_text(content)
            try:
                answer = replay(self.folder / f"rig.{language}", data)
            except InputError as error:
                self.fail(language, f"refused: {error}")
                continue
            full = np.max(np.abs(np.asarray(self.trajectory.u))) + 1e-12
            worst = max(row["largest_difference"] for row in answer["inputs"]) / full
            if worst > 1e-6 and worst > 1e5 * amplified(self.case, self.rig, self.style):
                self.fail(language, f"{worst:.3g} of the largest input apart")

    def without(self):
        """Take one key away at random: does its absence change the run?"""
        name, changed = drawn_rigs.without_a_key(self.rig, self.seed)
        if name is None:
            return
        try:
            case = rigs.loads(text(changed, self.style), folder=self.folder)
            run, _ = run_of(case)
        except (InputError, NonFiniteError):
            return
        off = apart(self.base, in_si(run, changed, self.style))
        self.removed = name, off > 0.0


def measured(seed, warm=False):
    """The Judged of a seed and its time; a traceback is a failure."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trial = Judged(seed, folder)
        try:
            trial.judge()
        except Exception:
            trial.fail("traceback", traceback.format_exc(limit=-4))
    spent = time.perf_counter() - start
    if spent > SLOWEST and warm and not trial.removed:
        trial.fail("time", f"{spent:.1f} s")
    return trial, spent


def audit(count, first=0):
    """Judge seeds first to first + count - 1; print what fails; return (counts, failed seeds)."""
    counts, keys, failed = collections.Counter(), collections.defaultdict(list), []
    for seed in range(first, first + count):
        if seed % drawn_rigs.GROUP == 0 and seed > first:
            jax.clear_caches()
            array_program.cache_clear()
        trial, spent = measured(seed, warm=seed > first + 1 and seed % 4 > 1)
        counts["refused" if trial.refusal else "accepted"] += 1
        if trial.removed:
            keys[trial.removed[0]].append(trial.removed[1])
        if trial.refusal:
            print(f"{seed} refused: {trial.refusal[:200]}", flush=True)
        for words in trial.failures:
            print(f"{seed} FAILED ({trial.rig['controller']['kind']}) {words}", flush=True)
        if trial.failures:
            failed.append(seed)
        if seed % 40 == 39:
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            print(f"{seed}: {dict(counts)}, {memory:.2f} GB, last {spent:.1f} s", flush=True)
    for name, changes in sorted(keys.items()):
        if not any(changes):
            print(f"never changed a run: {name}, in {len(changes)} rigs")
    print(f"keys taken away: { {n: f'{sum(c)}/{len(c)}' for n, c in sorted(keys.items())} }")
    print(f"{dict(counts)}; {len(failed)} failed: {failed}")
    return counts, failed


def main(words):
    numbers = [int(word) for word in words if word.lstrip("-").isdigit()]
    jax.config.update("jax_enable_x64", True)
    counts, failed = audit(*numbers[:2] or [24])
    if "--record" in words:
        tried = counts["accepted"] + counts["refused"]
        outcome = f"{counts['accepted']:,} accepted, {counts['refused']:,} refused in one line; "
        survived.record("rig files", tried, outcome + f"{len(failed) or 'none'} failed an oracle")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
