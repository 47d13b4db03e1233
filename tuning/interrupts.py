"""Ctrl-C where nothing is half done: the first ends a search with the best point so far, the second ends the program."""

import contextlib
import os
import signal
import threading

from tuning.streams import say_at_once

heard = []
"""Holds something once Ctrl-C has come before anything ran."""


def listen():
    """Remember a Ctrl-C, beside raising KeyboardInterrupt: one that comes while modules are imported may be lost in them."""

    def early(*_):
        heard.append(True)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, early)


class Interrupts:
    """Takes SIGINT from now on: `check` raises KeyboardInterrupt once it has come, a second one ends the program at once."""

    def __init__(self):
        self.stop = bool(heard)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self.interrupt)

    def interrupt(self, *_):
        """The handler of SIGINT."""
        if self.stop:
            say_at_once(b"\njaxtank: stopped at once\n")
            os._exit(130)
        self.stop = True
        say_at_once(b"\njaxtank: interrupted, finishing with the best point so far (Ctrl-C again stops at once)\n")

    def check(self, *_):
        """Raise KeyboardInterrupt if Ctrl-C was pressed."""
        if self.stop:
            raise KeyboardInterrupt


@contextlib.contextmanager
def put_back():
    """The handler of SIGINT is afterwards what it was before."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)
