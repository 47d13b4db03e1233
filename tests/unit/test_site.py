"""The pages of the documentation site: what they show parses, is read and runs."""

import re
import shlex

import jax
import pytest
from helpers import ROOT

from jaxtank import rig
from tuning.cli import main
from tuning.cli.parser import parser

SITE = ROOT / "notebooks" / "site"
PAGES = {str(p.relative_to(SITE)): p.read_text() for p in sorted(SITE.glob("**/*.md"))
         if "_build" not in p.parts}  # fmt: skip
pytestmark = pytest.mark.skipif(not PAGES, reason="the site is not beside the tests")


def blocks(language, *pages):
    pattern = rf"```{language}\n(.*?)```"
    return [b for p in pages or PAGES for b in re.findall(pattern, PAGES.get(p, ""), re.DOTALL)]


def rigs():
    """{file name: text} of the rig files that the pages have the reader save."""
    return {
        name: text
        for page in PAGES.values()
        for name, text in re.findall(r"Save as `(.*?)`:\n\n```toml\n(.*?)```", page, re.DOTALL)
    }


COMMANDS = [
    tuple(shlex.split(line, comments=True)[1:])
    for block in blocks("sh")
    for line in block.splitlines()
    if line.startswith("jaxtank")
]


def test_every_page_is_reached_from_the_first():
    named = set()
    for page in ("index.md", "howto/index.md"):
        folder = page.rpartition("/")[0]
        for block in re.findall(r"```\{toctree\}\n(.*?)```", PAGES[page], re.DOTALL):
            lines = [line for line in block.splitlines() if line and not line.startswith(":")]
            named |= {f"{folder}/{line}.md".lstrip("/") for line in lines}
    assert set(PAGES) - {"index.md"} <= named


def test_commands_parse():
    assert len(COMMANDS) >= 20
    for line in COMMANDS:
        args, rest = parser().parse_known_args(line)
        assert not rest and callable(args.run)


@pytest.mark.extended
def test_rigs_are_read_without_a_remark():
    assert set(rigs()) >= {"tank.toml", "cone.toml"}
    for text in rigs().values():
        case = rig.loads(text)
        assert not rig.case_warnings(case)


@pytest.mark.extended_for("howto/own-controller.md", "start.md")
@pytest.mark.slow_for("howto/plants.md")
@pytest.mark.parametrize("page", [p for p in PAGES if blocks("python", p)])
def test_python_runs(page, capsys):
    with jax.enable_x64(True):
        for block in blocks("python", page):
            exec(compile(block, page, "exec"), {"__name__": page})
    assert "nan" not in capsys.readouterr().out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    for name, text in rigs().items():
        (folder / name).write_text(text)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("line", COMMANDS, ids=" ".join)
def test_commands_run(line, folder, monkeypatch, capsys):
    """In the order of the pages: some read what those before them wrote."""
    monkeypatch.chdir(folder)
    assert main.main(list(line)) in (0, 4), capsys.readouterr().err  # 4: a limit is broken
