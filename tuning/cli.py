"""The command `jaxtank`. Results on stdout, progress and errors on stderr.

Exit codes: 0 done (and every limit holds), 1 internal error, 2 bad input (one line, nothing written), 3 not converged, 4 limits cannot
be met, 5 bad data file, 130 interrupted (the best point so far is written and said). Nothing heavy is imported before the arguments are read.
"""

import argparse
import functools
import os
import shlex
import sys

from jaxtank.errors import DataError, InputError, NonFiniteError, nearest
from tuning import identify_command
from tuning.arguments import check_out as _out
from tuning.arguments import number as _number
from tuning.arguments import open_case as _open
from tuning.arguments import pair as _pair
from tuning.arguments import parse_value
from tuning.arguments import plain_number as _plain_number
from tuning.arguments import seed as _seed
from tuning.arguments import span as _range
from tuning.arguments import whole as _whole
from tuning.interrupts import Interrupts, put_back

EXIT = {"converged": 0, "not_converged": 3, "infeasible": 4, "interrupted": 130}


class Parser(argparse.ArgumentParser):
    """Errors in one line, with the nearest valid word."""

    def error(self, message):
        words = [w.strip("'") for w in message.split() if w.startswith("'")] if "invalid choice" in message else []
        if words:
            choices = [w.strip("(),'") for w in message.split("choose from")[-1].split()]
            message = f"unknown command {words[0]!r}{nearest(words[0], choices)}"
        raise InputError(message)

    def options(self, command):
        """The options of one command."""
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction) and command in action.choices:
                return [o for a in action.choices[command]._actions for o in a.option_strings]
        return [o for a in self._actions for o in a.option_strings]


