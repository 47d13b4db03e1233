"""A search that is killed goes on where it ended, to the same bits."""

import contextlib
import json
import shutil
import sqlite3

import numpy as np
import pytest
from helpers import ONE_TANK

import tuning
from jaxtank import rig
from jaxtank.core import files
from jaxtank.core.errors import InputError
from tuning.storage.evaluation_log import EvaluationCache, EvaluationLog
from tuning.storage.store import NAME, SCHEMA, Store

OPTIONS = tuning.Options(starts=2, screening=8, validation=0)
SAME = ["parameters", "objective", "measures", "constraints", "evaluations", "starts", "optimality"]
SAME += ["curvature", "validation", "message"]


def case(values=None):
    """A small one: what is stored does not depend on the rig."""
    return rig.set_values(rig.loads(ONE_TANK), values or {})


def reported(result):
    page = result.to_json()
    return json.dumps({k: page[k] for k in SAME}, sort_keys=True)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The result of a search, and its records."""
    folder = tmp_path_factory.mktemp("whole")
    result = tuning.tune(case(), OPTIONS, checkpoint=folder)
    return result, folder


def copied(whole, folder):
    """Copy the records of a search into a folder."""
    shutil.copy(whole[1] / NAME, folder)


def rows(folder):
    """All records of a folder."""
    with contextlib.closing(sqlite3.connect(folder / NAME)) as file:
        return file.execute("SELECT * FROM record ORDER BY rowid").fetchall()


def change(folder, words, *values):
    """Change the records of a folder."""
    with contextlib.closing(sqlite3.connect(folder / NAME)) as file, file:
        file.execute(words, values)
        assert file.total_changes


@pytest.mark.slow
def test_with_and_without_a_log_alike(whole):
    assert reported(tuning.tune(case(), OPTIONS)) == reported(whole[0])


@pytest.mark.slow_for("0.02")
@pytest.mark.parametrize("share", [0.02, 0.4, 0.97])
def test_a_log_that_ends_anywhere_is_gone_on_with(whole, tmp_path, share):
    copied(whole, tmp_path)
    count = len(rows(tmp_path))
    change(tmp_path, "DELETE FROM record WHERE rowid > ?", 1 + int(share * count))
    result = tuning.tune(case(), OPTIONS, checkpoint=tmp_path, resume=True)
    assert reported(result) == reported(whole[0])
    assert rows(tmp_path) == rows(whole[1])


def test_what_is_in_the_log_is_not_run_again(whole, tmp_path, monkeypatch):
    copied(whole, tmp_path)
    monkeypatch.setattr(Store, "put", lambda *_: pytest.fail("something was evaluated"))
    result = tuning.tune(case(), OPTIONS, checkpoint=tmp_path, resume=True)
    assert reported(result) == reported(whole[0])


def test_a_log_of_another_problem_is_refused_and_kept(whole, tmp_path):
    copied(whole, tmp_path)
    options = {"method": OPTIONS, "checkpoint": tmp_path, "resume": True}
    with pytest.raises(InputError, match="of another problem; what differs: seed"):
        tuning.tune(case(), seed=1, **options)
    with pytest.raises(InputError, match="what differs: loop"):
        tuning.tune(case({"controller.Kc": [1.4]}), **options)
    assert rows(tmp_path) == rows(whole[1])
    with pytest.raises(InputError, match="holds no checkpoint to continue"):
        tuning.tune(case(), **{**options, "checkpoint": tmp_path / "none"})


def tables(words):
    """The bytes of a database."""
    with contextlib.closing(sqlite3.connect(":memory:")) as file:
        file.executescript(words)
        return file.serialize()


OTHER = {
    "text": b"hello\n",
    "another database": tables("CREATE TABLE record (key TEXT)"),
    "a view besides": tables(f"{SCHEMA}; CREATE VIEW other AS SELECT * FROM record"),
    "a trigger": tables(
        f"{SCHEMA}; CREATE TRIGGER t AFTER INSERT ON record BEGIN DELETE FROM record; END"
    ),
}


@pytest.mark.parametrize("data", OTHER.values(), ids=OTHER)
def test_what_is_no_checkpoint_is_refused(tmp_path, data):
    (tmp_path / NAME).write_bytes(data)
    with pytest.raises(InputError, match="not a checkpoint of this program"):
        Store(tmp_path, {"p": 1}, resume=True)
    assert (tmp_path / NAME).read_bytes() == data


@pytest.mark.parametrize("share", [0.3, 0.7, 0.95])
def test_a_file_that_is_cut_is_refused(whole, tmp_path, share):
    data = (whole[1] / NAME).read_bytes()
    (tmp_path / NAME).write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match="not a checkpoint of this program, or was changed"):
        Store(tmp_path, {"p": 1}, resume=True)


CHANGES = {
    "a bit of a number": "UPDATE record SET value = replace(value, 'AEA=', 'AEE=') WHERE rowid = 3",
    "another key": "UPDATE record SET key = '0' || substr(key, 2) || 'x' WHERE rowid = 3",
    "no seal": "UPDATE record SET seal = NULL WHERE rowid = 3",
    "no text": "UPDATE record SET value = x'ff' WHERE rowid = 3",
}


@pytest.mark.parametrize("words", CHANGES.values(), ids=CHANGES)
def test_a_record_that_was_changed_is_refused(tmp_path, words):
    log = EvaluationLog(tmp_path, {"p": 1})
    for i in range(3):
        log.recall("x", [np.array(float(i))], lambda i=i: (1.0 + i, np.arange(2.0)))
    log.close()
    change(tmp_path, words)
    before = rows(tmp_path)
    with pytest.raises(InputError, match=r"^--resume: record .* is not what was written"):
        EvaluationLog(tmp_path, {"p": 1}, resume=True)
    assert rows(tmp_path) == before
    change(tmp_path, "DELETE FROM record WHERE rowid = 3")
    assert len(EvaluationLog(tmp_path, {"p": 1}, resume=True).found) == 2


def test_a_record_of_another_problem_is_refused(tmp_path):
    for name in ("one", "other"):
        log = EvaluationLog(tmp_path / name, {"p": name})
        log.recall("x", [np.array(1.0)], lambda: (9.0,))
        log.close()
    change(tmp_path / "one", "DELETE FROM record WHERE rowid = 2")
    change(tmp_path / "one", "INSERT INTO record VALUES (?, ?, ?)", *rows(tmp_path / "other")[1])
    with pytest.raises(InputError, match="is not what was written"):
        EvaluationLog(tmp_path / "one", {"p": "one"}, resume=True)


DEEP = "[" * 100_000
HOSTILE = {
    "no end": DEEP,
    "too deep": '{"all": [' * 900 + "]}" * 900,
    "a shape that is none": '{"type": "<f8", "shape": [1000000000, 1000000000], "data": ""}',
    "objects": '{"type": "|O8", "shape": [1], "data": "AAAAAAAAAAA="}',
    "texts": '{"type": "<U2", "shape": [1], "data": "AAAAAAAAAAA="}',
    "no base64": '{"type": "<f8", "shape": [1], "data": "__import__"}',
    "a number": "1",
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_a_record_whose_seal_is_right_is_not_trusted_either(tmp_path, text):
    store = Store(tmp_path, {"p": 1})
    store._insert("k", text)
    store.close()
    with pytest.raises(InputError, match=r"record k of .* is not what was written"):
        EvaluationLog(tmp_path, {"p": 1}, resume=True)


def test_numbers_go_through_a_log_without_loss(tmp_path):
    nested = np.nan, np.array([[0.1, -np.inf], [5e-324, -0.0]]), ({"a": np.array([1 / 3])},)
    result = (*nested, np.zeros((0, 2)))
    log = EvaluationLog(tmp_path, {"p": 1})
    first = log.recall("x", [np.arange(2.0)], lambda: result)
    log = EvaluationLog(tmp_path, {"p": 1}, resume=True)
    again = log.recall("x", [np.arange(2.0)], lambda: pytest.fail("run again"))
    for a in (first, again):
        assert np.isnan(a[0]) and a[3].shape == (0, 2)
        np.testing.assert_array_equal(a[1], result[1])
        assert np.signbit(a[1][1, 1]) and a[2][0]["a"] == 1 / 3


def test_what_is_asked_decides():
    cache, calls, two = EvaluationCache(), [], np.zeros(2)
    for asked in ([two, False], [two, True], [np.zeros((1, 2)), False], [two, False]):
        cache.recall("screen", asked, lambda: calls.append(1) or (0.0,))
    assert len(calls) == 3


def test_a_run_that_was_killed_before_its_first_record_goes_on(tmp_path):
    """All that it left is its lock: there is nothing to lose, and a script that runs or else
    resumes need not know. A folder that is not there, or has anything else in it, is refused as
    before.
    """
    (tmp_path / files.LOCK).write_text("123456\n")
    assert files.untouched(tmp_path)
    (tmp_path / "note.txt").write_text("mine")
    assert not files.untouched(tmp_path)
    with pytest.raises(InputError, match=r"no checkpoint to continue: there is no checkpoint\."):
        Store(tmp_path, {}, resume=True)
    (tmp_path / "note.txt").unlink()
    Store(tmp_path, {}, resume=True).close()
    assert {p.name for p in tmp_path.iterdir()} == {files.LOCK, NAME}


def test_finished_batches_are_not_overwritten_and_a_log_is(tmp_path):
    store = Store(tmp_path, {"p": 1})
    store.put("0", 1.0)
    store.close()
    with pytest.raises(InputError, match="--resume continues"):
        Store(tmp_path, {"p": 1})
    assert Store(tmp_path, {"p": 1}, shared=True).get("0") == 1.0
    assert EvaluationLog(tmp_path, {"p": 1}).found == {}
