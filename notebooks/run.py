"""Execute the notebooks of this folder, top to bottom.

python notebooks/run.py            in full, and keep the outputs in the files
python notebooks/run.py --fast     with JAXTANK_NOTEBOOK_FAST=1 (coarse steps, few starts), outputs thrown away
python notebooks/run.py 05 08      those alone, by the beginnings of their names
"""

import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def main():
    fast = "--fast" in sys.argv[1:]
    wanted = tuple(a for a in sys.argv[1:] if a != "--fast")
    paths = [p for p in sorted(Path(__file__).parent.glob("*.ipynb")) if not wanted or p.name.startswith(wanted)]
    if not paths:
        sys.exit(f"no notebook here begins with {' or '.join(wanted)}")
    os.environ["JAXTANK_NOTEBOOK_FAST"] = "1" if fast else "0"
    if fast and len(paths) > 1:  # two at once, each in a process of its own
        alone = lambda path: subprocess.run([sys.executable, __file__, "--fast", path.name]).returncode
        with ThreadPoolExecutor(2) as pool:
            sys.exit(max(pool.map(alone, paths)))
    for path in paths:
        began = time.perf_counter()
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}).execute()
        print(f"{path.name}: {sum(c.cell_type == 'code' for c in notebook.cells)} cells ran in {time.perf_counter() - began:.0f} s")
        if not fast:
            for cell in notebook.cells:
                cell.metadata.pop("execution", None)
                for output in cell.get("outputs", []):
                    if output.output_type == "stream":  # a warning names a file of this run alone
                        output.text = re.sub(r"\S*ipykernel_\d+/\d+\.py", "notebook", output.text)
            notebook.metadata["kernelspec"] = {"display_name": "Python 3", "language": "python", "name": "python3"}
            notebook.metadata.get("language_info", {}).pop("version", None)
            nbformat.write(notebook, path)


if __name__ == "__main__":
    main()
