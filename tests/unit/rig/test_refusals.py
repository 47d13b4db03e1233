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
