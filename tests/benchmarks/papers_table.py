"""Write the table of papers in README.md here: python tests/benchmarks/papers_table.py (about half
a minute).
"""

import re
from pathlib import Path

import jaxtank  # noqa: F401  (before jax starts)

README = Path(__file__).with_name("README.md")
BEGIN, END = "<!-- jaxtank compare all --markdown -->", "<!-- end -->"


def table():
    """The table that belongs between the marks."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning.report import papers

    return papers.markdown({paper: papers.measure(paper) for paper in presets.PAPERS})


if __name__ == "__main__":
    text = README.read_text()
    README.write_text(
        re.sub(f"{BEGIN}.*?{END}", lambda _: f"{BEGIN}\n{table()}\n{END}", text, flags=re.DOTALL)
    )
