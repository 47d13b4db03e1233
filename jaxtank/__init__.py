"""Differentiable liquid-tank rigs and the controllers of five papers.

    import jaxtank
    from jaxtank import presets

    case = presets.load("gouta2015").cases["backstepping"]
    trajectory = jaxtank.simulate(case.loop, case.clock, save_every=10)
    values = jaxtank.evaluate(case.loop, case.clock, ["rms_error_total", "max_level"])

The one side effect of importing this package is that it sets four XLA options (three from jaxlib
0.12 on, which may not know the fourth). A closed loop is a scan over a handful of numbers, and
XLA's CPU runtime dispatches every operation of such a loop by itself unless the loop counts as
small; the option ``xla_cpu_small_while_loop_byte_threshold`` lets any loop count as small, so that
it is compiled to one function (about sixteen times faster in float64).
``xla_cpu_disable_loop_unrolling`` keeps short loops over lanes loops, which become vector
instructions. ``xla_cpu_disable_new_fusion_emitters`` selects the older code generator for what is
outside the loop, which compiles faster, and ``xla_cpu_prefer_vector_width`` the width of an AVX-512
unit. They are added to ``XLA_FLAGS``; options that are there already are not changed. Set
``JAXTANK_XLA_OPTION=0`` before the import to leave XLA as it is.
"""

import importlib

from jaxtank.xla import flags

# A type checker reads these imports in place of `__getattr__`; at run time none is made here.
TYPE_CHECKING = False  # for a checker it is True; `typing` would slow down --help
if TYPE_CHECKING:
    from jaxtank import analysis as analysis
    from jaxtank import controllers as controllers
    from jaxtank import core as core
    from jaxtank import export as export
    from jaxtank import instruments as instruments
    from jaxtank import interop as interop
    from jaxtank import loop as loop
    from jaxtank import measures as measures
    from jaxtank import observers as observers
    from jaxtank import plants as plants
    from jaxtank import plots as plots
    from jaxtank import presets as presets
    from jaxtank import rig as rig
    from jaxtank import signals as signals
    from jaxtank import xla as xla
    from jaxtank.case import Case as Case
    from jaxtank.core.clock import Clock as Clock
    from jaxtank.core.errors import EquilibriumError as EquilibriumError
    from jaxtank.core.errors import InputError as InputError
    from jaxtank.core.errors import NonFiniteError as NonFiniteError
    from jaxtank.core.tree import component as component
    from jaxtank.core.tree import leaf as leaf
    from jaxtank.core.tree import parameters as parameters
    from jaxtank.core.tree import static as static
    from jaxtank.core.tree import with_values as with_values
    from jaxtank.loop.closed_loop import ClosedLoop as ClosedLoop
    from jaxtank.loop.many import evaluate_many as evaluate_many
    from jaxtank.loop.margins import stability_margins as stability_margins
    from jaxtank.loop.run import evaluate as evaluate
    from jaxtank.loop.run import sensitivities as sensitivities
    from jaxtank.loop.run import simulate as simulate
    from jaxtank.loop.trajectory import Trajectory as Trajectory
    from jaxtank.loop.validation import check as check
    from jaxtank.plots.style import notebook as notebook
    from jaxtank.xla.program_cache import cache as cache

__version__ = "0.1.0"

flags.enable_small_loop_compilation()

# Names are imported when they are first used: `jaxtank --help` must not wait for jax.
_NAMES = {
    "InputError": "jaxtank.core.errors",
    "NonFiniteError": "jaxtank.core.errors",
    "EquilibriumError": "jaxtank.core.errors",
    "parameters": "jaxtank.core.tree",
    "with_values": "jaxtank.core.tree",
    "component": "jaxtank.core.tree",
    "leaf": "jaxtank.core.tree",
    "static": "jaxtank.core.tree",
    "Clock": "jaxtank.core.clock",
    "Trajectory": "jaxtank.loop.trajectory",
    "Case": "jaxtank.case",
    "ClosedLoop": "jaxtank.loop.closed_loop",
    "simulate": "jaxtank.loop.run",
    "evaluate": "jaxtank.loop.run",
    "evaluate_many": "jaxtank.loop.many",
    "sensitivities": "jaxtank.loop.run",
    "stability_margins": "jaxtank.loop.margins",
    "check": "jaxtank.loop.validation",
    "cache": "jaxtank.xla.program_cache",
    "notebook": "jaxtank.plots.style",
}
_FOLDERS = (
    "analysis",
    "controllers",
    "core",
    "instruments",
    "loop",
    "measures",
    "observers",
    "plants",
    "plots",
    "presets",
    "rig",
    "signals",
    "xla",
)
# Not in __all__: `import *` must not need gymnasium.
_OPTIONAL = {"export": "jaxtank.export", "interop": "jaxtank.interop"}

# the names of the table
__all__ = [*_NAMES, *_FOLDERS]  # pyright: ignore[reportUnsupportedDunderAll]


if not TYPE_CHECKING:  # a checker would take any name for one that is here

    def __getattr__(name):
        if name in _NAMES:
            return getattr(importlib.import_module(_NAMES[name]), name)
        if name in _FOLDERS:
            return importlib.import_module(f"jaxtank.{name}")
        if name in _OPTIONAL:
            return importlib.import_module(_OPTIONAL[name])
        raise AttributeError(f"module 'jaxtank' has no attribute {name!r}")


def __dir__():
    return sorted({*globals(), *__all__, *_OPTIONAL})