def parser():
    """The argument parser of every command."""
    top = Parser(
        prog="jaxtank",
        description="Differentiable liquid-tank rigs, the controllers of five papers, and a tuner that works "
        "through the simulation.",
        epilog="Start with: jaxtank list; jaxtank tune gouta2015/backstepping --out tuned",
    )
    top.add_argument("--version", action="store_true", help="print the version and exit")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")

    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="one JSON object on stdout instead of tables")
    common.add_argument("--quiet", action="store_true", help="no progress on stderr")

    case = argparse.ArgumentParser(add_help=False)
    case.add_argument("case", metavar="CASE", help='"paper/case" (see jaxtank list) or a rig file ending in .toml')
    case.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="values",
        help="set a parameter by its dotted name; repeatable",
    )
    case.add_argument(
        "--schedule",
        action="append",
        default=[],
        metavar="NAME=VARIABLE:K1,K2,...",
        help="a gain that follows a setpoint (r1, ..) or a level (h1, ..), linear between knots; repeatable, same variable and knots",
    )
    case.add_argument("--dt", type=str, metavar="S", help="sampling period [s], short for --set clock.dt=S")

    run = argparse.ArgumentParser(add_help=False)
    run.add_argument("--seed", default="0", metavar="N", help="seed of the sensor noise and of the search (default 0)")
    run.add_argument("--out", metavar="DIR", help="folder for result.json, CSV, pictures and the rig")

    commands.add_parser("list", parents=[common], help="print every case")
    show = commands.add_parser(
        "show", parents=[common, case], help="one case: rig, law, every parameter, published numbers, departures"
    )
    show.add_argument("--out", metavar="DIR", help="folder for rig.png and rig.svg, the rig drawn from its topology")
    simulate = commands.add_parser(
        "simulate", parents=[common, case, run], help="one run: measures; with --out its trajectory and pictures"
    )
    simulate.add_argument("--gif", action="store_true", help="with --out also run.gif, the tanks of the rig filling and emptying")
    tune = commands.add_parser("tune", parents=[common, case, run], help="tune the gains of a case under its limits")
    tune.add_argument("--method", default="auto", metavar="NAME", help="auto (default), trf, coarse-trf, slsqp, lbfgs or adam")
    tune.add_argument(
        "--free",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="a parameter to tune; replaces the case's own; repeatable",
    )
    tune.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="MEASURE=VALUE",
        help="a hard limit; MEASURE=none drops one, none drops all; repeatable",
    )
    tune.add_argument(
        "--objective",
        action="append",
        default=[],
        metavar="MEASURE=WEIGHT",
        help="what is made small (default rms_error_total=1); repeatable",
    )
    tune.add_argument(
        "--scenario",
        action="append",
        default=[],
        metavar="NAME=VALUE[;NAME=VALUE]",
        help='a run to judge by, as "sensor.noise=0.05;reference.ramp=30"; replaces those of the case; none: its own run; repeatable',
    )
    tune.add_argument(
        "--choose",
        action="append",
        default=[],
        metavar="NAME=V1,V2",
        help="a static number or text to try the values of; repeatable",
    )
    tune.add_argument(
        "--validation", default="64", metavar="N", help="held-out runs to judge the answer on (default 64, 0 for none)"
    )
    tune.add_argument("--tradeoff", metavar="MEASURE=LOW:HIGH[:N]", help="also: the best objective for N (6) values of one limit")
    tune.add_argument("--bound", action="store_true", help="also: what no law could beat, by optimising the input itself")
    tune.add_argument("--batch", metavar="N", help="scenarios drawn for each step of method adam (default all)")
    tune.add_argument("--resume", metavar="DIR", help="go on where a killed run with --out DIR ended, to the same answer")
    tune.add_argument("--starts", default="8", metavar="N", help="local searches (default 8)")
    tune.add_argument("--screening", default="64", metavar="N", help="Sobol points before them (default 64)")
    tune.add_argument("--iterations", default="60", metavar="N", help="iterations of each local search (default 60)")
    tune.add_argument(
        "--robust", metavar="RISK", help="on many plants at once: mean, cvar or worst of their costs, limits held on every one"
    )
    tune.add_argument("--samples", metavar="N", help="plants of --robust (default 64)")
    tune.add_argument("--fresh", metavar="N", help="plants that its answer is run on afterwards (default 1024)")
    tune.add_argument(
        "--back-off",
        metavar="SHARE",
        help="share of each limit that --robust keeps off it, as 0.03; fresh plants are judged without",
    )
    uncertain = commands.add_parser(
        "uncertainty", parents=[common, case, run], help="the same loop over N draws: bands, percentiles, violations"
    )
    uncertain.add_argument("--samples", default="1000", metavar="N", help="draws (default 1000)")
    for command in (tune, uncertain):
        command.add_argument(
            "--spread", metavar="FRACTION", help="one spread for all that the case calls uncertain, as 0.1 for +-10 %%"
        )
        command.add_argument(
            "--vary",
            action="append",
            default=[],
            metavar="NAME=DIST",
            help="what varies instead: uniform:5%%, normal:MEAN:SD, ...; repeatable",
        )
    uncertain.add_argument("--draws", default="random", metavar="KIND", help="random (default), latin or sobol")
    uncertain.add_argument(
        "--limit", action="append", default=[], metavar="MEASURE=VALUE", help="a limit to count violations of; repeatable"
    )
    uncertain.add_argument(
        "--measure", action="append", default=[], metavar="NAME", help="a measure to keep, not the usual ones; repeatable"
    )
    uncertain.add_argument("--devices", default="1", metavar="N", help="devices of this machine to use (default 1)")
    uncertain.add_argument("--shard", metavar="I/N", help="run the I-th of N shares into --out DIR; merge joins them")
    uncertain.add_argument("--resume", metavar="DIR", help="go on where a killed run with --out DIR ended")
    merge = commands.add_parser("merge", parents=[common, run], help="join the shards of an ensemble in a folder")
    merge.add_argument("case", metavar="DIR", help="where the shards are; or their case, with their options and --out DIR")
    for action in uncertain._actions:
        if action.dest in ("values", "schedule", "dt", "samples", "spread", "vary", "draws", "limit", "measure"):
            merge._add_action(action)
    sense = commands.add_parser(
        "sensitivity", parents=[common, case, run], help="which parameter moves which measure: local, Morris, Sobol"
    )
    sense.add_argument("--method", default="local", metavar="NAME", help="local (default: exact derivatives), morris or sobol")
    sense.add_argument(
        "--samples", metavar="N", help="trajectories of morris (default 32), base points of sobol (default 512, a power of 2)"
    )
    sense.add_argument("--devices", default="1", metavar="N", help="devices of this machine to use (default 1)")
    sense.add_argument("--spread", metavar="FRACTION", help="one share for all that the case calls uncertain, as 0.05")
    sense.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=DISTRIBUTION",
        help="what varies instead, as plant.drain=uniform:5%% or normal:MEAN:SD; repeatable",
    )
    sense.add_argument(
        "--measure",
        action="append",
        default=[],
        metavar="NAME",
        help="a measure to look at (default: those of the objective, rms_error_total, max_level); repeatable",
    )
    identify_command.add(commands, [common, case, run])
    init = commands.add_parser(
        "init", parents=[common, case], help="print a complete rig file to edit: every key, its unit and range"
    )
    init.add_argument("--short", action="store_true", help="only what differs from the preset, and what is tuned")
    init.add_argument("--tanks", action="store_true", help="described tank by tank, without its preset")
    exported = commands.add_parser(
        "export", parents=[common, case], help="the law and its observer as one C99 file or MATLAB function"
    )
    exported.add_argument("--lang", default="c", metavar="LANG", help="c (default) or m")
    exported.add_argument("--precision", default="double", metavar="TYPE", help="double (default) or float, of C")
    exported.add_argument("--name", metavar="NAME", help="of the functions (default: the case's)")
    exported.add_argument("--out", metavar="DIR", help="folder for the file (default: print it)")
    compare = commands.add_parser(
        "compare", parents=[common], help="published numbers beside measured ones, and why they differ; PAPER or all"
    )
    compare.add_argument("paper", metavar="PAPER", help='a paper (see jaxtank list), or "all"')
    compare.add_argument("--out", metavar="DIR", help="folder for report.html, result.json and the rigs as pictures")
    compare.add_argument("--markdown", action="store_true", help="as the table of the README")
    completed = commands.add_parser(
        "completion", help="a script that completes commands, options, cases and parameters: bash, zsh or fish"
    )
    completed.add_argument("shell", metavar="SHELL", help='as in: eval "$(jaxtank completion bash)"')
    bench = commands.add_parser("bench", parents=[common], help="ns per closed-loop step here, beside a C loop")
    bench.add_argument("cases", nargs="*", metavar="CASE", help='cases to time instead, or "all"')
    bench.add_argument("--rounds", default="7", metavar="N", help="interleaved rounds to take the median of (default 7)")
    return top


