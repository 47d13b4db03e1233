"""Execute the notebooks of this folder, top to bottom.

python notebooks/run.py            in full, and keep the outputs in the files
python notebooks/run.py --fast     with the parameters of FAST (coarse steps, few starts), without
                                   changing the files
python notebooks/run.py 05 08      those alone, by the beginnings of their names
"""

import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
from nbclient import NotebookClient

# Parameters of a quick run, by the beginning of a notebook's name: they replace those of its cell
# tagged "parameters".
FAST = {
    "01": {
        "dt": "0.1",
        "starts, screening": "2, 8",
        "rigs": "16",
        "slow_cases": '("backstepping-slow",)',
    },
    "02": {"dt": "0.1"},
    "03": {
        "starts, screening": "1, 8",
        "size": "15",
        "heights": "[30.0, 33.0, 36.0]",
        "bound_heights": "[33.0]",
        "bound_iterations": "20",
        "rigs, judged": "16, 32",
    },
    "04": {"dt": "0.05", "rates": "np.array([0.3, 3.0, 10.0])", "starts, screening": "1, 8"},
    "05": {"grid_points": "6", "kinds": '("hybrid",)', "screening": "2", "iterations": "2"},
    "06": {
        "horizons": "np.geomspace(1.5, 60.0, 9)",
        "tps": "np.geomspace(0.1, 5.0, 7)",
        "poles": "np.linspace(0.0, 0.95, 5)",
        "orders": "(1, 4)",
    },
    "07": {"rigs": "64", "sobol_samples": "16"},
    "08": {"starts, plants, new": "1, 8, 64", "judged": "32"},
    "09": {"starts": "2", "samples, new, iterations": "4, 16, 4"},
    "10": {"dt": "0.1", "starts, screening, validation": "1, 8, 8", "rigs": "32"},
}


def inject(notebook, values):
    """Replace the assignments of `values` {names: source of the value} in the cell tagged
    "parameters".
    """
    (cell,) = (c for c in notebook.cells if "parameters" in c.metadata.get("tags", ()))
    for names, value in values.items():
        cell.source, count = re.subn(
            f"^{re.escape(names)} = .*$",
            lambda _, line=f"{names} = {value}": line,
            cell.source,
            flags=re.M,
        )
        if count != 1:
            raise KeyError(f"the parameters are assigned {count} times, not once: {names}")


def main():
    fast = "--fast" in sys.argv[1:]
    wanted = tuple(a for a in sys.argv[1:] if a != "--fast")
    paths = [
        p
        for p in sorted(Path(__file__).parent.glob("*.ipynb"))
        if not wanted or p.name.startswith(wanted)
    ]
    if not paths:
        sys.exit(f"no notebook here begins with {' or '.join(wanted)}")
    if fast and len(paths) > 1:  # two at once, each in a process of its own
        alone = lambda path: (
            subprocess.run([sys.executable, __file__, "--fast", path.name]).returncode
        )
        with ThreadPoolExecutor(2) as pool:
            sys.exit(max(pool.map(alone, paths)))
    for path in paths:
        began = time.perf_counter()
        notebook = nbformat.read(path, as_version=4)
        if fast:
            inject(notebook, FAST[path.name[:2]])
        NotebookClient(
            notebook,
            timeout=1800,
            kernel_name="python3",
            resources={"metadata": {"path": str(path.parent)}},
        ).execute()
        print(
            f"{path.name}: {sum(c.cell_type == 'code' for c in notebook.cells)} cells ran in"
            f" {time.perf_counter() - began:.0f} s"
        )
        if not fast:
            for cell in notebook.cells:
                cell.metadata.pop("execution", None)
                for output in cell.get("outputs", []):
                    if output.output_type == "stream":  # a warning names a file of this run alone
                        output.text = re.sub(r"\S*ipykernel_\d+/\d+\.py", "notebook", output.text)
            notebook.metadata["kernelspec"] = {
                "display_name": "Python 3",
                "language": "python",
                "name": "python3",
            }
            notebook.metadata.get("language_info", {}).pop("version", None)
            nbformat.write(notebook, path)


if __name__ == "__main__":
    main()
