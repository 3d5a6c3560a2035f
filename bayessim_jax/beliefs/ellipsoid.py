"""The uniform law on an ellipsoid, as far as it lies in a box."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.beliefs.box_probability import lattice
from bayessim_jax.beliefs.triangular import solve_lower
from bayessim_jax.chance import normal, pick
from bayessim_jax.contracts import Box, Scalar

__all__ = ["Ellipsoid"]

_CANDIDATES = 32
_DIRECTIONS = 512


@struct.dataclass
class Ellipsoid:
    """p(θ) = 1/V on {θ ∈ box : |L⁻¹ (θ − m)| ≤ 1}, and zero elsewhere. Make one with `create`.

    The centre m lies in the box, and both are convex: from m a direction v = L u, |u| = 1, leads inside for a length
    t(u) ≤ 1, so that V = V_d |L| E tᵈ over even directions, with V_d the volume of the unit ball.
    """

    box: Box
    center: Float[Array, " d"]
    scale_tril: Float[Array, "d d"]
    """L: half-axes, turned; those of ±1 along the diagonal."""
    whole: Bool[Array, ""]
    """It is the box itself, whatever center and scale_tril say."""
    log_volume: Scalar
    first: Float[Array, " d"]
    second: Float[Array, "d d"]
    """Mean and covariance of p."""

    @classmethod
    def create(
        cls,
        center: Float[Array, " d"],
        scale_tril: Float[Array, "d d"],
        box: Box,
        whole: bool | Bool[Array, ""] = False,
    ) -> Ellipsoid:
        """The ellipsoid with centre m in the box and half-axes L; the box itself where `whole` is true."""
        d, whole = box.size, jnp.asarray(whole)
        ahead = _directions(lattice(_DIRECTIONS, d))
        steps, lengths = jax.vmap(lambda u: _inside(center, scale_tril, box, u))(jnp.concatenate([ahead, -ahead]))
        volumes = lengths**d
        weights = volumes / volumes.sum()
        ball = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1)
        log_volume = ball + jnp.log(jnp.diagonal(scale_tril)).sum() + jnp.log(volumes.mean())
        # along a direction the density of the length s grows as s^(d − 1)
        drift = d / (d + 1) * weights @ steps
        around = d / (d + 2) * jnp.einsum("n,ni,nj->ij", weights, steps, steps) - jnp.outer(drift, drift)
        return cls(
            box,
            center,
            scale_tril,
            whole,
            jnp.where(whole, jnp.log(box.width).sum(), log_volume),
            jnp.where(whole, 0.5 * (box.low + box.high), center + drift),
            jnp.where(whole, jnp.diag(box.width**2 / 12), around),
        )

    def sample(self, key: PRNGKeyArray) -> Float[Array, " d"]:
        """One draw of θ: one of 32 even directions by tᵈ, then the length along it; strictly inside the box."""
        d, low, high = self.box.size, self.box.low, self.box.high
        draws = jax.random.uniform(key, (2 * d + 2,), low.dtype, minval=1e-7)
        shift, flat, (kept, along) = draws[:d], draws[d : 2 * d], draws[2 * d :]
        u = _directions(jnp.mod(lattice(_CANDIDATES, d) + shift, 1.0))
        steps, lengths = jax.vmap(lambda v: _inside(self.center, self.scale_tril, self.box, v))(u)
        theta = self.center + along ** (1 / d) * steps[pick(kept, d * jnp.log(lengths))]
        theta = jnp.where(self.whole, low + flat * self.box.width, theta)
        return jnp.clip(theta, jnp.nextafter(low, high), jnp.nextafter(high, low))

    def log_prob(self, theta: Float[Array, " d"]) -> Scalar:
        """Normalized log density in raw units; −∞ outside the ellipsoid or the box."""
        white = solve_lower(self.scale_tril, theta - self.center)
        edge = 1 + 64 * jnp.finfo(white.dtype).eps
        inside = self.box.contains(theta) & (self.whole | ((white**2).sum() <= edge))
        return jnp.where(inside, -self.log_volume, -jnp.inf)

    def mean(self) -> Float[Array, " d"]:
        """E θ of the part in the box."""
        return self.first

    def covariance(self) -> Float[Array, "d d"]:
        """Cov θ of the part in the box."""
        return self.second


def _directions(u: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Unit vectors, even over the sphere where u is even in the cube."""
    edge = jnp.finfo(u.dtype).eps
    z = normal(u.clip(edge, 1 - edge))
    return z / jnp.sqrt((z**2).sum(1, keepdims=True) + jnp.finfo(u.dtype).tiny)


def _inside(center: Array, scale_tril: Array, box: Box, u: Array) -> tuple[Float[Array, " d"], Scalar]:
    """The way t L u from the centre to where the ellipsoid or the box ends, and t."""
    step = scale_tril @ u
    tiny = jnp.finfo(step.dtype).tiny
    room = jnp.where(step > 0, box.high - center, center - box.low)
    length = jnp.minimum((room / jnp.maximum(jnp.abs(step), tiny)).min(), 1.0).clip(tiny)
    return length * step, length