def main(argv=None):
    """Run the command; returns the exit code."""
    try:
        top = parser()
        args, rest = top.parse_known_args(argv)
        if rest:
            kind = "option" if rest[0].startswith("-") else "argument"
            raise InputError(
                f"unknown {kind} {rest[0]!r}"
                + (nearest(rest[0].split("=")[0], top.options(args.command)) if kind == "option" else "")
            )
        if args.version:
            import jaxtank

            print(jaxtank.__version__)
            return 0
        if args.command is None:
            raise InputError("no command: try jaxtank --help")
        args.line = shlex.join(["jaxtank", *(sys.argv[1:] if argv is None else argv)])
        return COMMANDS[args.command](args)
    except (InputError, NonFiniteError) as error:
        print(f"jaxtank: {_one_line(error)}", file=sys.stderr)
        return 5 if isinstance(error, DataError) else 2
    except KeyboardInterrupt:
        print("jaxtank: interrupted", file=sys.stderr, flush=True)
        if argv is None:
            os._exit(130)  # an interrupt inside jax leaves threads that cannot be wound up safely
        return 130
    except BrokenPipeError:  # the reader of our output has gone; nothing more to say
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(f"jaxtank: {_one_line(error)}", file=sys.stderr)
        return 2
    except Exception as error:
        if os.environ.get("JAXTANK_TRACEBACK"):
            raise
        print(
            f"jaxtank: internal error: {type(error).__name__}: {_one_line(error)} (JAXTANK_TRACEBACK=1 shows where)",
            file=sys.stderr,
        )
        return 1


def _one_line(error):
    return " ".join(str(error).split())


