from jaxtank import (
    analysis as analysis,
    controllers as controllers,
    core as core,
    export as export,
    instruments as instruments,
    interop as interop,
    live as live,
    loop as loop,
    measures as measures,
    observers as observers,
    plants as plants,
    plots as plots,
    presets as presets,
    rig as rig,
    signals as signals,
    xla as xla,
)
from jaxtank.case import Case as Case
from jaxtank.core.clock import Clock as Clock
from jaxtank.core.errors import (
    EquilibriumError as EquilibriumError,
    InputError as InputError,
    NonFiniteError as NonFiniteError,
)
from jaxtank.core.tree import (
    component as component,
    leaf as leaf,
    parameters as parameters,
    static as static,
    with_values as with_values,
)
from jaxtank.loop.closed_loop import ClosedLoop as ClosedLoop
from jaxtank.loop.many import evaluate_many as evaluate_many
from jaxtank.loop.margins import stability_margins as stability_margins
from jaxtank.loop.run import (
    evaluate as evaluate,
    sensitivities as sensitivities,
    simulate as simulate,
)
from jaxtank.loop.trajectory import Trajectory as Trajectory
from jaxtank.loop.validation import check as check
from jaxtank.plots.style import notebook as notebook
from jaxtank.rig.keywords import (
    Orifice as Orifice,
    Pipe as Pipe,
    Pump as Pump,
    Rig as Rig,
    Spill as Spill,
    Tank as Tank,
    Valve as Valve,
)
from jaxtank.xla.program_cache import cache as cache

__version__: str
