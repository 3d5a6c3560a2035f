"""The standard normal on an interval, without underflow: its log mass and its quantiles.

Intervals are mirrored to the negative side first, where the distribution function keeps its digits. Three regimes meet
where they agree to rounding: the body; an interval that starts more than 10 standard deviations out, by Mills' ratio;
and one narrower than 0.02, where the density is an exponential.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.special import erfc, ndtri
from jaxtyping import Array, Bool

from bayessim_jax.contracts import Scalar

__all__ = ["log_mass", "quantile"]

_NARROW, _FAR = 0.02, -10.0


@jax.custom_jvp
def log_mass(low: Scalar, high: Scalar) -> Scalar:
    """The log of Φ(high) − Φ(low), for low < high."""
    left, right, _ = _mirror(low, high)
    width, slope = right - left, -0.5 * (left + right) * (right - left)
    under, over = _below(left), _below(-jnp.abs(right))
    body = jnp.log(jnp.where(right > 0, 1 - under - over, over - under))
    far = _log_density(right) + jnp.log(_mills(right) - jnp.exp(-slope) * _mills(left))
    steep = 0.5 * slope + jnp.log(-jnp.expm1(-slope) / slope)
    narrow = _log_density(0.5 * (left + right)) + jnp.log(width) - width**2 / 24
    narrow = narrow + jnp.where(slope < 0.1, slope**2 / 24, steep)
    return jnp.where(width < _NARROW, narrow, jnp.where(right < _FAR, far, body))


@log_mass.defjvp
def _log_mass_jvp(primals: Any, tangents: Any) -> Any:
    (low, high), (d_low, d_high) = primals, tangents
    mass = log_mass(low, high)
    return mass, jnp.exp(_log_density(high) - mass) * d_high - jnp.exp(_log_density(low) - mass) * d_low


@jax.custom_jvp
def quantile(u: Scalar, low: Scalar, high: Scalar) -> tuple[Scalar, Scalar]:
    """The z in [low, high] below which a share u of the interval's mass lies, and (z − low)/(high − low).

    The fraction keeps its digits close to the bound that the mass crowds at, where low + fraction · width would
    round z.
    """
    left, right, mirrored = _mirror(low, high)
    width, slope = right - left, -0.5 * (left + right) * (right - left)
    below, above = jnp.where(mirrored, 1 - u, u), jnp.where(mirrored, u, 1 - u)

    under, over = _below(left), _below(-jnp.abs(right))
    mass = jnp.where(right > 0, 1 - under - over, over - under)
    from_left, from_right = under + below * mass, jnp.where(right > 0, over, 1 - over) + above * mass
    body = ndtri(jnp.minimum(from_left, from_right)) * jnp.where(from_left < from_right, 1.0, -1.0)
    body = jnp.clip(body, left, right)

    distance, mills = jnp.abs(right), _mills(right)
    energy = -jnp.log1p(above * (jnp.exp(-slope) * _mills(left) / mills - 1))
    step = 2 * energy / (distance + jnp.sqrt(distance**2 + 2 * energy))
    energy = jnp.maximum(energy + jnp.log(_mills(right - step) / mills), 0.0)
    far = 2 * energy / (distance + jnp.sqrt(distance**2 + 2 * energy)) / width

    narrow = -jnp.log1p(above * jnp.expm1(-slope)) / slope
    narrow = jnp.where(slope < 1e-2, above - 0.5 * slope * above * below, narrow)

    close = (width < _NARROW) | (right < _FAR)
    short = jnp.where(width < _NARROW, narrow, jnp.where(right < _FAR, far, (right - body) / width))
    short = jnp.clip(short, 0.0, 1.0)
    z = jnp.where(close, right - short * width, body)
    return jnp.where(mirrored, -z, z), jnp.where(mirrored, short, 1 - short)


@quantile.defjvp
def _quantile_jvp(primals: Any, tangents: Any) -> Any:
    (u, low, high), (d_u, d_low, d_high) = primals, tangents
    z, fraction = quantile(u, low, high)
    at_low, at_high = jnp.exp(0.5 * (z - low) * (z + low)), jnp.exp(0.5 * (z - high) * (z + high))
    d_z = (1 - u) * at_low * d_low + u * at_high * d_high + jnp.exp(log_mass(low, high) - _log_density(z)) * d_u
    d_fraction = (d_z - (1 - fraction) * d_low - fraction * d_high) / (high - low)
    return (z, fraction), (d_z, d_fraction)


def _mirror(low: Scalar, high: Scalar) -> tuple[Scalar, Scalar, Bool[Array, ""]]:
    mirrored = low + high > 0
    return jnp.where(mirrored, -high, low), jnp.where(mirrored, -low, high), mirrored


def _log_density(z: Scalar) -> Scalar:
    return -0.5 * z**2 - 0.5 * math.log(2 * math.pi)


def _below(z: Scalar) -> Scalar:
    """Φ(z) for z ≤ 0."""
    return 0.5 * erfc(-z * math.sqrt(0.5))


def _mills(z: Scalar) -> Scalar:
    """Φ(z)/φ(z) far out on the negative side, from its asymptotic series."""
    return (1 - z**-2 + 3 * z**-4) / -z