def _limits(args, case):
    limits, given = dict(case.limits), [text.partition("=")[0].strip() for text in args.limit]
    for name in given:
        if given.count(name) > 1:
            raise InputError(f"--limit {name} is given {given.count(name)} times: give it once (several tanks: {name}=30,28)")
    for text in args.limit:
        if text == "none":
            limits = {}
            continue
        measure, value = _pair("--limit", text, parse_value)
        from jaxtank.measures import check_names

        check_names([measure])
        if value == "none":
            limits.pop(measure, None)
        else:
            limits[measure] = value
    return limits


def _once(option, pairs):
    """{name: value} of (name, value) pairs, None where there is none; InputError for a name that is given twice."""
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{option} {name} is given {names.count(name)} times: give it once")
    return dict(pairs) or None


def _scenarios(args):
    from jaxtank.presets import Scenario

    if not args.scenario:
        return None
    if args.scenario == ["none"]:
        return ()
    found = []
    for i, text in enumerate(args.scenario):
        values = dict(_pair("--scenario", part, parse_value) for part in text.split(";") if part.strip())
        seed = values.pop("seed", i)
        weight = values.pop("weight", 1.0)
        found.append(Scenario(values.pop("name", text), values, seed, weight))
    return tuple(found)


def _choices(args):
    found = {}
    for text in args.choose:
        name, values = _pair("--choose", text, lambda v: [parse_value(p.strip()) for p in v.split(",") if p.strip()])
        found[name] = values
    return found or None


def _tradeoff(args):
    """(measure, values) of --tradeoff."""
    if args.tradeoff is None:
        return None
    measure, text = _pair("--tradeoff", args.tradeoff, str)
    parts = text.split(":")
    try:
        low, high = (float(_plain_number(p)) for p in parts[:2])
        count = int(parts[2]) if len(parts) > 2 else 6
        good = len(parts) <= 3 and low < high and 2 <= count <= 50
    except ValueError:
        good = False
    if not good:
        raise InputError(
            f"--tradeoff {args.tradeoff!r}: must be MEASURE=LOW:HIGH or MEASURE=LOW:HIGH:N, LOW below HIGH, N from 2 to 50"
        )
    from jaxtank.measures import check_names

    check_names([measure])
    return measure, [low + (high - low) * i / (count - 1) for i in range(count)]


def _distributions(args, case):
    """What varies, by --vary or --spread; None for the case's own."""
    from tuning.ensemble import spread_of

    if args.vary and args.spread is not None:
        raise InputError("--vary says what varies, --spread how much of the case's own: give one of them")
    if args.vary:
        varied = [_pair_of(text, case) for text in args.vary]
        if len({name for name, _ in varied}) < len(varied):
            raise InputError("--vary: a parameter is given twice")
        return dict(varied)
    if args.spread is None:
        return None
    share = _number("--spread", args.spread)
    if not 0 < share < 1:
        raise InputError(f"--spread {args.spread!r}: must be a share between 0 and 1")
    return spread_of(case, share)


def _pair_of(text, case):
    """(name, distribution) of one --vary, if every draw of it is a value that the case may have."""
    from tuning.distributions import Draws, parse

    name, value = _pair("--vary", text, str)
    try:
        found = parse(name, value)
        Draws(case.loop, {name: found})
    except InputError as error:
        raise InputError(f"--vary {text}: {error}") from None
    return name, found


def _ensemble(args, **options):
    from tuning.ensemble import ensemble

    case = _open(args)
    return ensemble(
        case,
        _distributions(args, case),
        samples=_whole("--samples", args.samples, 1, 10**8),
        key=_seed(args),
        draws=args.draws,
        measures=tuple(args.measure) or None,
        limits=_limits(args, case),
        **options,
    )


def _told(found, args):
    """Write, print and end with an Ensemble."""
    from tuning import report

    written = found.save(args.out, args.line) if args.out else []
    print(report.dumps(found.to_json()) if args.json else repr(found))
    _written(written, args)
    return 0


def _devices(args):
    """The number of --devices, which jax is told before it starts."""
    devices = _whole("--devices", args.devices, 1, 1024)
    if devices > 1:
        import jax

        jax.config.update("jax_num_cpu_devices", devices)
    return devices


