"""The command `jaxtank`: results on stdout, progress and errors on stderr."""

import os
import shlex
import sys

from tuning.cli import interrupts, terminal


def main(argv=None):
    """Run the command and return its exit code."""
    if argv is None:
        terminal.guard()
        interrupts.listen()  # before the slow imports
        # as many threads as processors add in another order: answers would depend on their number
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        import gc
        import warnings

        # tracing makes many objects and few circles: a twentieth of a tuning's time went there
        gc.set_threshold(50_000, 20, 100)
        # a note says the same, printed once when the case is opened
        warnings.filterwarnings("ignore", message="steps too long for an empty ")
        warnings.filterwarnings("ignore", message="the level of .* falls below 0")
        warnings.filterwarnings("ignore", message="clock.duration = .* is no whole number")
        warnings.showwarning = _with_notes(warnings.showwarning)
    try:
        try:
            code = _command(argv)
        finally:
            terminal.end_lines()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("jaxtank: interrupted", file=sys.stderr, flush=True)
        return 130
    except Exception as error:
        return _failed(error)


def _command(argv):
    """Parse the arguments, run the command and return its exit code."""
    from tuning.cli.parser import COMMANDS, arguments
    from tuning.storage.folder_lock import hold

    try:
        args = arguments(argv)
    except SystemExit:  # after --help, whose text may still be in the buffer
        sys.stdout.flush()
        raise
    if args.version:
        import jaxtank

        print(jaxtank.__version__)
        return 0
    terminal.phase.quiet = getattr(args, "quiet", True)
    terminal.phase.show("importing")
    args.line = shlex.join(["jaxtank", *(sys.argv[1:] if argv is None else argv)])
    if argv is None and COMMANDS[args.command].compiles:
        from jaxtank.xla.program_cache import keep_for_this_process

        why = keep_for_this_process()
        if why and not getattr(args, "quiet", False):
            print(f"jaxtank: note: compiled programs are not kept: {why}", file=sys.stderr)
    with hold(args.out, leaving=interrupts.before_leaving), interrupts.restored():
        code = args.run(args)
        sys.stdout.flush()  # print the answer before Ctrl-C is again allowed to end the program
        return code


def _with_notes(show_other):
    """Return a `warnings.showwarning` that prints a UserWarning as a note."""

    def show(message, category, *where):
        if issubclass(category, UserWarning):
            print(f"jaxtank: note: {message}", file=sys.stderr)
        else:
            show_other(message, category, *where)

    return show


def _failed(error):
    """Print an exception in one line and return the exit code."""
    from jaxtank.core.errors import DataError, InputError, NonFiniteError
    from jaxtank.core.text import MOST, one_line

    if isinstance(error, (InputError, NonFiniteError)):
        count = max(len(getattr(error, "parts", ())), 1)
        words, code = one_line(error, MOST * count), 5 if isinstance(error, DataError) else 2
    elif isinstance(error, OSError):
        where = one_line(error.filename or "output")
        words, code = f"{where}: {error.strerror or one_line(error)}", 2
    elif os.environ.get("JAXTANK_TRACEBACK"):
        raise error
    else:
        words = (
            f"internal error: {type(error).__name__}: {one_line(error)}"
            " (JAXTANK_TRACEBACK=1 prints the traceback)"
        )
        code = 1
    print(f"jaxtank: {words}", file=sys.stderr)
    if table := getattr(error, "table", ""):  # of columns that were not found
        print(f"Complete this table and put it into the rig file:\n\n{table}", file=sys.stderr)
    if isinstance(error, OSError) and code == 2:
        _drop_output()
    return code


def _drop_output():
    """Discard unwritten output after a closed pipe or a full disk: no second error at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
