"""Kills, full disks, folders that cannot be written to, Ctrl-C, two runs in one folder: one line,
the promised exit code, nothing lost.
"""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import interrupt_drill
import numpy as np
import pytest
from fault_drill import kept
from helpers import faulty_pictures

import tuning
from jaxtank import presets
from jaxtank.core import files
from jaxtank.core.errors import InputError
from jaxtank.plots import responses, run as figures
from tuning.cli import main
from tuning.storage import evaluation_log, folder_lock
from tuning.storage.store import NAME, Store

HERE = Path(__file__).parent
SHORT = ["cascaded/pi", "--set", "clock.dt=1", "--set", "clock.duration=400"]
SIMULATE = ["simulate", *SHORT, "--quiet"]
SEARCH = ["tune", *SHORT, "--quiet", "--starts", "1", "--screening", "2", "--validation", "0"]
SEARCH += ["--iterations", "3"]
SPREAD = ["uncertainty", *SHORT, "--samples", "20", "--quiet"]
JAXTANK = [sys.executable, "-m", "tuning.cli.main"]
WRITERS = {
    "simulate": SIMULATE,
    "uncertainty": SPREAD,
    "tune": SEARCH,
    "sensitivity": ["sensitivity", *SHORT, "--quiet"],
    "export": ["export", "cascaded/pi"],
    "show": ["show", "cascaded/pi"],
    "identify": ["identify", "cascaded/pi", "--data", "log.csv", "--quiet"],
    "compare": ["compare", "cascaded"],
}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def say(words, capsys):
    """(exit code, stdout, lines of stderr) of a command."""
    code = main.main([str(w) for w in words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err.splitlines()


def python(code, *words, **options):
    """The end of a Python program in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=120, **options
    )


@contextlib.contextmanager
def small_disk(size):
    """No file may grow past `size` bytes: writing more fails, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(autouse=True)
def heeded():
    """Ctrl-C reaches the processes that are started here also where these tests run in the
    background of a shell, which has it ignored.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def frozen(tmp_path):
    """A folder with an old result in it that nobody may write to, root included."""
    folder = tmp_path / "frozen"
    folder.mkdir()
    (folder / "result.json").write_text("old")
    if os.geteuid():
        folder.chmod(0o500)
        yield folder
        folder.chmod(0o700)
        return
    bind = subprocess.run(["mount", "--bind", folder, folder], capture_output=True)
    if bind.returncode:
        pytest.skip("root, to whom permissions say nothing, may not mount read-only here")
    subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
    yield folder
    subprocess.run(["umount", folder], check=True)


# Files together.


def test_files_are_replaced_together_or_not_at_all(tmp_path):
    (tmp_path / "a").write_text("old a")
    (tmp_path / "b").write_text("old b")
    with small_disk(1000), pytest.raises(OSError, match="too large"):
        files.write_together(tmp_path, {"a": "new a", "b": "x" * 2000})
    (tmp_path / "c").mkdir()
    with pytest.raises(IsADirectoryError):
        files.write_together(tmp_path, {"a": "new a", "c": "new c"})
    assert {p.name for p in tmp_path.iterdir()} == {"a", "b", "c"}
    assert ((tmp_path / "a").read_text(), (tmp_path / "b").read_text()) == ("old a", "old b")
    files.write_together(tmp_path, {"a": "new a", "b": b"new b"})
    assert ((tmp_path / "a").read_text(), (tmp_path / "b").read_text()) == ("new a", "new b")


def test_a_checkpoint_on_a_full_disk(tmp_path):
    with small_disk(100), pytest.raises(InputError, match=r"sqlite3' cannot be written.*--resume"):
        Store(tmp_path / "new", {"measures": ["x" * 200]})


def test_a_log_on_a_disk_that_fills_up_is_good_to_go_on_from(tmp_path):
    log = evaluation_log.EvaluationLog(tmp_path, {"p": 1})
    with small_disk(90_000), pytest.raises(InputError, match="free disk space, then --resume"):
        for i in range(100):
            log.recall("x", [float(i)], lambda i=i: (float(i), 1 / 3))
    again, missing = evaluation_log.EvaluationLog(tmp_path, {"p": 1}, resume=True), []
    results = [
        again.recall("x", [float(i)], lambda i=i: missing.append(i) or (float(i), 1 / 3))
        for i in range(20)
    ]
    assert results == [(float(i), 1 / 3) for i in range(20)]
    assert missing[0] > 5 and missing == list(range(missing[0], 20))


# The command on a full disk, and where nothing can be written.


def old_result(folder, words, capsys):
    """What a first run wrote; its log, if it needs one, is log.csv."""
    if words[0] == "identify":
        row = "".join(f"{k},{3 + k % 5},{4 + 0.01 * k},{4 - 0.01 * k}\n" for k in range(60))
        Path("log.csv").write_text("t_s,pump_V,upper_V,lower_tank_V\n" + row)
        folder.mkdir()
        (folder / "result.json").write_text("old" * 5000)
    else:
        assert say([*words, "--out", folder], capsys)[0] in (0, 3)
    return contents(folder)


def slow_but(*names):
    """The commands that write, all but some of them slow."""
    return [n if n in names else pytest.param(n, marks=pytest.mark.slow) for n in WRITERS]


@pytest.mark.slow_for("simulate")
@pytest.mark.parametrize("name", slow_but("simulate"))
def test_a_full_disk_leaves_one_result_whole(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words, folder = WRITERS[name], tmp_path / "out"
    before = old_result(folder, words, capsys)
    # enough for a batch, not for the largest file of the result, nor for a whole checkpoint
    margin = 0.5 * max(map(len, before.values()))
    seed = ["--seed", "1"] if name in ("simulate", "tune", "uncertainty") else []
    with small_disk(int(margin)):
        code, out, err = say([*words, *seed, "--out", folder], capsys)
    last = [line for line in err if line.startswith("jaxtank: ")]
    # of the system, and of SQLite
    full = any(words in last[0] for words in ("File too large", "disk I/O error"))
    assert code == 2 and last == err[-1:] and full, err
    assert "Traceback" not in "".join(err)
    after = contents(folder)
    drawn = {n for n in before if n.endswith((".png", ".svg", ".gif", ".html"))}
    # there was no room for the new one: all of the old is there; `compare` has the same one again
    if after.get("result.json") == before.get("result.json") and name != "compare":
        assert {n: data for n, data in after.items() if n in before} == before
    else:  # the new one, with no picture of the old
        assert not drawn & after.keys() and before.keys() - drawn <= after.keys()
        assert json.loads(after["result.json"])
    # the old result of identify here is its result.json alone
    new = after.keys() - before.keys() - ({"fit.csv", "rig.toml"} if name == "identify" else set())
    assert all(n.startswith(NAME) for n in new), new
    if name in ("tune", "uncertainty", "sensitivity", "identify"):
        assert out.strip() or "--resume" in last[0]  # the answer is printed, or how to resume


# identify, sensitivity and compare: test_page.py
DRAWERS = slow_but("simulate")
DRAWERS = [d for d in DRAWERS if d == "simulate" or d.values[0] in ("show", "tune", "uncertainty")]


@pytest.mark.slow_for("simulate")
@pytest.mark.parametrize("name", DRAWERS)
def test_a_picture_that_fails_costs_itself_and_not_the_answer(name, tmp_path, capsys, monkeypatch):
    """A text that matplotlib cannot set, in one kind of picture; then a function that fails."""
    monkeypatch.chdir(tmp_path)
    words, folder = WRITERS[name], tmp_path / "out"
    whole = old_result(folder, words, capsys)
    plot, broken = (responses, "responses") if name == "simulate" else (figures, "rig")
    usual = getattr(plot, broken)

    for fault in faulty_pictures(usual):
        monkeypatch.setattr(plot, broken, fault)
        code, _, err = say([*words, "--out", folder], capsys)
        notes = [line for line in err if line.startswith("jaxtank: ")]
        assert code in (0, 3) and notes, err
        assert all("note: " in n and "could not be drawn" in n for n in notes), err
        rest = contents(folder)
        missing = whole.keys() - rest.keys()
        assert missing and all(n.endswith((".png", ".svg")) for n in missing)
        if name != "show":
            assert json.loads(rest["result.json"]) and (name == "simulate" or "report.html" in rest)


@pytest.mark.slow_for("simulate")
@pytest.mark.parametrize("name", DRAWERS)
def test_what_a_file_calls_things_is_never_set_as_mathematics(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text("""case = "cascaded/pi"
name = "$\\\\x{$ $\\\\y{$"
[values]
"clock.dt" = 1.0
"clock.duration" = 400.0
[[scenario]]
name = "$\\\\x{$"
seed = 1
""")
    words = [WRITERS[name][0], "rig.toml", *(w for w in WRITERS[name][1:] if w not in SHORT)]
    old_result(tmp_path / "out", WRITERS[name], capsys)
    code, _, err = say([*words, "--out", "new"], capsys)
    assert code in (0, 3), err
    assert not [line for line in err if "not be drawn" in line or "internal error" in line], err
    pictures = {n for n in contents(tmp_path / "out") if n.endswith(".png")} - {"estimates.png"}
    assert pictures <= contents(tmp_path / "new").keys()


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_that_cannot_be_written_to_is_refused_by_input_validation(name, frozen, capsys):
    for folder in (frozen, frozen / "in" / "it", frozen / "result.json" / "under"):
        code, out, err = say([*WRITERS[name], "--out", folder], capsys)
        assert (code, out, len(err)) == (2, "", 1) and err[0].startswith("jaxtank: --out"), err
    assert contents(frozen) == {"result.json": b"old"}


def test_a_folder_that_cannot_be_is_refused_by_input_validation(tmp_path, capsys):
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for folder, why in ((tmp_path / "link", "nowhere"), ("a\0b", "NUL")):
        code, out, err = say([*WRITERS["simulate"], "--out", folder], capsys)
        assert (code, out, len(err)) == (2, "", 1) and err[0].startswith("jaxtank: --out"), err
        assert why in err[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link"]


# Two runs in one folder.

HOLDER = """
import sys, time
from tuning.storage.folder_lock import hold
with hold(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


@contextlib.contextmanager
def another(folder):
    """A process that holds a folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_folder_is_one_runs_at_a_time_and_a_dead_one_holds_nothing(tmp_path, capsys):
    folder = tmp_path / "out"
    with another(folder) as process:
        began = time.monotonic()
        code, out, err = say([*SIMULATE, "--out", folder], capsys)
        assert code == 2 and out == "" and len(err) == 1
        assert f"process {process.pid}" in err[0] and "give another folder" in err[0]
        assert time.monotonic() - began < 20 and [p.name for p in folder.iterdir()] == [files.LOCK]
        (folder / f".result.json.k3x{files.ASIDE}").write_text("half")
        (folder / ".mine").write_text("whole")
    with folder_lock.hold(folder):  # its process was killed
        assert {p.name for p in folder.iterdir()} == {files.LOCK, ".mine"}
        assert int((folder / files.LOCK).read_text()) == os.getpid()
    assert [p.name for p in folder.iterdir()] == [".mine"]


def test_a_folder_made_for_nothing_is_removed(tmp_path):
    with pytest.raises(KeyError), folder_lock.hold(tmp_path / "a" / "b"):
        raise KeyError
    assert not list(tmp_path.iterdir())
    with folder_lock.hold(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "result.json").write_text("{}")
    assert [p.name for p in (tmp_path / "a" / "b").iterdir()] == ["result.json"]
    with folder_lock.hold(None):
        pass


@pytest.mark.slow
def test_two_at_once(tmp_path):
    """Both may be right one after the other; neither is wrong."""

    def words(folder):
        command = [*JAXTANK, "uncertainty", *SHORT, "--samples", "3000", "--quiet", "--out"]
        return [*command, str(tmp_path / folder)]

    subprocess.run(words("alone"), check=True, capture_output=True)
    both = [
        subprocess.Popen(words("out"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    printed = [(*p.communicate(), p.returncode) for p in both]
    assert sorted(code for *_, code in printed) in ([0, 2], [0, 0])
    assert all(
        err == "" if code == 0 else "another run" in err and err.count("\n") == 1
        for _, err, code in printed
    )
    mine, theirs = contents(tmp_path / "out"), contents(tmp_path / "alone")
    assert mine.keys() == theirs.keys() and mine["draws.csv"] == theirs["draws.csv"]


# Ctrl-C.


def interrupted(words, folder, lines, number=signal.SIGINT):
    """(stderr, exit code) of a command that gets a signal once so many evaluations are kept; 0: as
    soon as the folder is there.
    """
    process = subprocess.Popen(
        [*JAXTANK, *words, "--out", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < until:
        if (lines == 0 and folder.exists()) or kept(folder) >= lines > 0:
            break
        time.sleep(0.005)
    process.send_signal(number)
    return process.communicate(timeout=120)[1], process.returncode


LONG = ["tune", "cascaded/pi", "--set", "clock.dt=0.1", "--set", "clock.duration=1000"]
LONG += ["--screening", "64", "--validation", "0"]


def interrupted_search(tmp_path, lines, number=signal.SIGINT):
    """Check that a search that gets a signal writes its best point so far."""
    words = [*LONG, "--starts", "40", "--quiet"]
    printed, code = interrupted(words, tmp_path / "out", lines, number)
    assert code == 128 + number and "Traceback" not in printed, printed
    page = json.loads((tmp_path / "out" / "result.json").read_text())
    assert page["status"] == "interrupted" and page["evaluations"]["simulations"] > 0
    assert 0 < kept(tmp_path / "out") < 200
    assert (tmp_path / "out" / "rig.toml").exists() and not (tmp_path / "out" / files.LOCK).exists()


@pytest.mark.slow
@pytest.mark.parametrize("lines", [6, 11, 25])
def test_ctrl_c_gives_the_best_point_so_far(lines, tmp_path):
    interrupted_search(tmp_path, lines)


@pytest.mark.slow
def test_sigterm_gives_the_best_point_so_far(tmp_path):
    interrupted_search(tmp_path, 6, signal.SIGTERM)


@pytest.mark.parametrize(
    ("lines", "number", "word"),
    [
        (0, signal.SIGTERM, "terminated"),
        pytest.param(0, signal.SIGINT, "interrupted", marks=pytest.mark.slow),
        # only the case's own values have been evaluated: what follows is compiled first
        pytest.param(2, signal.SIGINT, "interrupted", marks=pytest.mark.slow),
    ],
)
def test_a_signal_before_anything_was_found_ends_the_program_and_frees_its_folder(
    lines, number, word, tmp_path
):
    printed, code = interrupted([*LONG, "--quiet"], tmp_path / "out", lines, number)
    assert (printed, code) == (f"jaxtank: {word}\n", 128 + number)
    assert all(path.name.startswith(NAME) for path in tmp_path.glob("out/*"))
    with folder_lock.hold(tmp_path / "out"):
        pass


ENTRY = """
import os, signal, sys

# a shell may have started the tests with it ignored
signal.signal(signal.SIGINT, signal.default_int_handler)

class Interrupting:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
from tuning.cli.main import main
sys.exit(main())
"""


@pytest.mark.slow_for("numpy", "jax")
@pytest.mark.parametrize("module", ["tuning.cli.parser", "numpy", "jax"])
def test_ctrl_c_in_an_import_ends_the_program_at_once(module):
    done = python(ENTRY.format(module=module), "simulate", *SHORT)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "jaxtank: interrupted\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_is_ignored_at_the_start_stays_ignored(number):
    """As a shell has it for Ctrl-C when a script runs a command in the background."""
    code = (
        f"import os, signal, time; signal.signal({int(number)}, signal.SIG_IGN)\n"
        "from tuning.cli import interrupts; interrupts.listen()\n"
        f"os.kill(os.getpid(), {int(number)}); time.sleep(0.5); print('went on')"
    )
    done = python(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "went on\n", "")


def test_a_search_in_the_background_ignores_ctrl_c_and_ends_with_sigterm():
    """A script that runs it with & has its SIGINT ignored, from before the search to its end."""
    code = (
        "import os, signal, sys, time; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "from tuning.cli import interrupts; interrupts.listen(); search = interrupts.Interrupts()\n"
        "search.check(); os.kill(os.getpid(), signal.SIGINT); time.sleep(0.5); search.check()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\nwhile not search.stop: time.sleep(0.01)\n"
        "try: search.check()\n"
        "except KeyboardInterrupt: print('reports'); sys.exit(search.code)"
    )
    done = python(code)
    assert (done.returncode, done.stdout) == (143, "reports\n")
    assert done.stderr.startswith("jaxtank: terminated, finishing with the best point so far")
    assert done.stderr.count("\n") == 1


def test_a_second_ctrl_c_ends_a_search_at_once(tmp_path):
    """The first is answered while an evaluation is compiled that takes for ever; one that comes at
    once after it, as of `timeout`, which signals a program and its group, is the same.
    """
    code = (
        "import os, signal, sys, time; from tuning.cli import interrupts;"
        # a shell starts a background job with SIGINT ignored
        " signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "interrupts.listen(); search = interrupts.Interrupts()\nsearch.check()\n"
        "os.kill(os.getpid(), signal.SIGINT)\nwhile not search.stop: time.sleep(0.01)\n"
        "os.kill(os.getpid(), signal.SIGINT); time.sleep(1); print('went on', flush=True);"
        " os.kill(os.getpid(), signal.SIGINT); time.sleep(60); print('for ever')"
    )
    done = python(code)
    first, second = done.stderr.splitlines()
    assert (done.returncode, done.stdout, second) == (130, "went on\n", "jaxtank: stopped at once")
    assert "best point so far" in first


def test_importing_the_library_leaves_signals_alone():
    code = """
import signal
handlers = lambda: [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
before = handlers()
import jaxtank, tuning, tuning.cli.main, tuning.cli.interrupts, tuning.search.tuner
tuning.cli.main.main(["list"])
assert before == handlers() and signal.set_wakeup_fd(-1) == -1
"""
    done = python(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_two_hundred_signals():
    found = interrupt_drill.drill(200)
    assert found["signals"] == 200 and not found["wrong"], found["wrong"]


@pytest.mark.slow
def test_an_identification_goes_on_where_it_was_interrupted(tmp_path):
    """Two of three searches are in the log: the third alone is run, and the answer has the same
    bits; another problem's log is refused.
    """
    case, k = presets.find("cascaded/pi"), np.arange(80.0)
    y = np.stack([4 + 0.5 * np.sin(k / 9 - 1), 4 + 0.3 * np.sin(k / 9 - 2)], axis=1)
    log = tuning.log(t=4 * k, u=3 + np.sin(k / 9)[:, None], y=y)
    free = {"plant.pump_gain[0]": (0.02, 0.1), "plant.drain[1]": (0.02, 0.08)}
    options = {"start": "case", "starts": 3, "hold_back": 0, "noise": 0.05, "substeps": 2}
    fits = []

    def stop(fit):
        fits.append(fit)
        if len(fits) == 2:
            raise KeyboardInterrupt

    def fitted(**more):
        return tuning.identify(case, log, free, **{**options, **more})

    whole = fitted()
    assert fitted(checkpoint=tmp_path, progress=stop).status == "interrupted"
    assert kept(tmp_path) == 2
    again = fitted(checkpoint=tmp_path, resume=True, progress=fits.append)
    # what is recalled has no slopes
    assert [fit.jacobian.size > 0 for fit in fits[2:]] == [False, False, True]
    first, second = ({**found.to_json(), "wall_s": 0} for found in (whole, again))
    assert json.dumps(first) == json.dumps(second)
    with pytest.raises(InputError, match="of another problem; what differs: noise"):
        fitted(checkpoint=tmp_path, resume=True, noise=0.06)


# Kills.


@pytest.mark.slow
def test_kills():
    """More of them: fault_drill.py 50."""
    drill = [sys.executable, str(HERE / "fault_drill.py"), "24"]
    done = subprocess.run(drill, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
