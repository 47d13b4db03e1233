"""What is shipped, and what it never does: unpickle a user's file, evaluate text, talk to a
network, or read a file of any size. Compiled programs alone are unpickled, by jax, from a folder
that is checked (`jaxtank.xla.program_cache`), and tasks of Dask workers by Dask.
"""

import ast
import importlib.util
import json
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
from tuning.storage import batch_store, checkpoint, evaluation_log

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
    (
        "tuning.bench.bench",
        "subprocess",
    ): "`jaxtank bench` compiles its own floor.c with gcc, where there is one",
    ("tuning.bench.bench", "ctypes"): "and calls it",
    (
        "tuning.cluster.local",
        "subprocess",
    ): "`--cluster local:N` starts Dask's own commands, of this Python, with constant words",
    ("tuning.cli.commands.explore", "webbrowser"): "`explore --open` shows the file it has written",
}

# Calls that run text, and those that open a file to read it.
CALLS = {
    "eval",
    "exec",
    "__import__",
    "import_module",
    "system",
    "popen",
    "execv",
    "execve",
    "spawnv",
    "startfile",
    "breakpoint",
}
READS = {
    "open",
    "read_text",
    "read_bytes",
    "load",
    "fromfile",
    "loadtxt",
    "genfromtxt",
    "memmap",
    "ZipFile",
    "TarFile",
    "imread",
    "CDLL",
}
MADE = {
    ("tuning.search.judged", "_lines", "import_module"): "its own report, by a constant name",
    ("jaxtank", "__getattr__", "import_module"): "names of its own table, in its own package",
    ("jaxtank.xla.executables", "_tree", "import_module"): "of a named tuple of ours, of an entry",
    ("tuning", "__getattr__", "import_module"): "names of its own table, in its own package",
    ("tuning.problem.result", "_report", "import_module"): "the report of its own class",
    ("tuning.problem.result", "explore", "import_module"): "the live page, by a constant name",
    ("jaxtank.case", "explore", "import_module"): "the live page, by a constant name",
    ("tuning.live.live_figure", "_build", "import_module"): "ipywidgets, by a constant name",
    ("jaxtank.plots.style", "notebook", "import_module"): "matplotlib_inline, by a constant name",
    ("tuning.cluster.task", "call", "import_module"): "names of its own table, in its own package",
    ("jaxtank.presets", "_load", "import_module"): "names of presets.PAPERS, checked before",
}
READ = {
    ("jaxtank.core.installed", "imported", "load"): "an entry point of an installed package that a"
    " rig file names as the kind of a component; nothing from a path",
    ("jaxtank.core.files", "read_text", "read_text"): "after `refusal`: a file of at most 4 MiB",
    ("jaxtank.rig.read", "load", "read_text"): "that of jaxtank.files",
    ("tuning.bench.bench", "c_loop", "CDLL"): "the C loop that it has just compiled",
    ("tuning.report.html", "style", "read_text"): "page.css of the package",
    ("tuning.live.page", "_read", "read_text"): "a part of the page, of the package",
    ("tuning.live.watch", "_read", "read_text"): "watch.js and watch.css of the package",
    ("tuning.live.engine", "engine", "read_text"): "engine.js of the package",
    ("jaxtank.export.whole.array_values", "library", "read_text"): "arrays.js of the package",
    ("tuning.cli.completion", "words", "read_text"): "names.txt of the package",
    ("jaxtank.xla.program_cache", "_digest", "read_bytes"): "an entry that jax has just written, or"
    " one of a folder of mode 700 and the user's own, to compare its digest",
    ("jaxtank.xla.program_cache", "_check_entries", "read_text"): "that digest, compared only",
    ("jaxtank.xla.executables", "_read", "read_bytes"): "an entry of that folder, checked by its"
    " owner, mode and digest when the process began, and by the name and processor it holds",
    ("jaxtank.xla.program_cache", "processor", "open"): "/proc/cpuinfo",
    ("jaxtank.xla.flags", "_text_of", "open"): "the file that XLA_FLAGS names, looked through only",
    ("tuning.identification.csv_log", "_text", "read_bytes"): "after `refusal`",
    ("tuning.storage.evaluation_log", "_data", "read_bytes"): "after `refusal`",
    ("tuning.storage.evaluation_log", "__init__", "open"): "to write",
    ("tuning.storage.evaluation_log", "keep", "open"): "to write",
    (
        "tuning.storage.batch_store",
        "read_batch",
        "ZipFile",
    ): "after `refusal`; unpacked sizes are added up first",
    ("tuning.storage.batch_store", "read_batch", "load"): "after that; allow_pickle=False",
    ("tuning.storage.batch_store", "read_manifest", "read_text"): "after `refusal`",
    ("tuning.storage.columns", "__getitem__", "memmap"): "a file without a name, its own",
    ("tuning.cluster.local", "_process", "open"): "to write",
    ("tuning.cluster.local", "_address", "read_text"): "in a new folder of its own, mode 700",
    ("tuning.cluster.local", "_last_line", "read_text"): "of the same folder",
    ("tuning.cli.main", "_drop_output", "open"): "/dev/null, to write",
    ("tuning.cli.terminal", "guard", "open"): "/dev/null, in place of a stream that was closed",
    ("tuning.storage.folder_lock", "_locked", "open"): "its own lock, of which 20 bytes are read",
    ("tuning.storage.folder_lock", "release", "open"): "its own lock, of which nothing is read",
}


