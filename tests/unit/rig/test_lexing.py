"""Text that a rig file may hold, before it is parsed: long keys are told, and nothing else is taken
for one.
"""

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.rig.read import MOST, MOST_WORDS, check_keys

HEAD = 'case = "gouta2015/backstepping"\n'
DOTS = ".".join("a" * (MOST + 1))
AT_MOST = ".".join("a" * MOST)


@pytest.mark.parametrize(
    "text",
    [
        f"[{DOTS}]\n",
        f"[[{DOTS}]]\n",
        f"{DOTS} = 1\n",
        f"x = {{ {DOTS} = 1 }}\n",
        f"x = [[], [{{ b = 1, {DOTS} = 1 }}]]\n",
        "[" + " . ".join(['"a.b"', "'c'", "d-1"] * MOST) + "]\n",
        f'x = """a\\""" "" \n """" # not a remark of the text\n{DOTS} = 1\n',
        f"x = '''a\\''''\n{DOTS} = 1\n",
        f'x = "\\\\" # "\n{DOTS} = 1\n',
        f"x = 'it\\'\n{DOTS} = 1\n",
        f'x = """"""\n{DOTS} = 1\n',
    ],
)
def test_a_key_of_more_parts_than_any_name_is_reported(text):
    assert tomllib.loads(text)  # TOML it is
    with pytest.raises(
        InputError,
        match=rf"^rig file: line \d+: a key of \d+ parts joined by dots: must be at most {MOST}$",
    ):
        rig.loads(HEAD + text)


@pytest.mark.parametrize(
    "text",
    [
        f"[{AT_MOST}]\n",
        f"x = '{DOTS}' # {DOTS}\n",
        f'x = "\\"{DOTS}"\n',
        f'x = """{DOTS}\n{DOTS} = 1\n"""\n',
        f"x = '''{DOTS}\n'{DOTS}' = 1\n'''\n",
        f'"{DOTS}" = [1.5, -2.5e-3, 1979-05-27T07:32:00.999, {", ".join(["0.5"] * 500)}]\n',
        f"# {DOTS}\n" * 3,
    ],
)
def test_dots_of_numbers_texts_and_remarks_are_no_key(text):
    assert tomllib.loads(text) is not None
    check_keys(text)


def test_more_words_than_any_rig_has_are_reported():
    check_keys("x = [" + "1.0, " * (MOST_WORDS // 2 - 1) + "]")
    for text in (
        "".join(f"{AT_MOST[:-2]}.b{i} = 1\n" for i in range(MOST_WORDS // MOST)),
        "x = [" + "1.0, " * MOST_WORDS + "]",
        "[[tank]]\n" * MOST_WORDS,
        "x = [" + "[]," * MOST_WORDS + "]",
    ):
        with pytest.raises(
            InputError, match=f"^rig file: has more than {MOST_WORDS} keys and values$"
        ):
            rig.loads(text)


@given(st.text(alphabet="ab.\"'\\#=\n[]{} \t", max_size=60))
@settings(max_examples=500, deadline=None)
def test_what_is_toml_with_short_keys_passes(text):
    """Any TOML: no part of a short text is a long key, and a long one behind it is found."""
    check_keys(text)
    try:
        tomllib.loads(text + "\n")
    except ValueError:
        return
    with pytest.raises(InputError, match="parts joined by dots"):
        check_keys(f"{text}\n{DOTS} = 1\n")


@pytest.mark.parametrize("kind", ["pipe", "orifice", "spill", "pump"])
def test_more_of_a_kind_than_a_loop_can_hold_are_refused(kind):
    tanks = "[[tank]]\narea = 1.0\nrim = 9.0\n" * 2
    with pytest.raises(InputError, match=rf"\[\[{kind}\]\]: 5001 {kind}s: must be at most 5000"):
        rig.loads(
            tanks
            + ("[[pump]]\ngain = 1.0\nto = 1\nhigh = 1.0\n" if kind != "pump" else "")
            + f"[[{kind}]]\n" * 5001
        )
