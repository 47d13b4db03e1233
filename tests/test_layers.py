"""The plan of the house: who may import whom, read from the source."""

import ast
from pathlib import Path

import jaxtank
import tuning

LAYERS = [
    {"errors", "_xla", "files", "units"},
    {"tree", "numerics", "invariants", "dependence", "materialise", "compensated"},
    {"records", "signals"},
    {"plants", "sensors", "actuators"},
    {"analysis", "linear", "qp"},
    {"observers", "controllers"},
    {"measures"},
    {"stepping"},
    {"shapes", "step_length"},
    {"door", "derivatives"},
    {"loop"},
    {"presets"},
    {"scheduling"},
    {"record_tables", "layout", "equations"},
    {"rig", "plotting"},
    {"record_plots", "run_plots", "schematic", "codegen", "neighbours", "environment"},
    {"export", "animation"},
]
ABOVE = [
    {
        "bounds",
        "inputs",
        "projected",
        "memo",
        "scenarios",
        "distributions",
        "indices",
        "effects",
        "parts",
        "logs",
        "coordinates",
        "one_line",
        "long_steps",
    },
    {"log_file", "playback", "proposal"},
    {"experiments", "estimation", "identified"},
    {"identifiability"},
    {"identify", "many"},
    {"objective"},
    {"screening", "solvers", "input_search", "evidence"},
    {"result"},
    {"search", "choices", "bound", "tradeoff"},
    {"shards"},
    {"ensemble", "sensitivity"},
    {"robust", "page", "pictures", "tables"},
    {"saving"},
    {"report"},
    {"tune_report"},
    {"manual_parts"},
    {"manual", "sensitivity_report", "ensemble_report", "identify_report"},
    {"bench", "compare"},
    {"streams"},
    {"arguments", "interrupts", "completion", "holds"},
    {"options"},
    {"identify_command", "tune_command", "batch_commands"},
    {"parser"},
    {"case_commands"},
    {"cli"},
]
RANK = {f"jaxtank.{room}": i for i, layer in enumerate(LAYERS) for room in layer}
RANK |= {f"tuning.{room}": len(LAYERS) + i for i, layer in enumerate(ABOVE) for room in layer}

# Doors that look up: `python -m jaxtank`, and methods of a result that draw and write it.
DOORS = {
    ("jaxtank.__main__", "tuning.cli.main"),
    ("tuning.search.result", "tuning.report.tuning"),
    ("tuning.search.result", "tuning.report.tuning_figures"),
    ("tuning.uncertainty.sensitivity_study", "tuning.report.sensitivity_tables"),
    ("tuning.uncertainty.study", "tuning.report.uncertainty"),
    ("tuning.identification.fit", "tuning.report.identification"),
}


def room(module):
    return ".".join(module.split(".")[:2])


def imports():
    """(importing module, imported module) of every import of our own packages."""
    for package in (jaxtank, tuning):
        root = Path(package.__file__).parent
        for path in sorted(root.rglob("*.py")):
            name = ".".join([package.__name__, *path.relative_to(root).with_suffix("").parts]).removesuffix(".__init__")
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("jaxtank", "tuning"):
                    for alias in node.names:
                        yield name, f"{node.module}.{alias.name}" if "." not in node.module else node.module
                elif isinstance(node, ast.Import):
                    for alias in node.names:
                        if alias.name.split(".")[0] in ("jaxtank", "tuning") and "." in alias.name:
                            yield name, alias.name


def test_every_room_has_its_place():
    rooms = {room(name) for name, _ in imports() if "." in name} - {"jaxtank.__main__"}
    assert rooms <= set(RANK)


def test_no_import_looks_up():
    seen = 0
    for name, target in imports():
        name, target = room(name), room(target)
        if name == target or (name, target) in DOORS or target not in RANK or name not in RANK:
            continue
        seen += 1
        assert RANK[target] <= RANK[name], f"{name} imports {target}, which is above it"
    assert seen > 60


def test_jaxtank_never_imports_tuning():
    assert {name for name, target in imports() if name.startswith("jaxtank") and target.startswith("tuning")} == {
        "jaxtank.__main__"
    }


def test_only_pictures_import_matplotlib():
    """Drawing is on given axes; the reports open and close the figures that it is done on."""
    found = set()
    for package in (jaxtank, tuning):
        for path in Path(package.__file__).parent.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", None) or ""]
                if any(n.startswith("matplotlib") for n in names):
                    found.add(path.name)
    drawing = {"plotting.py", "schematic.py", "animation.py"}
    assert found == drawing | {"saving.py", "tune_report.py", "identify_report.py", "pictures.py", "page.py"}


def test_no_pickle_eval_or_network():
    for package in (jaxtank, tuning):
        for path in Path(package.__file__).parent.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                    assert node.func.id not in ("eval", "exec"), path
                if isinstance(node, (ast.Import, ast.ImportFrom)):
                    names = [a.name for a in node.names] + [getattr(node, "module", "") or ""]
                    assert not {"pickle", "marshal", "urllib", "socket", "requests"} & {n.split(".")[0] for n in names}, path
