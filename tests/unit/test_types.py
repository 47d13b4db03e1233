"""What an editor sees: names, keywords and types of user code, checked by pyright."""

import ast
import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import DATA

import jaxtank
import tuning

CODE = DATA / "type_checks"


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """{file: lines of it with an error} of pyright's basic mode."""
    beside = shutil.which("pyright", path=str(Path(sys.executable).parent))
    pyright = beside or shutil.which("pyright")
    if pyright is None:
        pytest.skip("pyright is not installed: pip install pyright")
    started = subprocess.run([pyright, "--version"], capture_output=True, text=True)
    # the package of PyPI fetches the program itself when it is first run
    if started.returncode != 0:
        pytest.skip(f"pyright cannot run here: {started.stderr[-200:]}")
    folder = tmp_path_factory.mktemp("types")
    (folder / "pyrightconfig.json").write_text('{"typeCheckingMode": "basic"}')
    files = sorted(shutil.copy(path, folder) for path in CODE.glob("*.py"))
    words = [pyright, "--pythonpath", sys.executable, "--project", str(folder), "--outputjson"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=folder)
    errors = {Path(file).name: {} for file in files}
    for row in json.loads(done.stdout)["generalDiagnostics"]:
        if row["severity"] == "error":
            errors[Path(row["file"]).name][row["range"]["start"]["line"]] = row["message"]
    return errors


def test_typical_user_code_is_accepted(reported):
    assert reported["user.py"] == {}


def test_mistyped_names_and_keywords_are_reported(reported):
    lines = (CODE / "wrong.py").read_text().splitlines()
    wrong = {i for i, line in enumerate(lines) if line.endswith("# wrong")}
    assert len(wrong) == 8 and set(reported["wrong.py"]) == wrong


@pytest.mark.parametrize("package", [jaxtank, tuning])
def test_a_type_checker_is_given_every_public_name_from_where_it_is(package):
    tree = ast.parse(Path(package.__file__).with_suffix(".pyi").read_text())
    imports = [n for n in tree.body if isinstance(n, ast.ImportFrom)]
    homes = {a.asname: (n.module, a.name) for n in imports for a in n.names}
    assert set(package.__all__) == set(homes)
    for name, (module, attribute) in homes.items():
        whole = module == package.__name__  # a folder of the package
        home = importlib.import_module(f"{module}.{attribute}" if whole else module)
        assert getattr(package, name) is (home if whole else getattr(home, attribute))
    assert (Path(package.__file__).parent / "py.typed").exists()
