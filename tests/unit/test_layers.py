"""Which folder may import which: a folder imports lower ranks only, and no cycle exists in one."""

import ast
import graphlib
from pathlib import Path

import pytest
from helpers import RANK

import jaxtank
import tuning

# A result displays itself as HTML (and opens the module of its report by name); `python -m jaxtank`
# is the command.
LAZY = {
    ("tuning.problem.result", "tuning.report.document"),
    ("tuning.problem.result", "tuning.report.html"),
    ("tuning.problem.result", "tuning.report.tables"),
    ("jaxtank.__main__", "tuning.cli.main"),
    ("jaxtank.case", "jaxtank.plots.run"),
    ("jaxtank.case", "jaxtank.rig.write"),
    ("jaxtank.loop.trajectory", "jaxtank.plots.run"),
}
DRAWING = {
    "jaxtank.plots",
    "tuning.report",
    "tuning.figures",
    "tuning.cli",
}  # folders that may import matplotlib


def sources(*roots):
    """{module: syntax tree} of every file below the roots of the packages."""
    found = {}
    for root in roots:
        for path in sorted(root.rglob("*.py")):
            name = ".".join([root.name, *path.relative_to(root).with_suffix("").parts])
            found[name.removesuffix(".__init__")] = ast.parse(path.read_text())
    return found


def imports(trees):
    """{module: the modules of our own that it imports}."""
    found = {}
    for module, tree in trees.items():
        named = found.setdefault(module, set())
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                named.update(a.name for a in node.names if a.name in trees)
            elif isinstance(node, ast.ImportFrom) and node.module in trees:
                full = {f"{node.module}.{a.name}" for a in node.names}
                named.update(f if f in trees else node.module for f in full)
    return found


def folder(module):
    return ".".join(module.split(".")[:2])


def check(graph):
    """Raise AssertionError for an import of a higher folder, CycleError for a cycle."""
    inside = {}
    for module, targets in graph.items():
        for target in targets:
            if (module, target) in LAZY or "." not in module or "." not in target:
                continue
            a, b = folder(module), folder(target)
            assert RANK[b] <= RANK[a], f"{module} imports {target}, which is above it"
            inside.setdefault(module, set()).add(target)
    for graph in (inside, between(inside)):
        list(graphlib.TopologicalSorter(graph).static_order())


def between(graph):
    """The same imports between folders."""
    found = {}
    for module, targets in graph.items():
        found.setdefault(folder(module), set()).update(folder(t) for t in targets)
    return {a: targets - {a} for a, targets in found.items()}


@pytest.fixture(scope="module")
def trees():
    return sources(*(Path(p.__file__).parent for p in (jaxtank, tuning)))


def test_folders_import_lower_folders_only_and_no_cycle_exists(trees):
    check(imports(trees))


def test_an_upward_import_and_a_cycle_are_found(trees):
    graph = imports(trees)
    with pytest.raises(AssertionError, match="above"):
        check(graph | {"jaxtank.core.tree": {"jaxtank.loop.run"}})
    for a, b in (
        ("tuning.search.tuner", "tuning.search.discrete"),
        ("tuning.identification.fit", "tuning.identification.design"),
    ):
        with pytest.raises(graphlib.CycleError):
            check(graph | {a: graph[a] | {b}, b: graph[b] | {a}})
    with pytest.raises(AssertionError, match="above"):  # a report imported by what it reports on
        check(graph | {"tuning.identification.fit": {"tuning.report.html"}})


def test_no_module_shares_its_name_with_a_public_function(trees):
    public = {n for p in (jaxtank, tuning) for n in p.__all__ if callable(getattr(p, n))}
    assert not {m for m in trees if m.rpartition(".")[2] in public}


def test_jaxtank_never_imports_tuning(trees):
    graph = imports(trees)
    up = {
        (m, t)
        for m, ts in graph.items()
        for t in ts
        if (m + ".").startswith("jaxtank.") and (t + ".").startswith("tuning.")
    }
    assert up == {("jaxtank.__main__", "tuning.cli.main")}


def test_only_pictures_import_matplotlib(trees):
    """Pictures are drawn on given axes; reports open and close the figures."""
    found = set()
    for module, tree in trees.items():
        for node in ast.walk(tree):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [getattr(node, "module", None) or ""]
            )
            if any(n.startswith("matplotlib") for n in names):
                found.add(folder(module))
    assert found <= DRAWING


def test_no_pickle_eval_or_network(trees):
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec"), module
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [a.name for a in node.names] + [getattr(node, "module", "") or ""]
                assert not {"pickle", "marshal", "urllib", "socket", "requests"} & {
                    n.split(".")[0] for n in names
                }, module