def sources():
    """(module, syntax tree) of every file of the packages."""
    for package, root in PACKAGES.items():
        for path in sorted(root.rglob("*.py")):
            name = ".".join([package, *path.relative_to(root).with_suffix("").parts]).removesuffix(
                ".__init__"
            )
            yield name, ast.parse(path.read_text())


def called(tree):
    """(function it stands in, name) of every call; a name is the last word: `np.load` is load."""
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
    ("jaxtank.xla.executables", "_read", "deserialize_and_load"): "a compiled program of the folder"
    " that `program_cache.prepare` has checked: owner and mode of every level, digest and name",
    ("tuning.cluster.engine", "_client", "Client"): "results of the workers that the user names, or"
    " that this process has started with keys of its own",
}
"""Calls of others that unpickle what they read."""


def test_every_call_that_unpickles_is_known_and_why_it_is_safe():
    names = {"deserialize_and_load", "Client", "Unpickler", "loads", "deserialize"}
    plain = ("json.loads", "rig.loads", "rigs.loads", "tomllib.loads", "rig_files.loads", "loads")
    calls = {
        (module, where, name)
        for module, tree in sources()
        for where, name, whole, _ in called(tree)
        if name in names and whole not in plain
    }
    assert calls == set(UNPICKLES)


def test_no_text_is_run():
    found = {
        (m, where, name)
        for m, tree in sources()
        for where, name, _, _ in called(tree)
        if name in CALLS
    }
    assert found == set(MADE)
    for module, tree in sources():
        for _, name, _, node in called(tree):
            assert not any(
                k.arg == "allow_pickle"
                and not (isinstance(k.value, ast.Constant) and k.value.value is False)
                for k in node.keywords
            )
            assert name not in ("to_pickle", "read_pickle") and not any(
                k.arg == "shell" for k in node.keywords
            ), module


def test_every_reading_of_a_file_is_known_and_why_it_is_safe():
    # load: of a case by its name, of a rig by read_text
    ours = ("presets.", "jaxtank.presets", "rig.", "rigs.")
    found = {
        (m, where, name)
        for m, tree in sources()
        for where, name, whole, _ in called(tree)
        if name in READS
        and not whole.startswith(ours)
        and not (m in ("jaxtank.presets", "jaxtank.rig.read") and whole == "load")
    }
    assert found == set(READ)
    assert all(READ.values()) and all(MADE.values()) and all(IMPORTED.values())


def test_what_never_ends_or_is_too_large_is_not_read(tmp_path):
    """A device, a pipe, a folder, a huge file where a log, a batch, a manifest or a rig file should
    be.
    """
    (tmp_path / "huge").touch()
    os.truncate(tmp_path / "huge", 1 << 32)  # takes no room
    os.mkfifo(tmp_path / "pipe")
    loop = presets.find("cascaded/pi").loop
    for i, odd in enumerate((Path("/dev/zero"), tmp_path / "pipe", tmp_path, tmp_path / "huge")):
        folder = tmp_path / f"run{i}"
        folder.mkdir()
        for name in (
            evaluation_log.NAME,
            batch_store.MANIFEST,
            "part-000000.npz",
            "rig.toml",
            "log.csv",
        ):
            (folder / name).symlink_to(odd)
        states = "is not a file|at most"
        with pytest.raises(InputError, match=states):
            evaluation_log.EvaluationLog(folder, {"p": 1}, resume=True)
        with pytest.raises(InputError, match=states):
            batch_store.read_manifest(folder)
        with pytest.raises(InputError, match=states):
            batch_store.read_batch(folder / "part-000000.npz", {"x"})
        with pytest.raises(InputError, match=states):
            files.read_text(folder / "rig.toml", "rig file")
        with pytest.raises(DataError, match=states):
            csv_log.read_log(folder / "log.csv", loop)


def header(shape):
    """The beginning of an .npy file that claims to hold an array of this shape."""
    text = (
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode()
        + b"\n"
    )
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


