"""Wrong rig files: every problem in one answer, with its line and what to write."""

import re

import pytest

from jaxtank import rig
from jaxtank.core.errors import InputError

HEAD = """units = ["m", "m^3/h"]
[[tank]]
name = "T1"
area = 0.5
rim = 1.2
[[pump]]
to = "T1"
high = 10.0
[controller]
kind = "pi"
Kc = 5.0
Ti = 300.0
"""


def problems_of(text):
    """{line: message} of a refusal, and the whole message."""
    with pytest.raises(InputError) as refusal:
        rig.loads(text)
    parts = re.split(r"line (\d+): ", str(refusal.value))
    return dict(zip(map(int, parts[1::2]), parts[2::2])), str(refusal.value)


def test_problems_of_all_tables_come_with_their_lines():
    text = """tank = [
  { name = "T1", area = "5 furlong", rim = 1.2 },
  { name = "T2", area = 0.5, rim = 1.2, weir = 0.8 },
]
[[pump]]
to = "T3"
high = 10.0
[law]
kind = "pi"
Kp = 2
tau_i = 300
[reference]
SP = [0.4]
[limits]
max_levl = 1.0
"""
    problems, _ = problems_of(text)
    words = {2: "furlong", 3: "spill", 6: "T3", 10: "Kc", 11: "Ti", 13: "initial", 15: "max_level"}
    for line, word in words.items():
        assert word in problems[line]


@pytest.mark.parametrize(
    ("word", "write"),
    [
        ("Kp = 2.0", "Kc"),
        ("tau_i = 9.0", "Ti"),
        ("Ki = 0.1", "Ti"),
        ("Kd = 0.1", "Td"),
        ("setpoint = 0.5", "[reference]"),
        ("SP = 0.5", "[reference]"),
        ("dt = 1.0", "dt at the top"),
    ],
)
def test_words_of_the_field_are_answered_with_ours(word, write):
    _, message = problems_of(HEAD + word)
    assert write in message.partition("write")[2] and "line 13" in message


WELL = """units = ["m", "%"]
[[tank]]
name = "WW1"
area = 5.0
rim = 5.0
level = 1.2
inflow = "5 L/s"
[[pump]]
name = "P1"
from = "WW1"
gain = "0.4 L/(s %)"
high = 100.0
"""
SECOND = WELL[WELL.index("[[pump]]") :].replace("P1", "P2")
FLOATS = '[controller]\nkind = "on-off"\non = [2.0, 2.5]\noff = [1.0, 1.2]\n'


def test_on_off_has_no_action_and_its_levels_say_the_direction():
    one = FLOATS.replace(", 2.5", "").replace(", 1.2", "")
    _, message = problems_of(WELL + one + 'action = "direct"\n')
    assert "leave it out" in message and "`on` above `off`" in message and "write" not in message
    assert rig.loads(WELL + one).loop.controller.on > 1.0


def test_two_floats_of_one_tank_are_told_to_name_it_twice():
    _, message = problems_of(WELL + SECOND + FLOATS)
    assert 'outputs = ["WW1", "WW1"]' in message
    twice = WELL + SECOND + '[plant]\noutputs = ["WW1", "WW1"]\n' + FLOATS
    assert rig.loads(twice).loop.controller.off.tolist() == [1.0, 1.2]


def test_the_stroke_of_a_valve_is_its_rate():
    valve = '[[valve]]\nfrom = "T1"\narea = 0.001\nstroke = "60 s"\n'
    problems, _ = problems_of(HEAD.replace("[controller]", valve + "[controller]"))
    assert "rate" in problems[12] and "%/s" in problems[12] and "low or high" not in problems[12]


def test_texts_and_comments_do_not_move_the_lines():
    text = HEAD.replace("rim = 1.2", 'rim = 1.2  # a [note] = { of }\nwrong = "[[tank]] { = }"')
    problems, _ = problems_of(text + "Kq = 1\n")
    assert "wrong" in problems[6] and "Kq" in problems[14]


def test_a_volume_gives_the_area_or_the_rim():
    area = lambda size: rig.loads(HEAD.replace("area = 0.5\nrim = 1.2", size)).loop.plant
    assert float(area('volume = "600 l"\nrim = 1.2').area[0]) == pytest.approx(0.5)
    assert float(area('volume = "600 l"\narea = 0.5').rim[0]) == pytest.approx(1.2)
    with pytest.raises(InputError):
        area('volume = "600 l"\narea = 0.5\nrim = 1.2')


def test_a_head_in_bar_is_a_level():
    plant = rig.loads(HEAD.replace("rim = 1.2", 'rim = "0.2 bar"')).loop.plant
    assert float(plant.rim[0]) == pytest.approx(0.2e5 / (1000 * 9.80665), rel=1e-6)
