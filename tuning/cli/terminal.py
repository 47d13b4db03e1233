"""The standard streams of the program, also closed ones, and the line of progress on stderr."""

import io
import os
import sys
import threading
import time


class Forgiving(io.RawIOBase):
    """A file descriptor for progress and errors; failed writes are ignored."""

    ignored: type[OSError] = OSError

    def __init__(self, descriptor):
        self.descriptor = descriptor

    def writable(self):
        return True

    def fileno(self):
        return self.descriptor

    def isatty(self):
        return os.isatty(self.descriptor)

    def write(self, data):
        """Write `data`; return the number of bytes taken, all of them where none can be written."""
        phase.erase()
        try:
            return os.write(self.descriptor, data)
        except self.ignored:
            return len(data)


class Leaving(Forgiving):
    """A file descriptor for results, whose reader may leave: the command goes on to its end."""

    ignored = BrokenPipeError


def guard():
    """Replace closed standard streams; only in the process of the command, never in a caller's."""
    # closed descriptors (`>&-`) are taken first: the next file opened would get their number
    for descriptor, mode in ((0, os.O_WRONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, mode)  # gets the lowest number that is free: this one
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(
            io.FileIO(os.open(os.devnull, os.O_RDONLY), "w"), encoding="utf-8"
        )
    else:  # its buffer, as a failed write of another keeps what it has not written
        raw, old = Leaving(sys.stdout.fileno()), sys.stdout
        old.flush()
        sys.stdout = io.TextIOWrapper(
            io.BufferedWriter(raw), encoding=old.encoding, line_buffering=bool(old.line_buffering)
        )
    there = sys.stderr is not None
    raw = Forgiving(sys.stderr.fileno() if there else os.open(os.devnull, os.O_WRONLY))
    sys.stderr = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=sys.stderr.encoding if there else "utf-8",
        errors="backslashreplace",
        line_buffering=True,
        write_through=True,
    )


def coloured(stream):
    """Return whether colours may be written to a stream (https://no-color.org)."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return stream.isatty() and not plain


class Phase:
    """Work that a terminal shows with its seconds, after DELAY, between lines of progress."""

    DELAY = 0.7  # s

    def __init__(self):
        self.quiet, self.words, self.since = True, "", 0.0
        self.there, self.ended = False, threading.Event()
        self.clock: threading.Thread | None = None

    def show(self, words):
        """Show `words` from DELAY on, until the next phase or the end."""
        if self.quiet or not sys.stderr.isatty():
            return
        self.words, self.since = words, time.monotonic()
        if self.clock is None:
            self.ended.clear()
            self.clock = threading.Thread(target=self._tick, daemon=True)
            self.clock.start()

    def _tick(self):
        while not self.ended.wait(0.35):
            seconds = time.monotonic() - self.since
            if seconds > self.DELAY:
                text = f"{self.words}, {seconds:.0f} s"
                self.there = True
                os.write(2, f"\r{text[:78]:<78}".encode())

    def erase(self):
        """Remove what is shown."""
        if self.there:
            self.there = False
            os.write(2, b"\r\033[K")

    def end(self):
        """Show nothing any more."""
        if self.clock is not None:
            self.ended.set()
            self.clock.join()
            self.clock = None
            self.erase()


phase = Phase()

OPEN: set["Line"] = set()  # lines of progress that have not ended


def end_lines():
    """End every line of progress, as before a result or an error is printed."""
    phase.end()
    for line in list(OPEN):
        line.end()


class Line:
    """Progress on stderr: one line, overwritten on a terminal; few lines elsewhere."""

    def __init__(self, quiet):
        self.quiet, self.terminal = quiet, sys.stderr.isatty()
        self.words, self.since, self.last = "", 0.0, 0
        self.ended = threading.Event()
        self.clock: threading.Thread | None = None

    def show(self, words):
        """Print `words`; on a terminal in place of the line before."""
        if self.quiet:
            return
        if not self.terminal:
            print(words, file=sys.stderr, flush=True)
            return
        phase.end()
        self.words, self.since = words, time.monotonic()
        self._print()
        if self.clock is None:
            OPEN.add(self)
            self.ended.clear()
            self.clock = threading.Thread(target=self._tick, daemon=True)
            self.clock.start()

    def _tick(self):
        while not self.ended.wait(1.0):
            self._print()

    def _print(self):
        seconds = int(time.monotonic() - self.since)
        text = f"{self.words}, {seconds} s" if seconds else self.words
        print(f"\r{text[:78]:<78}", end="", file=sys.stderr, flush=True)

    def compiling(self, what, seconds):
        """Print, on a terminal only, that `what` is compiled; return the line."""
        if self.terminal:
            self.show(f"compiling {what}, about {seconds} s")
        return self

    def runs(self, done, total):
        """Print the number of runs done; where it is no terminal, at each tenth of them only."""
        if self.terminal or done >= total or done - self.last >= total / 10:
            self.last = done
            self.show(f"run {done}/{total}")

    def end(self):
        self.ended.set()
        OPEN.discard(self)
        if self.clock is not None:
            self.clock.join()
            print(file=sys.stderr)
            self.clock = None
