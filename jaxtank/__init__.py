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
``JAXTANK_XLA_OPTION=0`` before the import to leave the options of XLA unchanged.
"""

from jaxtank.core import VERSION, lazy
from jaxtank.xla import flags

flags.enable_small_loop_compilation()

__version__ = VERSION
__getattr__, __all__ = lazy.attach(__name__, __file__)

lazy.HOMES.update(
    csv="jaxtank.loop.trajectory",
    dump="jaxtank.rig.write",
    figures="jaxtank.plots.run",
    live_page="jaxtank.live.page",
    pngs="jaxtank.plots.run",
    rig="jaxtank.plots.run",
    small="jaxtank.plots.run",
)


def __dir__():
    return sorted({*globals(), *__all__})
