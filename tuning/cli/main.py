"""The command `jaxtank`. Results on stdout, progress and errors on stderr.

Exit codes: 0 done (and every limit holds), 1 internal error, 2 bad input (one line, nothing
written), 3 not converged, 4 limits cannot be met, 5 bad data file, 130 interrupted (the best point
so far of a search is written and printed), 143 terminated. Nothing heavy is imported before the
arguments are read.
"""

import importlib
import os
import sys

from tuning.cli import interrupts, terminal

COMMANDS = {
    "list": "case.list_cases",
    "show": "case.show",
    "simulate": "case.simulate",
    "tune": "tuning.tune",
    "sensitivity": "studies.sensitivity",
    "identify": "identification.run_interruptibly",
    "init": "case.init",
    "export": "case.export_law",
    "uncertainty": "studies.uncertainty",
    "merge": "studies.merge",
    "compare": "case.compare",
    "completion": "case.completion",
    "bench": "case.bench",
}
"""{command: module and function that runs it}."""


def main(argv=None):
    """Run the command; returns the exit code. argv None: a program of its own, by sys.argv."""
    if argv is None:
        terminal.guard()
        interrupts.listen()  # before anything that takes time is imported
    return _run(argv)


def _run(argv):
    import shlex
    import warnings

    from jaxtank.core.errors import DataError, InputError, NonFiniteError, nearest
    from jaxtank.core.text import one_line
    from tuning.cli.parser import parser
    from tuning.cli.values import folder_of
    from tuning.storage.folder_lock import hold

    if argv is None:
        # the note is printed once, where the case is opened
        warnings.filterwarnings("ignore", message=".* runs empty faster than the steps follow")
    try:
        top = parser()
        try:
            args, rest = top.parse_known_args(argv)
        except SystemExit:  # --help, which may wait in a buffer
            sys.stdout.flush()
            raise
        if rest:
            kind = "option" if rest[0].startswith("-") else "argument"
            raise InputError(
                f"unknown {kind} {rest[0]!r}"
                + (
                    nearest(rest[0].split("=")[0], top.options(args.command))
                    if kind == "option"
                    else ""
                )
            )
        if args.version:
            import jaxtank

            print(jaxtank.__version__)
            return 0
        if args.command is None:
            raise InputError("no command: try jaxtank --help")
        args.line = shlex.join(["jaxtank", *(sys.argv[1:] if argv is None else argv)])
        folder = folder_of(args)
        if getattr(args, "resume", None) and not os.path.isdir(folder):
            raise InputError(
                f"--resume: {folder!r} cannot be read as a run to go on with: there is no such"
                " folder"
            )
        with hold(
            folder,
            shared=getattr(args, "shard", None) is not None,
            leaving=interrupts.before_leaving,
        ):
            module, name = COMMANDS[args.command].split(".")
            code = getattr(importlib.import_module(f"tuning.cli.commands.{module}"), name)(args)
        sys.stdout.flush()
        return code
    except (InputError, NonFiniteError) as error:
        print(f"jaxtank: {one_line(error)}", file=sys.stderr)
        return 5 if isinstance(error, DataError) else 2
    except KeyboardInterrupt:
        print("jaxtank: interrupted", file=sys.stderr, flush=True)
        return 130
    except BrokenPipeError:  # the reader of our output has gone; nothing more to say
        _drop_output()
        return 0
    except OSError as error:
        print(
            f"jaxtank: {one_line(error.filename or 'output')}: {error.strerror or one_line(error)}",
            file=sys.stderr,
        )
        _drop_output()
        return 2
    except Exception as error:
        if os.environ.get("JAXTANK_TRACEBACK"):
            raise
        print(
            f"jaxtank: internal error: {type(error).__name__}: {one_line(error)}"
            " (JAXTANK_TRACEBACK=1 shows where)",
            file=sys.stderr,
        )
        return 1


def _drop_output():
    """Let go of what stdout cannot take (a reader that has left, a full disk), so that the end of
    the program does not try again.
    """
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
