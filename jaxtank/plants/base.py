"""What every plant is to the loop, to observers and to the laws that carry one as their model."""

import abc


class Plant(abc.ABC):
    """A vector field over levels, held inputs and disturbing inflows. Vectors are tuples of scalars."""

    @property
    @abc.abstractmethod
    def tanks(self):
        """Number of levels n [-]."""

    @property
    @abc.abstractmethod
    def pumps(self):
        """Number of inputs m [-]."""

    @abc.abstractmethod
    def derivative(self, t, x, u, d):
        """x' at time t [s] for levels x (n) [cm], inputs u (m) [V] and inflows d (n) [cm^3/s] or None; returns (n) [cm/s]."""

    @abc.abstractmethod
    def spill(self, x):
        """(levels held at their rims, volume lost over each rim [cm^3]); unchanged and zeros where rims are not physics."""

    def output(self, x):
        """The levels that are controlled: those of the tanks in `outputs`, in that order."""
        return tuple(x[i] for i in self.outputs)
