"""What imports what: imports inside functions and imports by a computed name count as any other."""

import ast
import functools
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import RANK

import jaxtank
import tuning

ROOTS = {p.__name__: Path(p.__file__).parent for p in (jaxtank, tuning)}
COMMAND = ("jaxtank.__main__", "tuning.cli.main")
"""`python -m jaxtank` is the command: the one import of tuning in jaxtank."""
BY_NAME = {
    "jaxtank.core.lazy": "names that the two `__init__` give it, which nothing below imports",
    "jaxtank.plots.style": "settings of pictures in a notebook",
    "jaxtank.presets": "papers",
    "jaxtank.xla.jit": "the module of a named tuple among the arguments of a program",
    "tuning.cluster.engine": "a task, in the process of a worker",
}
"""{module that imports by another way than a statement: what}."""
IMPORTERS = {"importlib", "builtins", "pkgutil", "runpy"}
"""Modules of other ways to import; what is below them, as importlib.metadata, has none."""
WORDS = {"import_module", "__import__", "__builtins__", "resolve_name", "run_module", "run_path"}
DRAWING = {"jaxtank.plots", "tuning.report", "tuning.figures", "tuning.cli"}


def sources():
    """{module: syntax tree} of every file of both packages; that of a root has its stub too."""
    trees = {}
    for package, root in ROOTS.items():
        for path in sorted(root.rglob("*.py")):
            name = ".".join([package, *path.relative_to(root).with_suffix("").parts])
            stub = path.with_suffix(".pyi")
            text = path.read_text() + (stub.read_text() if stub.exists() else "")
            trees[name.removesuffix(".__init__")] = ast.parse(text)
    return trees