ARRAY = header("(2,)") + bytes(16)
HOSTILE = {
    "a bomb": {"x.npy": ARRAY + bytes(1 << 29)},
    "a name that climbs": {"../../x.npy": ARRAY},
    "a name of a folder": {"/x.npy": ARRAY},
    "a batch twice": {"x.npy": ARRAY, "y.npy": ARRAY},
    "an array of 745 GiB": {"x.npy": header("(100000000000,)") + bytes(16)},
    "a header that is a program": {
        "x.npy": b"\x93NUMPY\x01\x00\x20\x00" + b"__import__('os').abort()".ljust(31) + b"\n"
    },
    "a header of 9,000 brackets": {
        "x.npy": b"\x93NUMPY\x01\x00" + (9000).to_bytes(2, "little") + b"[" * 9000
    },
    "a header of 9,000 signs": {
        "x.npy": b"\x93NUMPY\x01\x00" + (9001).to_bytes(2, "little") + b"-" * 9000 + b"1"
    },
    "an array longer than a number can say": {"x.npy": header(f"({10**30},)")},
    "an object, pickled": {"x.npy": ARRAY.replace(b"<f8", b"|O ")},
    "nothing": {},
}


@pytest.mark.parametrize("held", HOSTILE.values(), ids=HOSTILE)
def test_a_batch_is_not_trusted(held, tmp_path):
    path = tmp_path / "part-000000.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in held.items():
            archive.writestr(name, data)
    with pytest.raises(InputError, match=r"part-000000\.npz: is not a batch of this program"):
        batch_store.read_batch(path, {"x"})
    assert [p.name for p in tmp_path.iterdir()] == [path.name] and not (
        tmp_path.parent / "x.npy"
    ).exists()


def test_a_batch_that_lies_about_its_size_or_is_cut_or_locked(tmp_path):
    path = tmp_path / "part-000000.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", ARRAY + bytes(1 << 20))
    whole = path.read_bytes()
    at = whole.rfind(b"PK\x01\x02")  # its entry in the directory
    for where, value in (
        (at + 24, b"\x0a\0\0\0"),
        (at + 8, b"\x01\0"),
        (at + 10, b"\x63\0"),
        (60, b"\xff" * 40),
        (0, b"\0" * 4),
    ):
        path.write_bytes(whole[:where] + value + whole[where + len(value) :])
        with pytest.raises(InputError, match="not a batch of this program"):
            batch_store.read_batch(path, {"x"})
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="not a batch of this program"):
        batch_store.read_batch(path, {"x"})


def test_json_without_end_is_refused(tmp_path):
    head = json.dumps({"problem": {"format": checkpoint.FORMAT, "p": 1}}) + "\n"
    deep = "[" * 200_000 + "\n"
    (tmp_path / batch_store.MANIFEST).write_text(deep)
    with pytest.raises(InputError, match="is not a manifest"):
        batch_store.read_manifest(tmp_path)
    entry = '{"kind": "x", "key": "k", "result": ['
    for text, words in (
        (deep, "not a log"),
        (head + deep, "line 2"),
        # JSON that is read, and is too deep to be a result
        (head + entry + '{"all": [' * 900 + "]}" * 900 + "]}\n", "line 2"),
        (head + entry + '{"shape": [1000000000, 1000000000], "hex": ["0x1p0"]}]}\n', "line 2"),
        (head + entry + '{"shape": [1], "hex": ["__import__"]}]}\n', "line 2"),
    ):
        (tmp_path / evaluation_log.NAME).write_text(text)
        with pytest.raises(InputError, match=words):
            evaluation_log.EvaluationLog(tmp_path, {"p": 1}, resume=True)
        assert (tmp_path / evaluation_log.NAME).read_text() == text


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
    assert {
        "tuning/bench/floor.c",
        "tuning/cli/names.txt",
        "jaxtank/README.md",
        "tuning/README.md",
    } <= packed
    assert {n.rsplit(".", 1)[1] for n in packed} == {
        *("py", "c", "css", "html", "js", "md", "txt", "typed")
    }
    assert license_there and "METADATA" in info and "jaxtank = tuning.cli.main:main" in entry


def test_the_sdist_holds_what_builds_and_tests_it(built):
    with tarfile.open(built[1]) as archive:
        names = {m.name.split("/", 1)[1] for m in archive.getmembers()}
        assert all(m.isreg() and not m.name.startswith(("/", "..")) for m in archive.getmembers())
    assert {
        "pyproject.toml",
        "README.md",
        "CHANGELOG.md",
        "LICENSE",
        "jaxtank/__init__.py",
        "tuning/bench/floor.c",
        "CITATION.cff",
        "tests/conftest.py",
    } <= names
    assert {
        "tests/data/rigs/watertank.toml",
        "tests/data/recorded_runs.json",
        "tests/audits/versions.sh",
        "notebooks/run.py",
    } <= names
    assert {
        "tests/benchmarks/README.md",
        "notebooks/README.md",
        "notebooks/images/filter.gif",
    } <= names
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
