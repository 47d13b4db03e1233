"""What the pages show is run: Python as written, commands by the same parser or in full; links and
folder maps hold.
"""

import re
import shlex
import tomllib
from pathlib import Path

import jax
import pytest
from helpers import RANK, RIGS, ROOT

import jaxtank
import tuning as package
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.measures import MEASURES
from tuning.cli import main
from tuning.cli.commands import identification, tuning
from tuning.cli.parser import parser
from tuning.problem.problem import Problem

RIG = RIGS / "watertank.toml"
FOLDERS = ("", "notebooks/", "jaxtank/", "tuning/", "tests/benchmarks/")
FILES = {f"{folder}README.md": ROOT / folder / "README.md" for folder in FOLDERS}
PAGES = {name: path.read_text() if path.exists() else "" for name, path in FILES.items()}
SITE = {
    str(path.relative_to(ROOT / "notebooks" / "site")): path.read_text()
    for path in sorted((ROOT / "notebooks" / "site").glob("**/*.md"))
    if "_build" not in path.parts
}
pytestmark = pytest.mark.skipif(
    not (all(PAGES.values()) and SITE), reason="the pages are not beside the tests"
)


def blocks(language, *names, pages=PAGES):
    """The code blocks of the pages, of all pages where none is named."""
    pattern = rf"```{language}\n(.*?)```"
    return [b for name in names or pages for b in re.findall(pattern, pages[name], re.DOTALL)]


def prose(page):
    """A page without its code blocks."""
    return re.sub(r"```.*?```", "", page, flags=re.DOTALL)


def words(line):
    command = line.partition(" >")[0]  # without the file that its output goes to
    return tuple(shlex.split(command, comments=True)[1:])


LINES = [line for block in blocks("sh") for line in block.replace("&&", "\n").splitlines()]
COMMANDS = list(dict.fromkeys(words(line) for line in LINES if line.strip()[:7] == "jaxtank"))
OF_SITE = [
    words(line)
    for block in blocks("sh", pages=SITE)
    for line in block.splitlines()
    if line[:7] == "jaxtank"
]
KEPT = {words(line): line.partition(" >")[2].split()[0] for line in LINES if " >" in line}
"""{command: the file that its output goes to}"""


def anchors(page):
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_the_front_page_is_at_most_10_kb():
    assert len(PAGES["README.md"].encode()) <= 10_000


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_to_files_and_headings_that_exist(name):
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(PAGES[name])):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / name).parent / path if path else ROOT / name
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


@pytest.mark.parametrize("package", ["jaxtank", "tuning"])
def test_a_folder_map_names_every_folder_in_the_order_of_imports(package):
    named = re.findall(r"^\| `(\w+)/` \|", PAGES[f"{package}/README.md"], re.M)
    assert sorted(named) == sorted(p.parent.name for p in (ROOT / package).glob("*/__init__.py"))
    ranks = [RANK[f"{package}.{name}"] for name in named]
    assert ranks == sorted(ranks)


@pytest.mark.parametrize("name", PAGES)
def test_paths_in_texts_exist(name):
    """Paths of files or folders, and dotted names of modules, in code spans."""
    for span in re.findall(r"`([^`\n]+)`", prose(PAGES[name])):
        for path in re.findall(r"\b(?:jaxtank|tuning|tests|notebooks)/[\w/]+\.\w+", span):
            assert (ROOT / path).exists(), path


def first_example():
    example = blocks("python", "README.md")[0]
    return compile(example, "README", "exec"), example


def test_the_python_example_runs_and_is_short(capsys, monkeypatch):
    """Its last line checks the problem and runs it once, at the case's own gain, for a search."""

    def run(case, free, limits):
        problem = package.Problem(case, free=free, limits=limits)
        return problem.objective, jaxtank.evaluate(case.loop, case.clock, ["rms_error_total"])

    monkeypatch.setattr(package, "tune", run)
    program, example = first_example()
    assert len([line for line in example.splitlines() if line.strip()]) <= 8
    exec(program, {})
    printed = capsys.readouterr().out
    assert printed.startswith("0.0819") and printed.count("0.0819") == 2


@pytest.mark.slow
def test_the_python_example_is_tuned(capsys):
    exec(first_example()[0], {})
    printed = capsys.readouterr().out
    assert printed.startswith("0.0819") and "ngpc: converged" in printed
    assert "RMS error 0.0778 cm" in printed and "controller.Tp" in printed


def test_the_rig_in_python_runs(capsys, monkeypatch):
    """Its last line checks the problem in place of a search."""
    monkeypatch.setattr(package, "tune", lambda case, starts: list(package.Problem(case).objective))
    exec(compile(blocks("python", "README.md")[1], "README", "exec"), {})
    printed = capsys.readouterr().out
    assert "0.0372" in printed and "rms_error_total" in printed


@pytest.mark.slow
def test_the_custom_objective_runs(monkeypatch):
    """Its last line evaluates the problem once, at a longer step, in place of a search."""
    (example,) = blocks("python", "tuning/README.md")

    def once(case, **stated):
        problem = Problem(rig.set_values(case, {"clock.dt": 0.2}), **stated)
        return problem, problem.point(problem.start())

    monkeypatch.setattr(package, "tune", once)
    known, names = set(MEASURES), {}
    exec(compile(example, "tuning/README", "exec"), names)
    problem, point = names["result"]
    assert list(problem.objective) == ["absolute_error"] and point.finite
    assert [limit.label for limit in problem.limits][-1] == "fastest_change"
    for name in set(MEASURES) - known:
        del MEASURES[name]


