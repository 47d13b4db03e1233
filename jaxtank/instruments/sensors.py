"""LevelSensor: readings of levels with noise and an ADC."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxtank.core.curves import straight_curve
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip, decay, lower_clip, quantise
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.core.vectors import each
from jaxtank.instruments.base import Sensor

option = functools.partial(leaf, like="gain", default=None, shape="tank")
"""A leaf of the sensors that may be left out."""


def _without_adc(fields, value):
    """`value` for a leaf of an ADC that is left out. Raises InputError where there is an ADC."""
    if fields.get("bits", 0):
        raise InputError(
            f"sensor.bits = {fields['bits']}: an ADC needs its gain and its full_scale"
        )
    return value


def check_unfiltered(sensor: Sensor, controller: str) -> None:
    """Raise InputError for filtered readings under a controller that predicts without a filter."""
    times = getattr(sensor, "filter", None)
    if times is not None and np.any(times):
        raise InputError(
            f"sensor.filter = {np.max(times):g} s: {controller} takes readings as levels; filtered"
            " ones lag behind, and levels would pass the limits: set it to 0 s, or choose another"
            " controller"
        )


@component
class LevelSensor(Sensor):
    """One level sensor per tank: noise, the ends of its span, then an ADC where `bits` is not 0,
    and a filter. `LevelSensor(noise=[0.1])` suffices where there is no ADC. With `low` and `high`,
    the levels at 0 % (4 mA) and 100 % (20 mA), readings stay within them, and the ADC divides what
    is between.

        y = scale curve(h) + offset + noise * xi,  xi ~ N(0, 1);  volts = y / gain, clipped to
        [0, full_scale], rounded to full_scale / 2^bits;
        y_f[k] = y[k] + exp(-dt/filter) (y_f[k-1] - y[k])

    The derivative of the ADC is the slope of the line through its staircase (numerics.quantise).

    Examples
    --------
    >>> sensor = LevelSensor(noise=[0.0], gain=[3.0], full_scale=3.3, bits=10)
    >>> round(float(sensor.read((5.0,), None)[0]), 4)
    4.9983
    """

    gain: np.ndarray = leaf(
        "cm/volt",
        "level per volt of each sensor (a)",
        **POSITIVE,
        default=lambda own: _without_adc(own, np.ones(np.shape(own["noise"]))),
        shape="tank",
    )
    noise: np.ndarray = leaf(
        "cm", "standard deviation of the noise on each level", low=0.0, shape="tank"
    )
    offset: np.ndarray | None = option("cm", "what each sensor reads of an empty tank")
    scale: np.ndarray | None = option(
        "-", "reading per level of each sensor; 1: calibrated", **POSITIVE
    )
    low: np.ndarray | None = option(
        "cm", "level at 0 % (4 mA): no reading is below; -inf: none", infinite=True
    )
    high: np.ndarray | None = option(
        "cm", "level at 100 % (20 mA): no reading is above; inf: none", **POSITIVE, infinite=True
    )
    curve_level: np.ndarray | None = option(
        "cm",
        "levels of the points of each sensor's curve, increasing",
        like="curve_reading",
        shape=("tank", "point"),
    )
    curve_reading: np.ndarray | None = option(
        "cm",
        "readings at these levels, straight lines between",
        like="curve_level",
        shape=("tank", "point"),
    )
    filter: np.ndarray | None = option(
        "s", "time constant of the first-order filter of the readings (damping); 0: none", low=0.0
    )
    full_scale: np.ndarray = leaf(
        "volt", "range of the ADC", **POSITIVE, default=lambda own: _without_adc(own, 5.0)
    )
    bits: int = static("-", "resolution of the ADC; 0: none", low=0, high=24, default=0)
    display: tuple = static(
        "-", 'unit in which each sensor shows its reading, "%" or "mA"; "": a level', default=()
    )

    arrays = True

    def reading_of(self, tank: int, level: Any, in_volts: bool = False) -> Any:
        """Return what the sensor of one tank reads of a level, without noise and ends."""
        if self.curve_level is not None and self.curve_reading is not None:
            level = straight_curve(self.curve_level[tank], self.curve_reading[tank], level)
        level = level if self.scale is None else self.scale[tank] * level
        level = level if self.offset is None else level + self.offset[tank]
        return level / self.gain[tank] if in_volts else level

    def level_of(self, tank: int, reading: Any, in_volts: bool = False) -> Any:
        """Return the level of a reading of one tank, the inverse of `reading_of`."""
        level = reading * self.gain[tank] if in_volts else reading
        level = level if self.offset is None else level - self.offset[tank]
        level = level if self.scale is None else level / self.scale[tank]
        if self.curve_level is None or self.curve_reading is None:
            return level
        return straight_curve(self.curve_reading[tank], self.curve_level[tank], level)

    def init(self, x0: Sequence) -> Any:
        return () if self.filter is None else self.read(x0, None)

    def step(self, state: Any, x: Sequence, xi: Sequence | None, dt: Any) -> tuple[Sequence, Any]:
        y = self.read(x, xi)
        if self.filter is None:
            return y, state
        y = each(lambda y, before, T: y + decay(dt, T) * (before - y), y, state, self.filter)
        return y, y

    def read(self, x: Sequence, xi: Sequence | None) -> Sequence:
        """Return the readings of levels, before their filter.

        Parameters
        ----------
        x : (n,) levels [cm]
        xi : (n,) standard normal deviates of the sample [-], or None

        Returns
        -------
        (n,) readings [cm]
        """
        y = x
        if self.curve_level is not None:
            curve = lambda h, levels, readings: straight_curve(levels, readings, h)
            y = each(curve, y, self.curve_level, self.curve_reading)
        y = y if self.scale is None else each(lambda h, scale: scale * h, y, self.scale)
        y = y if self.offset is None else each(lambda h, offset: h + offset, y, self.offset)
        y = y if xi is None else each(lambda h, noise, z: h + noise * z, y, self.noise, xi)
        if self.low is not None:
            y = each(lower_clip, y, self.low)
        if self.high is not None:
            y = each(lambda h, high: -lower_clip(-h, -high), y, self.high)
        if self.bits == 0:
            return y
        if self.low is not None and self.high is not None:
            count = 2**self.bits
            fine = lambda h, low, high: low + quantise(h - low, (high - low) / count)
            return each(fine, y, self.low, self.high)
        full_scale, step = self.full_scale, self.full_scale / 2**self.bits
        return each(
            lambda h, gain: quantise(clip(h / gain, 0.0, full_scale), step) * gain, y, self.gain
        )
