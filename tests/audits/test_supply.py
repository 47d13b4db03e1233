"""What is shipped, and what it never does: unpickle a user's file, evaluate text, talk to a
network, or read a file of any size. Compiled programs alone are unpickled, by jax, from a folder
that is checked (`jaxtank.xla.program_cache`), and tasks of Dask workers by Dask.
"""

import ast
import functools
import importlib.util
import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from helpers import ROOT

import jaxtank
import tuning
from jaxtank import presets
from jaxtank.core import files
from jaxtank.core.errors import DataError, InputError
from tuning.identification import csv_log
from tuning.storage.store import NAME, Store

PACKAGES = {p.__name__: Path(p.__file__).parent for p in (jaxtank, tuning)}

# Modules that one would need to unpickle, evaluate, talk to others or start programs.
SUSPECT = {
    "pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib",
    "code", "codeop", "runpy", "imp",
    "socket", "socketserver", "ssl", "urllib", "http", "ftplib", "smtplib", "telnetlib", "xmlrpc",
    "requests", "httpx", "aiohttp", "asyncio",
    "websockets", "webbrowser", "sentry_sdk", "posthog", "analytics",
    "subprocess", "ctypes", "cffi", "multiprocessing", "pty",
}  # fmt: skip
IMPORTED = {
    ("tuning.bench.bench", "subprocess"): "`jaxtank bench` compiles its floor.c with gcc",
    ("tuning.bench.bench", "ctypes"): "and calls it",
    ("jaxtank.export.timing", "subprocess"): "gcc compiles a controller of ours, to be timed",
    ("jaxtank.export.fmi", "subprocess"): "gcc compiles an FMU of ours, where there is one",
    ("jaxtank.export.replay", "subprocess"): "gcc or node for an export to be run",
    ("jaxtank.export.replay", "ctypes"): "and calls it",
    ("tuning.cli.commands.explore", "webbrowser"): "`explore --open` shows the file it has written",
}

# Calls that run text, and those that open a file to read it.
CALLS = "eval exec __import__ import_module system popen execv execve spawnv startfile breakpoint"
READS = (
    "open read_text read_bytes load fromfile loadtxt genfromtxt memmap ZipFile TarFile imread CDLL"
)
MADE = {
    ("jaxtank.core.lazy", "get", "import_module"): "names of the stub of its own package",
    ("jaxtank.core.lazy", "home", "import_module"): "modules that the two `__init__` name",
    ("jaxtank.xla.jit", "_definition", "import_module"): "of a class of ours, of an entry",
    ("jaxtank.plots.style", "notebook", "import_module"): "matplotlib_inline, by a constant name",
    ("tuning.cluster.engine", "call", "import_module"): "names of its table, in its package",
    ("jaxtank.presets", "_load", "import_module"): "names of presets.PAPERS, checked before",
}
READ = {
    ("jaxtank.export.replay", "_load_c", "read_text"): "an export that the user asks to be run",
    ("jaxtank.export.replay", "_loaded", "CDLL"): "its code, compiled here or in the user's FMU",
    ("jaxtank.export.replay", "_load_fmu", "read_bytes"): "an FMU that the user asks to be run",
    ("jaxtank.export.replay", "_load_fmu", "ZipFile"): "parts by name; its library is extracted",
    ("jaxtank.export.fmi", "library", "read_bytes"): "the library that gcc has made",
    ("jaxtank.export.fmi", "print_fmu", "ZipFile"): "is written",
    ("jaxtank.core.lazy", "attach", "read_text"): "the stub of its own package",
    ("jaxtank.core.installed", "imported", "load"): "an entry point of an installed package that a"
    " rig file names as the kind of a component; nothing from a path",
    ("jaxtank.core.files", "read_text", "read_text"): "after `refusal`: a file of at most 4 MiB",
    ("tuning.uncertainty.sobol", "_directions", "load"): "a table of scipy, without pickles",
    ("jaxtank.rig.read", "load", "read_text"): "that of jaxtank.files",
    ("jaxtank.core.tables", "_sheet", "ZipFile"): "sizes of the parts of an Excel file, in memory,"
    " before openpyxl reads them",
    ("jaxtank.rig.schema", "_sections", "read_text"): "a table of the package",
    ("jaxtank.rig.entry", "", "read_text"): "words.toml of the package",
    ("jaxtank.export.statements", "template", "read_text"): "a template of the package",
    ("jaxtank.presets.paper", "printed", "read_text"): "the numbers of a paper, of the package",
    ("tuning.bench.bench", "c_loop", "CDLL"): "the C loop that it has just compiled",
    ("tuning.figures.figure", "_figures", "read_text"): "figures.toml of the package",
    ("tuning.report.html", "document", "read_text"): "page.css of the package",
    ("jaxtank.live.page", "_read", "read_text"): "a part of the page, of the package",
    ("jaxtank.live.engine", "engine", "read_text"): "engine.js of the package",
    ("tuning.cli.completion", "_lines", "read_text"): "names.txt of the package",
    ("jaxtank.xla.program_cache", "seal", "read_bytes"): "an entry that jax has just written",
    ("jaxtank.xla.program_cache", "_check_entries", "read_bytes"): "an entry of a folder of mode"
    " 700 and the user's own, to compare its digest",
    ("jaxtank.xla.program_cache", "_check_entries", "read_text"): "that digest, compared only",
    ("jaxtank.xla.program_cache", "read", "read_bytes"): "an entry of that folder, whose owner and"
    " mode were checked when the process began; used after its digest is compared",
    ("jaxtank.xla.program_cache", "read", "read_text"): "that digest, compared only",
    ("jaxtank.xla.program_cache", "processor", "open"): "/proc/cpuinfo",
    ("jaxtank.xla.flags", "_text_of", "open"): "the file that XLA_FLAGS names, looked through only",
    ("jaxtank.core.tables", "_bytes", "read_bytes"): "after `refusal`",
    ("tuning.storage.columns", "__getitem__", "memmap"): "a file without a name, its own",
    ("tuning.cli.main", "_drop_output", "open"): "/dev/null, to write",
    ("tuning.cli.terminal", "guard", "open"): "/dev/null, in place of a stream that was closed",
    ("tuning.storage.folder_lock", "_locked", "open"): "its own lock, of which 20 bytes are read",
    ("tuning.storage.folder_lock", "release", "open"): "its own lock, of which nothing is read",
}


