"""A search that is killed goes on where it ended, to the same bits."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import tuning
from jaxtank import presets, rig
from jaxtank.core import files
from jaxtank.core.errors import InputError
from tuning.storage import batch_store, evaluation_log
from tuning.storage.evaluation_log import NAME, EvaluationCache, EvaluationLog

OPTIONS = {"starts": 2, "screening": 8, "validation": 8}
SAME = (
    "parameters",
    "objective",
    "measures",
    "constraints",
    "evaluations",
    "starts",
    "optimality",
    "curvature",
    "validation",
    "message",
)


def case(values=None):
    """A small one: what is stored does not depend on the rig."""
    return rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 1200.0, **(values or {})})


def reported(result):
    from tuning.report import tuned as report

    page = report.json_of(result)
    return json.dumps({k: page[k] for k in SAME}, sort_keys=True)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return (tuning.tune(case(), nominal=True, log=folder, **OPTIONS), (folder / NAME).read_bytes())


def test_with_and_without_a_log_alike(whole):
    assert reported(tuning.tune(case(), nominal=True, **OPTIONS)) == reported(whole[0])


@pytest.mark.parametrize("share", [0.02, 0.4, 0.97])
def test_a_log_cut_anywhere_is_gone_on_with(whole, tmp_path, share):
    data = whole[1]
    (tmp_path / NAME).write_bytes(data[: int(share * len(data))])
    kept = data[: int(share * len(data))].count(b"\n")
    result = tuning.tune(case(), nominal=True, log=tmp_path, resume=True, **OPTIONS)
    assert reported(result) == reported(whole[0])
    assert (tmp_path / NAME).read_bytes() == data and kept < data.count(b"\n")


def test_what_is_in_the_log_is_not_run_again(whole, tmp_path, monkeypatch):
    (tmp_path / NAME).write_bytes(whole[1])
    monkeypatch.setattr(EvaluationLog, "keep", lambda *_: pytest.fail("something was evaluated"))
    assert reported(
        tuning.tune(case(), nominal=True, log=tmp_path, resume=True, **OPTIONS)
    ) == reported(whole[0])


def test_a_log_of_another_problem_is_refused_and_kept(whole, tmp_path):
    (tmp_path / NAME).write_bytes(whole[1])
    with pytest.raises(InputError, match="of another problem; what differs: seed"):
        tuning.tune(case(), nominal=True, log=tmp_path, resume=True, seed=1, **OPTIONS)
    with pytest.raises(InputError, match="what differs: loop"):
        tuning.tune(
            case({"controller.Kc": [1.4]}), nominal=True, log=tmp_path, resume=True, **OPTIONS
        )
    assert (tmp_path / NAME).read_bytes() == whole[1]
    with pytest.raises(InputError, match="holds no checkpoint to continue"):
        tuning.tune(case(), nominal=True, log=tmp_path / "none", resume=True, **OPTIONS)


@pytest.mark.parametrize("text", [b"hello\n", b"[1]\n", b'{"jaxtank": 1}\n', b"\xff\xfe\n"])
def test_what_is_no_log_is_refused(tmp_path, text):
    (tmp_path / NAME).write_bytes(text)
    with pytest.raises(InputError, match="not a log"):
        tuning.tune(case(), nominal=True, log=tmp_path, resume=True, **OPTIONS)
    assert (tmp_path / NAME).read_bytes() == text


def test_a_broken_line_inside_is_refused(whole, tmp_path):
    lines = whole[1].splitlines(keepends=True)
    (tmp_path / NAME).write_bytes(b"".join([*lines[:3], b"{}\n", *lines[3:]]))
    with pytest.raises(InputError, match="line 4"):
        tuning.tune(case(), nominal=True, log=tmp_path, resume=True, **OPTIONS)


@pytest.mark.parametrize(
    "change", ["a bit of a number", "another key", "a line of another log", "no digest"]
)
def test_a_line_that_was_changed_is_refused(tmp_path, change):
    """Every one of them is JSON that could be an entry; the file is left as it is."""
    log = EvaluationLog(tmp_path, {"p": 1})
    for i in range(3):
        log.recall("x", [np.array(float(i))], lambda i=i: (1.0 + i, np.arange(2.0)))
    lines = (tmp_path / NAME).read_bytes().splitlines(keepends=True)
    if change == "a bit of a number":
        assert b"0x1.0000000000000p+1" in lines[2]
        lines[2] = lines[2].replace(b"0x1.0000000000000p+1", b"0x1.0000000000001p+1")
    elif change == "another key":
        keys = [json.loads(line)["key"].encode() for line in lines[1:]]
        lines[2] = lines[2].replace(keys[1], keys[1][::-1])
    elif change == "a line of another log":
        (tmp_path / "other").mkdir()
        other = EvaluationLog(tmp_path / "other", {"p": 2})
        other.recall("x", [np.array(1.0)], lambda: (9.0, np.arange(2.0)))
        lines[2] = other.path.read_bytes().splitlines(keepends=True)[1]
    else:
        entry = json.loads(lines[2])
        lines[2] = json.dumps({k: entry[k] for k in ("kind", "key", "result")}).encode() + b"\n"
    data = b"".join(lines)
    (tmp_path / NAME).write_bytes(data)
    with pytest.raises(
        InputError,
        match=r"^--resume: line 3 of evaluations\.jsonl is not one of its entries, or was changed",
    ):
        EvaluationLog(tmp_path, {"p": 1}, resume=True)
    assert (tmp_path / NAME).read_bytes() == data
    (tmp_path / NAME).write_bytes(b"".join(lines[:2] + lines[3:]))  # as the message says
    assert EvaluationLog(tmp_path, {"p": 1}, resume=True).resumed == 2


def test_numbers_go_through_a_log_without_loss(tmp_path):
    result = (
        np.nan,
        np.array([[0.1, -np.inf], [5e-324, -0.0]]),
        ({"a": np.array([1 / 3])},),
        np.zeros((0, 2)),
    )
    log = EvaluationLog(tmp_path, {"p": 1})
    first = log.recall("x", [np.arange(2.0)], lambda: result)
    again = EvaluationLog(tmp_path, {"p": 1}, resume=True).recall(
        "x", [np.arange(2.0)], lambda: pytest.fail("run again")
    )
    for a, b in ((first, result), (again, result)):
        assert np.isnan(a[0]) and a[3].shape == (0, 2)
        np.testing.assert_array_equal(a[1], b[1])
        assert np.signbit(a[1][1, 1]) and a[2][0]["a"] == b[2][0]["a"]


def test_what_is_asked_decides(tmp_path):
    cache, calls = EvaluationCache(), []
    for asked in (
        [np.zeros(2), False],
        [np.zeros(2), True],
        [np.zeros((1, 2)), False],
        [np.zeros(2), False],
    ):
        cache.recall("screen", asked, lambda: calls.append(1) or (0.0,))
    assert len(calls) == 3


@pytest.mark.slow
@pytest.mark.parametrize("wait", [8.0, 11.0, 15.0])
def test_the_command_killed_and_resumed(tmp_path, wait):
    """SIGKILL at some moment of the search; the result is that of a run left alone."""
    command = [
        sys.executable,
        "-m",
        "tuning.cli.main",
        "tune",
        "gouta2015/backstepping",
        "--quiet",
        "--json",
        "--starts",
        "2",
    ]
    command += ["--screening", "8", "--validation", "8", "--set", "clock.dt=0.1"]
    alone = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "run")], stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + wait
    while time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    if process.poll() is None:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        if not (tmp_path / "run" / NAME).exists():
            pytest.skip("killed before the search began")
        done = subprocess.run(
            [*command, "--resume", str(tmp_path / "run")], capture_output=True, check=True
        )
        page = json.loads(done.stdout)
        assert {k: page[k] for k in SAME} == {k: alone[k] for k in SAME}
    assert (
        json.loads((tmp_path / "run" / "result.json").read_text())["parameters"]
        == alone["parameters"]
    )
    assert not (tmp_path / "run" / NAME).exists()


@pytest.mark.parametrize("command", ["tune", "uncertainty"])
def test_a_run_that_was_killed_before_its_first_line_goes_on(command, tmp_path):
    """All that it left is its lock: there is nothing to lose, and a script that runs or else
    resumes need not know. A folder that is not there, or has anything else in it, is refused as
    before.
    """
    (tmp_path / files.LOCK).write_text("123456\n")
    assert files.untouched(tmp_path)
    (tmp_path / "note.txt").write_text("mine")
    assert not files.untouched(tmp_path)
    with pytest.raises(
        InputError,
        match=r"no checkpoint to continue: there is no (evaluations\.jsonl|manifest\.json)",
    ):
        began(command, tmp_path)
    (tmp_path / "note.txt").unlink()
    began(command, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} > {files.LOCK}  # and what it writes now


def began(command, folder):
    """Open the log, or the store of batches, of a run that goes on in `folder`."""
    (
        evaluation_log.EvaluationLog(folder, {}, resume=True)
        if command == "tune"
        else batch_store.BatchStore(folder, {}, resume=True)
    )
