"""What every law is to the loop."""

import abc


class Controller(abc.ABC):
    """A sampled law. It holds its own model of the plant: what it believes and what is true are different leaves."""

    def init(self):
        """State before the first sample."""
        return ()

    @abc.abstractmethod
    def step(self, state, tick, estimate):
        """((m) commanded voltages [V], new state) at `tick` for `estimate`; the command is not limited here."""

    def input_metric(self, estimate):
        """(g11, g12, g22): how the law's cost weighs a change of its two inputs, for allocation by box QP; None if it has none."""
        return None

    def check(self, reference):  # noqa: B027  (a law with nothing to check need not say so)
        """Raise InputError if the law cannot serve this reference, or its model is not of the kind it inverts."""