@functools.cache
def sources():
    """[(module, syntax tree) of every file of the packages]."""
    trees = []
    for package, root in PACKAGES.items():
        for path in sorted(root.rglob("*.py")):
            name = ".".join([package, *path.relative_to(root).with_suffix("").parts])
            trees.append((name.removesuffix(".__init__"), ast.parse(path.read_text())))
    return trees


@functools.cache
def calls():
    """[(module, function it stands in, name, whole name, node)] of every call of the packages; the
    name is the last word: `np.load` is load.
    """
    return [(module, *call) for module, tree in sources() for call in _called(tree)]


def _called(tree):
    inside = {}
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            inside |= {id(node): function.name for node in ast.walk(function)}  # the innermost last
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            f = node.func
            name = (
                f.id if isinstance(f, ast.Name) else f.attr if isinstance(f, ast.Attribute) else ""
            )
            yield inside.get(id(node), ""), name, ast.unparse(f), node


def test_nothing_is_imported_that_unpickles_talks_or_starts_programs():
    found = set()
    for module, tree in sources():
        for node in ast.walk(tree):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found |= {(module, n.split(".")[0]) for n in names if n.split(".")[0] in SUSPECT}
    assert found == set(IMPORTED)


UNPICKLES = {
    ("jaxtank.xla.jit", "_read", "deserialize_and_load"): "a compiled program of the folder"
    " that `program_cache.prepare` has checked: owner and mode of every level, digest and name",
    ("tuning.cluster.engine", "_client", "Client"): "results of the workers that the user names, or"
    " that this process has started with keys of its own",
}
"""Calls of others that unpickle what they read."""


def test_every_call_that_unpickles_is_known_and_why_it_is_safe():
    names = {"deserialize_and_load", "Client", "Unpickler", "loads", "deserialize"}
    plain = ("json.loads", "rig.loads", "rigs.loads", "tomllib.loads", "rig_files.loads", "loads")
    unpickling = {c[:3] for c in calls() if c[2] in names and c[3] not in plain}
    assert unpickling == set(UNPICKLES)


def test_no_text_is_run():
    assert {call[:3] for call in calls() if call[2] in CALLS.split()} == set(MADE)
    for module, _, name, _, node in calls():
        words = {k.arg: ast.unparse(k.value) for k in node.keywords if k.arg}
        assert words.get("allow_pickle", "False") == "False" and "shell" not in words, module
        assert name not in ("to_pickle", "read_pickle"), module


def test_every_reading_of_a_file_is_known_and_why_it_is_safe():
    # load: of a case by its name, of a rig by read_text
    ours = ("presets.", "jaxtank.presets", "rig.", "rigs.")
    found = {
        (module, where, name)
        for module, where, name, whole, _ in calls()
        if name in READS.split()
        and not whole.startswith(ours)
        and not (module in ("jaxtank.presets", "jaxtank.rig.read") and whole == "load")
    }
    assert found == set(READ)
    assert all(READ.values()) and all(MADE.values()) and all(IMPORTED.values())