def test_the_rigs_shown_are_the_one_that_is_tested():
    (short,), rigs = blocks("toml", "README.md"), blocks("toml", "jaxtank/README.md")
    full, plant, elements, watched = rigs
    assert full == RIG.read_text()
    assert tomllib.loads(short) == tomllib.loads(full)
    assert len([line for line in short.splitlines() if line.strip()]) <= 15
    assert blocks("toml") == [short, *rigs]
    of_file = tomllib.loads((RIGS / "two_tanks.toml").read_text())
    tables = tomllib.loads(plant)
    assert len(tables) == 5 and tables == {name: of_file[name] for name in tables}
    built, preset = rig.loads(watched), presets.find("gouta2015/backstepping-observer")
    assert jax.tree.structure(built.loop) == jax.tree.structure(preset.loop)
    assert built.loop.observer.l.tolist() == preset.loop.observer.l.tolist()
    assert built.free.keys() < preset.free.keys()
    more = 'reachable = false\ncontroller = { kind = "open-loop", initial = [6.0, 0.5] }\n'
    process = rig.loads(more + elements).loop.plant
    assert dict(process.names)["tank"] == ("T100", "LT101") and process.sources == (0,)
    assert process.valves == ((1, None),) and process.shapes == ("prism", "cone")


def test_what_the_page_states_of_outputs_holds():
    """The default, and what a PID refuses: both for the rig of two tanks in the page."""
    text = (RIGS / "two_tanks.toml").read_text()
    line = 'outputs = ["lower"]\n'
    assert text.count(line) == 1
    assert rig.loads(text).loop.plant.outputs == (1,)
    assert rig.loads(text.replace(line, "")).loop.plant.outputs == (0,)
    both = text.replace('outputs = ["lower"]', 'outputs = ["upper", "lower"]')
    both = both.replace("initial = [4.0]", "initial = [4.0, 4.0]")
    with pytest.raises(InputError, match=r"1 .*2|2 .*1"):
        rig.loads(both)


def test_commands_parse():
    inline = [words(span) for span in re.findall(r"`(jaxtank [^`\n]+)`", PAGES["README.md"])]
    assert len(COMMANDS) >= 30 and len(inline) >= 10 and len(OF_SITE) >= 20
    for line in [*COMMANDS, *inline, *OF_SITE]:
        args, rest = parser().parse_known_args(line)
        assert not rest and callable(args.run)


@pytest.mark.slow
@pytest.mark.parametrize("line", [c for c in COMMANDS if "host:8786" not in c], ids=" ".join)
def test_commands_run(line, tmp_path_factory, monkeypatch, capsys):
    """All but the one on a scheduler of the reader's; in their order, in one folder."""
    monkeypatch.chdir(tmp_path_factory.getbasetemp())
    code, printed = main.main(list(line)), capsys.readouterr()
    assert code == 0, printed.err
    if line in KEPT:
        Path(KEPT[line]).write_text(printed.out)


@pytest.mark.parametrize("name", PAGES)
def test_pictures_are_small(name):
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", PAGES[name]):
        assert ((ROOT / name).parent / picture).stat().st_size < 300_000


def test_every_exit_code_is_explained():
    """Those of a search, of an identification, of refused input and of refused data."""
    text = re.search(r"Exit codes: (.*?)\. Results", PAGES["notebooks/README.md"], re.DOTALL)[1]
    codes = {int(code) for code in re.findall(r"(?:^|, )(\d+) ", text.replace("\n", " "))}
    assert codes == {*tuning.EXIT.values(), *identification.STATUS.values(), 2, 143}


# the documentation site


def saved_rigs():
    """{file name: text} of the rig files that the pages of the site have the reader save."""
    pattern = r"Save as `(.*?)`:\n\n```toml\n(.*?)```"
    return dict(pair for page in SITE.values() for pair in re.findall(pattern, page, re.DOTALL))


def test_every_page_of_the_site_is_reached_from_the_first():
    named = set()
    for page in ("index.md", "howto/index.md"):
        folder = page.rpartition("/")[0]
        for block in re.findall(r"```\{toctree\}\n(.*?)```", SITE[page], re.DOTALL):
            lines = [line for line in block.splitlines() if line and not line.startswith(":")]
            named |= {f"{folder}/{line}.md".lstrip("/") for line in lines}
    assert set(SITE) - {"index.md"} <= named


@pytest.mark.extended
def test_rigs_of_the_site_are_read_without_a_remark():
    assert set(saved_rigs()) >= {"tank.toml", "cone.toml"}
    assert not [
        note for text in saved_rigs().values() for note in rig.case_warnings(rig.loads(text))
    ]


@pytest.mark.extended_for("howto/own-controller.md", "start.md")
@pytest.mark.slow_for("howto/plants.md")
@pytest.mark.parametrize("page", [page for page in SITE if blocks("python", page, pages=SITE)])
def test_python_of_the_site_runs(page, capsys):
    with jax.enable_x64(True):
        for block in blocks("python", page, pages=SITE):
            exec(compile(block, page, "exec"), {"__name__": page})
    assert "nan" not in capsys.readouterr().out


@pytest.mark.slow
def test_commands_of_the_site_run(tmp_path, monkeypatch, capsys):
    """In the order of the pages: some read what those before them wrote."""
    monkeypatch.chdir(tmp_path)
    for name, text in saved_rigs().items():
        (tmp_path / name).write_text(text)
    for line in OF_SITE:
        code = main.main(list(line))  # 4: a limit is broken
        assert code in (0, 4), f"{' '.join(line)}: {capsys.readouterr().err}"
