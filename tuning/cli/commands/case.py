"""`jaxtank list`, `show`, `init`, `export`, `simulate`, `compare`, `bench`, `completion`: a case as
it is.
"""

import sys

from jaxtank.core.errors import InputError
from jaxtank.core.files import write_folder
from tuning.cli.options import tell_written
from tuning.cli.values import open_case, whole
from tuning.cli.values import seed as seed_of


def list_cases(args):
    from jaxtank import presets
    from tuning.report import tables

    cases = {f"{p}/{n}": c.title for p in presets.PAPERS for n, c in presets.load(p).cases.items()}
    print(
        tables.dumps(cases)
        if args.json
        else tables.table([[n, t] for n, t in cases.items()], ["case", ""])
    )
    return 0


def show(args):
    case = open_case(args)
    from tuning.report import artifacts, tables
    from tuning.report import case as manual

    written = []
    if args.out:
        from pathlib import Path

        from tuning.report import figures
        from tuning.report import html as page

        try:
            drawn = figures.rig(case.loop, None, case.name)
            alone = {f"{name}.svg": page.alone(figure, name) for name, figure in drawn.items()}
        except Exception as error:
            figures.failed("rig", error)
            for name in ("rig.svg", "rig.png"):  # of another rig
                Path(args.out, name).unlink(missing_ok=True)
        else:
            written = write_folder(Path(args.out), alone | artifacts.pngs(drawn))
    print(tables.dumps(manual.json_of(case)) if args.json else manual.text(case))
    tell_written(written, args)
    return 0


def init(args):
    if args.short and args.tanks:
        raise InputError(
            "--short and --tanks: the short file names its preset; give one of the two"
        )
    case = open_case(args)
    from jaxtank import rig
    from tuning.report import tables

    text = rig.short(case) if args.short else rig.complete(case, tankwise=args.tanks)
    print(
        tables.dumps({"case": case.name, "rig": text}) if args.json else text,
        end="\n" if args.json else "",
    )
    return 0


def export_law(args):
    case = open_case(args)
    from pathlib import Path

    from jaxtank.export.printer import function_name
    from jaxtank.export.source import export
    from tuning.report import tables

    text = export(case, args.lang, args.precision, args.name)
    name = args.name or function_name(case)
    if args.json:
        print(tables.dumps({"case": case.name, "lang": args.lang, "name": name, "source": text}))
    if args.out:
        tell_written(write_folder(Path(args.out), {f"{name}.{args.lang}": text}), args)
    elif not args.json:
        print(text, end="")
    return 0


def simulate(args):
    if args.gif and not args.out:
        raise InputError("--gif needs --out DIR, where run.gif is written")
    seed, case = seed_of(args), open_case(args)
    import jax

    from jaxtank import measures as ms
    from jaxtank.loop import run, step_size
    from tuning.problem.scenarios import noisy
    from tuning.report import artifacts, tables
    from tuning.report import case as manual
    from tuning.search import baseline, provenance

    key = jax.random.key(seed) if noisy(case) else None
    if step_size.step_warnings(case.loop, case.clock):
        step_size.check_run(case.loop, case.clock, run.simulate(case.loop, case.clock, key))
    values = {m: v for m, v in baseline.run_measures(case.loop, case.clock, key).items()}
    payload = {
        "case": case.name,
        "measures": tables.measures_json(values),
        "units": tables.units(case.loop.units),
        "reasons": tables.reasons(values),
        "clock": manual.clock(case.clock),
        "parameters": tables.clean(run.parameters(case.loop)),
        "provenance": provenance.provenance(case, seed),
    }
    written = (
        artifacts.save_run(case, artifacts.run_for_people(case, key), payload, args.out, args.gif)
        if args.out
        else []
    )
    if args.json:
        print(tables.dumps(payload))
    else:
        print(f"{case.name}: {case.title}\n")
        rows = [
            [m, ms.unit(m, case.loop.units), tables.numbers(values[m]), s.doc]
            for m, s in ms.MEASURES.items()
            if m in values and m not in ms.times()
        ]
        print(tables.table(rows, ["measure", "unit", "value", ""]))
    tell_written(written, args)
    return 0


def compare(args):
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtank import presets
    from tuning.report import papers as compare
    from tuning.report import tables

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
        print(tables.dumps(found if args.paper == "all" else found[args.paper]))
    else:
        print(
            compare.markdown(found)
            if args.markdown
            else "\n\n".join(compare.text(page) for page in found.values())
        )
    tell_written(written, args)
    return 0


def bench(args):
    rounds = whole("--rounds", args.rounds, 1, 1000)
    import jax

    jax.config.update("jax_enable_x64", True)
    from tuning.bench import bench
    from tuning.report import tables

    if args.cases:
        from jaxtank import presets, rig

        names = presets.names() if args.cases == ["all"] else args.cases
        result = bench.measure_cases({name: rig.open_case(name) for name in names}, rounds)
        print(tables.dumps(result) if args.json else bench.text_of_cases(result))
        return 0
    result = bench.measure(rounds)
    print(tables.dumps(result) if args.json else bench.text(result))
    return 0


def completion(args):
    from tuning.cli import completion
    from tuning.cli.parser import parser

    print(completion.script(args.shell, parser()), end="")
    return 0
