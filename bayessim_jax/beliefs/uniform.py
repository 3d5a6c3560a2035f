"""The uniform belief: nothing is known but the bounds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Scalar

__all__ = ["Uniform"]


@struct.dataclass
class Uniform:
    """p(θ) = 1/∏ᵢ(highᵢ − lowᵢ) inside the box, 0 outside."""

    box: Box

    def sample(self, key: PRNGKeyArray) -> Float[Array, " d"]:
        """One draw of θ, strictly inside the box."""
        low, high = self.box.low, self.box.high
        theta = low + self.box.width * jax.random.uniform(key, low.shape, low.dtype)
        return jnp.clip(theta, jnp.nextafter(low, high), jnp.nextafter(high, low))

    def log_prob(self, theta: Float[Array, " d"]) -> Scalar:
        """Normalized log density in raw units; −∞ outside the box."""
        return jnp.where(self.box.contains(theta), -jnp.log(self.box.width).sum(), -jnp.inf)

    def mean(self) -> Float[Array, " d"]:
        """E θ, the centre of the box."""
        return 0.5 * (self.box.low + self.box.high)

    def covariance(self) -> Float[Array, "d d"]:
        """Cov θ = diag(width²/12)."""
        return jnp.diag(self.box.width**2 / 12)
