#!/usr/bin/env bash
# In an environment of its own, tests/audits/versions.sh oldest|newest [--record] runs
#   oldest: a part of the suite that uses every dependency, with the oldest supported versions of them;
#   newest: the whole default suite, with the newest versions that pip offers, on the newest Python there is (on PATH, or of pyenv or uv).
set -euo pipefail
unset PYTHONPATH # else another tree would be tested
which=${1:-}
case "$which" in oldest | newest) ;; *) echo "usage: tests/audits/versions.sh oldest|newest [--record]" >&2; exit 2 ;; esac
cd "$(dirname "$0")/../.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# oldest: name==minimum of each dependency in pyproject.toml; newest: nothing but what pyproject.toml excludes
python3 - "$which" >"$work/constraints.txt" <<'PY'
import re, sys, tomllib
needs = tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"]
if sys.argv[1] == "oldest":
    for need in needs:
        print("==".join(re.match(r"([\w-]+)>=([\d.]+)", need).groups()))
PY
python=python3
if [ "$which" = newest ]; then
    for minor in 14 13 12; do
        python=$({ command -v "python3.$minor" | grep -v shims; ls -d ~/.pyenv/versions/3.$minor.*/bin/python3; uv python find --no-python-downloads "3.$minor"; } 2>/dev/null | tail -n 1 || true)
        [ -z "$python" ] || break
    done
    python=${python:-python3}
fi
"$python" -m venv "$work/env"
"$work/env/bin/pip" install --quiet --upgrade pip
"$work/env/bin/pip" install --quiet --constraint "$work/constraints.txt" ".[test]"
"$work/env/bin/python" -c 'from importlib.metadata import version as v; from platform import python_version
print("Python", python_version(), end=", ")
print(", ".join(f"{n} {v(n)}" for n in ("jax", "jaxlib", "optax", "numpy", "scipy", "matplotlib")))' | tee "$work/told"

# the layers; the compiled loop; one paper to its numbers; the command; names; QP; logs; pictures (matplotlib); searches (optax, scipy)
part=(tests/unit/test_layers.py tests/unit/loop/test_compiled_loop.py tests/papers/test_gouta2015.py tests/unit/core/test_tree.py tests/unit/analysis/test_qp.py
    tests/unit/identification/test_logs.py tests/unit/plots/test_run_plots.py tests/unit/report/test_page.py tests/unit/storage/test_resume.py
    tests/unit/analysis/test_linear.py tests/cli/test_cli.py)
[ "$which" = oldest ] || part=()
"$work/env/bin/pytest" -o "cache_dir=$work/cache" --junitxml="$work/report.xml" "${part[@]}" || failed=$?
if [ "${2:-}" = --record ]; then
    "$work/env/bin/python" tests/audits/survived.py --versions "$which" "$work/report.xml" "$work/told"
fi
exit "${failed:-0}"
