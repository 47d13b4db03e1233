"""The table of stress tests in benchmarks/README.md is that of the record, and a drill that fails
is reported as such.
"""

import survived

REPORT = """<testsuites><testsuite>
<testcase name="a[200]"/><testcase name="b[8]"><failure message="x"/></testcase>
<testcase name="c"><skipped message="no"/></testcase>
<testcase name="d"><error message="y"/></testcase>
</testsuite></testsuites>"""


def test_a_report_is_read_as_it_is(tmp_path):
    (tmp_path / "r.xml").write_text(REPORT)
    found = survived.cases(tmp_path / "r.xml")
    assert found == {"a[200]": "passed", "b[8]": "failed", "c": "skipped", "d": "failed"}
    assert survived.summed(found) == "1 passed, 2 failed, 1 skipped"
    assert survived.summed({"a": "passed", "b": "passed"}) == "all passed"
    assert survived.summed({}) == survived.summed({"a": "skipped"}) == "none ran"


def test_a_record_keeps_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(survived, "KEPT", tmp_path / "s.json")
    survived.record("kills", 50, "all went on")
    survived.record("fuzz", 10_000, "1 failed")
    assert survived.table().splitlines()[2:] == [
        (
            "| broken rig files, logs and command lines | 10,000 | 1 failed | `pytest -m slow"
            " tests/audits/test_fuzz.py` |"
        ),
        (
            f"| {survived.DRILLS['kills'][0]} | 50 | all went on | `python"
            " tests/audits/fault_drill.py 50` |"
        ),
    ]


def test_the_page_shows_what_is_recorded():
    page = survived.README.read_text()
    assert page.split(survived.BEGIN)[1].split(survived.END)[0].strip() == survived.table()
