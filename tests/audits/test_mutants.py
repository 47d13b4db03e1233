"""Changes that tests may miss are of code that does something; the table in benchmarks/README.md is
that of the record.
"""

import json

import mutants

SOURCE = '''
"""1 message."""
@cache(2)
def held(a: int < 3, b: max = 4) -> list[5]:
    if a < 6:
        raise ValueError(f"{a + 7} is below", 8)
    warnings.warn(str(a * 9), stacklevel=10)
    text = f"{a * 11:.2f}"
    return min(a, b) - 12 if a and not b else -b
'''


def test_changes_are_of_code_and_not_of_messages_types_or_decorators():
    words = sorted(what for _, _, what, _ in mutants.changes(SOURCE))
    assert words == sorted(
        ["a < 6 -> False", "< -> >=", "6 -> 7", "4 -> 5", "- -> +", "12 -> 13", "min -> max"]
        + ["and -> or", "not b -> b", "-b -> b"]
    )


def test_each_change_is_one_and_leaves_a_module():
    lines = SOURCE.split("\n")
    for line, _, _, text in mutants.changes(SOURCE):
        compile(text, "changed", "exec")
        after = text.split("\n")
        assert [i for i, (a, b) in enumerate(zip(lines, after), 1) if a != b] == [line]


def test_the_fastest_tests_run_within_the_limit_and_one_always():
    times = {"a": 3.0, "b": 1.0, "c": 2.0}
    assert mutants.fastest(times, 3.0) == ["b", "c"]
    assert mutants.fastest(times, 0.5) == ["b"]


def test_the_table_counts_what_was_missed_and_what_became_of_it(tmp_path, monkeypatch):
    monkeypatch.setattr(mutants, "KEPT", tmp_path / "m.json")
    missed = [{"place": "a:1:0", "what": "x"} for _ in range(4)]
    missed[0]["test"], missed[1]["reason"] = "test_a", "no difference"
    row = {"seeds": [0], "reached": 1500, "drawn": 20, "noticed": 16, "missed": missed}
    mutants.record("jaxtank/b", row)
    mutants.record("jaxtank/a", row)
    assert mutants.table().splitlines()[2:] == [
        "| `jaxtank/a` | 1,500 | 20 | 16 | 17 | 1 | 2 |",
        "| `jaxtank/b` | 1,500 | 20 | 16 | 17 | 1 | 2 |",
        "| all | 3,000 | 40 | 32 | 34 | 2 | 4 |",
    ]


def test_a_draw_with_another_seed_adds_to_a_record_and_the_same_one_replaces_it(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(mutants, "KEPT", tmp_path / "m.json")
    row = {"seeds": [1], "reached": 90, "drawn": 3, "noticed": 2, "missed": [{"place": "a:1:0"}]}
    mutants.record("a", row)
    latest = {"seeds": [2], "reached": 80, "drawn": 5, "noticed": 4, "missed": [{"place": "b:7:3"}]}
    both = [{"place": "a:1:0"}, {"place": "b:7:3"}]
    total = {"seeds": [1, 2], "reached": 80, "drawn": 8, "noticed": 6, "missed": both}
    assert mutants.join_rows(mutants.load_row("a", 2), latest) == total
    assert mutants.join_rows(mutants.load_row("a", 1), latest) == latest
    assert mutants.join_rows(mutants.load_row("b", 2), latest) == latest


def test_a_recorded_change_is_that_of_its_words_and_line_in_its_file_at_the_closest_place(tmp_path):
    for name in ("a.py", "b.py"):
        (tmp_path / name).write_text("x = 1\nz = 1\nif x:\n    y = 1\n    x = 1\nx = 1\n")
    places = [("a.py", 1, 4), ("a.py", 4, 8), ("a.py", 5, 8), ("a.py", 6, 4), ("b.py", 3, 0)]
    known = [(tmp_path / name, *place, "1 -> 2", "") for name, *place in places]
    entry = {"place": "a.py:4:3", "what": "1 -> 2", "line": "x = 1"}
    assert mutants.nearest(known, entry) == known[2]
    assert mutants.nearest(known, entry | {"what": "3 -> 4"}) is None
    assert mutants.nearest(known, entry | {"line": "x = 2"}) is None


def test_the_page_shows_what_is_recorded():
    page = mutants.README.read_text()
    assert page.split(mutants.BEGIN)[1].split(mutants.END)[0].strip() == mutants.table()
    for row in json.loads(mutants.KEPT.read_text()).values():
        assert row["drawn"] == row["noticed"] + len(row["missed"])
