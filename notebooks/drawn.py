"""What a figure shows, in lines of text that are stored beside its pixels. run.py executes this
file in the kernel of a notebook before its first cell; no cell of a notebook sees it.
"""


def _keep_what_figures_show():
    import numpy as np
    from IPython.core import pylabtools

    plain = pylabtools.print_figure

    def ends(values):
        values = np.asarray(values, dtype=float)
        values = values[np.isfinite(values)]
        return f"{values.min():.3g} to {values.max():.3g}" if values.size else "nothing"

    def lines(figure):
        if figure._suptitle is not None:
            yield f"title {figure._suptitle.get_text()}"
        for axes in figure.axes:
            yield f"axes {axes.get_title()} | {axes.get_xlabel()} | {axes.get_ylabel()}"
            yield from (f"text {text.get_text()}" for text in axes.texts)
            for line in axes.lines[:12]:
                if len(line.get_ydata()) > 2:
                    yield f"line {ends(line.get_ydata())}"
        for legend in [*figure.legends, *(axes.get_legend() for axes in figure.axes)]:
            yield from (
                f"legend {text.get_text()}" for text in (legend.get_texts() if legend else ())
            )

    def print_figure(figure, fmt="png", **options):
        data = plain(figure, fmt=fmt, **options)
        return (data, {"drawn": list(lines(figure))}) if fmt == "png" and data else data

    pylabtools.print_figure = print_figure


_keep_what_figures_show()
del _keep_what_figures_show
