"""`jaxtank compare`: published and measured numbers side by side, with a verdict."""

import textwrap
from collections import Counter
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.tree import get_value
from jaxtank.loop import run as lp
from jaxtank.plants.network import TankNetwork
from jaxtank.presets.paper import Claim, Sample, verdict as word_of
from tuning.problem.scenarios import noisy
from tuning.report import verdict as verdicts
from tuning.report.advice import Advice, listed
from tuning.report.document import Live, Report, Text
from tuning.report.folder import earlier, save as save_all
from tuning.report.tables import Table, Value, clean, fields

SAME = 1e-9  # relative difference below which a number was not measured, but set [-]
NUMBER, CLAIM = "number", "claim"
REPRODUCED, FITTED, DIFFERS = "reproduced", "fitted", "differs"
IMPOSSIBLE, INPUT = "not reproducible", "input"
VERDICTS = {  # {verdict of a row: its meaning}
    REPRODUCED: "within the tolerance of its row, or a claim that holds",
    FITTED: "near the printed number because an assumption was chosen for it: no evidence",
    DIFFERS: "measured, and different or true in part only: the row says why",
    IMPOSSIBLE: "cannot be measured: the row says what is missing",
    INPUT: "a number that our case has from the paper: no evidence",
}


def runner(paper):
    """Return run(case name, values={}, save_every=1, seed=0) of a paper; each run is made once."""
    # run: (Case with `values` set, Trajectory); run.cost(name, values={}): `cost` of such a case
    cases, runs = presets.load(paper).cases, {}

    def run(name, values=None, save_every=1, seed=0):
        key = (name, repr(values), save_every, seed)
        if key not in runs:
            case = rig.set_values(cases[name], values or {})
            noise = jax.random.key(seed) if noisy(case) else None
            trajectory = lp.simulate(case.loop, case.clock, noise, save_every)
            runs[key] = case, jax.tree.map(np.asarray, trajectory)
        return runs[key]

    run.cost = lambda name, values=None: cost(rig.set_values(cases[name], values or {}))
    return run


def cost(case):
    costs = []
    for scenario in case.scenarios:
        changed = rig.set_scenario(case, scenario.values)
        key = jax.random.fold_in(jax.random.key(0), scenario.seed)
        measures = lp.evaluate(changed.loop, changed.clock, list(case.objective), key)
        costs.append(sum(w * float(np.sum(measures[m])) for m, w in case.objective.items()))
    return float(np.mean(costs))


def verdict(published, measured):
    """Return (one of VERDICTS, measured value or text, reason) of one published quantity."""
    if measured is None:
        return IMPOSSIBLE, None, published.reason
    if isinstance(measured, Claim):
        reason, fitted = published.reason, published.fitted
        if measured.verdict == "not reproduced":
            return DIFFERS, measured.text, reason
        if fitted:
            return FITTED, measured.text, f"{fitted}; {reason}".rstrip("; ")
        if measured.verdict == REPRODUCED:
            return REPRODUCED, measured.text, ""  # the text has the numbers
        return DIFFERS, measured.text, f"in part: {reason}"
    return _verdict_on_number(published, measured)


def _verdict_on_number(published, measured):
    reason, fitted = published.reason, published.fitted
    value = measured.mean if isinstance(measured, Sample) else measured
    if isinstance(published.value, str):
        return INPUT, value, VERDICTS[INPUT]
    printed, values = (np.ravel(v).astype(float) for v in (published.value, value))
    # No simulation agrees with a rounded number to 1e-9: it was set, unless a closed form is named.
    same = printed.size in (1, values.size) and np.all(abs(values - printed) <= SAME * abs(printed))
    if same and not published.closed_form:
        return INPUT, value, VERDICTS[INPUT]
    apart = np.abs(values - printed) if values.shape == printed.shape else np.inf
    if published.tolerance is None or not np.all(apart <= published.tolerance * np.abs(printed)):
        return DIFFERS, value, reason
    apart = max((abs(v / p - 1.0) for v, p in zip(values, printed) if p), default=0.0)
    within = f"within {100 * published.tolerance:g} %: largest difference {100 * apart:.1f} %"
    if isinstance(measured, Sample):
        within += f" (mean of {len(measured.values)} seeds of the noise)"
    return (FITTED, value, f"{fitted}; {within}") if fitted else (REPRODUCED, value, within)