def _uncertainty(args):
    shard = None
    if args.shard is not None:
        shard = _shard(args.shard)
        if not args.out and not args.resume:
            raise InputError(f"--shard {args.shard!r}: needs --out DIR, where the shares meet")
    if args.resume and args.out and args.resume != args.out:
        raise InputError("--resume and --out name different folders: a run is continued in its own")
    args.out = args.resume or args.out
    _out(args)
    devices = _devices(args)
    progress = None if args.quiet else lambda done: print(f"{done} draws", file=sys.stderr, flush=True)
    found = _ensemble(args, devices=devices, shard=shard, folder=args.out, resume=args.resume is not None, progress=progress)
    if found is None:
        if not args.quiet:
            print(f"shard {args.shard} is in {args.out}; `jaxtank merge` joins the shards when all are", file=sys.stderr)
        return 0
    return _told(found, args)


def _shard(text):
    """(i, n) of --shard I/N."""
    try:
        i, n = (int(part) for part in text.split("/"))
    except ValueError:
        raise InputError(f"--shard {text!r}: must be I/N, as 1/4 for the first of four shares") from None
    if not 1 <= n <= 10**6:
        raise InputError(f"--shard {text!r}: there may be 1 to 1000000 shares")
    if not 1 <= i <= n:
        raise InputError(f"--shard {text!r}: with {n} shares they are 1/{n} to {n}/{n}")
    return i, n


def _merge(args):
    """Of a folder alone, by what its manifest says; of a case with the options of its shards and --out DIR."""
    if args.out:
        _out(args)
        return _told(_ensemble(args, folder=args.out, resume=True, merge=True), args)
    if not os.path.isdir(args.case):
        raise InputError(f"merge {args.case!r}: is no folder; give the one that the shards were written to (their --out DIR)")
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning.ensemble import ensemble
    from tuning.shards import restore

    given = [a for a in ("values", "schedule", "dt", "spread", "vary", "measure") if getattr(args, a)]
    if given or args.samples != "1000" or args.draws != "random" or args.seed != "0":
        raise InputError(f"merge {args.case!r}: the folder says what its shards are of; leave the other options out (but --limit)")
    case, options = restore(args.case)
    if args.limit:
        options["limits"] = _limits(args, case.replace(limits=options["limits"]))
    args.out = args.case
    return _told(ensemble(case, folder=args.out, resume=True, merge=True, **options), args)


def _list(args):
    from jaxtank import presets
    from tuning import report

    cases = {f"{p}/{n}": c.title for p in presets.PAPERS for n, c in presets.load(p).cases.items()}
    print(report.dumps(cases) if args.json else report.table([[n, t] for n, t in cases.items()], ["case", ""]))
    return 0


def _show(args):
    _out(args)
    case = _open(args)
    from tuning import manual, report

    written = []
    if args.out:
        from pathlib import Path

        from tuning import page, pictures

        drawn = pictures.rig(case.loop, None, case.name)
        alone = {f"{name}.svg": page.alone(figure, name) for name, figure in drawn.items()}
        written = report.write_files(Path(args.out), alone | report.pngs(drawn))
    print(report.dumps(manual.json_of(case)) if args.json else manual.text(case))
    _written(written, args)
    return 0


def _init(args):
    if args.short and args.tanks:
        raise InputError("--short and --tanks: the short file names its preset; give one of the two")
    case = _open(args)
    from jaxtank import rig
    from tuning import report

    text = rig.short(case) if args.short else rig.complete(case, tankwise=args.tanks)
    print(report.dumps({"case": case.name, "rig": text}) if args.json else text, end="\n" if args.json else "")
    return 0


def _export(args):
    _out(args)
    case = _open(args)
    from pathlib import Path

    from jaxtank.export import export
    from tuning import report

    text = export(case, args.lang, args.precision, args.name)
    name = args.name or case.name.replace("/", "_").replace("-", "_").replace(" ", "_")
    if args.json:
        print(report.dumps({"case": case.name, "lang": args.lang, "name": name, "source": text}))
    if args.out:
        _written(report.write_files(Path(args.out), {f"{name}.{args.lang}": text}), args)
    elif not args.json:
        print(text, end="")
    return 0