def test_what_never_ends_or_is_too_large_is_not_read(tmp_path):
    """A device, a pipe, a folder, a huge file where a checkpoint, a log or a rig file should be."""
    (tmp_path / "huge").touch()
    os.truncate(tmp_path / "huge", 1 << 32)  # takes no room
    os.mkfifo(tmp_path / "pipe")
    loop = presets.find("cascaded/pi").loop
    for i, odd in enumerate((Path("/dev/zero"), tmp_path / "pipe", tmp_path, tmp_path / "huge")):
        folder = tmp_path / f"run{i}"
        folder.mkdir()
        for name in (NAME, "rig.toml", "log.csv"):
            (folder / name).symlink_to(odd)
        states = "is not a file|at most"
        with pytest.raises(InputError, match=f"{states}|is not a checkpoint"):
            Store(folder, {"p": 1}, resume=True)
        with pytest.raises(InputError, match=states):
            files.read_text(folder / "rig.toml", "rig file")
        with pytest.raises(DataError, match=states):
            csv_log.read_log(folder / "log.csv", loop)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """(wheel, sdist) of the repository."""
    if importlib.util.find_spec("hatchling") is None or not (ROOT / "pyproject.toml").exists():
        pytest.skip("hatchling, or the repository, is not here")
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", str(folder)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def test_the_wheel_holds_the_two_packages_and_nothing_else(built):
    with zipfile.ZipFile(built[0]) as archive:
        names = set(archive.namelist())
        info = {n.split(".dist-info/")[1] for n in names if ".dist-info/" in n}
        license_there = any("LICENSE" in n for n in info)
        entry = next(archive.read(n).decode() for n in names if n.endswith("entry_points.txt"))
    packed = {n for n in names if ".dist-info/" not in n}
    there = {
        f"{package}/{path.relative_to(root)}"
        for package, root in PACKAGES.items()
        for path in root.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert packed == there
    there = "tuning/bench/floor.c tuning/cli/names.txt jaxtank/README.md tuning/README.md"
    assert set(there.split()) <= packed
    assert {n.rsplit(".", 1)[1] for n in packed} == {
        *(
            *("py", "pyi", "c", "m", "st", "css", "h", "xml", "html", "js", "md", "mplstyle"),
            *("toml", "txt", "typed"),
        )
    }
    assert license_there and "METADATA" in info and "jaxtank = tuning.cli.main:main" in entry


def test_the_sdist_holds_what_builds_and_tests_it(built):
    with tarfile.open(built[1]) as archive:
        names = {m.name.split("/", 1)[1] for m in archive.getmembers()}
        assert all(m.isreg() and not m.name.startswith(("/", "..")) for m in archive.getmembers())
    there = (
        "pyproject.toml README.md CHANGELOG.md LICENSE CITATION.cff jaxtank/__init__.py"
        " tuning/bench/floor.c tests/conftest.py tests/data/rigs/watertank.toml"
        " tests/data/recorded_runs.json tests/audits/versions.sh tests/benchmarks/README.md"
        " notebooks/run.py notebooks/README.md notebooks/images/filter.gif"
    )
    assert set(there.split()) <= names
    assert not any("__pycache__" in n or n.endswith((".pyc", ".so", ".log")) for n in names)


@pytest.mark.slow
def test_it_installs_into_an_empty_environment_and_runs(built, tmp_path):
    """From wheel and from sdist, away from the repository; needs the dependencies from pip."""
    for package, words in zip(
        built,
        (
            ["tune", "gouta2015/backstepping", "--dt", "0.5", "--starts", "1", "--out", "tuned"],
            ["list"],
        ),
    ):
        home = tmp_path / package.suffix[1:]
        venv.create(home, with_pip=True)
        clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
        subprocess.run(
            [home / "bin" / "pip", "install", "--quiet", package],
            check=True,
            capture_output=True,
            env=clean,
        )
        done = subprocess.run(
            [home / "bin" / "jaxtank", *words], cwd=home, capture_output=True, text=True, env=clean
        )
        assert done.returncode == 0 and "backstepping" in done.stdout, done.stderr
        where = subprocess.run(
            [home / "bin" / "python", "-c", "import tuning; print(tuning.__file__)"],
            cwd=home,
            capture_output=True,
            text=True,
            env=clean,
        )
        assert where.stdout.startswith(str(home))
    assert {"result.json", "rig.toml", "report.html", "responses.png"} <= {
        p.name for p in (tmp_path / "whl" / "tuned").iterdir()
    }
