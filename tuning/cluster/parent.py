"""Loaded by the scheduler and the workers of `local`: they end when the process that began them
does, however it ends. Imports the standard library alone.
"""

import os
import shutil
import sys
import threading

FOLDER = "JAXTANK_LOCAL_CLUSTER"
"""Environment variable with the folder that the scheduler removes then."""


def dask_setup(server):
    """Wait for the end of the pipe from the parent process; called by Dask in each process."""

    def watch():
        sys.stdin.buffer.read()
        if os.environ.get(FOLDER):
            shutil.rmtree(os.environ[FOLDER], ignore_errors=True)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
