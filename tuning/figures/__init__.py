"""The figures of the papers, redrawn by runs of our cases; imported by `jaxtank figure` alone."""