def _simulate(args):
    _out(args)
    if args.gif and not args.out:
        raise InputError("--gif needs --out DIR, where run.gif is written")
    seed, case = _seed(args), _open(args)
    import jax

    from jaxtank import loop
    from jaxtank import measures as ms
    from tuning import manual, report, search

    key = jax.random.key(seed) if manual.noisy(case) else None
    values = {m: v for m, v in search.run_measures(case.loop, case.clock, key).items()}
    payload = {
        "case": case.name,
        "measures": report.measures_json(values),
        "units": report.units(case.loop.units),
        "reasons": report.reasons(values),
        "clock": manual.clock(case.clock),
        "parameters": report.clean(loop.parameters(case.loop)),
        "provenance": search.provenance(case, seed),
    }
    written = report.save_run(case, report.run_for_people(case, key), payload, args.out, args.gif) if args.out else []
    if args.json:
        print(report.dumps(payload))
    else:
        print(f"{case.name}: {case.title}\n")
        rows = [
            [m, ms.unit(m, case.loop.units), report.numbers(values[m]), s.doc]
            for m, s in ms.MEASURES.items()
            if m in values and m not in ms.TIMES.values()
        ]
        print(report.table(rows, ["measure", "unit", "value", ""]))
    _written(written, args)
    return 0


def _tune(args):
    _out(args)
    seed, case = _seed(args), _open(args)
    from jaxtank.rig import check_objective
    from tuning import report, search

    free = _once("--free", [_pair("--free", text, _range) for text in args.free])
    objective = _once("--objective", [_pair("--objective", text, lambda v: _number("--objective", v)) for text in args.objective])
    if objective:
        objective = check_objective(objective)
    limits, scenarios, sweep = _limits(args, case), _scenarios(args), _tradeoff(args)
    if args.resume and args.out and args.resume != args.out:
        raise InputError("--resume and --out name different folders: a run is continued in its own")
    if args.resume is not None and not args.resume.strip():
        raise InputError("--resume '': must name a folder")
    folder = args.resume or args.out
    choices, varied = _choices(args), _distributions(args, case)
    only = (args.samples, args.fresh, args.back_off)
    if (varied is not None or any(v is not None for v in only)) and args.robust is None:
        raise InputError("--samples, --fresh, --back-off, --spread and --vary of tune belong to --robust")
    finder, more = search.tune, {"choices": choices}
    if args.robust is not None:
        from tuning.robust import tune_robust

        if choices or args.scenario:
            raise InputError("--robust makes scenarios of its own: no --scenario, no --choose beside it")
        finder = functools.partial(
            tune_robust,
            distributions=varied,
            risk=args.robust,
            samples=_whole("--samples", args.samples or "64", 2, 100_000),
            fresh=_whole("--fresh", args.fresh or "1024", 1, 100_000),
            back_off=_number("--back-off", args.back_off or "0"),
        )
        scenarios, more = None, {}
    result = finder(
        case,
        method=args.method,
        free=free,
        objective=objective,
        limits=limits,
        **({} if args.robust else {"scenarios": scenarios}),
        **more,
        batch=None if args.batch is None else _whole("--batch", args.batch, 1, 100_000),
        validation=_whole("--validation", args.validation, 0, 100_000),
        log=folder,
        resume=args.resume is not None,
        starts=_whole("--starts", args.starts, 1, 1000),
        seed=seed,
        screening=_whole("--screening", args.screening, 1, 65536),
        iterations=_whole("--iterations", args.iterations, 1, 100_000),
        progress=Progress(report.objective_unit(objective or case.objective, case.loop.units), args.quiet),
    )
    if not args.quiet and sys.stderr.isatty():
        print(file=sys.stderr)
    if sweep and result.status != "interrupted":
        from tuning.tradeoff import tradeoff

        answer = {n: p["after"] for n, p in result.parameters.items()}
        options = {"free": free, "objective": objective, "limits": limits, "scenarios": scenarios, "seed": seed}
        result = result.replace(tradeoff=tradeoff(case, *sweep, start=answer, **options))
    if args.bound and result.status != "interrupted":
        from tuning.bound import bound

        result = result.replace(bound=bound(result.tuned, objective, limits))
    written = result.save(folder, args.line) if folder else []
    args.out = folder
    if folder and result.status != "interrupted":
        from tuning.memo import discard

        discard(folder)  # the result is whole: there is nothing left to go on with
    print(report.dumps(report.json_of(result)) if args.json else report.text(result))
    _written(written, args)
    if not args.out and not args.json and not args.quiet:
        print("Add --out DIR for the tuned rig, the trajectory and pictures.", file=sys.stderr)
    return EXIT[result.status]


