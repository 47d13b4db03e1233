"""What a Dask worker runs."""

TASKS = {
    "batches": ("tuning.uncertainty.remote", "batches"),
    "points": ("tuning.uncertainty.remote", "points"),
    "search": ("tuning.search.methods", "search_task"),
}
"""{name of a task: module and function}; names, texts, numbers and arrays are sent to it."""


def call(task, x64, *arguments):
    """Run a task on a worker."""
    import importlib

    import jax

    import jaxtank  # noqa: F401  it sets the options of the compiler, before jax starts
    from jaxtank.xla.program_cache import processor

    module, name = TASKS[task]
    function = getattr(importlib.import_module(module), name)
    with jax.enable_x64(x64):
        return processor(), function(*arguments)


# Dask sends a function of the main module as its code: a worker without this program then raises
# an error of its own rather than end, and the scheduler needs no more than Dask
call.__module__ = "__main__"
