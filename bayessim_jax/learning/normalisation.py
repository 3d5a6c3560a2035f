"""Scaling of what a network sees: fixed, from the box of the observations, or from what was seen so far."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.contracts import Box, Scalar

__all__ = ["Moments", "Scaling"]


@struct.dataclass
class Scaling:
    """n = clip((y − shift) / scale, ±10), dimensionless; a box maps onto [−1, 1]."""

    shift: Float[Array, " obs"]
    scale: Float[Array, " obs"]

    @classmethod
    def from_box(cls, box: Box) -> Scaling:
        """Centre and half-width of a box; axes without finite bounds stay as they are."""
        bounded = jnp.isfinite(box.width)
        return cls(
            shift=jnp.where(bounded, (box.low + box.high) / 2, 0.0),
            scale=jnp.where(bounded, box.width / 2, 1.0),
        )

    def normalise(self, observation: Float[Array, "*batch obs"]) -> Float[Array, "*batch obs"]:
        """Scaled observations, without unit."""
        return jnp.clip((observation - self.shift) / self.scale, -10.0, 10.0)


@struct.dataclass
class Moments:
    """Number, mean and mean square deviation of everything seen so far.

    Source: Chan, Golub and LeVeque 1983
    """

    count: Scalar
    mean: Float[Array, " obs"]
    variance: Float[Array, " obs"]

    @classmethod
    def create(cls, size: int) -> Moments:
        """Nothing seen."""
        return cls(jnp.zeros(()), jnp.zeros(size), jnp.zeros(size))

    def add(self, rows: Float[Array, "rows obs"]) -> Moments:
        """Take more rows in."""
        new, total = rows.shape[0], self.count + rows.shape[0]
        mean, variance = rows.mean(0), rows.var(0)
        share, gap = new / total, mean - self.mean
        spread = (1.0 - share) * self.variance + share * variance + share * (1.0 - share) * gap**2
        return Moments(total, self.mean + share * gap, spread)

    def scaling(self, least: float = 1e-2) -> Scaling:
        """Mean and standard deviation, which is `least` at least; before anything was seen, 0 and 1."""
        return Scaling(self.mean, jnp.where(self.count > 0, jnp.maximum(jnp.sqrt(self.variance), least), 1.0))
