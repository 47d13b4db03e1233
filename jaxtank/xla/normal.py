"""Normal deviates of `jax.random.normal`, to 1e-13, drawn several times as fast on a CPU.

jax lowers its generator (Threefry-2x32, Salmon et al., SC 2011) on the CPU to loops that pass
through memory at each of the 20 rounds (jax 0.10 and 0.11); written out, the rounds are fused with
what follows. Of a deviate most time was `erf_inv`: a logarithm that is not vectorised and three
polynomials of which two are thrown away. Here it is one quotient.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.xla.barrier import materialised

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA
NUMERATOR = (
    0.886226925452758, 0.37295923435619166, 0.1078698275134423, 0.022637047019527286,
    0.003647761505339555, 0.00046946820365559213, 4.880581408985848e-05, 4.129357883818834e-06,
    2.881506695657402e-07, 1.6848303056499265e-08, 8.162288545560231e-10, 2.8444266040380894e-11,
    1.1250333940426505e-12, 1.47361631773671e-14, 3.36185941885605e-17,
)  # fmt: skip
DENOMINATOR = (
    1.0, 0.15904004242427522, 0.06704944343237143, 0.0085519333555328, 0.001566909164122308,
    0.00015512336634086922, 1.5616859359819715e-05, 1.1672049956501198e-06, 7.233280754721521e-08,
    4.107628440791895e-09, 1.5189732595414491e-10, 6.211258667720306e-12, 1.5622160735065302e-13,
    9.175687076560176e-16, 5.53778670617121e-19,
)  # fmt: skip
"""Coefficients of w^0, w^1, ... with NUMERATOR/DENOMINATOR = erf_inv(x)/x at w = -log(1 - x^2) up
to 36: fitted in 60 digits, 7e-17 off.
"""
MIDDLE = 1.0606601717798212
LOGARITHM = (
    0.058891517828191776, 0.9428090415820634, -0.4444444444445185, 0.27935082713549286,
    -0.19753086417802726, 0.14898710778800847, -0.11705532891936679, 0.09459499087149775,
    -0.07803678206128929, 0.06539891250439789, -0.055495923800157096, 0.0475656374133395,
    -0.04105173673162326, 0.035725124861047855, -0.031911396301202634, 0.028092297565652402,
    -0.020511173156318122, 0.0181537015335668, -0.03242235860534481, 0.02903831784149121,
)  # fmt: skip
"""Coefficients of log(m) in powers of m - MIDDLE for m from sqrt(1/2) to sqrt(2), 7e-17 off."""


def normal(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Return jax.random.normal(key, shape) in the default float type, the same to 1e-13."""
    if not is_fast(key):
        return jax.random.normal(key, shape, jnp.result_type(float))
    return normal_at(key, jax.lax.iota(np.uint64, math.prod(shape)).reshape(shape))


def is_fast(key: Any) -> bool:
    """Return whether `normal_at` serves: a key of jax's default generator, float64, a CPU."""
    config: Any = jax.config
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    cpu_float64 = jax.default_backend() == "cpu" and jnp.result_type(float) == jnp.float64
    threefry = typed and str(jax.random.key_impl(key)) == "threefry2x32"
    return cpu_float64 and threefry and bool(config.jax_threefry_partitionable)


def normal_at(key: Any, index: jax.Array) -> jax.Array:
    """Return jax.random.normal(key, shape).ravel() at the places `index` (uint64)."""
    # in a loop of their own 32-bit words take twice the lanes of the 64-bit numbers after them
    first, second = materialised(_blocks(jax.random.key_data(key), index))
    bits = first.astype(jnp.uint64) << 32 | second.astype(jnp.uint64)
    # 52 random bits after the point of a number in [1, 2)
    numbers: Any = jax.lax.bitcast_convert_type(
        bits >> 12 | np.uint64(0x3FF0000000000000), jnp.float64
    )
    low = np.nextafter(-1.0, 0.0)
    uniform = jnp.maximum(low, (numbers - 1.0) * (1.0 - low) + low)
    return math.sqrt(2.0) * erf_inv(uniform)


def erf_inv(x: jax.Array) -> jax.Array:
    """Return the inverse error function of float64 x, -1 < x < 1, to 1e-14 of its value."""
    # a root or a quotient that is used twice would keep XLA from making one loop of all this
    w = -_log((1.0 - x) * (1.0 + x))
    return x * _polynomial(NUMERATOR, w) / _polynomial(DENOMINATOR, w)


def _log(x):
    """Logarithm of normal numbers x > 0, off by 1e-15 at most where x is above 1e-16."""
    half = np.uint64(0x3FE6A09E667F3BCD)  # bits of sqrt(1/2); x = m 2^k, m from there to sqrt(2)
    one = np.uint64(0x3FF0000000000000)
    number: Any = jax.lax.bitcast_convert_type
    bits = number(x, jnp.uint64) + (one - half)
    m = number((bits & np.uint64(0x000FFFFFFFFFFFFF)) + half, jnp.float64)
    k = number(bits >> 52 | np.uint64(0x4330000000000000), jnp.float64) - (2.0**52 + 1023.0)
    return k * math.log(2.0) + _polynomial(LOGARITHM, m - MIDDLE)


def _polynomial(coefficients, x):
    """Sum of coefficients[i] x^i."""
    total = jnp.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def _blocks(key: Any, index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the two words of Threefry-2x32 of each number's index, under a key of two words."""
    schedule = key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(PARITY)
    a = (index >> 32).astype(jnp.uint32) + schedule[0]
    b = index.astype(jnp.uint32) + schedule[1]
    for i in range(5):
        for r in ROTATIONS[i % 2]:
            a = a + b
            b = a ^ (b << jnp.uint32(r) | b >> jnp.uint32(32 - r))
        a = a + schedule[(i + 1) % 3]
        b = b + schedule[(i + 2) % 3] + jnp.uint32(i + 1)
    return a, b