@functools.cache
def imports(tree):
    """Names of what a module imports anywhere in it; "?" where it may import by another way."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{'.' * node.level}{node.module or ''}.{a.name}" for a in node.names}
        words = {getattr(node, field, None) for field in ("id", "attr", "value", "name")
                 if isinstance(getattr(node, field, None), str)}  # fmt: skip
        found |= {"?"} if words & WORDS else set()
    return frozenset(found | ({"?"} if found & IMPORTERS else set()))


def graph_of(trees, modules=None):
    """{module: modules of ours that it imports}, those that are there or `modules`."""
    graph, modules = {}, modules or trees
    for module, tree in trees.items():
        names = imports(tree)
        assert not any(name.startswith(".") for name in names), f"{module}: a relative import"
        assert ("?" in names) <= (module in BY_NAME), f"{module} imports by a name"
        if module == "jaxtank.presets":
            names |= {m for m in modules if m.startswith("jaxtank.presets.")}
        if module in ROOTS:  # HOMES of core/lazy.py
            names |= {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)} - {None}
        graph[module] = {t for t in map(lambda n: home(n, modules), names) if t and t != module}
    return graph


def home(name, modules):
    """The module of ours that holds a dotted name: itself, or the package that it is a name of."""
    if not isinstance(name, str) or name.split(".")[0] not in ROOTS:
        return None
    return name if name in modules else home(name.rpartition(".")[0] or "-", modules)


def folder(module):
    return ".".join(module.split(".")[:2])


def check(graph):
    """Raise AssertionError for an import of a higher folder, CycleError for a circle."""
    for module, targets in graph.items():
        for target in targets - set(ROOTS):
            if module not in ROOTS and (module, target) != COMMAND:
                above = RANK[folder(target)] > RANK[folder(module)]
                assert not above, f"{module} imports {target}, which is above it"
    folders = {}
    for module, targets in graph.items():
        if module not in ROOTS:
            folders.setdefault(folder(module), set()).update(map(folder, targets))
    for edges in (graph, {a: targets - {a} for a, targets in folders.items()}):
        list(graphlib.TopologicalSorter(edges).static_order())


@pytest.fixture(scope="module")
def trees():
    return sources()


@pytest.fixture(scope="module")
def graph(trees):
    return graph_of(trees)


def test_folders_import_lower_folders_only_and_there_is_no_circle(graph):
    check(graph)
    assert {m for m, targets in graph.items() if "jaxtank.core.lazy" in targets} == {
        *ROOTS,
        *("jaxtank.interop", "jaxtank.views", "tuning.views"),
    }


def test_jaxtank_imports_tuning_in_its_command_alone(graph):
    upward = [
        (m, t) for m, ts in graph.items() for t in ts if m[:7] == "jaxtank" and t[:6] == "tuning"
    ]
    assert upward == [COMMAND]


MUTANTS = {
    "plain": "import tuning.search.tuner",
    "in a method": "class A:\n    def plot(self):\n        import tuning\n        tuning.tune()",
    "from, in a function": "def f():\n    from tuning.search import tuner as t",
    "import_module": "import importlib\nimportlib.import_module('tuning.search.tuner')",
    "under an alias": "from importlib import import_module as bring\nbring('tuning.search.tuner')",
    "module under an alias": "import importlib as i\ndef f():\n    i.import_module('tuning')",
    "given a name": "import importlib\na = importlib.import_module\nb = a\nb('tuning.search')",
    "by getattr": "import importlib\ngetattr(importlib, 'import_module')('tuning.search.tuner')",
    "__import__": "def f():\n    return __import__('tuning.search.tuner')",
    "a computed name": "from importlib import import_module as bring\nbring('tun' + 'ing')",
    "given away": "from importlib import import_module\nlist(map(import_module, ['tuning']))",
    "by vars": "import importlib\nvars(importlib)['import_module']('tuning')",
}


@pytest.mark.parametrize("name", MUTANTS)
def test_an_import_of_tuning_is_seen_however_it_is_written(graph, name):
    mutant = {"jaxtank.loop.run": ast.parse(MUTANTS[name])}
    with pytest.raises((AssertionError, graphlib.CycleError)):  # the root is in a circle
        check(graph | graph_of(mutant, graph))


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("tuning.search.tuner", "from tuning.search.discrete import tune_choices"),
        ("tuning.identification.design", "def f():\n    import tuning.identification.fit"),
        ("jaxtank.case", "def f():\n    import jaxtank"),
        ("tuning.views", "import tuning"),
    ],
)
def test_a_circle_is_found_inside_functions_too(graph, module, line):
    added = graph_of({module: ast.parse(line)}, graph)[module]
    with pytest.raises((graphlib.CycleError, AssertionError)):
        check(graph | {module: graph[module] | added})


def test_no_module_shares_its_name_with_a_public_function(trees):
    public = {n for p in (jaxtank, tuning) for n in p.__all__ if callable(getattr(p, n))}
    assert not {m for m in trees if m.rpartition(".")[2] in public}


def test_only_pictures_import_matplotlib(trees):
    """Pictures are drawn on given axes; reports open and close the figures."""
    drawing = {m for m, tree in trees.items() if any(n[:10] == "matplotlib" for n in imports(tree))}
    assert set(map(folder, drawing)) <= DRAWING


def linalg_of_jax(tree):
    """Dotted names of `linalg` of jax in a syntax tree; norm, a sum of squares, is left out."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            words = ast.unparse(node).split(".")
            if words[0] in ("jnp", "jax", "xp", "lax") and "linalg" in words[:-1]:
                yield from [".".join(words)] * (words[-1] != "norm")
        elif isinstance(node, ast.Import | ast.ImportFrom):
            module = getattr(node, "module", None) or ""
            names = [f"{module}.{alias.name}".strip(".") for alias in node.names]
            yield from (n for n in names if n.startswith("jax.") and "linalg" in n.split("."))


@pytest.mark.parametrize(
    "line",
    [
        "jnp.linalg.solve(A, b)",
        "jax.scipy.linalg.expm(A)",
        "from jax.scipy.linalg import expm",
        "from jax.numpy import linalg",
        "import jax.scipy.linalg as la",
    ],
)
def test_linalg_of_jax_is_found_however_it_is_written(line):
    assert list(linalg_of_jax(ast.parse(line)))
    assert not list(linalg_of_jax(ast.parse("jnp.linalg.norm(A) + np.linalg.solve(A, b)")))


def test_nothing_uses_linalg_of_jax(trees):
    """In jaxlib 0.10 a program with two calls of it deadlocks on a batch of 1,000 runs."""
    assert {m: names for m, tree in trees.items() if (names := list(linalg_of_jax(tree)))} == {}


CALLS = Path(__file__).with_name("public_calls.py")


@pytest.mark.slow
def test_no_public_call_of_jaxtank_loads_tuning():
    """In a process of its own, tests/unit/public_calls.py; the imports above show the same."""
    ran = subprocess.run([sys.executable, CALLS], capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
