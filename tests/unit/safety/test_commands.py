"""The safety filter through the command line, rig files and exported controllers."""

import json

import numpy as np
import pytest
from helpers import command

from jaxtank import presets, rig
from jaxtank.core.errors import InputError

RIG = """
case = "cascaded/pi"
[values]
clock.duration = 2000.0
[safety_filter]
rate = 0.1
limit = [9.5, 9.0]
"""


def highest(*words):
    code, out, err = command("simulate", *words, "--json", "--quiet")
    assert code == 0, err
    return np.array(json.loads(out)["measures"]["max_level"])


def test_the_option_keeps_levels_below_the_rims():
    assert highest("cascaded/pi")[0] == 10.0  # and spills
    assert highest("cascaded/pi", "--safety-filter")[0] < 9.7


def test_simulate_says_that_the_filter_is_on():
    for words, on in (([], False), (["--safety-filter"], True)):
        code, out, _ = command("simulate", "cascaded/pi", *words)
        assert code == 0 and ("The safety filter is on" in out) == on
        assert ("filter_active_fraction" in out) == on


def test_a_rig_file_turns_the_filter_on_and_an_option_turns_it_off(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    limited = highest(str(path))
    assert np.all(limited <= [9.5, 9.0]) and limited[0] > 8.0
    assert highest(str(path), "--no-safety-filter")[0] == 10.0


def test_a_filtered_case_comes_back_from_its_rig_file():
    case = rig.loads(RIG)
    for text in (rig.dump(case), rig.complete(case)):
        again = rig.loads(text)
        assert again.safety == {"rate": 0.1, "limit": pytest.approx([9.5, 9.0])}
        assert again.loop.safety_filter.limit.tolist() == case.loop.safety_filter.limit.tolist()
    assert rig.loads(rig.dump(case.without_safety_filter())).loop.safety_filter is None


def test_the_filter_is_designed_for_the_values_that_are_set():
    """A wider rim raises the limit; the box is that of [uncertain]."""
    code, out, _ = command("show", "cascaded/pi", "--set", "plant.rim=[12,13]", "--json")
    assert code == 0
    assert [row["limit"] for row in json.loads(out)["safety_filter"]] == [12.0, 13.0]


def test_show_prints_what_is_proved_and_the_condition_that_failed():
    pulses = ["actuator.dead_zone=[1,1]", "actuator.dead_zone_kind=pulse"]
    code, out, _ = command("show", "gouta2015/ngpc", *(w for p in pulses for w in ("--set", p)))
    assert code == 0 and "pays out more than was commanded" in " ".join(out.split())
    code, out, _ = command("show", "gouta2015/ngpc")
    table = out.split("Limits on levels")[1].split("The safety filter")[0]
    assert table.count("yes") == 4 and "Theorem 2" in table and "0.108" in table


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("rate = -1.0", "safety_filter.rate = -1"),
        ("limits = [1.0, 2.0]", "nearest: limit"),
        ("limit = [1.0]", "safety_filter.limit"),
        ('widths = { "plant.drian" = 0.1 }', "plant.drian"),
    ],
)
def test_a_wrong_setting_is_one_line(lines, words):
    text = f'case = "cascaded/pi"\n[safety_filter]\n{lines}\n'
    with pytest.raises(InputError, match=words.replace(".", r"\.")):
        rig.loads(text)


def test_a_filter_made_by_hand_has_no_rig_file():
    case = presets.find("cascaded/pi").with_safety_filter()
    with pytest.raises(InputError, match="its safety filter is not that of"):
        rig.dump(case.replace(safety=None))


def test_a_setting_of_the_filter_is_set_by_its_name():
    tight = highest("cascaded/pi", "--safety-filter", "--set", "safety_filter.limit=[9.0,9.0]")
    assert np.all(tight <= 9.0)
    code, _, err = command("simulate", "cascaded/pi", "--set", "safety_filter.rate=0.1")
    assert code == 2 and "the safety filter is off; --safety-filter turns it on" in err
    words = ["cascaded/pi", "--safety-filter", "--set", "safety_filter.rat=0.1"]
    code, _, err = command("simulate", *words)
    assert code == 2 and "nearest: rate" in err


def test_a_limit_that_is_not_proved_is_reported():
    fast = ["cascaded/pi", "--safety-filter", "--set", "safety_filter.rate=0.3"]
    code, _, err = command("simulate", *fast)
    assert code == 0 and "tank 1 is not proved: kappa 0.3 above its bound 0.25 1/s" in err
    code, _, err = command("simulate", *fast[:2])
    assert code == 0 and "not proved" not in err
