"""What laws for tanks that each have their own pump share: the model as h_i' = f_i(h) + c2_i u_i (gouta2022 eqs. 1-3)."""

from jaxtank.core.errors import InputError


def drift(model, x):
    """f(h) [cm/s]: level rates of the model with its pumps off, one per output; x: (n) levels [cm], scalars or arrays."""
    rate = model.derivative(0.0, tuple(x), (0.0,) * model.pumps, None)
    return tuple(rate[i] for i in model.outputs)


def authority(model):
    """c2 [cm/(s V)]: level rate per volt of each pump in its own tank, Kp/A (gouta2022 eq. 3)."""
    return tuple(model.pump_gain[j] / model.area[first] for j, (first, _) in enumerate(model.feeds))


def check_own_pumps(model, every=True):
    """Raise InputError unless pump j fills the j-th controlled tank alone and, with `every`, every tank is controlled."""
    if tuple(first for first, _ in model.feeds) != model.outputs or any(second is not None for _, second in model.feeds):
        raise InputError(
            "controller.model must have one pump per controlled tank, in the same order: this law inverts it tank by tank"
        )
    if every and model.outputs != tuple(range(model.tanks)):
        raise InputError("controller.model has tanks whose levels are not controlled: this law needs the setpoint of every tank")
