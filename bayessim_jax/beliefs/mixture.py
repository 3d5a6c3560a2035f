"""The Gaussian mixture: what an estimator returns, and what the algebra of the proposal correction works on."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs.triangular import factor
from bayessim_jax.chance import draw, normal, pick
from bayessim_jax.contracts import Scalar

if TYPE_CHECKING:
    import distrax

__all__ = ["GaussianMixture", "moment_match"]


@struct.dataclass
class GaussianMixture:
    """Σₖ αₖ N(θ; μₖ, Lₖ Lₖᵀ) with αₖ ∝ exp(log_weights), in the units of θ.

    `log_weights` need not be normalized: every method normalizes them, and after `product` their log-sum-exp is the
    mass ∫ a b. `scale_trils` are lower triangular with a positive diagonal.
    """

    log_weights: Float[Array, " components"]
    means: Float[Array, "components d"]
    scale_trils: Float[Array, "components d d"]

    @property
    def weights(self) -> Float[Array, " components"]:
        """Normalized weights αₖ."""
        return jax.nn.softmax(self.log_weights)

    def distribution(self) -> distrax.MixtureSameFamily:
        """The same law as a distrax distribution."""
        # imported late: a diagnosis takes none, and it takes half a second
        with warnings.catch_warnings(), jax.ensure_compile_time_eval():
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            import distrax

        return distrax.MixtureSameFamily(
            distrax.Categorical(logits=self.log_weights),
            distrax.MultivariateNormalTri(self.means, self.scale_trils),
        )

    def sample(self, key: PRNGKeyArray) -> Float[Array, " d"]:
        """One draw of θ."""
        return self.made_of(draw(key, (1 + self.means.shape[1],), self.means.dtype))

    def made_of(self, uniform: Float[Array, " 1+d"]) -> Float[Array, " d"]:
        """The draw of θ that independent uniform numbers in (0, 1) give."""
        index = pick(uniform[0], self.log_weights)
        return self.means[index] + self.scale_trils[index] @ normal(uniform[1:])

    def log_prob(self, theta: Float[Array, " d"]) -> Scalar:
        """Normalized log density, differentiable in θ and in every leaf."""
        return jnp.asarray(self.distribution().log_prob(theta))

    def mean(self) -> Float[Array, " d"]:
        """E θ = Σₖ αₖ μₖ."""
        return self.weights @ self.means

    def covariance(self) -> Float[Array, "d d"]:
        """Cov θ = Σₖ αₖ (Lₖ Lₖᵀ + (μₖ − E θ)(μₖ − E θ)ᵀ)."""
        spread = self.means - self.mean()
        within = jnp.einsum("k,kij,klj->il", self.weights, self.scale_trils, self.scale_trils)
        return within + jnp.einsum("k,ki,kj->ij", self.weights, spread, spread)

    def marginal(self, axes: tuple[int, ...]) -> GaussianMixture:
        """The law of the named axes of θ, in the order given."""
        index = jnp.array(axes)
        trils = jax.vmap(factor)(self.scale_trils[:, index])
        return GaussianMixture(self.log_weights, self.means[:, index], trils)

    def affine(self, shift: Float[Array, " d"], scale: Float[Array, " d"]) -> GaussianMixture:
        """The law of shift + scale · z, axis by axis, where this mixture is the law of z; no scale may be zero."""
        sign = jnp.where(scale < 0, -1.0, 1.0)
        trils = scale[:, None] * self.scale_trils * sign[None, :]
        return GaussianMixture(self.log_weights, shift + scale * self.means, trils)

    def widen(self, factor: float | Scalar) -> GaussianMixture:
        """The law of E θ + factor · (θ − E θ)."""
        mean = self.mean()
        return GaussianMixture(self.log_weights, mean + factor * (self.means - mean), factor * self.scale_trils)


def moment_match(mixture: GaussianMixture) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """The Gaussian with the mixture's mean and covariance, as (mean, scale_tril): the nearest one in KL(mixture‖·)."""
    mean, root = mixture.mean(), jnp.sqrt(mixture.weights)
    within = jnp.moveaxis(root[:, None, None] * mixture.scale_trils, 0, 1).reshape(mean.size, -1)
    between = (root[:, None] * (mixture.means - mean)).T
    return mean, factor(jnp.concatenate([within, between], axis=1))