class Progress(Interrupts):
    """A line per evaluation on a terminal, a line per local search elsewhere. Ctrl-C is taken between evaluations."""

    def __init__(self, unit, quiet):
        super().__init__()
        self.unit, self.quiet, self.last, self.terminal = unit, quiet, None, sys.stderr.isatty()

    def __call__(self, event):
        self.check()
        if self.quiet or (not self.terminal and event["start"] == self.last):
            return
        self.last = event["start"]
        breaks = " (breaks a limit)" if event["best_violation"] else ""
        best = "none yet" if event["best"] is None else f"{event['best']:.6g} {self.unit}{breaks}"
        line = f"start {min(event['start'] + 1, event['starts'])}/{event['starts']}  evaluation {event['evaluations']}  best {best}"
        print(f"\r{line:<70}" if self.terminal else line, end="" if self.terminal else "\n", file=sys.stderr, flush=True)


def _written(paths, args):
    if paths and not args.quiet:
        print(f"written to {args.out}: " + ", ".join(p.name for p in paths), file=sys.stderr)


def _sensitivity(args):
    _out(args)
    devices = _devices(args)
    seed, case = _seed(args), _open(args)
    varied = _distributions(args, case)
    from tuning import report, sensitivity_report
    from tuning.sensitivity import MOST, sensitivity

    terminal, told = sys.stderr.isatty(), [0]

    def progress(done, total):
        if args.quiet or (not terminal and done < total and done - told[0] < total / 10):
            return
        told[0] = done
        start, end = ("\r", "") if terminal else ("", "\n")
        print(f"{start}run {done}/{total}", end=end, file=sys.stderr, flush=True)

    result = sensitivity(
        case,
        varied,
        method=args.method,
        measures=args.measure or None,
        samples=None if args.samples is None else _whole("--samples", args.samples, 1, MOST),
        seed=seed,
        devices=devices,
        progress=progress,
    )
    if terminal and not args.quiet:
        print(file=sys.stderr)
    written = result.save(args.out, args.line) if args.out else []
    print(report.dumps(sensitivity_report.json_of(result)) if args.json else result.text())
    _written(written, args)
    return 0


def _bench(args):
    rounds = _whole("--rounds", args.rounds, 1, 1000)
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning import bench, report

    if args.cases:
        from jaxtank import presets, rig

        names = presets.names() if args.cases == ["all"] else args.cases
        result = bench.measure_cases({name: rig.open_case(name) for name in names}, rounds)
        print(report.dumps(result) if args.json else bench.text_of_cases(result))
        return 0
    result = bench.measure(rounds)
    print(report.dumps(result) if args.json else bench.text(result))
    return 0


def _completion(args):
    from tuning import completion

    print(completion.script(args.shell, parser()), end="")
    return 0


def _compare(args):
    _out(args)
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning import compare, report

    papers = presets.PAPERS if args.paper == "all" else (args.paper,)
    for paper in papers:
        presets.load(paper)  # an unknown one is told before anything runs
    found = {}
    for paper in papers:
        if not args.quiet:
            print(f"running {paper}", file=sys.stderr, flush=True)
        found[paper] = compare.measure(paper)
    written = compare.save(found, args.out, args.line) if args.out else []
    if args.json:
        print(report.dumps(found if args.paper == "all" else found[args.paper]))
    else:
        print(compare.markdown(found) if args.markdown else "\n\n".join(compare.text(page) for page in found.values()))
    _written(written, args)
    return 0


def _tune_interruptibly(args):
    """`_tune`, with the handler of SIGINT put back afterwards."""
    with put_back():
        return _tune(args)


COMMANDS = {
    "list": _list,
    "show": _show,
    "simulate": _simulate,
    "tune": _tune_interruptibly,
    "sensitivity": _sensitivity,
    "identify": identify_command.run_interruptibly,
    "init": _init,
    "export": _export,
    "uncertainty": _uncertainty,
    "merge": _merge,
    "compare": _compare,
    "completion": _completion,
    "bench": _bench,
}

if __name__ == "__main__":
    sys.exit(main())
