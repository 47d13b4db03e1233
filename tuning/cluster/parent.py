"""Loaded by the scheduler and the workers of `local`: they end when the process that began them
does, however it ends.
"""

import os
import shutil
import sys
import threading
import time

FOLDER = "JAXTANK_LOCAL_CLUSTER"
"""Environment variable with the folder that the scheduler removes then."""

PATIENCE = 10.0
"""Time for which it tries to [s]."""


def dask_setup(server):
    """Wait for the end of the pipe from the parent process; called by Dask in each process."""

    def watch():
        sys.stdin.buffer.read()
        folder, until = os.environ.get(FOLDER), time.monotonic() + PATIENCE
        while folder and os.path.exists(folder) and time.monotonic() < until:
            shutil.rmtree(folder, ignore_errors=True)  # workers write there until they end, too
            time.sleep(0.1)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
