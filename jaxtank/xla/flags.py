"""XLA options that compile a closed loop to one fast function (jaxlib 0.10 to 0.12, CPU)."""

import os
import re
import sys
import warnings

import jaxlib.version

SWITCH = "JAXTANK_XLA_OPTION"
OFF = ("0", "off", "false", "no")
KEY = "xla_cpu_small_while_loop_byte_threshold"
ROLLED = "xla_cpu_disable_loop_unrolling"
"""LLVM unrolls a short loop before it can be vectorised: a batch of 16 plants then runs as 16
single ones (36 against 11 ns per step and plant), and derivatives compile twice as long. A compiler
that does not know the option ignores it.
"""
OLD_EMITTERS = "xla_cpu_disable_new_fusion_emitters"
"""What is computed outside the loop is compiled by XLA's older code generator, in less time; runs
take as long. A compiler that does not know the option ignores it.
"""
OPTION = f"{KEY}=100000000000,{ROLLED},{OLD_EMITTERS}"
_FLAG = "--xla_backend_extra_options="

VECTOR_WIDTH = "--xla_cpu_prefer_vector_width=512"
"""XLA's own 256 bits leave half of an AVX-512 unit idle. With 512, batches of plants take half the
time, networks of 100 tanks three quarters, a single run as long (tests/benchmarks/README.md). A
processor without such a unit uses what it has.
"""

UNTRIED = (0, 13)
"""From this version of jaxlib on VECTOR_WIDTH is not set: XLA ends the process at an unknown flag
in XLA_FLAGS. Unknown extra options are ignored.
"""


def append_option(flags):
    """Return `flags`, the text of XLA_FLAGS, with the options added."""
    # Options that the user has set, also these, stay unchanged. A text that does not begin with
    # "--" names a file of flags, to which nothing can be appended.
    if flags.strip() and not flags.lstrip().startswith("--"):
        return flags
    if VECTOR_WIDTH.split("=")[0] not in flags and jaxlib.version.__version_info__ < UNTRIED:
        flags = f"{VECTOR_WIDTH} {flags}".strip()
    missing = ",".join(option for option in OPTION.split(",") if option.split("=")[0] not in flags)
    if not missing:
        return flags
    # XLA keeps the last of several such flags, so the options join that one
    head, flag, tail = flags.rpartition(_FLAG)
    if not flag:
        return f"{flags} {_FLAG}{missing}".strip()
    quote = tail[:1] if tail[:1] in ("'", '"') else ""
    tail = tail[len(quote) :]  # the options join inside of the user's quotes
    theirs = re.split(quote or r"\s", tail, maxsplit=1)[0]
    joined = ",".join(filter(None, (theirs, missing)))
    return head + _FLAG + quote + joined + tail[len(theirs) :]


def backend_started():
    """Return whether jax has already read XLA_FLAGS, so that a change would come too late."""
    if "jax" not in sys.modules:
        return False
    # a private function: if it moves, the test of the compiled loop still shows whether the option
    # had an effect
    try:
        from jax._src import xla_bridge

        return bool(xla_bridge.backends_are_initialized())
    except (ImportError, AttributeError):
        return False


def _text_of(file):
    """The content of a file; empty if it cannot be read."""
    try:
        with open(file) as text:
            return text.read()
    except (OSError, ValueError):
        return ""


def enable_small_loop_compilation():
    """Add the options to XLA_FLAGS; warn once if jax has already started and cannot see it."""
    if os.environ.get(SWITCH, "1").lower() in OFF:
        return
    before = os.environ.get("XLA_FLAGS", "")
    after = append_option(before)
    if after == before:
        if KEY not in before and KEY not in _text_of(before.strip()):
            warnings.warn(
                f"XLA_FLAGS names a file ({before!r}), to which the options for fast loops cannot"
                " be appended: runs are correct but about 16 times slower. Add"
                f" {VECTOR_WIDTH} {_FLAG}{OPTION} to it, or set {SWITCH}=0 to silence this.",
                stacklevel=3,
            )
        return
    if backend_started():
        warnings.warn(
            "jax had started before jaxtank was imported, so the XLA option for fast loops could"
            " not be set: runs are correct but about 16 times slower. Import jaxtank before the"
            f" first jax computation, or set {SWITCH}=0 to silence this.",
            stacklevel=3,
        )
        return
    os.environ["XLA_FLAGS"] = after
