"""Write the table of papers in README.md here: python tests/benchmarks/papers_table.py (about half
a minute).
"""

from measuring import store

import jaxtank  # noqa: F401  (before jax starts)

BEGIN, END = "<!-- jaxtank compare all --markdown -->", "<!-- end -->"


def table():
    """The table that belongs between the marks."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning.report import papers

    return papers.markdown({paper: papers.measure(paper) for paper in presets.PAPERS})


if __name__ == "__main__":
    store(BEGIN, END, table())
