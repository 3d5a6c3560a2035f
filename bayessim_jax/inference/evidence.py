"""Evidence of several recordings, and recalibration of what came of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.beliefs import GaussianMixture, moment_match
from bayessim_jax.contracts import Scalar

__all__ = ["Recalibration", "combine_evidence", "credible_level", "recalibrate"]


def combine_evidence(each: GaussianMixture, use: Bool[Array, " set"]) -> GaussianMixture:
    """One Gaussian from the posteriors of single recordings, under a proposal of mean 0 and variance 1 on every axis.

    What recording i adds to the proposal is Jᵢ = Λᵢ − I and hᵢ = Λᵢ μᵢ, from the moments of its posterior; directions
    in which it would add negative precision are left out. The product of the evidence is

        Λ = I + Σ Jᵢ,   μ = Λ⁻¹ Σ hᵢ

    Evidence adds up; posteriors are neither averaged nor multiplied with the proposal counted more than once.
    """

    def evidence(mixture: GaussianMixture) -> tuple[Array, Array]:
        mean, tril = moment_match(mixture)
        precision = jax.scipy.linalg.cho_solve((tril, True), jnp.eye(mean.size))
        values, axes = jnp.linalg.eigh(precision)
        added = jnp.maximum(values - 1.0, 0.0)
        weighed = jnp.where(added > 0, values * (axes.T @ mean), 0.0)
        return (axes * added) @ axes.T, axes @ weighed

    j, h = jax.vmap(evidence)(each)
    precision = jnp.eye(h.shape[-1]) + jnp.where(use[:, None, None], j, 0.0).sum(0)
    covariance = jnp.linalg.inv(precision)
    mean = covariance @ jnp.where(use[:, None], h, 0.0).sum(0)
    return GaussianMixture(jnp.zeros(1), mean[None], jnp.linalg.cholesky(covariance)[None])


@struct.dataclass
class Recalibration:
    """A correction of a posterior in the coordinates that its own moments whiten: a shift and a stretch."""

    shift: Float[Array, " d"]
    stretch: Float[Array, "d d"]
    """Lower triangular."""

    @classmethod
    def none(cls, d: int) -> Recalibration:
        """The identity."""
        return cls(jnp.zeros(d), jnp.eye(d))

    def apply(self, mixture: GaussianMixture) -> GaussianMixture:
        """θ ↦ μ + L (shift + stretch L⁻¹ (θ − μ)), with μ and L Lᵀ the mean and covariance of the mixture."""
        mean, tril = moment_match(mixture)
        inverse = jax.scipy.linalg.solve_triangular(tril, jnp.eye(mean.size), lower=True)
        linear = tril @ self.stretch @ inverse
        return GaussianMixture(
            mixture.log_weights,
            mean + tril @ self.shift + (mixture.means - mean) @ linear.T,
            linear @ mixture.scale_trils,
        )


def recalibrate(mixtures: GaussianMixture, truths: Float[Array, "n d"]) -> Recalibration:
    """The correction that makes held-out truths look like draws of their posteriors.

    r = L⁻¹ (θ − μ) of a calibrated posterior has mean zero and covariance I, and ‖r‖² has the quantiles of χ²(d). The
    shift is the median of r; the stretch has the shape of the covariance of r, shrunk towards isotropy, and the size at
    which the quantiles at 50 % and 90 % agree (geometric mean of their ratios). Both are shrunk towards no correction
    by a few pseudo-observations, the stretch covers the error of the shift, and it never narrows:
    a mixture with a sharp core and wide tails has small quantiles without being too wide.
    """

    def whiten(mixture: GaussianMixture, truth: Array) -> Array:
        mean, tril = moment_match(mixture)
        return jax.scipy.linalg.solve_triangular(tril, truth - mean, lower=True)

    n, d = truths.shape
    r = jnp.clip(jax.vmap(whiten)(mixtures, truths), -50.0, 50.0)
    shift = n / (n + 10.0) * jnp.median(r, axis=0)
    centred = r - shift
    bounded = (
        centred * jnp.minimum(1.0, 3.0 * jnp.sqrt(d) / jnp.maximum(jnp.linalg.norm(centred, axis=-1), 1e-6))[:, None]
    )
    covariance = bounded.T @ bounded / n
    size = jnp.trace(covariance) / d
    shape = (n * covariance + 10.0 * size * jnp.eye(d)) / (n + 10.0)
    tril = jnp.linalg.cholesky(shape + 1e-6 * jnp.eye(d))
    tril = tril / jnp.exp(jnp.log(jnp.diagonal(tril)).mean())
    squared = (jax.scipy.linalg.solve_triangular(tril, centred.T, lower=True) ** 2).sum(0)
    levels = jnp.array([0.5, 0.9])
    log_ratio = 0.5 * (jnp.log(jnp.quantile(squared, levels)) - jnp.log(_chi2_quantile(levels, d))).mean()
    factor = jnp.exp(n / (n + 10.0) * jnp.maximum(log_ratio, 0.0)) * jnp.sqrt(1.0 + 1.0 / n)
    sound = jnp.isfinite(factor) & jnp.isfinite(shift).all() & jnp.isfinite(tril).all()
    plain = Recalibration.none(d)
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), Recalibration(shift, factor * tril), plain)


def _chi2_quantile(levels: Float[Array, " n"], d: int) -> Float[Array, " n"]:
    """Quantiles of χ²(d) by bisection of the regularized incomplete gamma function."""

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = 0.5 * (low + high)
        below = jax.scipy.special.gammainc(d / 2, middle / 2) < levels
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, 40, halve, (jnp.zeros_like(levels), jnp.full_like(levels, 10.0 * d + 20.0)))
    return 0.5 * (low + high)


def credible_level(
    key: PRNGKeyArray, mixtures: GaussianMixture, truths: Float[Array, "n d"], draws: int = 128
) -> Float[Array, " n"]:
    """Smallest highest-density credible level that holds the truth, estimated from draws; uniform if calibrated."""

    def one(key: PRNGKeyArray, mixture: GaussianMixture, truth: Array) -> Scalar:
        samples = jax.vmap(mixture.sample)(jax.random.split(key, draws))
        return (jax.vmap(mixture.log_prob)(samples) > mixture.log_prob(truth)).mean()

    return jax.vmap(one)(jax.random.split(key, truths.shape[0]), mixtures, truths)
