"""Print the size of the code by folder, and how much of it a call enters.

python tests/audits/code_size.py              lines, statements, files by folder
python tests/audits/code_size.py --entered    modules, functions and call depth of three calls
"""

import ast
import collections
import io
import subprocess
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("jaxtank", "tuning")
CALLS = {
    "evaluate": "jaxtank.evaluate(case.loop, case.clock, ['rms_error_total'])",
    "tune --nominal": "main(['tune', case.name, '--nominal', '--starts', '1', '--quiet'])",
    "tune --out": "main(['tune', case.name, '--quiet', '--out', folder])",
}
PROBE = """
import collections, contextlib, io, sys, tempfile
import jax
jax.config.update("jax_enable_x64", True)
import jaxtank
from jaxtank import presets
from tuning.cli.main import main
case = presets.find("gouta2015/backstepping")
modules, functions, depths, depth = set(), set(), collections.Counter(), 0
def profile(frame, event, _):
    global depth
    if frame.f_globals.get("__name__", "").split(".")[0] not in ("jaxtank", "tuning"):
        return
    if event == "call":
        depth += 1
        depths[depth] += 1
        modules.add(frame.f_code.co_filename)
        functions.add(frame.f_code)
    elif event == "return":
        depth -= 1
with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
    sys.setprofile(profile)
    CALL
    sys.setprofile(None)
mean = sum(d * n for d, n in depths.items()) / sum(depths.values())
print(len(modules), len(functions), round(mean, 1), max(depths))
"""


def docstring_lines(tree):
    """Return the number of lines in docstrings of a module."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    documented = [n for n in ast.walk(tree) if isinstance(n, kinds) and ast.get_docstring(n)]
    return sum(n.body[0].end_lineno - n.body[0].lineno + 1 for n in documented)


def sizes(paths):
    """Return a Counter of files, lines, code lines, docstring lines, statements and functions."""
    total = collections.Counter()
    for path in paths:
        text = path.read_text()
        tree = ast.parse(text)
        nodes = list(ast.walk(tree))
        skipped = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT}
        skipped |= {tokenize.DEDENT, tokenize.ENDMARKER}
        code = {
            line
            for token in tokenize.generate_tokens(io.StringIO(text).readline)
            if token.type not in skipped
            for line in range(token.start[0], token.end[0] + 1)
        }
        documented = docstring_lines(tree)
        total += collections.Counter(
            files=1,
            lines=len(text.splitlines()),
            code=len(code) - documented,
            docstrings=documented,
            statements=sum(isinstance(n, ast.stmt) for n in nodes),
            functions=sum(isinstance(n, ast.FunctionDef) for n in nodes),
        )
    return total


def functions_used_once():
    """Return {folder: functions of modules whose name is written once besides its definition}."""
    texts = {p: p.read_text() for package in PACKAGES for p in (ROOT / package).rglob("*.py")}
    words = collections.Counter()
    for text in texts.values():
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        words.update(t.string for t in tokens if t.type == tokenize.NAME)
    once = collections.Counter()
    for path, text in texts.items():
        once[path.parent] += sum(
            isinstance(n, ast.FunctionDef) and words[n.name] == 2 for n in ast.parse(text).body
        )
    return once


def print_sizes():
    """Print the table by folder."""
    columns = ("files", "lines", "code", "docstrings", "statements", "functions")
    print(f"{'folder':28}" + "".join(f"{c:>12}" for c in (*columns, "used once")))
    once, total = functions_used_once(), collections.Counter()
    for package in PACKAGES:
        for folder in sorted({p.parent for p in (ROOT / package).rglob("*.py")}):
            row = sizes(folder.glob("*.py"))
            row["used once"] = once[folder]
            total += row
            print(f"{folder.relative_to(ROOT)!s:28}" + "".join(
                f"{row[c]:12,}" for c in (*columns, "used once")
            ))  # fmt: skip
    print(f"{'both packages':28}" + "".join(f"{total[c]:12,}" for c in (*columns, "used once")))
    print(
        f"{'tests':28}"
        + "".join(f"{sizes((ROOT / 'tests').rglob('*.py'))[c]:12,}" for c in columns)
    )


def print_entered():
    """Print how many modules and functions calls enter, and how deep."""
    print(f"{'call':16}{'modules':>10}{'functions':>10}{'mean depth':>12}{'deepest':>9}")
    for name, call in CALLS.items():
        program = PROBE.replace("CALL", call)
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
        )
        modules, functions, mean, deepest = done.stdout.split()
        print(f"{name:16}{modules:>10}{functions:>10}{mean:>12}{deepest:>9}")


if __name__ == "__main__":
    print_entered() if "--entered" in sys.argv[1:] else print_sizes()