def measure(paper):
    """Return {"paper", "citation", "notes", "headline", "ramps", "rows"} of a paper."""
    # deviation: of one noisy run; ramp_s: assumed setpoint ramps; by_ramp: verdict with each
    preset = presets.load(paper)
    measured = preset.measured(runner(paper))
    if stray := set(measured) - set(preset.published):
        names = ", ".join(sorted(stray))
        raise KeyError(f"{paper} measures what is not in its published quantities: {names}")
    rows = []
    for name, printed in preset.published.items():
        value = measured.get(name)
        word, number, reason = verdict(printed, _set_in(preset, name) if value is None else value)
        kind = CLAIM if isinstance(printed.value, str) else NUMBER
        deviation = clean(value.deviation) if isinstance(value, Sample) else None
        by_ramp = value.by_ramp.items() if isinstance(value, Claim) else ()
        row = {"quantity": name, "kind": kind, **fields(printed, "unit where published=value")}
        row |= {"measured": clean(number), "deviation": deviation, "verdict": word}
        row |= {"reason": reason, "ramp_s": printed.ramp}
        rows.append(row | {"by_ramp": {f"{ramp:g}": word_of(holds) for ramp, holds in by_ramp}})
    heading = {"paper": paper, "citation": preset.citation, "notes": str(preset.notes)}
    return heading | {"headline": headline(rows), "ramps": ramps(rows), "rows": rows}


def headline(rows):
    """Return {"numbers" and "claims": {"reproduced", "fitted", "differs", "of"}, ...}."""
    counts, tally = {}, Counter((row["kind"], row["verdict"]) for row in rows)
    for name, kind in (("numbers", NUMBER), ("claims", CLAIM)):
        counts[name] = {word: tally[kind, word] for word in (REPRODUCED, FITTED, DIFFERS)}
        counts[name]["of"] = sum(counts[name].values())
    return counts | {w: tally[NUMBER, w] + tally[CLAIM, w] for w in (INPUT, IMPOSSIBLE)}


def headline_text(rows):
    counts: Any = headline(rows)
    numbers, claims = counts["numbers"], counts["claims"]
    return (
        f"printed numbers: {numbers[REPRODUCED]} of {numbers['of']} reproduced, {numbers[FITTED]}"
        f" fitted; claims in words: {claims[REPRODUCED]} of {claims['of']} hold, {claims[FITTED]}"
        f" fitted; {counts[INPUT]} inputs, {counts[IMPOSSIBLE]} not reproducible"
    )


def ramps(rows):
    """Return [{"ramp_s", "reproduced", "of", "differs"}] of claims that depend on ramps."""
    by_ramp = {row["quantity"]: row["by_ramp"] for row in rows if row.get("by_ramp")}
    rows = []
    for ramp in next(iter(by_ramp.values()), ()):
        lost = [name for name, words in by_ramp.items() if words[ramp] != REPRODUCED]
        counts = {"reproduced": len(by_ramp) - len(lost), "of": len(by_ramp)}
        rows.append({"ramp_s": float(ramp), **counts, "differs": lost})
    return rows


def ramps_text(rows):
    return [
        f"with setpoint ramps of {row['ramp_s']:g} s: {row['reproduced']} of {row['of']} claims"
        f" that depend on them hold{', not ' * bool(row['differs'])}{', '.join(row['differs'])}"
        for row in ramps(rows)
    ]


def _set_in(preset, name):
    """The value of parameter `name` in the first case that has it, None of another name."""
    for case in preset.cases.values():
        if name.startswith("clock."):
            return getattr(case.clock, name.removeprefix("clock."), None)
        try:
            value = np.asarray(get_value(case.loop, name))
        except ValueError:  # InputError
            continue
        return value.item() if value.ndim == 0 else tuple(value.ravel().tolist())
    return None


def _cell(value):
    if value is None or isinstance(value, str):
        return value or "-"
    entries = np.unique(np.ravel(value))
    return Value(entries if entries.size == 1 else value, 4, between=", ")


def _measured(row):
    spread, value = row.get("deviation"), _cell(row["measured"])
    return f"{value} (standard deviation {_cell(spread)})" if spread else value


def _reason(row):
    ramp = row.get("ramp_s")
    return "; ".join(filter(None, [row["reason"], f"ramps of {ramp:g} s" if ramp else ""]))


def verdict_of(pages):
    rows = [row for page in pages.values() for row in page["rows"]]
    return verdicts.outcome(headline_text(rows), all(row["verdict"] != DIFFERS for row in rows))


