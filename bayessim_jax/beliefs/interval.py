"""The standard normal on an interval, without underflow: its log mass and its quantiles.

Three regimes, joined where they agree to rounding: an interval narrower than 0.02 (the density is an exponential
there), one that starts more than 10 standard deviations out (Mills' ratio), and the body. Intervals are mirrored to
the negative side first, where the distribution function keeps its digits.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, ndtr, ndtri
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar

__all__ = ["log_mass", "quantile"]

_NARROW, _FAR = 0.02, -10.0


@jax.custom_jvp
def log_mass(low: Scalar, high: Scalar) -> Scalar:
    """log(Φ(high) − Φ(low)) for low < high."""
    left, right, _ = _mirror(low, high)
    width = right - left
    gap = jnp.minimum(log_ndtr(left) - log_ndtr(right), -jnp.finfo(width.dtype).tiny)
    wide = log_ndtr(right) + jnp.log(-jnp.expm1(gap))
    middle = 0.5 * (left + right)
    slope = -middle * width
    steep = 0.5 * slope + jnp.log(-jnp.expm1(-slope)) - jnp.log(slope)
    bend = jnp.where(slope < 0.1, slope**2 / 24, steep) - width**2 / 24
    return jnp.where(width < _NARROW, _log_density(middle) + jnp.log(width) + bend, wide)


@log_mass.defjvp
def _log_mass_jvp(primals: Any, tangents: Any) -> Any:
    (low, high), (d_low, d_high) = primals, tangents
    mass = log_mass(low, high)
    return mass, jnp.exp(_log_density(high) - mass) * d_high - jnp.exp(_log_density(low) - mass) * d_low


@jax.custom_jvp
def quantile(u: Scalar, low: Scalar, high: Scalar) -> tuple[Scalar, Scalar]:
    """z in [low, high] below which a share u of the interval's mass lies, and (z − low)/(high − low).

    The fraction keeps its digits close to the bound that the mass crowds at, where low + fraction · width would
    round z.
    """
    left, right, mirrored = _mirror(low, high)
    width = right - left
    below = jnp.where(mirrored, 1 - u, u)
    above = jnp.where(mirrored, u, 1 - u)

    mass = jnp.exp(log_mass(left, right))
    from_left, from_right = ndtr(left) + below * mass, ndtr(-right) + above * mass
    body = jnp.where(from_left < from_right, ndtri(from_left), -ndtri(from_right))
    body = jnp.clip(body, left, right)

    distance = jnp.abs(right)
    energy = -jnp.log1p(above * jnp.expm1(jnp.minimum(log_ndtr(left) - log_ndtr(right), 0.0)))
    step = 2 * energy / (distance + jnp.sqrt(distance**2 + 2 * energy))
    energy = jnp.maximum(energy - jnp.log1p(step / distance) + distance**-2 - (distance + step) ** -2, 0.0)
    far = 2 * energy / (distance + jnp.sqrt(distance**2 + 2 * energy)) / width

    slope = -0.5 * (left + right) * width
    narrow = -jnp.log1p(above * jnp.expm1(-slope)) / slope
    narrow = jnp.where(slope < 1e-2, above - 0.5 * slope * above * below, narrow)

    short = jnp.where(width < _NARROW, narrow, jnp.where(right < _FAR, far, (right - body) / width))
    short = jnp.clip(short, 0.0, 1.0)
    z = jnp.where((width < _NARROW) | (right < _FAR), right - short * width, body)
    return jnp.where(mirrored, -z, z), jnp.where(mirrored, short, 1 - short)


@quantile.defjvp
def _quantile_jvp(primals: Any, tangents: Any) -> Any:
    (u, low, high), (d_u, d_low, d_high) = primals, tangents
    z, fraction = quantile(u, low, high)
    at_low, at_high = jnp.exp(0.5 * (z - low) * (z + low)), jnp.exp(0.5 * (z - high) * (z + high))
    d_z = (1 - u) * at_low * d_low + u * at_high * d_high + jnp.exp(log_mass(low, high) - _log_density(z)) * d_u
    d_fraction = (d_z - (1 - fraction) * d_low - fraction * d_high) / (high - low)
    return (z, fraction), (d_z, d_fraction)


def _mirror(low: Scalar, high: Scalar) -> tuple[Scalar, Scalar, Array]:
    mirrored = low + high > 0
    return jnp.where(mirrored, -high, low), jnp.where(mirrored, -low, high), mirrored


def _log_density(z: Float[Array, "..."]) -> Float[Array, "..."]:
    return -0.5 * z**2 - 0.5 * jnp.log(2 * jnp.pi)
