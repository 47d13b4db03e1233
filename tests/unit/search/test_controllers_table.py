"""The stored rows of every controller on the papers' rigs: page, picture, and one row run again."""

import controllers_table
import numpy as np
import pytest
from measuring import README

from jaxtank import presets
from jaxtank.core.tree import with_values
from tuning.search.comparison import TRAVEL
from tuning.search.judged import judge
from tuning.search.setting import setting_of

STORED = controllers_table.load()


def test_the_page_has_what_is_stored():
    text = controllers_table.tables(STORED)
    begin, end = controllers_table.BEGIN, controllers_table.END
    assert f"{begin}\n{text}\n{end}" in README.read_text()
    assert controllers_table.PICTURE.stat().st_size < 120_000


@pytest.mark.parametrize("rig", controllers_table.RIGS)
def test_a_rig_has_the_controllers_of_its_paper_and_others(rig):
    preset = rig.partition("/")[2]
    rows = STORED[rig]["controllers"]
    claims = controllers_table.stored_comparison(rig, STORED[rig]).claims
    assert {preset, *(set(claims) & set(controllers_table.RIGS[rig].split()))} <= set(rows)
    assert any(row["gains"] == "first" for found in rows.values() for row in found)
    for found in rows.values():
        sides = [(row["gains"] == "tuned", row["filter"]) for row in found]
        assert len(set(sides)) == len(sides) and (True, False) in sides


@pytest.mark.extended_for("published")
@pytest.mark.parametrize("gains", ["published", "tuned"])
def test_a_row_run_again_has_the_stored_numbers(gains):
    rig = "calofir/backstepping"
    rows = STORED[rig]["controllers"]["backstepping"]
    (row,) = (r for r in rows if r["gains"] == gains and not r["filter"])
    case = presets.find(rig)
    case = case.replace(loop=with_values(case.loop, row["parameters"]))
    runs = judge(setting_of(case), STORED[rig]["samples"], controllers_table.SEED, more=(TRAVEL,))
    good = ~runs.failed
    if runs.infeasible is not None:
        good &= ~runs.infeasible
    assert np.mean(runs.error[good]) == pytest.approx(row["error"], rel=1e-6)
    assert int((~runs.held).sum()) == row["violations"]
    assert runs.measures[TRAVEL][good].sum(axis=1).mean() == pytest.approx(
        row["input_travel"], rel=1e-6
    )
