"""The notes of the papers: there is one for each, its labels are unique, and whatever refers to a
label or a test names one that exists.
"""

import ast
import functools
import re
from importlib import resources
from pathlib import Path

import pytest
from helpers import TESTS

import jaxtank
import tuning
from jaxtank import presets

NOTES = resources.files("jaxtank.presets") / "notes"
HEADING = re.compile(r"^###? (S\d+(?:\.\d+)?) ", re.M)  # a section
# an erratum's row; an assumption or a hazard in bold
ENTRY = re.compile(r"(?:^\| |\*\*)([AEH]\d+)(?: \||\*\*)", re.M)
LABEL = r"[SAEH]\d+(?:\.\d+)?"
REFERENCE = re.compile(
    rf"(?:\b({'|'.join(presets.PAPERS)})[\s#]+)?\b[Nn]otes[\s#]+"
    rf"({LABEL}(?:(?:, | and | to |-){LABEL})*)"
)


def note(paper):
    return (NOTES / f"{paper}.md").read_text()


def labels(paper):
    """Every label of a note, in its order."""
    return HEADING.findall(note(paper)) + ENTRY.findall(note(paper))


def sources():
    """(path, text) of every module and test that may refer to a note."""
    for folder in (Path(jaxtank.__file__).parent, Path(tuning.__file__).parent, TESTS):
        for path in sorted((*folder.rglob("*.py"), *folder.rglob("presets/*.toml"))):
            if path != Path(__file__):
                yield path, path.read_text()


def about(path):
    """The paper of a file whose name has it, or None."""
    return next((p for p in presets.PAPERS if path.stem in (p, f"test_{p}")), None)


def dangling(path, text):
    """References of a file to labels that its note does not have: a list of (paper, label)."""
    found = []
    for named, given in REFERENCE.findall(text):
        paper = named or about(path)
        known = labels(paper) if paper else ()
        found += [(paper, label) for label in re.findall(LABEL, given) if label not in known]
    return found


@pytest.mark.parametrize("paper", presets.PAPERS)
def test_every_paper_has_a_note_with_its_sections(paper):
    found = labels(paper)
    assert len(found) == len(set(found))
    assert {"S1", "S2", "S3", "S4", "S5", "S6", "S7", "S8", "S9"} <= set(found)
    assert "A1" in found and "H1" in found


def test_references_to_notes_name_a_section_that_exists():
    missing = {str(path): wrong for path, text in sources() if (wrong := dangling(path, text))}
    assert missing == {}


def test_a_wrong_reference_is_found():
    here = Path("test_gouta2015.py")
    assert dangling(here, "as in notes S4.3") == []
    assert dangling(here, "khalid notes S4.5 and H4") == []
    assert dangling(here, "notes S4.9, E1") == [("gouta2015", "S4.9")]
    # outside a paper's own files the paper is named
    assert dangling(Path("qp.py"), "notes S4.5") == [(None, "S4.5")]


@functools.cache
def modules_and_functions():
    """Names of the test modules, and "module::function" of all their functions."""
    files = sorted(TESTS.rglob("test_*.py"))  # of which several may have the same name
    functions = {
        f"{file.name}::{node.name}"
        for file in files
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    return {file.name for file in files}, functions


@pytest.mark.parametrize("paper", presets.PAPERS)
def test_tests_that_a_note_names_exist(paper):
    modules, functions = modules_and_functions()
    named = set(re.findall(r"test_\w+\.py::test_\w+", note(paper)))
    assert named and named <= functions
    assert set(re.findall(r"`(test_\w+\.py)`", note(paper))) <= set(modules)


@pytest.mark.parametrize("paper", presets.PAPERS)
def test_sections_and_errata_named_within_a_note_exist(paper):
    """Labels that are no symbol of a paper too: an area is A1, a level H1, a pipe's section S1."""
    assert set(re.findall(r"\bS\d+\.\d+\b|\bE\d+\b", note(paper))) <= set(labels(paper))
