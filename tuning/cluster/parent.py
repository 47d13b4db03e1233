"""Loaded by the scheduler and the workers of `local`: they end when the process that began them
does, however it ends. Imports the standard library alone.
"""

import os
import sys
import threading


def dask_setup(server):
    """Wait for the end of the pipe from the parent process; called by Dask in each process."""

    def watch():
        sys.stdin.buffer.read()
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
