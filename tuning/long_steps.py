"""What an answer says where its own run was made in steps too long for a tank that runs empty (see `jaxtank.step_length`)."""

import warnings

from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.loop.step_size import StepWarning, check_run, doubts

MOST = 16
"""Runs that are made to see whether a level is thrown up in one."""


def of_answer(problem, tuned, values, key=None):
    """[] where the steps of the tuned case and of its scenarios are short enough, else one sentence: which run is wrong, for a level was
    thrown up in it; or, where none was, what would happen to a tank that runs empty. Runs are made only where there are doubts.

    values: {parameter: the answer's}; key: of the sensor noise of the case's own run.
    """
    lanes = problem.lanes[:MOST] if problem.scenarios else ()
    runs = [("", tuned.loop, tuned.clock, key)]
    runs += [(f"scenario {lane.name}: ", with_values(lane.case.loop, values), lane.case.clock, lane.key) for lane in lanes]
    told = []
    for name, loop, clock, own in runs:
        found = doubts(loop, clock)
        if found and (why := _thrown_up(loop, clock, own)):
            return [f"{name}this answer's run is wrong, and so are its numbers: {why}"]
        told += [f"{name}{sentence}" for sentence in found]
    return told[:1]


def _thrown_up(loop, clock, key):
    """What `check_run` says of the run of a loop; None where it is right."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StepWarning)  # the sentence says it
        run = lp.simulate(loop, clock, key)
    try:
        check_run(loop, clock, run)
    except InputError as error:
        return str(error)
    return None
