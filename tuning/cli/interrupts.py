"""SIGINT (Ctrl-C) and SIGTERM of the command: it ends at once with one line, 130 or 143, anywhere.

A search that has a result goes on to report it. Imported first: only parts of the interpreter are.
"""

# `signal` adds enumerations, whose import takes longer than all of this; _signal has no stubs
import _signal  # pyright: ignore[reportMissingImports]
import _thread
import atexit
import os
import time

SIGNALS = {_signal.SIGINT: b"interrupted", _signal.SIGTERM: b"terminated"}

SAME = 0.3  # time within which a signal that comes twice is one [s], as of `timeout`

_searches = []  # the Interrupts that takes the signals, if any
_before = []  # functions that are called before the process ends
_leaving = _thread.allocate_lock()
_watched = []  # True once a thread answers signals
_held = []  # True once the main thread waits for its end


def listen():
    """Handle SIGINT and SIGTERM; only in the process of the command, never in a caller's."""
    # A thread answers them. The main thread cannot while it is in native code, which may compile
    # for minutes, and an exception raised in an import would leave a module half made.
    if os.name == "posix":
        read, write = os.pipe()
        os.set_blocking(write, False)
        _signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        try:
            _thread.start_new_thread(_watch, (read,))
            _watched.append(True)
        except RuntimeError:  # no more threads for this user: the main thread answers when it can
            _signal.set_wakeup_fd(-1)
    for number in SIGNALS:
        # a script that ran this with & keeps its Ctrl-C
        if _signal.getsignal(number) != _signal.SIG_IGN:
            _signal.signal(number, _handler)
    atexit.register(_end)  # the first to be registered is the last to be called


def _end():
    """Give the signals back to the system: the interpreter ends, and its threads with it."""
    for number in SIGNALS:
        if _signal.getsignal(number) is _handler:
            _signal.signal(number, _signal.SIG_DFL)


def _watch(pipe):
    """Answer the signals whose numbers come through a pipe."""
    while True:
        for number in os.read(pipe, 64):
            for _ in range(20):  # the main thread stops first, unless it is in native code
                if _held or _searches:
                    break
                time.sleep(0.005)
            if number in SIGNALS:
                _answer(number)


def _handler(number, _):
    """Hold the main thread while the watching thread ends the process."""
    if not _watched:
        _answer(number)
    elif not _searches:
        _held.append(True)
        time.sleep(1.0)
        leave(number)  # the thread is gone, for the interpreter is ending


def _answer(number):
    if _searches:
        _searches[-1].interrupt(number)
    else:
        leave(number)


def leave(number, words=None):
    """End the process at once, with one line and exit code 128 + `number`."""
    if not _leaving.acquire(False):  # another thread does it
        time.sleep(5.0)
        os._exit(128 + number)
    for release in reversed(_before):
        try:  # noqa: SIM105
            release()
        except Exception:
            pass  # a folder that has gone
    say(words or SIGNALS[number])
    os._exit(128 + number)  # no finalizers: native threads may be at work


def say(words):
    """Write a line to stderr; a failed write is ignored."""
    try:
        fresh = b"\n" if os.isatty(2) else b""  # after ^C, or a line of progress
        os.write(2, fresh + b"jaxtank: " + words + b"\n")
    except OSError:
        pass


class before_leaving:  # contextlib takes long to import
    """Context in which `release` is called should a signal end the process."""

    def __init__(self, release):
        self.release = release

    def __enter__(self):
        _before.append(self.release)

    def __exit__(self, *_):
        _before.remove(self.release)


class Interrupts:
    """Ctrl-C or SIGTERM of a search: one ends it with the best point so far, the next at once."""

    def __init__(self):
        self.stop = self.taken = False
        self.number, self.since = _signal.SIGINT, 0.0

    @property
    def code(self):
        """Exit code of a search that was stopped: 130 after SIGINT, 143 after SIGTERM."""
        return 128 + self.number

    def interrupt(self, number=_signal.SIGINT, *_):
        """The handler of a signal."""
        if self.stop and number == self.number and time.monotonic() - self.since < SAME:
            return
        if self.stop:
            leave(number, b"stopped at once")
        self.stop, self.number, self.since = True, number, time.monotonic()
        again = b"Ctrl-C again" if number == _signal.SIGINT else b"a second signal"
        say(SIGNALS[number] + b", finishing with the best point so far (%b stops at once)" % again)

    def check(self, *_):
        """Take the signals; raise KeyboardInterrupt once one has come."""
        if not self.taken:
            self.taken = True
            if any(_signal.getsignal(number) is _handler for number in SIGNALS):
                _searches.append(self)
            elif _signal.getsignal(_signal.SIGINT) != _signal.SIG_IGN and _in_main_thread():
                _signal.signal(_signal.SIGINT, self.interrupt)
        if self.stop:
            raise KeyboardInterrupt


class restored:
    """Context after which SIGINT is handled as before: the searches in it have ended."""

    def __enter__(self):
        self.handler, self.count = _signal.getsignal(_signal.SIGINT), len(_searches)

    def __exit__(self, *_):
        del _searches[self.count :]
        if self.handler is not _handler and _in_main_thread():
            _signal.signal(_signal.SIGINT, self.handler)


def _in_main_thread():
    import threading

    return threading.current_thread() is threading.main_thread()
