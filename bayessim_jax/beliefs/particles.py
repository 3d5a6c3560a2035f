"""Weighted particles: a belief without a form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs.mixture import GaussianMixture, moment_match
from bayessim_jax.contracts import Scalar

__all__ = ["Particles"]


@struct.dataclass
class Particles:
    """N positions in raw units of θ with weights wᵢ ∝ exp(log_weights).

    As a belief it is the Gaussian kernel density on them, Σᵢ wᵢ N(θ; θᵢ, h² Σ), with Σ the particles' covariance and
    Silverman's bandwidth h = (4/((d + 2) n))^(1/(d + 4)) for n effective particles. `sample` and `log_prob` are that
    density; `mean`, `covariance` and `resample` are the bare particles'.

    Source: Silverman 1986
    """

    positions: Float[Array, "particles d"]
    log_weights: Float[Array, " particles"]

    @property
    def weights(self) -> Float[Array, " particles"]:
        """Normalized weights wᵢ."""
        return jax.nn.softmax(self.log_weights)

    def kernels(self) -> GaussianMixture:
        """The kernel density, as a mixture with one component for each particle."""
        n, d = self.positions.shape
        bare = GaussianMixture(self.log_weights, self.positions, jnp.zeros((n, d, d), self.positions.dtype))
        _, spread = moment_match(bare)
        bandwidth = (4 / ((d + 2) * self.effective_sample_size())) ** (1 / (d + 4))
        return GaussianMixture(self.log_weights, self.positions, jnp.broadcast_to(bandwidth * spread, (n, d, d)))

    def sample(self, key: PRNGKeyArray) -> Float[Array, " d"]:
        """One draw of θ: a particle by its weight, and noise of the kernel."""
        return self.kernels().sample(key)

    def log_prob(self, theta: Float[Array, " d"]) -> Scalar:
        """Normalized log density of the kernels in raw units."""
        return self.kernels().log_prob(theta)

    def mean(self) -> Float[Array, " d"]:
        """E θ = Σᵢ wᵢ θᵢ."""
        return self.weights @ self.positions

    def covariance(self) -> Float[Array, "d d"]:
        """Cov θ = Σᵢ wᵢ (θᵢ − E θ)(θᵢ − E θ)ᵀ; the kernel density's is (1 + h²) times as large."""
        gap = self.positions - self.mean()
        return jnp.einsum("n,ni,nj->ij", self.weights, gap, gap)

    def effective_sample_size(self) -> Scalar:
        """1/Σᵢ wᵢ²: N where all weigh the same, 1 where one particle holds everything.

        Source: Kong, Liu and Wong 1994
        """
        return 1 / (self.weights**2).sum()

    def resample(self, key: PRNGKeyArray) -> Particles:
        """As many particles of equal weight; particle i is kept ⌊N wᵢ⌋ or ⌈N wᵢ⌉ times (systematic resampling).

        Source: Kitagawa 1996
        """
        n = self.log_weights.size
        ladder = jnp.cumsum(self.weights)
        rungs = (jnp.arange(n) + jax.random.uniform(key, (), ladder.dtype)) / n
        index = jnp.minimum(jnp.searchsorted(ladder / ladder[-1], rungs, side="right"), n - 1)
        return Particles(self.positions[index], jnp.zeros_like(self.log_weights))
