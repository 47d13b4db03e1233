"""The three standard streams of a program: there when the shell has closed them, and none of its
end when nobody takes what stderr says.
"""

import io
import os
import sys


class Forgiving(io.RawIOBase):
    """A file descriptor to write progress and errors to. What it does not take, a full disk or a
    reader that has gone, is let go.
    """

    def __init__(self, descriptor):
        self.descriptor = descriptor

    def writable(self):
        """True."""
        return True

    def fileno(self):
        """The descriptor."""
        return self.descriptor

    def isatty(self):
        """Whether it is a terminal."""
        return os.isatty(self.descriptor)

    def write(self, data):
        """Number of bytes done with: all of them where the descriptor takes none."""
        try:
            return os.write(self.descriptor, data)
        except OSError:
            return len(data)


def guard():
    """Make the process's streams ones that the command can use: for a program of its own, never for
    a caller's process.

    Descriptors that were closed (`>&-`) are taken first, or the next file that is opened would get
    what is meant for them. A stdout that was closed is one that nothing can be written to: an
    OSError once something is. stderr is a `Forgiving` one.
    """
    for descriptor, mode in ((0, os.O_WRONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, mode)  # gets the lowest number that is free: this one
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(
            io.FileIO(os.open(os.devnull, os.O_RDONLY), "w"), encoding="utf-8"
        )
    there = sys.stderr is not None
    raw = Forgiving(sys.stderr.fileno() if there else os.open(os.devnull, os.O_WRONLY))
    encoding = sys.stderr.encoding if there else "utf-8"
    sys.stderr = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=encoding,
        errors="backslashreplace",
        line_buffering=True,
        write_through=True,
    )