def json_of(pages):
    (first, *others) = pages.values()
    above = {"verdict": verdict_of(pages).to_json(), "advice": list(advice_of(pages))}
    return (dict(pages) if others else dict(first)) | above


def advice_of(pages):
    rows = [row for page in pages.values() for row in page["rows"]]
    counts: Any = headline(rows)
    claims, numbers = counts["claims"], counts["numbers"]
    apart = [row for row in rows if row["verdict"] == DIFFERS]
    failed, apart = ([r["quantity"] for r in apart if r["kind"] == k] for k in (CLAIM, NUMBER))
    to_set = f"Claims: {claims[REPRODUCED]} of {claims['of']} hold in our runs"
    to_set += f"; not, or in part only: {listed(failed)}" if failed else ""
    gives = f"Printed numbers: {numbers[REPRODUCED]} of {numbers['of']} reproduced"
    gives += f"; furthest apart: {_furthest(rows)}" if apart else ""
    missing = [row["quantity"] for row in rows if row["verdict"] == IMPOSSIBLE]
    beyond = "No run is missing: every quantity could be measured."
    if missing:
        beyond = f"No run can tell {len(missing)} of {len(rows)} quantities: {listed(missing)}."
    return Advice(f"{to_set}.", f"{gives}.", beyond)


def _furthest(rows):
    """The number that is furthest from the printed one, as a ratio."""
    apart = [
        (float(np.max(np.abs(np.log(ratios)))), row, ratios)
        for row in rows
        if row["verdict"] == DIFFERS and (ratios := _ratios(row)).size
    ]
    if not apart:
        return "none, as the others cannot be divided"
    _, row, ratios = max(apart, key=lambda entry: entry[0])
    worst = ratios[np.argmax(np.abs(np.log(ratios)))]
    return f"{row['quantity']}, {verdicts.shown(worst)} times the printed value"


def report(pages):
    tally = Counter(row["verdict"] for page in pages.values() for row in page["rows"])
    facts = [(word, tally[word]) for word in VERDICTS if tally[word]]
    sections = [
        Text([f"{word}: {VERDICTS[word]}" for word, _ in facts], items=True, on="page"),
        *(section for page in pages.values() for section in _sections(page)),
        *(Live(next(iter(presets.load(p).cases.values()))) for p in pages),
    ]
    name, verdict = ", ".join(pages) if len(pages) == 1 else "all papers", verdict_of(pages)
    title = (
        "Published numbers, numbers of our runs of the same rigs and controllers, and why they"
        " differ."
    )
    advised = advice_of(pages)
    return Report(name, "published and measured", verdict, facts, sections, title, advice=advised)


def _sections(page):
    """The sections of one paper: on a terminal long texts stand below the table."""
    brief, full, notes, ramped = [], [], [], ramps_text(page["rows"])
    shorten = lambda cell: textwrap.shorten(str(cell), 60, placeholder=" ...")
    for r in page["rows"]:
        published, measured, reason = _cell(r["published"]), _measured(r), _reason(r)
        first = [r["quantity"], r["unit"]]
        brief.append([*first, shorten(published), shorten(measured), r["verdict"]])
        full.append([*first, published, measured, r["verdict"], r["where"], reason])
        claim = r["measured"] if isinstance(r["measured"], str) else ""
        if note := "; ".join(filter(None, [claim, reason])):
            notes.append(f"{r['quantity']} ({r['where']}): {note}")
    heads = ["quantity", "unit", "published", "measured", "verdict"]
    head = [page["citation"], f"notes: {presets.load(page['paper']).notes}"]
    return [
        Text([*head, *ramped], gap=True, on="terminal"),
        Table(brief, heads, gap=True, on="terminal"),
        Text(notes, items=True, on="terminal"),
        Text([page["citation"], *ramped], on="page"),
        Table(full, [*heads, "where", "why"], on="page"),
    ]


def save(pages, folder, command=None):
    captions = {
        "published": "Measured over published, for every number that was measured: at the line the"
        " two agree. Numbers of both signs, and those that are 0, are in the table alone."
    }
    draw, page = lambda: overview(pages) | _rigs(pages, captions), lambda: report(pages)
    old = [path.stem for paper in presets.PAPERS for path in Path(folder).glob(f"rig-{paper}*.png")]
    payload, stale = json_of(pages), earlier(folder, [*old, "published"])
    versions = {"jaxtank": jaxtank.__version__, "jax": jax.__version__, "numpy": np.__version__}
    return save_all(folder, payload, {}, draw, page, captions, command, stale, versions)


