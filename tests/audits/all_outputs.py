"""Write what the commands print and export to a folder, for a comparison of two checkouts.

    python tests/audits/all_outputs.py DIR        writes DIR/NAME.json, DIR/NAME.c and so on
    python tests/audits/all_outputs.py A B        lists the files of A that differ in B

Times, paths and versions are left out; a run of all takes about ten minutes.
"""

import contextlib
import io
import itertools
import json
import sys
from pathlib import Path

from tuning.cli.main import main

EXPORTED = (
    "gouta2015/ngpc",
    "gouta2015/backstepping",
    "gouta2015/ngpc-observer",
    "gouta2022/pi",
    "gouta2022/enmpc",
    "gouta2022/chadpc",
    "mirakhorli/hybrid",
    "mirakhorli/lqi",
    "calofir/backstepping",
    "khalid/gpc",
)
COMMANDS = {
    "list": "list",
    "show": "show gouta2015/backstepping",
    "show-khalid": "show khalid/gpc",
    "simulate": "simulate gouta2022/chadpc",
    "simulate-filter": "simulate gouta2015/ngpc --safety-filter --margins",
    "tune": "tune gouta2015/backstepping",
    "tune-cascaded": "tune cascaded/pi",
    "tune-nominal": "tune gouta2015/backstepping --nominal --starts 2",
    "tune-robust": "tune cascaded/pi --robust cvar --samples 8 --starts 1",
    "uncertainty": "uncertainty cascaded/pi --samples 64",
    "sensitivity": "sensitivity cascaded/pi --method morris --samples 4",
    "attack": "attack gouta2015/backstepping --safety-filter --starts 2",
    "identify": "identify cascaded/open-loop --data tests/data/cascaded_tanks.csv",
    "compare": "compare calofir",
    "bound": "tune cascaded/pi --nominal --starts 1 --bound",
}
VOLATILE = {"mends_s", "wall_s", "provenance", "elapsed_s", "seconds", "saved", "files"}


def stable(value):
    """Return a JSON value without what differs from run to run."""
    if isinstance(value, dict):
        return {k: stable(v) for k, v in value.items() if k not in VOLATILE}
    return [stable(v) for v in value] if isinstance(value, list) else value


def printed(words):
    """Return (exit code, standard output) of a command."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        code = main(words)
    return code, out.getvalue()


def record(folder):
    """Write one file for each command and each export."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, words in COMMANDS.items():
        code, text = printed([*words.split(), "--json", *([] if name == "list" else ["--quiet"])])
        with contextlib.suppress(json.JSONDecodeError):
            text = json.dumps(stable(json.loads(text)), indent=1, sort_keys=True)
        (folder / f"{name}.json").write_text(f"exit {code}\n{text}\n")
    for case, language in itertools.product(EXPORTED, ("c", "js", "m")):
        code, text = printed(["export", case, "--lang", language])
        (folder / f"{case.replace('/', '-')}.{language}").write_text(text or f"exit {code}\n")


def compare(before, after):
    """Print the files that differ; return how many do."""
    names = sorted({p.name for p in (*before.iterdir(), *after.iterdir())})

    def text(folder, name):
        return (folder / name).read_text() if (folder / name).exists() else None

    differing = [name for name in names if text(before, name) != text(after, name)]
    print("\n".join(differing) or f"{len(names)} files agree")
    return len(differing)


if __name__ == "__main__":
    first, *second = map(Path, sys.argv[1:])
    sys.exit(bool(compare(first, second[0])) if second else record(first))