def _rigs(pages, captions):
    """{name: drawing} of each different rig of the papers; their captions are added to a dict."""
    from jaxtank.plots import run as plots

    drawings = {}
    for paper, page in pages.items():
        topologies = []
        for name, case in presets.load(paper).cases.items():
            plant = cast(TankNetwork, case.loop.plant)  # as every preset's
            parts = (plant.links, plant.pipes, plant.feeds, plant.spills, plant.outputs)
            topology = (*parts, np.asarray(plant.rim).tolist())
            if topology not in topologies:  # cases of one paper share their rig, but for some
                topologies.append(topology)
                of = f"rig-{paper}" + f"-{len(topologies)}" * (len(topologies) > 1)
                drawings[of] = plots.rig(plant, None, f"{paper}/{name}")["rig"]
                captions[of] = f"The rig of {paper}/{name}. {page['citation']}"
    return drawings


def overview(pages):
    """Return {"published": figure of measured over published numbers}, {} without any."""
    from jaxtank.plots import style

    rows = [(paper, row, _ratios(row)) for paper, page in pages.items() for row in page["rows"]]
    rows = [row for row in rows if row[2].size]
    looks = {REPRODUCED: (style.AFTER, "o"), FITTED: ("#E69F00", "s"), DIFFERS: (style.BEFORE, "X")}

    def draw(ax):
        for k, (_, row, ratios) in enumerate(rows):
            colour, marker = looks[row["verdict"]]
            points = {"color": colour, "markersize": 5, "alpha": 0.8, "label": row["verdict"]}
            ax.plot(ratios, [k] * len(ratios), marker, **points)
        ax.axvline(1.0, color=style.REFERENCE, linewidth=1.0)
        ax.set_xscale("log")
        ax.set(xlabel="measured / published [-]", ylim=(len(rows) - 0.4, -0.6))
        start = (lambda paper: f"{paper}: ") if len(pages) > 1 else (lambda paper: "")
        names = [start(paper) + style.plain(row["quantity"]) for paper, row, _ in rows]
        ax.set_yticks(range(len(rows)), names, fontsize=7)

    size = (7.2 if len(pages) > 1 else 6.0, 0.8 + 0.2 * len(rows))
    return {"published": style.picture(draw, size, legend=3)} if rows else {}


def _ratios(row):
    """Measured over published numbers of a row, one for each entry; none for claims."""
    pair = (row["published"], row["measured"])
    if row["verdict"] in (INPUT, IMPOSSIBLE) or any(v is None or isinstance(v, str) for v in pair):
        return np.zeros(0)
    printed, measured = (np.ravel(np.asarray(v, dtype=float)) for v in pair)
    if printed.size not in (1, measured.size):
        return np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = measured / printed
    ratios = ratios[np.isfinite(ratios) & (ratios > 0.0)]
    # Entries that differ by rounding alone are one point, whatever the processor.
    return np.unique([float(f"{ratio:.6g}") for ratio in ratios])


def markdown(pages):
    """Return the table of tests/benchmarks/README.md: every measured quantity of {paper: page}."""
    every = [row for page in pages.values() for row in page["rows"]]
    lines = [f"All papers: {headline_text(every)}.", ""] if len(pages) > 1 else []
    for paper, page in pages.items():
        lines += [f"- {paper}: {headline_text(page['rows'])}"]
        lines += [f"  - {line}" for line in ramps_text(page["rows"])]
    lines += ["", "| paper | quantity | published | measured | verdict |", "|---|---|---|---|---|"]
    for paper, r in ((paper, r) for paper, page in pages.items() for r in page["rows"]):
        if r["verdict"] not in (INPUT, IMPOSSIBLE):
            sides = (("published", _cell(r["published"])), ("measured", _measured(r)))
            cells = [f"{v} {r['unit'] if not isinstance(r[k], str) else ''}" for k, v in sides]
            why = f": {_reason(r)}" if _reason(r) else ""
            cells = [paper, r["quantity"], *map(str.rstrip, cells), r["verdict"] + why]
            lines.append(f"| {' | '.join(c.replace('|', chr(92) + '|') for c in cells)} |")
    return "\n".join(lines)
